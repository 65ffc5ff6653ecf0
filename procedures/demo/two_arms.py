"""`armwright demo two-arms`: a mock pair calibrates itself where its tips touch, without a camera.

The run has no access to the hidden errors: contacts reach it as the joint angles of both arms in a file. Only the circle is
measured by the truth, as an outside camera would.
"""

from __future__ import annotations

import datetime
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

import numpy as np

from calib.arrays import Array
from calib.closed_chain.calibrate import PairFound, PairPlan, calibrate_pair, contact_errors_m
from calib.closed_chain.candidates import base_of
from calib.closed_chain.conduct import conduct, contact_plan
from calib.closed_chain.contacts import Contacts, read_contacts
from calib.closed_chain.outcome import calibrated_cell, pair_text, write_pair
from calib.closed_chain.planning import ContactPlan, pair_of, plan_contacts, write_contacts
from calib.inputs import input_file
from calib.session.conversation import Recorded, unattended
from calib.session.folder import POINTS, SessionFolder
from calib.validation.verify import Track, TrackPair
from control.files import write_whole
from control.model.cell import Cell, load_cell, save_cell
from control.model.description import load_arm
from control.progress import Advance
from hil_mocks.scenario import load_scenario
from procedures.demo.two_arms_moves import circle_beside, in_order, rest
from procedures.mock import CellBench, as_bolted_down
from procedures.session.pair_station import MockPairHand, pair_station

BAR_m = 0.1  # known distance: a bar between the tips
FITTED, CHECKED = 40, 12  # contacts for the calibration, and others to judge it
CHECK_SEED = 0


@dataclass(frozen=True, slots=True)
class PairOutcome:
    """What was found. Errors [m] of contacts that were not used: as the files say, bases placed alone, calibrated."""

    cell: Cell
    plan: ContactPlan
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
    names = pair_of(cell)
    scenario = load_scenario(scenario_file)
    advance("planning contacts", 0.0)
    plan = plan_contacts(cell, names, (0.0, BAR_m), FITTED)
    write_contacts(out / "planned.csv", plan.chosen.contacts)
    bench = CellBench(as_bolted_down(cell, scenario.seed), scenario, out / "log")
    try:
        advance("homing", 0.02)
        before = _circle(bench, cell, names, lambda: _take(cell, names, bench, plan, out, advance))
        advance("identification", 0.8)
        fitted, checked = (_read(out / name / POINTS, plan) for name in ("contacts", "check"))
        found = calibrate_pair(plan.arms, fitted, PairPlan())
        calibrated = _written(cell, names, plan, found, out)
        advance("circle, after", 0.9)
        after = _circle(bench, calibrated, names)
    finally:
        bench.close()
    circle = TrackPair(before.name, "", before, after)
    return _judged(cell, plan, found, fitted, checked, circle, out)


def _circle(
    bench: CellBench, cell: Cell, names: tuple[str, str], then: Callable[[], None] = lambda: None
) -> Track:
    """A runtime that knows `cell`: home, the circle of one tip beside the other, something else, to the rest poses, off."""
    bench.home(cell)
    track = circle_beside(cell, names, bench)
    then()
    rest(cell, names, bench)
    bench.stop()
    return track


def _judged(
    cell: Cell,
    plan: ContactPlan,
    found: PairFound,
    fitted: Contacts,
    checked: Contacts,
    circle: TrackPair,
    out: Path,
) -> PairOutcome:
    """The result on contacts that were not used: by the files, with the second base placed alone, and calibrated."""
    base = base_of(cell, (cell.names[0], cell.names[1]))
    placed = calibrate_pair(plan.arms, fitted, PairPlan(fixed=_geometry(found)))
    files = {
        "contacts": out / "contacts" / POINTS,
        "calibrated cell": out / "calibrated" / f"{cell.name}.cell.toml",
        "recordings": out / "log",
    }
    return PairOutcome(
        cell,
        plan,
        found,
        contact_errors_m(plan.arms, base, checked),
        contact_errors_m(placed.arms, placed.base, checked),
        contact_errors_m(found.arms, found.base, checked),
        fitted,
        checked,
        circle,
        files,
    )


def _take(
    cell: Cell, names: tuple[str, str], bench: CellBench, plan: ContactPlan, out: Path, advance: Advance
) -> None:
    """Record the planned contacts in one session, and some others, which the calibration does not get, in another."""
    rest = len(plan.others.contacts)
    rows = np.random.default_rng(CHECK_SEED).permutation(rest)[:CHECKED].tolist()
    hand, done = MockPairHand(cell, names, bench), 0
    for name, wanted in (("contacts", plan.chosen), ("check", plan.others.chosen(rows))):
        station = pair_station(cell, names, bench.clients, 1.0, 0.0, hand)
        ordered = wanted.contacts.chosen(in_order(wanted, station.room))
        with SessionFolder(out / name, contact_plan(names, "demo", ordered, "hand")) as folder:
            for saying in unattended(conduct(folder, station)):
                if isinstance(saying, Recorded):
                    done += 1
                    advance(f"contact {saying.record.point}", 0.1 + 0.7 * done / (FITTED + CHECKED))


def _read(file: Path, plan: ContactPlan) -> Contacts:
    return read_contacts(file, plan.arms)[0]


def _geometry(found: PairFound) -> list[str]:
    """The names of all parameters but the second base's."""
    return [one.parameter.name for one in found.estimates if one.parameter.has_bound]


def _written(cell: Cell, names: tuple[str, str], plan: ContactPlan, found: PairFound, out: Path) -> Cell:
    """Both arms, pair.json and the calibrated cell as files; the cell as loaded from them."""
    inputs = {"points.csv": input_file(out / "contacts" / POINTS, "contacts").sha256}
    date = datetime.datetime.now(datetime.UTC).date().isoformat()
    folder = out / "pair"
    folder.mkdir()
    write_pair(folder, plan.arms, found, "huber", inputs, date, f"armwright {version('armwright')}")
    write_whole(folder / "pair.txt", pair_text(plan.arms, found) + "\n")
    first, second = (load_arm(str(folder / f"{name}.toml")) for name in names)
    (out / "calibrated").mkdir()
    return load_cell(save_cell(calibrated_cell(cell, (first, second), found.base), out / "calibrated"))
