"""What arm.toml of the gap workflow leaves on poses that nobody fitted, beside the given arm and what `calibrate` makes of the
same poses: on simulated arms with rough parts, and on folders with arm.toml and points.

    python -m benchmarks.gap.static.file_score --cases 20
    python -m benchmarks.gap.static.file_score --data FOLDER ...

A row: root mean square distance on poses kept apart [mm] by the given arm, `calibrate`, `calibrate` with the true effects, the
file of `gap`, and what `gap` says is left; file over the best of the first three (asked: 1.02) and said over file (1 to 1 %).
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.arms import FIVE, SIX
from benchmarks.calibration.chains import ChainModel
from benchmarks.gap.static import cases
from benchmarks.gap.static.cases import PARAMETER, RIGS, Design, designed
from benchmarks.gap.static.physics import Hidden, Rig
from benchmarks.gap.static.rough_cases import ON_TIP, Rough, several
from benchmarks.studies import say
from calib.arm_problem.assembly import BASE, Choice
from calib.arm_problem.joint_effects import LAWS
from calib.arrays import Array, Mask
from calib.boards import best_motion
from calib.calibration import CalibrationPlan, calibrated_arm, identified
from calib.errors import CalibrationError
from calib.gap.finding import with_totals
from calib.gap.poses.recordings import split
from calib.gap.workflow import Recordings, find_gap_in, write_gap
from calib.points.points import Points, base_points_for
from calib.validation.verify import measuring_frame, predicted_tips
from control.errors import ArmError
from control.model.arm import Arm, Effect, Tool
from control.model.description import load_arm
from control.model.table import board_cavities

FIRST_SEED = 230_000
UNKNOWN_TOOL_m = (0.03, -0.02, 0.06)
MORE_RIGS = {
    "five": Rig(
        replace(FIVE, table=None),
        ChainModel((True,) * 5),
        np.array([-1.5, 0.2, -2.0, -2.0, -2.0]),
        np.array([1.5, 2.2, 0.5, 0.5, 2.0]),
        np.array([0.9, 0.9, 0.7, 0.3, 0.2]),
    ),
    "other six": Rig(
        replace(SIX, table=None),
        ChainModel((True,) * 6, modified=True, tool_m=SIX.tool.position_m),
        np.array([-1.5, 0.0, -1.5, -2.0, -1.5, -2.0]),
        np.array([1.5, 2.2, 1.0, 2.0, 1.5, 2.0]),
        np.array([0.9, 0.9, 0.7, 0.4, 0.3, 0.2]),
    ),
}


@dataclass(frozen=True)
class Set:
    """Poses of an arm, and what is hidden in it as far as that is known."""

    name: str
    arm: Arm
    points: Points
    hidden: tuple[Effect, ...]


def main() -> None:
    """Run the study."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=int, default=0)
    parser.add_argument("--first-seed", type=int, default=FIRST_SEED)
    parser.add_argument("--data", type=Path, nargs="*", default=[])
    given = parser.parse_args()
    say(f"{'':32} {'given':>8} {'calibr.':>8} {'with all':>8} {'file':>8} {'said':>8}  file/best said/file   s")
    ratios = [_row(one) for one in (*simulated(given.first_seed, given.cases), *recorded(given.data))]
    say(f"file at most 1.02 of the best: {sum(ratio <= 1.02 for ratio in ratios)} of {len(ratios)}")


def simulated(first: int, count: int) -> Iterator[Set]:
    """Rough arms in turn: the reference, 5 and 6 joints, frames metres away, unknown tools; one to four effects."""
    rigs = RIGS | MORE_RIGS
    for number in range(count):
        seed, kind = first + number, ("reference", "five", "six", "other six", "planar")[number % 5]
        rng = np.random.default_rng(seed)
        rig = rigs[kind]
        if number % 4 == 3 and kind != "reference":  # the tool is somewhere else than its file says
            chain = replace(rig.chain, tool_m=tuple(np.add(rig.chain.tool_m, UNKNOWN_TOOL_m)))
            rig = replace(rig, chain=chain, arm=replace(rig.arm, tool=Tool(rig.arm.tool.position_m, known=False)))
        joints = len(rig.lower)
        among = tuple(one for one in ON_TIP if joints > 2 or one not in ("belt_coupling", "link_flexure", "joint_compliance"))
        hidden = tuple(one for one in several(rng, 1 + number % 4, among) if (one.joint or 1) <= joints)
        cases.RIGS["drawn"] = rig
        with Rough(seed, 0.10):
            arm, points = designed(seed, hidden, Design(rig="drawn" if kind != "reference" else kind, free=60))
        if kind != "reference" and number % 3:
            points = _from_afar(rng, points)
        label = f"{kind} {seed}{', tool' if not arm.tool.known else ''}{', afar' if number % 3 and kind != 'reference' else ''}"
        yield Set(label, arm, points, tuple(map(_effect, hidden)))


def _from_afar(rng: np.random.Generator, points: Points) -> Points:
    """As a tracker some metres away sees it."""
    turn, far = Rotation.random(random_state=int(rng.integers(1 << 30))), rng.uniform(2.0, 5.0, 3)
    return replace(points, tip_m=turn.apply(np.array(points.tip_m)) + far)


def _effect(one: Hidden) -> Effect:
    more = {"encoder_eccentricity": "phase_rad", "thermal_drift": "time_constant_s"}
    parameters = {PARAMETER[one.effect]: one.value}
    if one.effect in more:
        parameters[more[one.effect]] = one.more
    return Effect(one.effect, one.joint, parameters)


def recorded(folders: list[Path]) -> Iterator[Set]:
    """Every points*.csv below the folders that has an arm.toml beside it."""
    for folder in folders:
        for path in sorted(folder.rglob("points*.csv*")):
            if not (path.parent / "arm.toml").exists():
                continue
            arm = load_arm(str(path.parent / "arm.toml"))
            points, _ = base_points_for(arm, [path], "gap")
            truth, known = path.parent / "truth.json", set(PARAMETER)
            told = json.loads(truth.read_text())["effects"] if truth.exists() else []
            hidden = tuple(Effect(e["effect"], e["joint"], e["parameters"]) for e in told if e["effect"] in known)
            yield Set(f"{path.parent.name} {path.name.split('.')[0].removeprefix('points')}".strip(), arm, points, hidden)


def _row(one: Set) -> float:
    began = time.process_time()
    try:
        found = find_gap_in(one.arm, Recordings(one.points, None, (), (), ()))
        with tempfile.TemporaryDirectory() as folder:
            write_gap(found, one.arm, Recordings(one.points, None, (), (), ()), Path(folder) / "gap")
            file = load_arm(str(Path(folder) / "gap" / "arm.toml"))
    except (CalibrationError, ArmError) as error:
        say(f"{one.name:32} refused: {error}")
        return float("inf")
    took = time.process_time() - began
    out = np.zeros(len(one.points), dtype=bool) if found.static is None else found.static.looked.out
    parts = split(one.points).without(out)
    some = one.points.chosen(np.flatnonzero(parts.known))
    arms = one.arm, _calibrated(one, some, False), _calibrated(one, some, True), file
    given, plain, full, own = (1e3 * _left_m(arm, one.points, parts.known, parts.report) for arm in arms)
    said = 1e3 * np.sqrt(3.0) * found.finding.after_si.get("tip_m", np.nan)
    names = ", ".join(str(e.name) for e in found.finding.effects if e.name.effect != "link_geometry")
    truth = ", ".join(f"{e.effect} {e.joint or ''}".strip() for e in one.hidden)
    best = min(given, plain, full)
    say(
        f"{one.name:32} {given:8.3f} {plain:8.3f} {full:8.3f} {own:8.3f} {said:8.3f}  {own / best:9.3f} {said / own:9.3f}"
        f" {took:5.1f}  [{truth}] -> [{names}]{' unknown: ' + found.finding.unknown.where if found.finding.unknown else ''}"
    )
    return own / best


def _calibrated(one: Set, points: Points, with_truth: bool) -> Arm:
    """`calibrate`'s arm; with the hidden effects: identified too, or given as they are where it cannot."""
    hidden = one.hidden if with_truth else ()
    fitted = [e for e in hidden if e.effect in LAWS]
    given = [e for e in hidden if e.effect not in LAWS and e.effect != "base_frame"]
    keys = tuple(e.effect if e.joint is None else f"{e.effect}:{e.joint}" for e in fitted)
    freed = (BASE,) if any(e.effect == "base_frame" for e in hidden) else ()
    drifts = [e for e in fitted if e.effect == "thermal_drift"]  # whose time constant a file has to say
    arm = with_totals(one.arm, [*given, *drifts])
    try:
        choice = Choice(effects=keys, freed=freed).for_points(arm, points)
        return calibrated_arm(arm, identified(arm, points, CalibrationPlan(choice))[1], points)
    except CalibrationError:
        return one.arm


def _left_m(arm: Arm, points: Points, known: Mask, report: Mask) -> float:
    """Root mean square distance on the poses that report; what no file says is placed by those that are known."""
    tips = predicted_tips(arm, points)
    is_tied = any(e.effect == "base_frame" for e in arm.effects) or (arm.table is not None and arm.table.known_pose)
    was = measuring_frame(arm, points).to_base(points.tip_m)
    measured = np.isfinite(points.tip_m).all(axis=1)
    if not is_tied and measured.any():
        was = _placed(points.tip_m, tips, known & measured)
    cavities = board_cavities(arm.table) if arm.table is not None else {}
    for setup in dict.fromkeys(points.setup):
        rows = np.array([name == setup for name in points.setup]) & ~measured
        if rows.any():
            on_board = np.array([cavities.get(name, (0.0, 0.0, 0.0)) for name in points.point])
            was[rows] = _placed(on_board, tips, known & rows)[rows]
    return float(np.sqrt(np.mean(np.sum((was - tips)[report] ** 2, axis=1))))


def _placed(points_m: Array, tips: Array, rows: Mask) -> Array:
    return np.asarray(best_motion(points_m[rows], tips[rows]).of(points_m))


if __name__ == "__main__":
    main()
