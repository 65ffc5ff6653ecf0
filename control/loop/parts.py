"""The fixed parts of a runtime, built by control.server.assemble, and the punctuality that they measure."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

from control.dynamics.joint_side import JointSide
from control.dynamics.loads import Loads
from control.end_effector import GripperControl, Outputs
from control.hardware.board_stop import BoardStop
from control.hardware.interface import Hardware
from control.hardware.measurement import Measurement, MotorLeads
from control.hardware.tip_camera import TipCamera
from control.kinematics.inverse import InverseKinematics
from control.kinematics.kinematics import ForwardKinematics
from control.loop import cross_checks
from control.loop.homing_sequence import HomingSequence
from control.loop.jogging import Jogging
from control.loop.watch import Watch
from control.model.arm import Tool
from control.motion.guard import Guard
from control.motion.setpoint import Motion, SetPoint
from control.recording.record import Recorder
from control.safety.limits import SetPointLimits, UniqueTurn
from control.servo import GravityCompensation, Servo

Strain = Callable[[], tuple[int, int]]
KEPT_CYCLES = 500  # a second at the usual rate


class Punctuality:
    """Statistics over the last cycles. `begin` and `end` cost a fraction of a microsecond each.

    `stopwatch_s` reads a clock; a stepped simulation passes its own, so that its recordings are reproducible. `strain` returns
    the page faults and involuntary switches of this thread so far; without it they count as none.
    """

    def __init__(self, period_s: float, stopwatch_s: Callable[[], float], strain: Strain | None = None) -> None:
        self.period_s = period_s
        self.missed = 0
        self._stopwatch_s = stopwatch_s
        self._late_s = [0.0] * KEPT_CYCLES
        self._busy_s = [0.0] * KEPT_CYCLES
        self._next = 0
        self._began_s = 0.0
        self._strain = strain
        self._strained = strain() if strain is not None else (0, 0)

    def begin(self, late_s: float, missed: int) -> None:
        """Note a cycle that begins `late_s` after its deadline, with `missed` deadlines since the last."""
        self._began_s = self._stopwatch_s()
        self.missed += missed
        self._late_s[self._next] = late_s

    def end(self) -> float:
        """Note the end of the cycle's work; return its duration in s."""
        busy_s = self._stopwatch_s() - self._began_s
        self._busy_s[self._next] = busy_s
        self._next = (self._next + 1) % KEPT_CYCLES
        return busy_s

    def strain(self) -> tuple[int, int]:
        """Page faults and involuntary switches since the last call: once a cycle, what made it late or long."""
        if self._strain is None:
            return 0, 0
        faults, switches = self._strained
        self._strained = now = self._strain()
        return now[0] - faults, now[1] - switches

    def late_s(self, fraction: float) -> float:
        """Quantile of the lateness over the last cycles, e.g. `fraction` 0.99."""
        return _quantile(self._late_s, fraction)

    def busy_s(self, fraction: float) -> float:
        """Quantile of the time spent over the last cycles."""
        return _quantile(self._busy_s, fraction)


def _quantile(values: list[float], fraction: float) -> float:
    ordered = sorted(values)
    return ordered[min(len(ordered) - 1, int(fraction * len(ordered)))]


Vector = tuple[float, float, float]
NOWHERE: Vector = (math.nan, math.nan, math.nan)


@dataclass(frozen=True, slots=True)
class ToolParts:
    """The parts that depend on where the tip is, with one of the arm's tools on."""

    tool: Tool
    kinematics: ForwardKinematics
    inverse: InverseKinematics
    guard: Guard
    jogging: Callable[[bool], Jogging]  # of an arm that is homed; of one that is not


@dataclass(frozen=True, slots=True)
class Checks:
    """What is checked in each cycle: measured values against limits, and sensors against each other."""

    watch: Watch
    motors: cross_checks.CrossChecks
    indices: cross_checks.IndexWatch
    switches: cross_checks.SwitchWatch
    motor_counts: cross_checks.MotorCountWatch
    leads: cross_checks.LeadWatch
    limit_switches: cross_checks.LimitSwitchWatch


@dataclass(frozen=True, slots=True)
class Parts:
    """The parts of a runtime; see control.server.assemble."""

    hardware: Hardware
    recorder: Recorder
    measurement: Measurement
    motor_leads: MotorLeads
    servo: Servo
    checks: Checks
    set_point_limits: tuple[SetPointLimits, ...]
    homing: Callable[[], HomingSequence]
    gravity_compensation: GravityCompensation
    stop_from: Callable[[SetPoint], Motion]
    tools: Mapping[str, ToolParts]  # by name
    tool: ToolParts  # the one that is on
    loads: Loads
    camera: TipCamera | None
    joint_names: tuple[str, ...]
    second_encoders: tuple[int, ...]  # joints with an encoder on the motor, too
    do_counters_span: bool  # whose counters cover the whole travel of their joints without a wrap
    period_s: float
    board_stop: BoardStop
    stopwatch_s: Callable[[], float]
    strain: Strain | None = None  # page faults and switches of the loop's thread
    payload_limit_kg: float = math.inf
    allows_unrecorded: bool = False  # motions while the recording has stopped
    aim_limits: tuple[SetPointLimits, ...] = ()  # of the encoders' set-points, for such an arm
    gripper: GripperControl | None = None
    outputs: Outputs | None = None
    unique_turns: tuple[UniqueTurn, ...] = ()  # of joints whose encoders are absolute
    joint_side: JointSide | None = None  # of an arm whose encoders do not say where its joints are

    def with_tool(self, name: str) -> "Parts":
        """The same parts with another tool on."""
        return replace(self, tool=self.tools[name])
