"""`armwright demo two-arms`: a mock pair calibrates itself where its tips touch, without a camera.

The run has no access to the hidden errors: contacts reach it as the joint angles of both arms in a file. Only the circle is
measured by the truth, as an outside camera would.
"""

from __future__ import annotations

import dataclasses
import datetime
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

import numpy as np

from calib.arm_problem.frames import rotation_of
from calib.arrays import Array
from calib.closed_chain.calibrate import PairFound, PairPlan, calibrate_pair, contact_errors_m
from calib.closed_chain.candidates import base_of
from calib.closed_chain.contacts import Contacts, read_contacts
from calib.closed_chain.outcome import calibrated_cell, pair_text, write_pair
from calib.closed_chain.planning import ContactPlan, plan_contacts, write_contacts
from calib.errors import CalibrationError
from calib.inputs import input_file
from calib.validation.tracks import TrackPair
from control.files import write_whole
from control.kinematics.rotation import quaternion_of
from control.model.cell import Cell, Placed, load_cell, save_cell
from control.model.description import load_arm
from control.progress import Advance
from hil_mocks.scenario import load_scenario
from procedures.demo.two_arms_moves import Contact, Contacting, circle_beside, rest, write_taken
from procedures.mock.cell_bench import CellBench

BAR_m = 0.1  # known distance: a bar between the tips
FITTED, CHECKED = 40, 12  # contacts for the calibration, and others to judge it
CHECK_SEED = 0
SHIFT_m, TURN_rad = 0.004, 0.007  # a base that was placed by tape measure, against its file


@dataclass(frozen=True, slots=True)
class Outcome:
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


def run(cell: Cell, scenario_file: Path, out: Path, advance: Advance) -> Outcome:
    """Run everything on a mock of the cell; results are in the folder `out`."""
    names = _pair_of(cell)
    scenario = load_scenario(scenario_file)
    advance("planning contacts", 0.0)
    plan = plan_contacts(cell, names, (0.0, BAR_m), FITTED)
    write_contacts(out / "planned.csv", plan.chosen.contacts)
    bench = CellBench(as_bolted_down(cell, scenario.seed), scenario, out / "log")
    try:
        advance("homing", 0.02)
        _home(bench, cell)
        before = circle_beside(cell, names, bench)
        _take(cell, names, bench, plan, out, advance)
        rest(cell, names, bench)
        bench.stop()
        advance("identification", 0.8)
        fitted, checked = (_read(out / f"{name}.csv", plan) for name in ("contacts", "check"))
        found = calibrate_pair(plan.arms, fitted, PairPlan())
        placed = calibrate_pair(plan.arms, fitted, PairPlan(fixed=_geometry(found)))
        calibrated = _written(cell, names, plan, found, out)
        advance("circle, after", 0.9)
        _home(bench, calibrated)
        after = circle_beside(calibrated, names, bench)
        rest(calibrated, names, bench)
        bench.stop()
    finally:
        bench.close()
    circle = TrackPair(before.name, "", before, after)
    files = {
        "contacts": out / "contacts.csv",
        "calibrated cell": out / "calibrated" / f"{cell.name}.cell.toml",
        "recordings": out / "log",
    }
    return Outcome(
        cell,
        plan,
        found,
        contact_errors_m(plan.arms, base_of(cell, names), checked),
        contact_errors_m(placed.arms, placed.base, checked),
        contact_errors_m(found.arms, found.base, checked),
        fitted,
        checked,
        circle,
        files,
    )


def _pair_of(cell: Cell) -> tuple[str, str]:
    if len(cell.names) != 2:
        raise CalibrationError(f"demo two-arms: expected a cell of two arms, got {', '.join(cell.names)}")
    return cell.names[0], cell.names[1]


def _home(bench: CellBench, cell: Cell) -> None:
    """Start a runtime, and home one arm after the other."""
    for client in bench.start(cell).values():
        client.enable()
    for client in bench.clients.values():
        client.home()


def _take(
    cell: Cell, names: tuple[str, str], bench: CellBench, plan: ContactPlan, out: Path, advance: Advance
) -> None:
    """Record the planned contacts, and some others that the calibration does not get."""
    rest = len(plan.others.contacts)
    rows = np.random.default_rng(CHECK_SEED).permutation(rest)[:CHECKED].tolist()
    arms, done = Contacting(cell, names, bench), 0
    for name, wanted in (("contacts", plan.chosen), ("check", plan.others.chosen(rows))):
        taken: list[Contact] = []
        for contact in arms.take(wanted):
            taken.append(contact)
            done += 1
            advance(f"contact {contact.name}", 0.1 + 0.7 * done / (FITTED + CHECKED))
        write_taken(out / f"{name}.csv", taken)


def _read(file: Path, plan: ContactPlan) -> Contacts:
    return read_contacts(file, plan.arms)[0]


def _geometry(found: PairFound) -> list[str]:
    """The names of all parameters but the second base's."""
    return [one.parameter.name for one in found.estimates if one.parameter.has_bound]


def _written(cell: Cell, names: tuple[str, str], plan: ContactPlan, found: PairFound, out: Path) -> Cell:
    """Both arms, pair.json and the calibrated cell as files; the cell as loaded from them."""
    inputs = {"contacts.csv": input_file(out / "contacts.csv", "contacts").sha256}
    date = datetime.datetime.now(datetime.UTC).date().isoformat()
    folder = out / "pair"
    folder.mkdir()
    write_pair(folder, plan.arms, found, "huber", inputs, date, f"armwright {version('armwright')}")
    write_whole(folder / "pair.txt", pair_text(plan.arms, found) + "\n")
    first, second = (load_arm(str(folder / f"{name}.toml")) for name in names)
    (out / "calibrated").mkdir()
    return load_cell(save_cell(calibrated_cell(cell, (first, second), found.base), out / "calibrated"))


def as_bolted_down(cell: Cell, seed: int) -> Cell:
    """The cell as it truly stands: every base but the first some millimetres and tenths of a degree off (seeded)."""
    draw = np.random.default_rng(seed)
    moved = [cell.arms[0]]
    for placed in cell.arms[1:]:
        x, y, z = (np.array(placed.origin_m) + draw.normal(0.0, SHIFT_m, 3)).tolist()
        rows = rotation_of(draw.normal(0.0, TURN_rad, 3)) @ np.array(placed.rotation)
        moved.append(Placed(placed.arm, (x, y, z), quaternion_of(rows.tolist())))
    return dataclasses.replace(cell, arms=tuple(moved))
