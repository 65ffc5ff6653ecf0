"""Survey: short pulses on one motor board after the other show which joint moves and which encoder counts.

Only the rough motor constants of the draft (resistance, constant, gear) are trusted; they limit a pulse.
"""

import math
from dataclasses import asdict, dataclass, replace

from control.hardware.words import SIGNAL_LOST
from control.model.arm import Drive
from control.model.joint_map import JointMap
from procedures.bringup.operator import BringupOperator, Stopped
from procedures.bringup.workbench import Channel, DriveLimits, Sample, Workbench, named, node_of

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


def pulse(
    bench: Workbench, operator: BringupOperator, drive: Drive, caution: Caution, joint_count: int
) -> Pulse:
    """Ramp the voltage of the draft's motor board for `drive` until something moves, ask what moved, and go back.

    Raises Stopped, SafetyTrip and the errors of the boards; the drive is then off.
    """
    volts, name, node = caution.voltage_V(drive), named(drive), node_of(drive)
    per_rad = abs(JointMap(drive).counts_per_radian)
    if not operator.allow(
        f"{name[:1].upper()}{name[1:]} (joint {drive.joint} in the draft): a pulse of at most"
        f" {caution.current_A:.2f} A and {volts:.2f} V. One joint should turn by about {math.degrees(PULSE_RAD):.0f}"
        f" deg, at most {math.degrees(BLIND_RAD):.0f} deg."
    ):
        raise Stopped("the operator did not confirm the pulse")
    bench.prepare()
    before_count = bench.motor_count(node)
    sinking = _drift(bench)
    limits = DriveLimits(caution.current_A, volts, travel_count=TRAVEL * PULSE_RAD * per_rad)
    forth = _ramp(bench, drive, limits, per_rad, 1.0)
    rest = bench.observe(SETTLE_S)
    moved = _moved(forth[0], rest, sinking)
    motor_board_count = bench.motor_count(node) - before_count
    seen = operator.what_moved(joint_count)
    returned: dict[Channel, int] = {}
    if any(abs(count) > MOVED_RAD * per_rad for count in moved.values()) or seen:
        back = _ramp(bench, drive, limits, per_rad, -1.0, -_largest(moved))
        rest = bench.observe(SETTLE_S)
        returned = _moved(back[0], rest, sinking)
    judged = _judged(drive, forth, moved, returned, seen, per_rad, motor_board_count)
    return judged if bench.has_volts else replace(judged, peak_volts=math.nan, stall_ohm=math.nan)


def _ramp(
    bench: Workbench, drive: Drive, limits: DriveLimits, per_rad: float, sign: float, wanted: int = 0
) -> list[Sample]:
    """Raise the voltage until the largest channel has moved by the pulse (or by `wanted` counts); returns all cycles."""
    samples: list[Sample] = []
    blind_rad, time_s = 0.0, 0.0
    goal = abs(wanted) or PULSE_RAD * per_rad
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
            if any(abs(samples[-1].counts[at] - first.counts[at]) >= goal for at in first.counts):
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


def _largest(moved: dict[Channel, int]) -> int:
    return max(moved.values(), key=abs, default=0)


def _judged(
    drive: Drive,
    forth: list[Sample],
    moved: dict[Channel, int],
    returned: dict[Channel, int],
    seen: tuple[int, int] | None,
    per_rad: float,
    motor_board_count: int,
) -> Pulse:
    least = MOVED_RAD * per_rad
    ordered = sorted((at for at in moved if abs(moved[at]) > least), key=lambda at: -abs(moved[at]))
    channel = ordered[0] if ordered else None
    largest = abs(moved[channel]) if channel else 0
    others = tuple(at for at in ordered[1:] if abs(moved[at]) > ANSWERING_SHARE * largest)
    still = [s for s in forth if all(abs(s.counts[at] - forth[0].counts[at]) < 5 for at in s.counts)]
    vi, ii = sum(s.volts * s.current_A for s in still), sum(s.current_A**2 for s in still)
    return Pulse(
        node=node_of(drive),
        joint=seen[0] if seen else 0,
        direction=seen[1] if seen else 0,
        channel=channel,
        moved_count=moved[channel] if channel else 0,
        returned_count=returned.get(channel, 0) if channel else 0,
        others=others,
        peak_volts=max(abs(s.volts) for s in forth),
        peak_current_A=max(abs(s.current_A) for s in forth),
        stall_ohm=vi / ii if ii > 0.01 else math.nan,
        breakaway_A=abs(still[-1].current_A) if still else math.nan,
        motor_board_count=motor_board_count,
        lost=tuple(at for at, flags in forth[-1].flags.items() if flags & SIGNAL_LOST),
    )
