"""`armwright demo two-arms`: a mock pair calibrates itself where its tips touch, without a camera.

The run has no access to the hidden errors: contacts reach it as the joint angles of both arms in a file. Only the circle is
measured by the truth, as an outside camera would.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import combinations, islice
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from calib.arm_problem.arm_model import ArmModel
from calib.arrays import Array, frozen, norms
from calib.closed_chain import planning
from calib.closed_chain.calibrate import PairFound, calibrate_pair, calibrated_cell, contact_errors_m, pair_text, write_pair
from calib.closed_chain.conduct import conduct, contact_plan
from calib.closed_chain.pair_problem import Contacts, PairPlan, read_contacts
from calib.design.planning import short_path
from calib.errors import CalibrationError
from calib.identify.determinability import open_in_words
from calib.report.page import (
    AFTER,
    BEFORE,
    PLANNED,
    Section,
    bullets,
    label_plane,
    list_section,
    page,
    pair,
    paragraph,
    svg,
    table,
    tiles,
    verdict,
)
from calib.report.pictures import path_picture
from calib.report.report import dh_section
from calib.results import input_file, made_today
from calib.session.conversation import Recorded, unattended
from calib.session.folder import POINTS, SessionFolder
from calib.validation.verify import Track, TrackPair
from control.files import write_whole
from control.kinematics.inverse import InverseKinematics
from control.kinematics.kinematics import Corners
from control.model.cell import Cell, Placed, load_cell, save_cell
from control.model.description import load_arm
from control.motion.plan import PlannedPath, plan_path
from control.motion.waypoints import Waypoints
from control.plain_text import Advance
from control.recording.reading import Recording
from hil_mocks.scenario import load_scenario
from procedures.mock import CellBench, as_bolted_down
from procedures.mock_session import MockPairHand, pair_station

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


BAR_m = 0.1  # known distance: a bar between the tips
FITTED, CHECKED = 40, 12  # contacts for the calibration, and others to judge it
CHECK_SEED = 0


@dataclass(frozen=True, slots=True)
class PairOutcome:
    """What was found. Errors [m] of contacts that were not used: as the files say, bases placed alone, calibrated."""

    cell: Cell
    plan: planning.ContactPlan
    found: PairFound
    by_files_m: Array
    placed_m: Array
    calibrated_m: Array
    fitted: Contacts
    checked: Contacts
    circle: TrackPair
    files: dict[str, Path]


def run(cell: Cell, scenario_file: Path, out: Path, advance: Advance) -> PairOutcome:
    """Run everything on a mock of the cell; results are in the folder `out`."""
    names = planning.pair_of(cell)
    scenario = load_scenario(scenario_file)
    advance("planning contacts", 0.0)
    plan = planning.plan_contacts(cell, names, (0.0, BAR_m), FITTED)
    planning.write_contacts(out / "planned.csv", plan.chosen.contacts)
    bench = CellBench(as_bolted_down(cell, scenario.seed), scenario, out / "log")
    try:
        advance("homing", 0.02)
        with _homed(cell, names, bench) as pair:
            before = pair.circle_beside()
            _take(pair, plan, out, advance)
        advance("identification", 0.8)
        fitted, checked = (read_contacts(out / name / POINTS, plan.arms)[0] for name in ("contacts", "check"))
        identification = calibrate_pair(plan.arms, fitted, PairPlan())
        calibrated = _written(cell, names, plan, identification, out)
        advance("circle, after", 0.9)
        with _homed(calibrated, names, bench) as pair:
            after = pair.circle_beside()
    finally:
        bench.close()
    base = planning.base_of(cell, (cell.names[0], cell.names[1]))
    placed = calibrate_pair(plan.arms, fitted, PairPlan(fixed=_geometry(identification)))
    files = {
        "contacts": out / "contacts" / POINTS,
        "calibrated cell": out / "calibrated" / f"{cell.name}.cell.toml",
        "recordings": out / "log",
    }
    return PairOutcome(
        cell,
        plan,
        identification,
        contact_errors_m(plan.arms, base, checked),
        contact_errors_m(placed.arms, placed.base, checked),
        contact_errors_m(identification.arms, identification.base, checked),
        fitted,
        checked,
        TrackPair(before.name, "", before, after),
        files,
    )


@contextmanager
def _homed(cell: Cell, names: tuple[str, str], bench: CellBench) -> Iterator[MockPair]:
    """The pair on a runtime that knows `cell`: homed at first, at its rest poses and off in the end."""
    bench.home(cell)
    pair = MockPair(cell, names, bench)
    yield pair
    pair.go(pair.room.rest_rad)  # from which they hardly sink when the drives go off
    bench.stop()


def _take(pair: MockPair, plan: planning.ContactPlan, out: Path, advance: Advance) -> None:
    """Record the planned contacts in one session, and some others, which the calibration does not get, in another."""
    rest = len(plan.others.contacts)
    rows = np.random.default_rng(CHECK_SEED).permutation(rest)[:CHECKED].tolist()
    hand, done = MockPairHand(pair.cell, pair.names, pair.bench), 0
    for name, wanted in (("contacts", plan.chosen), ("check", plan.others.chosen(rows))):
        station = pair_station(pair.cell, pair.names, pair.bench.clients, 1.0, 0.0, hand)
        ordered = wanted.contacts.chosen(in_order(wanted, station.room))
        with SessionFolder(out / name, contact_plan(pair.names, "demo", ordered, "hand")) as folder:
            for saying in unattended(conduct(folder, station)):
                if isinstance(saying, Recorded):
                    done += 1
                    advance(f"contact {saying.record.point}", 0.1 + 0.7 * done / (FITTED + CHECKED))


def _geometry(identification: PairFound) -> list[str]:
    """The names of all parameters but the second base's."""
    return [one.parameter.name for one in identification.estimates if one.parameter.has_bound]


def _written(cell: Cell, names: tuple[str, str], plan: planning.ContactPlan, identification: PairFound, out: Path) -> Cell:
    """Both arms, pair.json and the calibrated cell as files; the cell as loaded from them."""
    folder, made = out / "pair", made_today(input_file(out / "contacts" / POINTS, "contacts"))
    folder.mkdir()
    write_pair(folder, plan.arms, identification, "huber", made)
    write_whole(folder / "pair.txt", pair_text(plan.arms, identification) + "\n")
    first, second = (load_arm(str(folder / f"{name}.toml")) for name in names)
    (out / "calibrated").mkdir()
    return load_cell(save_cell(calibrated_cell(cell, (first, second), identification.base), out / "calibrated"))


# What the two arms of the demo do: touch each other at planned contacts, and draw a circle relative to the other's tip.
DETOUR_rad = 4.0  # what a way by the rest poses costs
RADIUS_m = 0.05
CENTRE_m = (0.0, -0.11, 0.0)  # of the circle from the other tip, in the frame of the cell; it stands upright before that tip
WAYPOINTS = 16
SAMPLE_s = 0.01
TURNS = 20  # steps to the best turn
HELD_m = (0.4, 0.06, 0.4)  # where the first tip holds meanwhile, in the frame of the cell


def in_order(planned: planning.Candidates, room: planning.SharedRoom) -> list[int]:
    """The order of the contacts from the rest poses with little joint travel, and few detours."""
    here_rad = room.rest_rad
    both = np.hstack((planned.first_away_rad, planned.second_away_rad))
    places = [here_rad, *zip(planned.first_away_rad.tolist(), planned.second_away_rad.tolist(), strict=True)]
    q = np.vstack((np.concatenate(here_rad), both))
    ways = np.abs(q[:, None] - q[None, :]).max(axis=2)
    for i, j in combinations(range(len(q)), 2):
        if not room.is_way_clear(places[i], places[j]):
            ways[i, j] = ways[j, i] = ways[i, j] + DETOUR_rad
    return [k - 1 for k in short_path(ways)[1:]]


class MockPair:
    """The two arms of a mock cell on a runtime that knows `cell`."""

    def __init__(self, cell: Cell, names: tuple[str, str], bench: CellBench) -> None:
        self.cell, self.names, self.bench = cell, names, bench
        self.room = planning.SharedRoom(cell, (cell.placed(names[0]), cell.placed(names[1])))

    @property
    def here_rad(self) -> planning.Poses:
        """Where the arms are."""
        return [self.bench.clients[name].status()["joint_rad"] for name in self.names]

    def go(self, goal_rad: planning.Poses) -> bool:
        """Move both together on a way that is clear; False, and nothing moves, if there is none."""
        way = self.room.way(self.here_rad, goal_rad)
        for poses in way or ():
            self.bench.together(dict(zip(self.names, poses, strict=True)))
        return way is not None

    def circle_beside(self) -> Track:
        """The second arm's tip on a circle relative to the first one's, planned by the arms' models, measured by the truth.

        Positions are of the second tip from the first, along the axes of the cell. Planned: the nearest place of the circle,
        so what is compared is its shape and place, not the time. No contact tells where the first arm's joint 1 is zero:
        measured positions are turned about the vertical as they fit best.
        """
        held, moved = self.names
        holding, moving = self.cell.placed(held), self.cell.placed(moved)
        here, there = self.here_rad
        inverse = InverseKinematics(holding.arm)
        q_held = inverse.nearest(holding.in_base(HELD_m), here)
        points = moving.beside_tip(holding, inverse.kinematics.tip(*q_held), _offsets())
        path = plan_path(moving.arm, Waypoints(points, None), q_near_rad=there)
        if not self.go((q_held, path.q_start_rad)):
            raise CalibrationError("demo two-arms: no clear way to where the circle begins")
        seen = _turned(self._seen_on(path))
        time_s = np.arange(len(seen)) * SAMPLE_s
        return Track("circle beside the other tip", frozen(time_s), frozen(_on_circle(seen)), frozen(seen))

    def _seen_on(self, path: PlannedPath) -> Array:
        """The true way (k, 3) of the second tip from the first, while the second arm runs the path."""
        held, moved = self.names
        self.bench.clients[moved].run_path(path.to_message(), waits=False)
        seen = []
        for _ in range(math.ceil(path.duration_s / SAMPLE_s)):
            seen.append(np.subtract(self.bench.tip_m(moved), self.bench.tip_m(held)))
            self.bench.wait(SAMPLE_s)
        self.bench.clients[moved].arrive(5.0)
        return np.array(seen)


def _offsets() -> list[list[float]]:
    turn = 2.0 * np.pi * np.arange(WAYPOINTS + 1) / WAYPOINTS
    ring = np.column_stack((np.cos(turn), np.zeros_like(turn), np.sin(turn)))
    return list((np.array(CENTRE_m) + RADIUS_m * ring).tolist())


def _turned(points_m: Array) -> Array:
    """Turned about z (through the first tip) so that they are nearest to the circle."""
    turn_rad = 0.0
    for _ in range(TURNS):
        cos, sin = math.cos(turn_rad), math.sin(turn_rad)
        here = points_m @ np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]])
        goal = _on_circle(here)
        across = here[:, 0] * goal[:, 1] - here[:, 1] * goal[:, 0]
        turn_rad += math.atan2(float(across.sum()), float((here[:, :2] * goal[:, :2]).sum()))
    return np.asarray(here)


def _on_circle(points_m: Array) -> Array:
    """The nearest places of the circle."""
    flat = (points_m - CENTRE_m) * np.array([1.0, 0.0, 1.0])
    return np.asarray(CENTRE_m + RADIUS_m * flat / norms(flat)[:, None])


SHOWN_s = 12.0  # of the recording
ARM_COLOURS = (BEFORE, AFTER)
CALIBRATED = ("as the files say", "second base placed alone", "both arms calibrated")


def write_page(outcome: PairOutcome, out: Path) -> Path:
    """report.html."""
    about = f"{made_today().line} · mock arms with hidden errors, no camera"
    path, names = out / "report.html", " and ".join(outcome.cell.names)
    write_whole(path, page("Two arms that measured each other", names, about, _parts(outcome)))
    return path


def findings(outcome: PairOutcome) -> tuple[str, ...]:
    """The result in sentences."""
    files, placed, calibrated = (
        f"{_mean_mm(error_m):.2f} mm" for error_m in (outcome.by_files_m, outcome.placed_m, outcome.calibrated_m)
    )
    before, after = (f"{_mean_mm(error_m):.2f} mm" for error_m in circle_errors_m(outcome))
    rank, count = outcome.found.known.rank, len(outcome.found.estimates)
    return (
        f"{len(outcome.checked)} contacts that the calibration did not use stay open by {files} on average as the files say,"
        f" by {placed} where only the second base is placed, and by {calibrated} with both arms calibrated.",
        f"A circle of one tip beside the other is off by {before} before and by {after} after, by the plant's truth.",
        f"{len(outcome.fitted)} contacts determine {rank} of {count} parameters; those that stay open"
        " move no tip of one arm relative to the other.",
    )


def circle_errors_m(outcome: PairOutcome) -> tuple[Array, Array]:
    """Distances from the circle, before and after."""
    tracks = (outcome.circle.before, outcome.circle.after)
    before, after = (norms(track.measured_m - track.planned_m) for track in tracks)
    return before, after


def _mean_mm(error_m: Array) -> float:
    return 1e3 * float(error_m.mean())


def _parts(outcome: PairOutcome) -> Iterator[Section | str]:
    before, after = circle_errors_m(outcome)
    yield verdict(findings(outcome))
    yield tiles(
        (
            ("before", f"{_mean_mm(outcome.by_files_m):.2f} mm", "contacts not used, as the files say"),
            ("after", f"{_mean_mm(outcome.calibrated_m):.2f} mm", "contacts not used, calibrated"),
            ("before", f"{_mean_mm(before):.2f} mm", "circle beside the other tip, before"),
            ("after", f"{_mean_mm(after):.2f} mm", "circle beside the other tip, after"),
        )
    )
    yield list_section("Procedure", _steps(outcome))
    yield Section(
        "Contacts",
        svg((10.4, 4.6), lambda figure: _draw_contacts(figure, outcome))
        + pair(svg((5.1, 3.2), lambda figure: _draw_errors(figure, outcome)), _table(outcome)),
    )
    yield Section("A circle of the right tip beside the left one", path_picture(outcome.circle))
    yield Section("Both arms on one clock", svg((10.4, 3.6), lambda figure: _draw_motion(figure, outcome)))
    yield Section("What stays open", bullets(f"{one}." for one in open_in_words(outcome.found.known.undetermined)))
    for nominal, calibrated in zip(outcome.plan.arms, outcome.found.arms, strict=True):
        section = dh_section(nominal, calibrated)
        yield Section(f"{nominal.name}: {section.title}", section.html)


def _steps(outcome: PairOutcome) -> Iterator[str]:
    plan = outcome.plan
    kinds = [outcome.fitted.setup.count(kind) for kind in (planning.CAVITY, planning.APART)]
    yield "Both arms were homed, one after the other, and drew the circle with the models of their files."
    yield (
        f"Of {plan.candidates_count} contacts that both arms reach, clear of each other, {len(plan.chosen.contacts)} were chosen"
        " by what they say about both arms together (D-optimal)."
    )
    yield (
        f"The arms moved there together; a hand brought both tips into one cavity ({kinds[0]} times) or to the ends of a bar of"
        f" known length ({kinds[1]} times). The encoders were averaged; {len(outcome.checked)} further contacts were recorded to"
        " judge the result."
    )
    yield "Both arms and the place of the second base were identified from the joint angles alone."
    yield "The runtime was started again with the calibrated cell, and drew the circle again."


def _table(outcome: PairOutcome) -> str:
    errors = (outcome.by_files_m, outcome.placed_m, outcome.calibrated_m)
    rows = [
        (("text", what), f"{_mean_mm(error_m):.3f}", f"{1e3 * float(error_m.max()):.3f}")
        for what, error_m in zip(CALIBRATED, errors, strict=True)
    ]
    return (
        "<div>"
        + table((("text", "contacts not used"), "mean [mm]", "largest [mm]"), rows)
        + paragraph(
            "Where the first arm stands, and where its joint 1 is zero, is a convention: no contact tells. The circle is"
            " compared after a turn of the whole pair about the vertical.",
            "soft small",
        )
        + "</div>"
    )


def _draw_contacts(figure: Figure, outcome: PairOutcome) -> None:
    """Where the tips met, and both arms at the most valuable contact, from above and from the side."""
    figure.subplots_adjust(left=0.065, right=0.985, top=0.9, bottom=0.11, wspace=0.2)
    for axes, (i, j, seen) in zip(figure.subplots(1, 2), ((0, 1, "from above"), (0, 2, "from the side")), strict=True):
        for k, placed in enumerate(outcome.cell.arms):
            _draw_arm(axes, placed, (i, j), _joints(outcome, k)[0], ARM_COLOURS[k])
        first = outcome.cell.arms[0]
        for contacts, marker, label in (
            (outcome.fitted, "o", "contacts of the fit"),
            (outcome.checked, "x", "contacts not used"),
        ):
            tips = ArmModel(first.arm).tips(first.arm.dh, contacts.first_rad)
            places = 1e3 * (tips @ np.array(first.rotation).T + first.origin_m)
            axes.plot(places[:, i], places[:, j], marker, ms=3.6, mfc="white", mec=PLANNED, label=label)
        axes.set_aspect("equal", adjustable="datalim")
        label_plane(axes, i, j, seen)
    axes.legend(loc="upper right")


def _joints(outcome: PairOutcome, arm: int) -> Array:
    contacts = outcome.plan.chosen.contacts
    return (contacts.first_rad, contacts.second_rad)[arm]


def _draw_arm(axes: Axes, placed: Placed, plane: tuple[int, int], q_rad: Array, colour: str) -> None:
    corners = [placed.in_cell(corner) for corner in Corners(placed.arm).at(*q_rad.tolist())]
    way = 1e3 * np.array([placed.origin_m, *corners])
    axes.plot(way[:, plane[0]], way[:, plane[1]], "-o", color=colour, lw=2.5, ms=4, label=placed.name)


def _draw_errors(figure: Figure, outcome: PairOutcome) -> None:
    figure.subplots_adjust(left=0.12, right=0.98, top=0.9, bottom=0.15)
    axes = figure.subplots()
    errors = (outcome.by_files_m, outcome.placed_m, outcome.calibrated_m)
    for k, (error_m, colour) in enumerate(zip(errors, (BEFORE, PLANNED, AFTER), strict=True)):
        spread = k + np.linspace(-0.15, 0.15, len(error_m))
        axes.plot(spread, 1e3 * error_m, "o", color=colour, ms=4, alpha=0.7)
        axes.plot([k - 0.25, k + 0.25], [_mean_mm(error_m)] * 2, color=colour, lw=2)
    axes.set_yscale("log")
    axes.yaxis.set_major_formatter("{x:g}")
    axes.set_xticks(range(3), ["files", "base placed", "calibrated"])
    axes.set(ylabel="open by [mm]")
    axes.set_title("contacts not used (lines: means)", loc="left")


def _draw_motion(figure: Figure, outcome: PairOutcome) -> None:
    """Joint angles of both arms over some contacts, from their recordings."""
    figure.subplots_adjust(left=0.065, right=0.985, top=0.9, bottom=0.13, wspace=0.15)
    for axes, placed in zip(figure.subplots(1, 2, sharey=True), outcome.cell.arms, strict=True):
        time_s, q_rad = _recorded(outcome.files["recordings"], placed.name)
        for joint, style in zip(range(q_rad.shape[1]), ("-", "--", ":", "-.") * 2, strict=False):
            axes.plot(time_s, np.degrees(q_rad[:, joint]), style, lw=1.2, label=f"joint {joint + 1}")
        axes.set(xlabel="time of the runtime [s]", ylabel="joint angle [deg]")
        axes.set_title(placed.name, loc="left")
        axes.margins(x=0.01)
    figure.legend(*axes.get_legend_handles_labels(), loc="upper right", ncols=4)


def _recorded(recordings: Path, name: str) -> tuple[Array, Array]:
    """Times (k,) [s] and joint angles (k, n) of an arm in the middle of the first run, between contacts."""
    recording = Recording.open(sorted(recordings.iterdir())[0] / f"{name}.armlog")
    names = recording.layout.names
    joints = [names.index(f"q{joint}_rad") for joint in range(1, recording.layout.joint_count + 1)]
    middle = recording.row_count // 2
    rows = np.array([(row[names.index("t_s")], *(row[k] for k in joints)) for row in islice(recording.rows(), middle, None)])
    rows = rows[rows[:, 0] < rows[0, 0] + SHOWN_s]
    return rows[:, 0], rows[:, 1:]
