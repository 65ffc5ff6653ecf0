"""From a joint's measurements to its drive: figures, messages for the operator, and where it cannot go on."""

import math
from dataclasses import dataclass, field, replace
from statistics import fmean, median

from control.hardware.interface import QUADRATURE_ERROR, SIGNAL_LOST
from control.model.arm import Drive, Home
from procedures.bringup.measuring import ODD_RATIO, JointMeasurements, has_two_indices
from procedures.bringup.wiring import MeasuredWiring


@dataclass(slots=True)
class Diagnosis:
    """The diagnosis of one joint. `drive` is the draft's with the measured values; problems prevent a new arm.toml."""

    drive: Drive
    figures: dict[str, float] = field(default_factory=dict)
    changes: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)
    coulomb_Nm: float = math.nan
    viscous_Nm_s_rad: float = math.nan


# Diagnosis of a joint from its measurements: changed keys of arm.toml, notes, and faults.
#
# Two scales are separate. There is one index per motor turn, so the spacing of index pulses is exactly the counts per turn.
# The operator's readings against counts give counts per joint turn, hence the gear ratio. The back-EMF gives the motor
# constant from the motor's own speed, independent of the gear.


READING_SD_RAD = 0.004  # of a protractor, including the reading error
SCALE_TOLERANCE = 0.015  # of the gear ratio; a wrong gear is off by more
EXACT = 0.004  # accuracy of a gear ratio from the end stops
SPACING_SPREAD_counts = 4
TOUCH_SPREAD_RAD = 0.0025  # repeatability of an end stop
SAME_WAY_SPREAD_RAD = 0.003  # repeatability of the home switch in one direction
EDGE_SPREAD_RAD = 0.015  # of the home switch in both directions: backlash, hysteresis, half a cycle of motion
MISREAD_RAD = 0.025  # residual of a reading from the line through the others
FEWEST_READINGS = 3  # readings needed to detect a misread one
CONSTANT_TOLERANCE = 0.2
RESISTANCE_TOLERANCE = 0.6  # leads, brushes and heat add to the data sheet's value
LEAST_CURRENT_A = 0.1  # smallest current that determines a resistance


def diagnose(draft: Drive, wiring: MeasuredWiring, measured: JointMeasurements, board_counts: int) -> Diagnosis:
    """The diagnosis of a joint; `board_counts`: counts per turn of its encoder by its boards."""
    drive = rewired(draft, wiring)
    result = Diagnosis(drive)
    is_slipping = _slip(result, measured)
    _counts(result, measured, board_counts)
    offset_rad, slope = _line(result, measured, is_slipping)
    if not is_slipping:
        _gear(result, slope, draft, len(measured.readings))
    scale = draft.counts_per_joint_turn / result.drive.counts_per_joint_turn
    _motor(result, measured, scale * result.drive.gear_ratio)
    _friction(result, measured, draft, scale)
    if not result.problems:
        offset_rad = place_home(result, measured, offset_rad, scale)
        place_limits(result, measured, offset_rad, scale)
    return result


def rewired(draft: Drive, wiring: MeasuredWiring) -> Drive:
    """The draft's drive with the measured wiring."""
    if wiring.board:
        return replace(
            draft,
            board=wiring.board,
            board_channel=wiring.board_channel,
            motor_direction=wiring.motor_direction,
            encoder_direction=wiring.encoder_direction,
        )
    return replace(
        draft,
        motor_node=wiring.node,
        motor_direction=wiring.motor_direction,
        encoder_board=wiring.channel[0],
        encoder_channel=wiring.channel[1],
        encoder_direction=wiring.encoder_direction,
        board_holds=wiring.board_holds,
    )


def _slip(result: Diagnosis, measured: JointMeasurements) -> bool:
    """Whether the counts fail to repeat when the joint returns to a place."""
    name = f"joint {result.drive.joint}"
    evidence = []
    for stops, side in zip(measured.stops_rad, ("lower", "upper"), strict=True):
        if len(stops) > 1 and max(stops) - min(stops) > TOUCH_SPREAD_RAD:
            spread = max(stops) - min(stops)
            evidence.append(
                f"the {side} end stop was touched {len(stops)} times, and the counts differ by {1e3 * spread:.1f} mrad"
            )
    ways = [[edge for edge, direction, _ in measured.edges if direction == way] for way in (1, -1)]
    for edges, limit_rad in (
        (ways[0], SAME_WAY_SPREAD_RAD),
        (ways[1], SAME_WAY_SPREAD_RAD),
        (ways[0] + ways[1], EDGE_SPREAD_RAD),
    ):
        if len(edges) > 1 and max(edges) - min(edges) > limit_rad + measured.cycle_rad:
            evidence.append(f"the home switch positions differ by {1e3 * (max(edges) - min(edges)):.1f} mrad")
            break
    if measured.flags & SIGNAL_LOST:
        result.problems.append(f"{name}: LOST ENCODER SIGNAL during motion: check the cable where it bends, and its plug")
    if not evidence:
        if measured.flags & QUADRATURE_ERROR:
            result.notes.append(f"{name}: illegal encoder transition: check the shield and the supply of the encoder cable")
        return False
    if measured.flags & QUADRATURE_ERROR:
        cause = "COUNTS ARE LOST: illegal encoder transitions: check the shield, supply and length of the encoder cable"
    else:
        cause = (
            "LOOSE ENCODER: no illegal transition was seen, so something slips: tighten the encoder on its shaft,"
            " then the belt, pinion and end stop"
        )
    result.problems.append(f"{name}: {cause} ({'; '.join(evidence)})")
    return True


def _counts(result: Diagnosis, measured: JointMeasurements, board_counts: int) -> None:
    """Counts per turn of the encoder, from index to index."""
    drive, name = result.drive, f"joint {result.drive.joint}"
    spacings = measured.spacings_count
    if not measured.has_index:
        result.notes.append(
            f"{name}: its board knows no index: counts per turn are the draft's, and the gear ratio is that times these"
        )
        return
    if not spacings and not has_two_indices(drive):
        result.notes.append(f"{name}: its range has no two index pulses: counts per turn of the encoder are the draft's")
        return
    if not spacings:
        problem = f"{name}: NO INDEX PULSE within {2.6:g} turns of the encoder: check the encoder's Z wire"
        if drive.home is not None:
            result.problems.append(f"{problem}; homing needs it")
        else:
            result.notes.append(f"{problem}; counts per turn were not checked and are the draft's")
        return
    middle = round(median(spacings))
    result.figures["index_spacing_counts"] = middle
    if max(spacings) - min(spacings) > SPACING_SPREAD_counts:
        result.problems.append(
            f"{name}: COUNTS ARE LOST between index pulses ({min(spacings)} to {max(spacings)} counts): check the"
            " shield, supply and length of the encoder cable"
        )
    elif abs(middle - drive.encoder_counts_per_rev) > SPACING_SPREAD_counts:
        result.changes.append(
            f"{name}: WRONG COUNTS: {middle} counts from index to index, draft {drive.encoder_counts_per_rev}:"
            f" encoder_counts_per_rev = {middle}"
        )
        result.drive = replace(drive, encoder_counts_per_rev=middle)
    if abs(middle - board_counts) > SPACING_SPREAD_counts:
        result.notes.append(
            f"{name}: the boards are configured for {board_counts} counts per turn, the encoder has {middle}:"
            " configure the boards, or the new arm.toml will reject them"
        )


def _line(result: Diagnosis, measured: JointMeasurements, is_slipping: bool) -> tuple[float, float]:
    """Fit reading = offset + slope * nominal angle by least squares; NaN with fewer than two places."""
    points = measured.readings
    name = f"joint {result.drive.joint}"
    if len(points) < 2:
        result.notes.append(f"{name}: no angle was read: gear ratio, zero and limits were not checked and are the draft's")
        return math.nan, math.nan
    x0, q0 = fmean(x for x, _ in points), fmean(q for _, q in points)
    sxx = math.fsum((x - x0) ** 2 for x, _ in points)
    if sxx < 0.01:
        result.problems.append(f"{name}: it hardly moved between two readings: free the joint and run again")
        return math.nan, math.nan
    slope = math.fsum((x - x0) * (q - q0) for x, q in points) / sxx
    offset = q0 - slope * x0
    worst = max(abs(q - offset - slope * x) for x, q in points)
    result.figures |= {"scale": slope, "scale_sd": READING_SD_RAD / math.sqrt(sxx)}
    if slope < 0.0:
        result.problems.append(
            f"{name}: the angle readings fell while the joint turned in its stated positive direction: one of the two"
            " answers was wrong; run again"
        )
    elif worst > MISREAD_RAD and not is_slipping:
        result.problems.append(
            f"{name}: the readings deviate by up to {math.degrees(worst):.1f} deg from a straight line over the"
            " counts: an angle was misread, or the encoder slips (LOOSE ENCODER); run again"
        )
    return offset, slope


def _gear(result: Diagnosis, slope: float, draft: Drive, readings: int) -> None:
    """Turns of the gear that the encoder is behind: gear_ratio of one on the motor, encoder_ratio of one on the joint.

    A ratio other than the draft's is accepted only if a misread angle would show.
    """
    if not slope > 0.0:
        return
    drive = result.drive
    key, what = ("gear_ratio", "motor") if drive.encoder_on == "motor" else ("encoder_ratio", "encoder")
    drawn: float = getattr(draft, key)
    ratio = drawn * draft.encoder_counts_per_rev / (slope * drive.encoder_counts_per_rev)
    sd = ratio * result.figures["scale_sd"] / slope
    result.figures |= {key: ratio, f"{key}_sd": sd}
    if abs(ratio / drawn - 1.0) <= max(SCALE_TOLERANCE, 3.0 * sd / ratio):
        return
    comparison = f"{ratio:.2f} {what} turns per joint turn (sd {sd:.2f}), draft {drawn:g}"
    if abs(ratio / drawn - 1.0) < ODD_RATIO:
        result.problems.append(
            f"joint {drive.joint}: LOOSE ENCODER or WRONG GEAR: {comparison}: such a small difference is rarely a"
            f" different gearbox; tighten the encoder on its shaft and run again, or correct {key} in the draft"
            " if the gearbox plate confirms it"
        )
        return
    if readings < FEWEST_READINGS:
        result.problems.append(
            f"joint {drive.joint}: WRONG GEAR or a misread angle: {comparison}; {readings} readings cannot reveal a"
            f" misread one; run again with end stops, or correct {key} in the draft if the gearbox plate"
            " confirms it"
        )
        return
    rounded = float(round(ratio)) if abs(ratio - round(ratio)) < 2.0 * sd else float(f"{ratio:.4g}")
    result.changes.append(f"joint {drive.joint}: WRONG GEAR: {comparison}: {key} = {rounded:g}; compare with the gearbox plate")
    if sd > EXACT * ratio:
        result.notes.append(
            f"joint {drive.joint}: the gear ratio is known to {sd / ratio:.1%} only: run with end stops and read the angles there"
        )
    result.drive = replace(drive, gear_ratio=rounded) if what == "motor" else replace(drive, encoder_ratio=rounded)


def _motor(result: Diagnosis, measured: JointMeasurements, motor_turns: float) -> None:
    """Fit volts = R I + k w over all passes, w the motor's own speed; only a check of the data sheet's values.

    `motor_turns`: of the motor per turn of the joint by the draft's counts.
    """
    if len(measured.passes) < 4 or not measured.has_volts:
        return
    rows = [(p.current_A, p.speed_rad_s * motor_turns, p.volts) for p in measured.passes]
    aa, ab, bb = (math.fsum(r[i] * r[j] for r in rows) for i, j in ((0, 0), (0, 1), (1, 1)))
    av, bv = (math.fsum(r[i] * r[2] for r in rows) for i in (0, 1))
    determinant = aa * bb - ab * ab
    if determinant <= 1e-3 * aa * bb or aa < len(rows) * LEAST_CURRENT_A**2:
        return  # with currents proportional to speeds, resistance and constant are not separable
    resistance_ohm, constant = (av * bb - bv * ab) / determinant, (bv * aa - av * ab) / determinant
    result.figures |= {"resistance_ohm": resistance_ohm, "torque_constant_Nm_A": constant}
    drive, name = result.drive, f"joint {result.drive.joint}"
    if abs(constant / drive.torque_constant_Nm_A - 1.0) > CONSTANT_TOLERANCE:
        result.notes.append(
            f"{name}: back-EMF constant {constant:.4f} V s/rad, torque_constant_Nm_A of the draft"
            f" {drive.torque_constant_Nm_A:g}: check motor and winding against the data sheet"
        )
    if abs(resistance_ohm / drive.resistance_ohm - 1.0) > RESISTANCE_TOLERANCE:
        result.notes.append(
            f"{name}: {resistance_ohm:.3f} ohm between board and motor, draft {drive.resistance_ohm:g}: check crimps"
            " and brushes, or correct resistance_ohm"
        )


def _friction(result: Diagnosis, measured: JointMeasurements, draft: Drive, scale: float) -> None:
    """Friction from half the difference of the currents in both directions: coulomb + viscous * speed; the mean is gravity."""
    constant = result.drive.torque_constant_Nm_A * result.drive.gear_ratio
    forth = [p for p in measured.passes if p.speed_rad_s > 0.0]
    back = [p for p in measured.passes if p.speed_rad_s < 0.0]
    points = [
        (0.5 * (f.speed_rad_s - b.speed_rad_s) * scale, 0.5 * (f.current_A - b.current_A) * constant)
        for f in forth
        for b in back
        if math.isclose(f.speed_rad_s, -b.speed_rad_s, rel_tol=0.1)
    ]
    if len(points) < 2:
        result.notes.append(f"joint {draft.joint}: friction was not measured: the joint did not turn freely in both directions")
        return
    w0, t0 = fmean(w for w, _ in points), fmean(t for _, t in points)
    sww = math.fsum((w - w0) ** 2 for w, _ in points)
    viscous = max(0.0, math.fsum((w - w0) * (t - t0) for w, t in points) / sww) if sww > 1e-4 else 0.0
    result.coulomb_Nm = max(0.0, t0 - viscous * w0)
    result.viscous_Nm_s_rad = viscous
    result.figures |= {"coulomb_Nm": result.coulomb_Nm, "viscous_Nm_s_rad": viscous}


# Where index, home switch and end stops are, in the joint's own angle, and the resulting changes of a draft.
TURN_TOLERANCE = 0.3  # of the encoder's turn, between the index by the readings and by the draft
SWITCH_TOLERANCE = 0.15  # of the encoder's turn, of the switch
STOP_CLEARANCE_RAD = 0.02  # distance of a limit from its stop
LEAST_CLEARANCE_RAD = 0.01
SHORT_RANGE = 0.9  # of the draft's range


def place_home(result: Diagnosis, measured: JointMeasurements, offset_rad: float, scale: float) -> float:
    """Index and switch by the readings; returns the angle of the joint's first pose, from the index if it is trusted."""
    drive, name = result.drive, f"joint {result.drive.joint}"
    home = drive.home
    if home is None:
        return offset_rad
    if not measured.edges:
        if measured.is_home_active and all(measured.stops_rad):
            state = "active" if measured.is_home_active[0] else "not active"
            result.problems.append(
                f"{name}: NO HOME SWITCH: it was {state} from one end stop to the other: check the switch, cam and"
                " wire, or remove [drive.home]"
            )
        return offset_rad
    above = {(direction > 0) == is_active for _, direction, is_active in measured.edges}
    if len(above) == 1 and above != {home.sense > 0.0}:
        result.problems.append(
            f"{name}: HOME SWITCH INVERTED: it is active {'above' if above == {True} else 'below'} its edge, expected"
            " on the side of index_rad: invert the switch, or set index_rad and switch_rad for the other side"
        )
        return offset_rad
    if math.isnan(measured.index_rad):
        result.notes.append(
            f"{name}: no index pulse was seen behind the home switch: [drive.home] was not checked and is the draft's"
        )
        return offset_rad
    return _place_index(result, measured, home, offset_rad, scale)


def _place_index(result: Diagnosis, measured: JointMeasurements, home: Home, offset_rad: float, scale: float) -> float:
    name = f"joint {result.drive.joint}"
    turn_rad = result.drive.encoder_turn_rad
    index_rad = home.index_rad
    if not math.isnan(offset_rad):
        read_rad = offset_rad + scale * measured.index_rad
        result.figures["index_read_rad"] = read_rad
        if abs(read_rad - index_rad) > TURN_TOLERANCE * turn_rad:
            index_rad = round(read_rad, 4)
            what = "index" if measured.has_index else "switch"
            result.changes.append(
                f"{name}: {what.upper()} MOVED: the readings put its {what} at {math.degrees(read_rad):.2f} deg, the draft at"
                f" {math.degrees(home.index_rad):.2f} deg (one turn of the encoder is {math.degrees(turn_rad):.2f} deg):"
                f" index_rad = {index_rad:g}; calibration refines the zero"
            )
    forth = round(home.sense)
    edges = [edge for edge, direction, is_active in measured.edges if direction == forth and is_active]
    switch_rad = home.switch_rad + (index_rad - home.index_rad)
    if edges:
        measured_rad = index_rad - scale * (measured.index_rad - fmean(edges))
        result.figures["index_behind_switch_rad"] = scale * (measured.index_rad - fmean(edges))
        if abs(measured_rad - switch_rad) > SWITCH_TOLERANCE * turn_rad:
            switch_rad = measured_rad
            result.changes.append(
                f"{name}: HOME SWITCH MOVED: its index comes {scale * (measured.index_rad - fmean(edges)):.4f} rad"
                f" behind it, draft {home.index_rad - home.switch_rad:.4f} rad: switch_rad = {round(switch_rad, 4):g}"
            )
        if measured.has_index:
            _warn_of_far_index(result, turn_rad, scale * (measured.index_rad - fmean(edges)))
    result.drive = replace(result.drive, home=replace(home, index_rad=index_rad, switch_rad=round(switch_rad, 7)))
    return index_rad - scale * measured.index_rad


def _warn_of_far_index(result: Diagnosis, turn_rad: float, behind_rad: float) -> None:
    share = abs(behind_rad) / turn_rad % 1.0
    if min(share, 1.0 - share) < 0.15:
        result.notes.append(
            f"joint {result.drive.joint}: its index comes {share:.2f} of a motor turn behind the home switch: a small"
            " shift of the switch makes homing one turn off; move the switch by half a motor turn"
        )


def _ends(measured: JointMeasurements) -> str:
    names = {"LIMIT SWITCHES" if has_limit else "END STOPS" for has_limit in measured.has_limit}
    return " and ".join(sorted(names))


def place_limits(result: Diagnosis, measured: JointMeasurements, offset_rad: float, scale: float) -> None:
    """Place the limits in front of the stops."""
    if math.isnan(offset_rad):
        return
    drive, name = result.drive, f"joint {result.drive.joint}"
    lower, upper = drive.joint_lower_rad, drive.joint_upper_rad
    ends_rad = [offset_rad + scale * fmean(stops) if stops else math.nan for stops in measured.stops_rad]
    result.figures |= {"lower_stop_rad": ends_rad[0], "upper_stop_rad": ends_rad[1]}
    if not math.isnan(ends_rad[0]) and lower < ends_rad[0] + LEAST_CLEARANCE_RAD:
        lower = round(ends_rad[0] + STOP_CLEARANCE_RAD, 3)
    if not math.isnan(ends_rad[1]) and upper > ends_rad[1] - LEAST_CLEARANCE_RAD:
        upper = round(ends_rad[1] - STOP_CLEARANCE_RAD, 3)
    if (lower, upper) == (drive.joint_lower_rad, drive.joint_upper_rad):
        return
    stops = " and ".join(f"{math.degrees(stop):.1f} deg" for stop in ends_rad if not math.isnan(stop))
    if not lower < upper:
        result.problems.append(
            f"{name}: {_ends(measured)} at {stops} leave no range: it did not come from one to the other: free the joint and run"
            " again"
        )
        return
    result.changes.append(
        f"{name}: {_ends(measured)} are at {stops}: joint_lower_rad = {lower:g}, joint_upper_rad = {upper:g} (draft"
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
