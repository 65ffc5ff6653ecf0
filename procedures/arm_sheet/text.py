"""The figures of an arm as text: lengths in mm, angles in deg."""

from __future__ import annotations

import math
from collections.abc import Iterator

from control.model.arm import Arm
from procedures.arm_sheet.figures import BUSY, Buses, JointFigures, Sheet
from procedures.arm_sheet.missing import Missing

FULL = 1.0
LITTLE = 0.8  # of the torque: above it, friction and feedback have little left
HEAD = ("joint", "range", "speed", "free", "torque", "gravity", "share", "moving", "step")
UNITS = ("", "deg", "deg/s", "deg/s", "N m", "N m", "%", "N m", "mdeg")


def sheet_lines(arm: Arm, found: Sheet, absent: tuple[Missing, ...]) -> Iterator[str]:
    """The lines of `armwright arm` behind the DH table."""
    reach = found.reach
    yield (
        f"reach: {1e3 * reach.farthest_m:.0f} mm from axis 1; heights {1e3 * reach.lowest_m:.0f} to"
        f" {1e3 * reach.highest_m:.0f} mm; {100 * reach.above_floor:.0f} % of all poses stay above the floor"
    )
    widths = (6, 18, 8, 8, 9, 9, 7, 9, 8)
    for row in (HEAD, UNITS, *(_row(joint) for joint in found.joints)):
        yield "".join(f"{cell:>{width}}" for cell, width in zip(row, widths, strict=True)).rstrip()
    yield "free: without load; gravity, moving (at the acceleration limit): worst pose above the floor; step: of the encoder"
    if found.payload is not None:
        payload = found.payload
        yield f"payload: {payload.everywhere_kg:.2f} kg held in every pose, {payload.in_half_kg:.2f} kg in half of them;"
        yield f"  {payload.moving_kg:.2f} kg moved in every pose, with all joints at their acceleration limits"
    if found.buses is not None:
        yield _buses(arm, found.buses)
    yield from (f"warning: {text}" for text in warnings(found))
    yield from (f"missing: {one.what}: {one.needed_for}" for one in absent)


def warnings(found: Sheet) -> Iterator[str]:
    """What cannot work, although nothing is missing."""
    for joint in found.joints:
        if joint.share > FULL:
            yield f"joint {joint.joint} does not hold the arm: {joint.gravity_Nm:.3g} of {joint.torque_Nm:.3g} N m"
        elif joint.share > LITTLE:
            yield f"joint {joint.joint} has little torque left: gravity takes {100 * joint.share:.0f} %"
        elif joint.moving_Nm > joint.torque_Nm:
            yield (
                f"joint {joint.joint} cannot accelerate as its limit says: {joint.moving_Nm:.3g} of"
                f" {joint.torque_Nm:.3g} N m"
            )
        if math.isfinite(joint.speed_rad_s) and joint.speed_rad_s > joint.free_speed_rad_s:
            yield f"joint {joint.joint} is slower than its speed limit, even without load"
    if found.buses is not None:
        if found.buses.can > BUSY:
            yield f"the CAN bus is too busy: serve with --rate {found.buses.can_rate_Hz:.0f} or less"
        if max(found.buses.serial) > FULL:
            yield "an encoder board's line is too slow: choose a higher baud rate"


def _row(joint: JointFigures) -> tuple[str, ...]:
    ends = (_number(math.degrees(joint.lower_rad), 1), _number(math.degrees(joint.upper_rad), 1))
    return (
        str(joint.joint),
        " to ".join(ends),
        _number(math.degrees(joint.speed_rad_s), 0),
        _number(math.degrees(joint.free_speed_rad_s), 0),
        _number(joint.torque_Nm, 2),
        _number(joint.gravity_Nm, 2),
        _number(100 * joint.share, 0),
        _number(joint.moving_Nm, 2),
        _number(1e3 * math.degrees(joint.step_rad), 2),
    )


def _number(value: float, digits: int) -> str:
    return f"{value:.{digits}f}" if math.isfinite(value) else "-"


def _buses(arm: Arm, buses: Buses) -> str:
    lines = ", ".join(
        f"{board.name} {100 * load:.0f} %"
        for board, load in zip(arm.encoder_boards, buses.serial, strict=True)
    )
    return (
        f"at {buses.rate_Hz:.0f} Hz: CAN {100 * buses.can:.0f} % (good up to {buses.can_rate_Hz:.0f} Hz);"
        f" serial {lines}"
    )
