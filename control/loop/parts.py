"""The fixed parts of a runtime, built by control.server.assemble."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

from control.dynamics.joint_side import JointSide
from control.dynamics.loads import Loads
from control.end_effector.gripper import GripperControl
from control.end_effector.outputs import Outputs
from control.hardware.board_stop import BoardStop
from control.hardware.interface import Hardware
from control.hardware.measurement import Measurement
from control.hardware.tip_camera import TipCamera
from control.kinematics.inverse import InverseKinematics
from control.kinematics.kinematics import ForwardKinematics
from control.loop.cross_checks import CrossChecks, IndexWatch, MotorCountWatch, SwitchWatch
from control.loop.homing_sequence import HomingSequence
from control.loop.jogging import Jogging
from control.loop.punctuality import Strain
from control.loop.watch import Watch
from control.model.arm import Tool
from control.motion.guard import Guard
from control.motion.setpoint import Motion, SetPoint
from control.recording.record import Recorder
from control.safety.limits import SetPointLimits, UniqueTurn
from control.servo.gravity_compensation import GravityCompensation
from control.servo.servo import Servo

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
    motors: CrossChecks
    indices: IndexWatch
    switches: SwitchWatch
    motor_counts: MotorCountWatch


@dataclass(frozen=True, slots=True)
class Parts:
    """The parts of a runtime; see control.server.assemble."""

    hardware: Hardware
    recorder: Recorder
    measurement: Measurement
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
