"""Which board moves which joint, and which encoder counts it: short pulses on one motor after the other, and what follows.

Only the rough motor constants of the draft (resistance, constant, gear) are trusted; they limit a pulse.
"""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field

from control.hardware.interface import SIGNAL_LOST
from control.model.arm import Drive
from control.model.drive import JointMap
from procedures.bringup.workbench import (
    BringupOperator,
    Channel,
    DriveLimits,
    Sample,
    Stopped,
    Workbench,
    channel_of,
    named,
    node_of,
)

PULSE_RAD = 0.05  # joint travel of a pulse: visible, but harmless
BLIND_RAD = 0.12  # largest travel of a pulse if nothing is counted, by voltage over back-EMF
TRAVEL = 4.0  # times the pulse: travel limit
RAMP_S = 1.5  # from 0 V to the limit
HOLD_S = 0.3  # at the limit
SETTLE_S = 0.15
MOVED_RAD = 0.005  # by the draft's scale: less does not count as motion
ANSWERING_SHARE = 0.3  # of the largest: a second channel with more travel also moves


@dataclass(frozen=True, slots=True)
class Caution:
    """Limits of a motor in bring-up."""

    current_A: float
    speed_rad_s: float

    def voltage_V(self, drive: Drive) -> float:
        """Enough for the current at stall and the speed, no more."""
        constant = drive.gear_ratio * drive.torque_constant_Nm_A
        return min(self.current_A * drive.resistance_ohm + constant * self.speed_rad_s, drive.supply_V)


@dataclass(frozen=True, slots=True)
class Pulse:
    """A pulse of positive voltage on one motor board. `joint` and `direction` are the operator's answer, 0 for none."""

    node: int
    joint: int
    direction: int
    channel: Channel | None
    moved_count: int
    returned_count: int
    """Travel of the same channel under negative voltage."""
    others: tuple[Channel, ...]
    """Other channels that moved."""
    peak_volts: float
    peak_current_A: float
    stall_ohm: float
    """Voltage over current before anything moved; NaN if no current flowed."""
    breakaway_A: float
    motor_board_count: int
    """Travel of the motor board's own counter."""
    lost: tuple[Channel, ...] = ()
    """Channels whose signal the encoder board reports as lost."""

    def as_json(self) -> dict[str, object]:
        """For the journal."""
        return asdict(self)


def pulse(bench: Workbench, operator: BringupOperator, drive: Drive, caution: Caution, joint_count: int) -> Pulse:
    """Ramp the voltage of the draft's motor board for `drive` until something moves, ask what moved, and go back.

    Raises Stopped, SafetyTrip and the errors of the boards; the drive is then off.
    """
    volts, name, node = caution.voltage_V(drive), named(drive), node_of(drive)
    per_rad = abs(JointMap(drive).counts_per_radian)
    strength = f"of at most {caution.current_A:.2f} A and {volts:.2f} V"
    if not bench.limits_current:
        strength = "as strong as its board's own settings let it be"
    if not operator.allow(
        f"{name[:1].upper()}{name[1:]} (joint {drive.joint} in the draft): a pulse {strength}. One joint should turn by"
        f" about {math.degrees(PULSE_RAD):.0f} deg, at most {math.degrees(BLIND_RAD):.0f} deg."
    ):
        raise Stopped("the operator did not confirm the pulse")
    bench.prepare()
    before_count = bench.motor_count(node)
    sinking = _drift(bench)
    limits = DriveLimits(caution.current_A, volts, travel_count=TRAVEL * PULSE_RAD * per_rad)
    forth = _ramp(bench, drive, limits, 1.0, PULSE_RAD * per_rad)
    rest = bench.observe(SETTLE_S)
    moved = _moved(forth[0], rest, sinking)
    motor_board_count = bench.motor_count(node) - before_count
    seen = operator.what_moved(joint_count)
    returned: dict[Channel, int] = {}
    if any(abs(count) > MOVED_RAD * per_rad for count in moved.values()) or seen:
        back = _ramp(bench, drive, limits, -1.0, abs(max(moved.values(), key=abs, default=0)) or PULSE_RAD * per_rad)
        rest = bench.observe(SETTLE_S)
        returned = _moved(back[0], rest, sinking)
    channel, others = _answering(moved, MOVED_RAD * per_rad)
    still = _still(forth)
    return Pulse(
        node=node,
        joint=seen[0] if seen else 0,
        direction=seen[1] if seen else 0,
        channel=channel,
        moved_count=moved[channel] if channel else 0,
        returned_count=returned.get(channel, 0) if channel else 0,
        others=others,
        peak_volts=max(abs(s.volts) for s in forth) if bench.has_volts else math.nan,
        peak_current_A=max(abs(s.current_A) for s in forth),
        stall_ohm=_resistance_ohm(still) if bench.has_volts else math.nan,
        breakaway_A=abs(still[-1].current_A) if still else math.nan,
        motor_board_count=motor_board_count,
        lost=tuple(at for at, flags in forth[-1].flags.items() if flags & SIGNAL_LOST),
    )


def _ramp(bench: Workbench, drive: Drive, limits: DriveLimits, sign: float, goal_count: float) -> list[Sample]:
    """Raise the voltage until the largest channel has moved by so many counts; returns all cycles."""
    samples: list[Sample] = []
    blind_rad, time_s = 0.0, 0.0
    constant = drive.gear_ratio * drive.torque_constant_Nm_A
    with bench.driving(node_of(drive), limits):
        first = bench.cycle(0.0)
        samples.append(first)
        while time_s < RAMP_S + HOLD_S and blind_rad < BLIND_RAD:
            volts = limits.voltage_V * min(1.0, time_s / RAMP_S)
            samples.append(bench.cycle(sign * volts))
            span_s = samples[-1].t_s - samples[-2].t_s
            time_s += span_s
            # Voltage minus the resistive drop is back-EMF, hence speed.
            emf = max(0.0, volts - drive.resistance_ohm * abs(samples[-1].current_A))
            blind_rad += emf / constant * span_s
            if any(abs(samples[-1].counts[at] - first.counts[at]) >= goal_count for at in first.counts):
                break
    return samples


def _drift(bench: Workbench) -> dict[Channel, float]:
    """Counts per second of joints that sink with shorted windings, before anything is driven."""
    first = bench.observe(0.02)
    last = bench.observe(SETTLE_S)
    span_s = max(last.t_s - first.t_s, 1e-3)
    return {at: (last.counts[at] - first.counts[at]) / span_s for at in last.counts}


def _moved(first: Sample, last: Sample, sinking: dict[Channel, float]) -> dict[Channel, int]:
    """Travel of the channels, without the sinking."""
    span_s = last.t_s - first.t_s
    return {at: round(last.counts[at] - first.counts[at] - sinking[at] * span_s) for at in last.counts}


def _answering(moved: dict[Channel, int], least_count: float) -> tuple[Channel | None, tuple[Channel, ...]]:
    """The channel that moved most, if one moved at all, and the others that answered."""
    ordered = sorted((at for at in moved if abs(moved[at]) > least_count), key=lambda at: -abs(moved[at]))
    if not ordered:
        return None, ()
    largest = abs(moved[ordered[0]])
    return ordered[0], tuple(at for at in ordered[1:] if abs(moved[at]) > ANSWERING_SHARE * largest)


def _still(forth: list[Sample]) -> list[Sample]:
    """The cycles before anything moved."""
    return [s for s in forth if all(abs(s.counts[at] - forth[0].counts[at]) < 5 for at in s.counts)]


def _resistance_ohm(still: list[Sample]) -> float:
    """Voltage over current; NaN if no current flowed."""
    vi, ii = sum(s.volts * s.current_A for s in still), sum(s.current_A**2 for s in still)
    return vi / ii if ii > 0.01 else math.nan


NO_CURRENT = 0.1  # of the current that the voltage would drive through the windings at rest
NO_CURRENT_A = 0.06  # more is not noise; friction of a small gear needs it
SAME_COUNT = 0.5  # tolerance of the motor board's count: a joint sinks between readings


@dataclass(frozen=True, slots=True)
class MeasuredWiring:
    """Measured wiring of a joint. Directions as in arm.toml."""

    joint: int
    node: int
    motor_direction: int
    channel: Channel
    encoder_direction: int
    board_holds: bool
    board: str = ""  # of a bought board, and its output
    board_channel: int = 1


@dataclass(slots=True)
class WiringFound:
    """The identified joints, and the problems of the others with remedies."""

    joints: dict[int, MeasuredWiring] = field(default_factory=dict)
    problems: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


def wiring_of(pulses: Sequence[Pulse], drives: Sequence[Drive]) -> WiringFound:
    """Combine the pulses of all motor boards."""
    result = WiringFound()
    draft = {node_of(drive): drive for drive in drives}
    for pulse in pulses:
        drive = draft[pulse.node]
        problem = _problem_of(pulse, drive)
        if problem:
            result.problems.append(problem)
            continue
        _take(result, pulse, drive)
    _same_channel(result)
    for joint in result.joints.values():
        result.notes += _changes(joint, drives[joint.joint - 1])
    return result


def _problem_of(pulse: Pulse, drive: Drive) -> str:
    """Why a pulse does not identify a joint, or ""."""
    name = f"{named(drive)} (joint {drive.joint} in the draft)"
    is_counted, is_seen = pulse.channel is not None, pulse.joint > 0
    flowed = f"{pulse.peak_current_A:.2f} A"
    least_A = NO_CURRENT_A
    if math.isfinite(pulse.peak_volts):
        flowed += f" at {pulse.peak_volts:.2f} V"
        least_A = min(NO_CURRENT * pulse.peak_volts / drive.resistance_ohm, NO_CURRENT_A)
    # A gear without friction hardly needs current either, but it follows the voltage in both directions.
    follows = pulse.moved_count * pulse.returned_count < 0
    if pulse.peak_current_A < least_A and not follows and is_counted >= is_seen:
        moved = "the motion came from gravity" if is_counted else "nothing moves or counts"
        return (
            f"{name}: DEAD MOTOR: no current flows ({flowed}), {moved}: check the motor's cable, plug and brushes,"
            " and the board's fuse"
        )
    if is_counted and is_seen:
        return ""
    if not is_counted and not is_seen:
        return (
            f"{name}: STUCK JOINT: the motor draws {flowed}, but nothing moves or counts: look for a brake, a"
            " transport lock or a jammed gear; for high friction, give a larger --current"
        )
    if is_seen:
        alive = abs(pulse.motor_board_count) > 10
        hint = (
            f"the motor board counted {pulse.motor_board_count:+d}, so the encoder works: check the cable from the"
            " encoder to the encoder board"
            if alive
            else "the motor board counted nothing either: check the encoder's supply, plug and coupling"
        )
        if pulse.lost:
            hint = f"the encoder board reports a lost signal on channel {', '.join(map(_named, pulse.lost))}; {hint}"
        return f"{name}: DEAD ENCODER: joint {pulse.joint} moved, but no encoder channel counted; {hint}"
    return (
        f"{name}: channel {_named(pulse.channel)} counted {pulse.moved_count:+d}, but no joint was seen to move: the"
        " motor turns without its joint: check pinion, belt and set screws between them"
    )


def _take(result: WiringFound, pulse: Pulse, drive: Drive) -> None:
    if pulse.channel is None:
        return
    if drive.board and pulse.channel != channel_of(drive):
        result.problems.append(
            f"{named(drive)} moved joint {pulse.joint}, but the encoder of joint {pulse.channel[1] + 1} in the draft counted:"
            " SWAPPED ENCODER: swap the encoders' plugs"
        )
        return
    if pulse.joint in result.joints:
        result.problems.append(
            f"motor boards {result.joints[pulse.joint].node} and {pulse.node} both moved joint {pulse.joint}: two"
            " motors are wired in parallel, or an answer was wrong; check and run again"
        )
        return
    if pulse.others:
        others = ", ".join(_named(at) for at in pulse.others)
        result.notes.append(
            f"joint {pulse.joint}: channel {others} moved with it: a belt couples the joints (effect belt_coupling),"
            " or a joint is not supported"
        )
    encoder_direction = pulse.direction * (1 if pulse.moved_count > 0 else -1)
    holds = drive.board_holds if drive.board else _can_board_hold(pulse)
    result.joints[pulse.joint] = MeasuredWiring(
        pulse.joint, pulse.node, pulse.direction, pulse.channel, encoder_direction, holds, drive.board, drive.board_channel
    )
    _compare_motor_board(result, pulse, drive)


def _can_board_hold(pulse: Pulse) -> bool:
    """Whether the motor board's own counter follows the joint with the sign of the voltage."""
    counted, moved = pulse.motor_board_count, abs(pulse.moved_count)
    return counted > 10 and math.isclose(counted, moved, rel_tol=SAME_COUNT, abs_tol=50)


def _compare_motor_board(result: WiringFound, pulse: Pulse, drive: Drive) -> None:
    """The motor board's own counter of the same encoder: needed in position mode, and to hold when the loop is gone."""
    counted = pulse.motor_board_count
    name = f"joint {pulse.joint}: {named(drive)}"
    is_position = drive.pid.mode == "position"
    if counted < -10:
        text = (
            f"{name}: REVERSED MOTOR: the board's own encoder counts down with positive voltage, so its position"
            " control would run away: swap the motor's two leads (or A and B of its encoder)"
        )
        (result.problems if is_position else result.notes).append(
            text if is_position else f'{text} before you use [drive.pid] mode = "position"'
        )
    elif abs(counted) <= 10:
        text = f"{name}: the board's own encoder input counts nothing"
        if is_position:
            result.problems.append(f"{text}: connect it, or choose another [drive.pid] mode")
        else:
            result.notes.append(f"{text}; without it the board brakes when the loop is gone, and cannot hold")
    elif not math.isclose(abs(counted), abs(pulse.moved_count), rel_tol=SAME_COUNT, abs_tol=50):
        result.notes.append(
            f"{name}: the board's own encoder counted {counted:+d}, the encoder board {pulse.moved_count:+d}: check"
            " that both read the same encoder"
        )


def _same_channel(result: WiringFound) -> None:
    """Two joints cannot share one channel."""
    seen: dict[Channel, int] = {}
    for joint, wiring in sorted(result.joints.items()):
        if wiring.channel in seen:
            result.problems.append(
                f"joints {seen[wiring.channel]} and {joint} both made channel {_named(wiring.channel)} count: an"
                " answer was probably wrong; run again"
            )
        seen[wiring.channel] = joint


def _changes(wiring: MeasuredWiring, drive: Drive) -> list[str]:
    """Differences of the wiring from the draft; each is corrected in the new file."""
    changes = []
    name = f"joint {wiring.joint}"
    if wiring.board and wiring.node != node_of(drive):
        changes.append(
            f'{name}: SWAPPED MOTOR: board "{wiring.board}" (output {wiring.board_channel}) moves it, draft {named(drive)}:'
            " board and board_channel corrected"
        )
    elif wiring.node != node_of(drive):
        changes.append(
            f"{name}: SWAPPED MOTOR: motor board {wiring.node} moves it, draft {drive.motor_node}: motor_node corrected"
        )
    if not wiring.board and wiring.channel != channel_of(drive):
        draft = _named((drive.encoder_board, drive.encoder_channel))
        changes.append(
            f"{name}: SWAPPED ENCODER: channel {_named(wiring.channel)} counts it, draft {draft}: encoder_channel corrected"
        )
    if wiring.motor_direction != drive.motor_direction:
        changes.append(
            f"{name}: REVERSED MOTOR: positive voltage turns it in the {_way(wiring.motor_direction)} direction:"
            f" motor_direction = {wiring.motor_direction}"
        )
    if wiring.board_holds != drive.board_holds:
        able = "can hold the joint by its own encoder" if wiring.board_holds else "cannot hold the joint and will brake"
        changes.append(f"{name}: without the loop its motor board {able}: board_holds = {str(wiring.board_holds).lower()}")
    if wiring.encoder_direction != drive.encoder_direction:
        changes.append(
            f"{name}: REVERSED ENCODER: it counts {'up' if wiring.encoder_direction > 0 else 'down'} in the joint's positive"
            f" direction: encoder_direction = {wiring.encoder_direction}"
        )
    return changes


def _way(direction: int) -> str:
    return "positive" if direction > 0 else "negative"


def _named(channel: Channel | None) -> str:
    if channel is None:
        return "none"
    return f"{channel[1]}" if channel[0] == 0 else f"{channel[1]} of encoder board {channel[0]}"
