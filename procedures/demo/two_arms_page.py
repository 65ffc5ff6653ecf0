"""The report of `armwright demo two-arms`: where the tips met, what was found, and the circle of one beside the other."""

from __future__ import annotations

import datetime
from collections.abc import Iterator
from importlib.metadata import version
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from calib.arm_problem.arm_model import ArmModel
from calib.arrays import Array, norms
from calib.closed_chain.planning import APART, CAVITY
from calib.identify.open_combinations import open_in_words
from calib.report.drawing import AFTER, BEFORE, PLANNED, label_plane, svg
from calib.report.page import Section, bullets, list_section, page, pair, paragraph, table, tiles, verdict
from calib.report.pictures import path_picture
from calib.report.report_sections import dh_section
from control.files import write_whole
from control.kinematics.corners import Corners
from control.model.cell import Placed
from control.recording.reading import Recording
from procedures.demo.two_arms import PairOutcome

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SHOWN_s = 12.0  # of the recording
ARM_COLOURS = (BEFORE, AFTER)
CALIBRATED = ("as the files say", "second base placed alone", "both arms calibrated")


def write_page(outcome: PairOutcome, out: Path) -> Path:
    """report.html."""
    date = datetime.datetime.now(datetime.UTC).date().isoformat()
    about = f"{date} · armwright {version('armwright')} · mock arms with hidden errors, no camera"
    path, names = out / "report.html", " and ".join(outcome.cell.names)
    write_whole(path, page("Two arms that measured each other", names, about, _parts(outcome)))
    return path


def findings(outcome: PairOutcome) -> tuple[str, ...]:
    """The result in sentences."""
    files, placed, calibrated = (
        f"{_mean_mm(error_m):.2f} mm"
        for error_m in (outcome.by_files_m, outcome.placed_m, outcome.calibrated_m)
    )
    before, after = (f"{_mean_mm(error_m):.2f} mm" for error_m in circle_errors_m(outcome))
    found = outcome.found
    return (
        f"{len(outcome.checked)} contacts that the calibration did not use stay open by {files} on average as the files say,"
        f" by {placed} where only the second base is placed, and by {calibrated} with both arms calibrated.",
        f"A circle of one tip beside the other is off by {before} before and by {after} after, by the plant's truth.",
        f"{len(outcome.fitted)} contacts determine {found.known.rank} of {len(found.estimates)} parameters; those that stay open"
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
        + pair(
            svg((5.1, 3.2), lambda figure: _draw_errors(figure, outcome)),
            _table(outcome),
        ),
    )
    yield Section("A circle of the right tip beside the left one", path_picture(outcome.circle))
    yield Section("Both arms on one clock", svg((10.4, 3.6), lambda figure: _draw_motion(figure, outcome)))
    yield Section(
        "What stays open", bullets(f"{one}." for one in open_in_words(outcome.found.known.undetermined))
    )
    for nominal, calibrated in zip(outcome.plan.arms, outcome.found.arms, strict=True):
        section = dh_section(nominal, calibrated)
        yield Section(f"{nominal.name}: {section.title}", section.html)


def _steps(outcome: PairOutcome) -> Iterator[str]:
    plan = outcome.plan
    kinds = [outcome.fitted.setup.count(kind) for kind in (CAVITY, APART)]
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
    for axes, (i, j, seen) in zip(
        figure.subplots(1, 2), ((0, 1, "from above"), (0, 2, "from the side")), strict=True
    ):
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
    rows = np.array(
        [
            (row[names.index("t_s")], *(row[k] for k in joints))
            for row in islice(recording.rows(), middle, None)
        ]
    )
    rows = rows[rows[:, 0] < rows[0, 0] + SHOWN_s]
    return rows[:, 0], rows[:, 1:]
