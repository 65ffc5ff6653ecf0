"""An arm under control: its fixed parts, built by control.server.assemble, and its mutable state, read and written by the steps
of a cycle.

The steps are functions of the state, one module per subject: control.loop.set_points (set-points), motion_modes (motions,
jogs, stops), fault_reactions, on_and_off. Each module lists the attributes that it writes; all others only read them.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

from control.dynamics.feedforward import Loads
from control.dynamics.joint_side import JointSide
from control.end_effector import GripperControl, Outputs
from control.hardware.board_stop import BoardStop, Bridge
from control.hardware.interface import Hardware
from control.hardware.measurement import Averaging, Measurement, MotorLeads
from control.hardware.tip_camera import TipCamera
from control.kinematics.inverse import InverseKinematics
from control.kinematics.kinematics import ForwardKinematics
from control.loop import cross_checks
from control.loop.drives import Bound, DriveStates, Standstill
from control.loop.homing_sequence import HomingSequence
from control.loop.jogging import Jogging
from control.loop.watch import Watch
from control.model.arm import Tool
from control.motion.guard import Guard
from control.motion.pace import Paced
from control.motion.setpoint import Lookout, Motion, SetPoint, at_rest
from control.recording.record import Recorder
from control.safety.limits import SetPointLimits, UniqueTurn
from control.safety.modes import CONTROLLED_MODES, Event, Mode, Monitor
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


SEARCHING_MODES = frozenset({Mode.HOMING, Mode.JOGGING})


class ArmState:
    """State of the arm: measured values, set-points, mode and motion."""

    def __init__(self, parts: Parts) -> None:
        n = len(parts.joint_names)
        self.parts = parts
        self.monitor = Monitor()
        # the cycle
        self.punctuality = Punctuality(parts.period_s, parts.stopwatch_s, parts.strain)
        self.now_s = 0.0
        # since the last cycle, by the cycle timer; of a pause, what `bridge` leaves
        self.elapsed_s = parts.period_s
        self.has_missed = False  # deadlines, before this cycle
        self.bridge: Bridge | None = None  # what the pause before this cycle meant, if the boards had to stop
        self.cycles = 0
        self.has_waited = False  # for boards, outside of a cycle: deadlines missed meanwhile do not count
        # measured
        self.averaging: Averaging | None = None
        self.camera_m = self.new_camera_m = NOWHERE  # of the last frame; of this cycle's frame
        self.camera_at_s = -math.inf
        self.drives = DriveStates(parts.joint_names)
        self.stillness = Standstill()
        # set-points (set_points)
        self.no_motion = (0.0,) * n  # speeds or accelerations
        self.set_point = self.aim = at_rest(self.no_motion)  # of the joints; of their encoders
        self.is_of_encoders = False  # whether set_point is; only during a motion given in encoder angles
        # motions (motion_modes, on_and_off)
        self.run_number = 0
        self.paced: Paced | None = None  # the active motion or stop
        self.lookout: Lookout | None = None  # of that motion, unless it is a stop
        self.stops_along = False  # whether that motion slows down to rest on its path
        self.override = 1.0  # pace at which motions run
        self.jogging: Jogging | None = None
        self.homing: HomingSequence | None = None
        self.was_stopped = False  # the last motion, before its end
        self.stop_reason = ""  # of the last stop that no client of this arm asked for
        self.is_weightless = False  # gravity compensation during hand guiding
        self.unrecorded = ""  # why cycles are not recorded now; empty while they are
        self.stated_payload_kg = 0.0  # by a client; the model's payload follows it
        self.bound = Bound.NOWHERE  # where the arm is on its way to by itself (on_and_off)
        self.fault_rows: tuple[bytes, ...] = ()  # the cycles before the first fault (fault_reactions)
        if parts.hardware.has_torque():
            self.on(Event.FOUND_HELD)

    def on(self, event: Event) -> None:
        """Raise an event; IllegalTransition if the mode does not allow it, and then nothing changes."""
        before = self.monitor.mode
        self.monitor.on(event)
        if self.monitor.mode is not before or event is Event.BRAKE:
            self.stillness.enter_mode(self.now_s)

    def end_way_to_hold(self) -> None:
        """What was asked since, or a fault, ends it; a way off goes on. An arm that was off a moment ago is off again.

        A take-over goes to its end: boards of which some are ours already are safest under control, and then the arm holds.
        """
        if self.monitor.mode is Mode.HELD:
            return
        if self.bound is Bound.ON and self.monitor.mode is Mode.BRAKED:
            self.on(Event.SWITCH_OFF)
        if self.bound.is_hold:
            self.bound = Bound.NOWHERE

    def is_controlled(self) -> bool:
        """Whether the servo works on the set-point."""
        return self.monitor.mode in CONTROLLED_MODES or self.monitor.is_held_fault

    def is_searching(self) -> bool:
        """Whether joints without a known zero are moving."""
        mode = self.monitor.mode
        return mode in SEARCHING_MODES and (mode is Mode.HOMING or not self.monitor.is_homed)

    def is_still(self) -> bool:
        """Whether the arm has come to rest in its present mode."""
        return self.stillness.is_still(self.now_s, self.parts.measurement.speed_rad_s)

    def stands(self) -> bool:
        """Whether the arm is left to its boards, or to shorted windings, is to stay so, and has come to rest."""
        is_left = not self.is_controlled() and self.monitor.mode is not Mode.GUIDING
        return is_left and self.bound is Bound.NOWHERE and self.is_still()

    def is_off(self) -> bool:
        """Whether its drives are off."""
        return self.monitor.mode is Mode.OFF

    def payload_kg(self) -> float:
        """Mass at the tip in the model now; it follows the stated one."""
        return self.parts.loads.at_tip_kg

    def progress(self) -> float:
        """Progress of the active motion, 0 to 1; 1 if there is none."""
        return self.paced.progress if self.paced is not None else 1.0

    def pace(self) -> float:
        """Pace of the active motion, 0 to 1; 1 if there is none."""
        return self.paced.pace if self.paced is not None else 1.0

    @property
    def motion(self) -> Motion | None:
        """The active motion."""
        return self.paced.motion if self.paced is not None else None
