"""Where index, home switch and end stops are, in the joint's own angle, and the resulting changes of a draft."""

import math
from dataclasses import replace
from statistics import fmean

from control.model.arm import Home
from procedures.bringup.findings import Diagnosis
from procedures.bringup.measuring import JointMeasurements

TURN_TOLERANCE = 0.3  # of a motor turn, between the index by the readings and by the draft
SWITCH_TOLERANCE = 0.15  # of a motor turn, of the switch
STOP_CLEARANCE_RAD = 0.02  # distance of a limit from its stop
LEAST_CLEARANCE_RAD = 0.01
SHORT_RANGE = 0.9  # of the draft's range


def place_home(result: Diagnosis, found: JointMeasurements, offset_rad: float, scale: float) -> float:
    """Index and switch by the readings; returns the angle of the joint's first pose, from the index if it is trusted."""
    drive, name = result.drive, f"joint {result.drive.joint}"
    home = drive.home
    if home is None:
        return offset_rad
    if not found.edges:
        if found.is_home_active and all(found.stops_rad):
            state = "active" if found.is_home_active[0] else "not active"
            result.problems.append(
                f"{name}: NO HOME SWITCH: it was {state} from one end stop to the other: check the switch, cam and"
                " wire, or remove [drive.home]"
            )
        return offset_rad
    above = {(direction > 0) == is_active for _, direction, is_active in found.edges}
    if len(above) == 1 and above != {home.index_rad >= home.switch_rad}:
        result.problems.append(
            f"{name}: HOME SWITCH INVERTED: it is active {'above' if above == {True} else 'below'} its edge, expected"
            " on the side of index_rad: invert the switch, or set index_rad and switch_rad for the other side"
        )
        return offset_rad
    if math.isnan(found.index_rad):
        result.notes.append(
            f"{name}: no index pulse was seen behind the home switch: [drive.home] was not checked and is the draft's"
        )
        return offset_rad
    return _place_index(result, found, home, offset_rad, scale)


def _place_index(
    result: Diagnosis, found: JointMeasurements, home: Home, offset_rad: float, scale: float
) -> float:
    name = f"joint {result.drive.joint}"
    turn_rad = 2.0 * math.pi / result.drive.gear_ratio
    index_rad = home.index_rad
    if not math.isnan(offset_rad):
        read_rad = offset_rad + scale * found.index_rad
        result.figures["index_read_rad"] = read_rad
        if abs(read_rad - index_rad) > TURN_TOLERANCE * turn_rad:
            index_rad = round(read_rad, 4)
            result.changes.append(
                f"{name}: INDEX MOVED: the readings put its index at {math.degrees(read_rad):.2f} deg, the draft at"
                f" {math.degrees(home.index_rad):.2f} deg (one motor turn is {math.degrees(turn_rad):.2f} deg):"
                f" index_rad = {index_rad:g}; calibration refines the zero"
            )
    forth = 1 if home.index_rad >= home.switch_rad else -1
    edges = [edge for edge, direction, is_active in found.edges if direction == forth and is_active]
    switch_rad = home.switch_rad + (index_rad - home.index_rad)
    if edges:
        measured_rad = index_rad - scale * (found.index_rad - fmean(edges))
        result.figures["index_behind_switch_rad"] = scale * (found.index_rad - fmean(edges))
        if abs(measured_rad - switch_rad) > SWITCH_TOLERANCE * turn_rad:
            switch_rad = measured_rad
            result.changes.append(
                f"{name}: HOME SWITCH MOVED: its index comes {scale * (found.index_rad - fmean(edges)):.4f} rad"
                f" behind it, draft {home.index_rad - home.switch_rad:.4f} rad: switch_rad = {round(switch_rad, 4):g}"
            )
        if found.has_index:
            _warn_of_far_index(result, turn_rad, scale * (found.index_rad - fmean(edges)))
    result.drive = replace(
        result.drive, home=replace(home, index_rad=index_rad, switch_rad=round(switch_rad, 7))
    )
    return index_rad - scale * found.index_rad


def _warn_of_far_index(result: Diagnosis, turn_rad: float, behind_rad: float) -> None:
    share = abs(behind_rad) / turn_rad % 1.0
    if min(share, 1.0 - share) < 0.15:
        result.notes.append(
            f"joint {result.drive.joint}: its index comes {share:.2f} of a motor turn behind the home switch: a small"
            " shift of the switch makes homing one turn off; move the switch by half a motor turn"
        )


def place_limits(result: Diagnosis, found: JointMeasurements, offset_rad: float, scale: float) -> None:
    """Place the limits in front of the stops."""
    if math.isnan(offset_rad):
        return
    drive, name = result.drive, f"joint {result.drive.joint}"
    lower, upper = drive.joint_lower_rad, drive.joint_upper_rad
    measured = [offset_rad + scale * fmean(stops) if stops else math.nan for stops in found.stops_rad]
    result.figures |= {"lower_stop_rad": measured[0], "upper_stop_rad": measured[1]}
    if not math.isnan(measured[0]) and lower < measured[0] + LEAST_CLEARANCE_RAD:
        lower = round(measured[0] + STOP_CLEARANCE_RAD, 3)
    if not math.isnan(measured[1]) and upper > measured[1] - LEAST_CLEARANCE_RAD:
        upper = round(measured[1] - STOP_CLEARANCE_RAD, 3)
    if (lower, upper) == (drive.joint_lower_rad, drive.joint_upper_rad):
        return
    stops = " and ".join(f"{math.degrees(stop):.1f} deg" for stop in measured if not math.isnan(stop))
    if not lower < upper:
        result.problems.append(
            f"{name}: END STOPS at {stops} leave no range: it did not come from one to the other: free the joint and run"
            " again"
        )
        return
    result.changes.append(
        f"{name}: END STOPS are at {stops}: joint_lower_rad = {lower:g}, joint_upper_rad = {upper:g} (draft"
        f" {drive.joint_lower_rad:g} and {drive.joint_upper_rad:g})"
    )
    if math.isfinite(drive.joint_upper_rad - drive.joint_lower_rad) and upper - lower < SHORT_RANGE * (
        drive.joint_upper_rad - drive.joint_lower_rad
    ):
        result.notes.append(
            f"{name}: this range is smaller than the draft's: check for an obstacle, a cable, or a load too heavy for"
            " the low current"
        )
    result.drive = replace(drive, joint_lower_rad=lower, joint_upper_rad=upper)
