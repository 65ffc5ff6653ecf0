"""What is odd about poses, and what an answer from them is worth less for: in sentences. What is hopeless is refused."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping

import numpy as np

from calib.arm_problem.assembly import problem_of
from calib.arm_problem.checks import require_usable
from calib.arrays import Array, Mask, frozen
from calib.calibration import about_settling
from calib.errors import UnusablePointsError
from calib.gap.effects.record import load_of
from calib.gap.poses.currents import SATURATED
from calib.gap.poses.floor import Floor
from calib.gap.poses.recordings import EVERY, RECORDINGS_LEAST, recordings, split
from calib.gap.posterior.constants import INFLATED, UNMEASURED
from calib.identify.identification import Identification
from calib.points.points import Points
from calib.validation.verdict import TO_MEASURE_NOISE
from control.model.arm import Arm

FEW_POSES = 24
GAP_SHARE = 0.4  # of a joint's travel without a single pose
BOUNDED_LEAST = 3
UNBEARABLE = 5.0  # times what a drive holds at its current limit
MILLI = 10.0  # times the limit
NAMED_MOST = 8  # poses of a setup in a sentence

UNKNOWN_TURNS = (
    "the measured orientations (qw to qz) are checked and not used, as their noise is not known:"
    f" {TO_MEASURE_NOISE}, or give [camera] orientation_noise_rad in arm.toml"
)


def require_posed(arm: Arm, points: Points) -> tuple[str, ...]:
    """UnusablePointsError for points that are misread or too few; warnings otherwise."""
    warnings = require_usable(arm, points, problem_of(arm, points))
    _require_bearable(arm, points)
    return warnings


def _require_bearable(arm: Arm, points: Points) -> None:
    """A payload that no drive could hold was not written in kilograms."""
    load = load_of(arm, points)
    if load is None or len(arm.drives) < points.joint_count or not np.nan_to_num(points.payload_kg).any():
        return
    drives = [arm.drive(j + 1) for j in range(points.joint_count)]
    most = np.array([d.current_limit_A * d.gear_ratio * d.torque_constant_Nm_A for d in drives])
    joint = int(np.argmax(np.abs(load).max(axis=0) / most))
    torque = float(np.abs(load[:, joint]).max())
    if torque > UNBEARABLE * most[joint]:
        heaviest = float(np.nanmax(points.payload_kg))
        raise UnusablePointsError(
            f"payload_kg reaches {heaviest:g}: joint {joint + 1} would hold {torque:.0f} N m, its drive gives"
            f" {most[joint]:.0f} at its limit; grams? Expected kilograms"
        )


def cleaned(points: Points) -> Points:
    """The same, currents that never change taken out: nobody measured them."""
    current = np.array(points.current_A)
    for column in current.T:
        if _is_constant(column):
            column[:] = np.nan
    return dataclasses.replace(points, current_A=frozen(current))


def _is_constant(column: Array) -> bool:
    known = column[np.isfinite(column)]
    return len(known) > 1 and bool(np.ptp(known) == 0.0)


def about_data(arm: Arm, points: Points) -> Iterator[str]:
    """What the columns lack or hold, and what cannot be named for it."""
    yield from _about_recordings(points)
    yield from _about_time(points)
    yield from _about_currents(arm, points)
    yield from _about_loads(arm, points)
    yield from _about_travel(points)


def _about_recordings(points: Points) -> Iterator[str]:
    if len(points) < FEW_POSES:
        yield f"{len(points)} poses are few: little can be identified, and a small effect looks like noise"
    setups, count = set(points.setup), len(set(recordings(points).tolist()))
    if len(setups) == 1:
        yield (
            f'all poses are of one setup, "{points.setup[0]}": what the geometry and an effect do alike there cannot be told'
            " apart; take free poses away from the table, or tilt the board"
        )
    parts = split(points)
    if not parts.is_divided:
        yield f"{len(points)} poses are too few to hold some out: the gap is that of the fitted poses"
    elif parts.is_by_pose:
        why = f"{RECORDINGS_LEAST} are needed to hold one out" if count < RECORDINGS_LEAST else "none can be held out as a whole"
        yield (
            f"{count} recording{'s' if count > 1 else ''} (setup, payload, approach), and {why}: every {EVERY}th pose of each"
            " setup is held out, and errors that a setup's poses share are not checked"
        )
    last = points.direction
    if not last.any():
        yield (
            "the directions of the last motion (dir1 ...) are missing or all 0: backlash shows only where gravity alone sets its"
            " flank"
        )
    elif not ((last > 0).any() and (last < 0).any()):
        yield "every pose was approached from one side: backlash that gravity does not turn looks like an offset of its zero"


def _about_time(points: Points) -> Iterator[str]:
    time = points.t_s
    if not np.isfinite(time).any():
        yield "there is no t_s: thermal drift cannot be identified, and would look like another effect or noise"
    elif not np.isfinite(time).all():
        missing = int(np.sum(~np.isfinite(time)))
        yield f"t_s is missing in {missing} poses: thermal drift is not tried"
    elif np.ptp(time) == 0.0:
        yield "t_s is the same in every pose: thermal drift is not tried"
    elif (np.diff(time) < 0.0).any():
        row = int(np.argmax(np.diff(time) < 0.0)) + 1
        yield (
            f"t_s runs backwards at pose {row + 1} (line {points.lines[row]}): if that is not the order in which files were"
            " joined, drift and steps in time cannot be believed"
        )


def _about_currents(arm: Arm, points: Points) -> Iterator[str]:
    if not np.isfinite(points.current_A).any():
        yield "there are no holding currents (i1_A ...): payload, masses and torque constants are not tried"
        return
    for drive in arm.drives:
        current_A = points.current_A[:, drive.joint - 1]
        count = int(np.sum(np.abs(current_A) >= SATURATED * drive.current_limit_A))
        if count > 0 and np.nanmedian(np.abs(current_A)) > MILLI * drive.current_limit_A:
            yield f"i{drive.joint}_A is far beyond the drive's limit of {drive.current_limit_A:g} A: milliamperes? Not used"
        elif count:
            yield (
                f"i{drive.joint}_A is at the drive's limit of {drive.current_limit_A:g} A in {count} poses: the joint may not"
                " have stood where it was sent, and these currents are not used"
            )
        if _is_constant(current_A):
            yield f"i{drive.joint}_A never changes: the column seems not to be measured, and is not used"


def _about_loads(arm: Arm, points: Points) -> Iterator[str]:
    has_masses = any(link.mass_kg for link in arm.links)
    without = [j for j in range(1, points.joint_count + 1) if all(drive.joint != j for drive in arm.drives)]
    if has_masses and without:
        joints = ", ".join(map(str, without))
        yield (
            f"arm {arm.name} has no [[drive]] of joint{'s' if len(without) > 1 else ''} {joints}: compliance, flexure and play"
            " are tried by gravity alone; what the motors hold, and with it payload, masses and torque constants, is not"
        )
    if not has_masses:
        yield (f"arm {arm.name} has no masses: backlash, compliance, flexure and loads are not tried, and would be unknown")
    if np.nan_to_num(points.payload_kg).any() and not has_masses:
        yield "payload_kg is not used: without masses there is no torque for it to add to"
    if 0 < np.isfinite(points.payload_kg).sum() < len(points):
        yield "payload_kg is missing in some poses: they count as unloaded"


def _about_travel(points: Points) -> Iterator[str]:
    for j, q_rad in enumerate(points.q_rad.T):
        steps, travel = np.diff(np.sort(q_rad)), float(np.ptp(q_rad))
        if len(q_rad) >= FEW_POSES and travel > 0.0 and steps.max() > GAP_SHARE * travel:
            at = int(np.argmax(steps))
            low, high = np.sort(q_rad)[at], np.sort(q_rad)[at + 1]
            yield (
                f"no pose has q{j + 1}_rad between {low:.2f} and {high:.2f}, {100 * steps.max() / travel:.0f} % of its travel:"
                " what happens there is not known"
            )


def about_orientations(points: Points, floor: Floor) -> Iterator[str]:
    """Why measured orientations tell nothing."""
    if np.isfinite(points.orientation).any() and not floor.lever_m > 0.0:
        yield UNKNOWN_TURNS


def about_outliers(points: Points, out: Mask) -> Iterator[str]:
    """Which poses are left out."""
    rows = np.flatnonzero(out)
    if len(rows):
        listed = ", ".join(
            f"{row + 1} ({points.setup[row]}, {points.point[row]}, line {points.lines[row]})" for row in rows[:5].tolist()
        )
        more = f" and {len(rows) - 5} more" if len(rows) > 5 else ""
        yield (
            f"{len(rows)} of {len(points)} poses are far from what any effect explains and are left out: {listed}{more}; swapped,"
            " or the marker was lost?"
        )


def about_flanks(points: Points, report: Mask, unclear: Mapping[int, Mask]) -> Iterator[str]:
    """Poses (m,) of each joint, from 1, of which nothing tells the flank of its loose gear."""
    for joint, poses in unclear.items():
        if open_count := int(np.sum(report & poses)):
            yield (
                f"on {open_count} of {int(report.sum())} held-out poses nothing tells on which flank the loose gear of joint"
                f" {joint} lies: there the new arm.toml predicts the middle of its play, and is off by up to half of it. No map"
                f" mends that. Record these poses with joint {joint} moved there in both directions, and the direction or the"
                f" holding currents with them: {_named_by_setup(points, report & poses)}"
            )


def _named_by_setup(points: Points, rows: Mask) -> str:
    """Poses of a mask (m,) by their names in points.csv, each setup's first few."""
    by_setup: dict[str, list[str]] = {}
    for k in np.flatnonzero(rows).tolist():
        by_setup.setdefault(points.setup[k], []).append(points.point[k])
    told = {setup: list(dict.fromkeys(names)) for setup, names in by_setup.items()}
    few = (
        f"{setup}: {', '.join(names[:NAMED_MOST])}{' ...' if len(names) > NAMED_MOST else ''}" for setup, names in told.items()
    )
    return "; ".join(few)


def about_fit(arm: Arm, fit: Identification, floor: Floor, noise_m: float) -> Iterator[str]:
    """What the identification itself says against the answer; noise_m: what the best set of effects leaves."""
    bounded, times = fit.binding, noise_m / floor.tip_m
    if len(bounded) >= BOUNDED_LEAST and times > INFLATED:
        yield (
            f"the geometry ends at its bounds ({', '.join(bounded[:6])}) and leaves {times:.1f} times the noise: are these poses"
            f" of arm {arm.name}, with its zeros?"
        )
    yield from about_settling(fit)
    if floor.doubt >= UNMEASURED:
        yield f"the noise is {floor.source}: {TO_MEASURE_NOISE}, or give [camera] position_noise_m"
    if times > INFLATED:
        yield (
            f"everything that was found leaves {times:.1f} times the noise floor ({floor.source}): names are weighed against that"
        )
