"""Builds a runtime from an arm, its hardware and a recorder. The only place that knows all parts of the loop."""

import dataclasses
import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence

from control.dynamics.feedforward import Loads, Motor, torque_constants_Nm_A, without_tool_mass
from control.dynamics.gains import InertiaScale, gains_of
from control.dynamics.joint_side import SHARE_OF_ACCELERATION, SHARE_OF_SPEED, JointSide
from control.end_effector import GripperControl, Outputs, PlacedGripper
from control.errors import MissingModel
from control.hardware.board_stop import board_stop
from control.hardware.gripper import PlacedOnBoard
from control.hardware.interface import LOWER_LIMIT, UPPER_LIMIT, Hardware, OutputMode
from control.hardware.measurement import Measurement, MotorLeads
from control.hardware.tip_camera import TipCamera
from control.kinematics.inverse import InverseKinematics
from control.kinematics.kinematics import ForwardKinematics
from control.loop import cross_checks
from control.loop.arm_state import Checks, Parts, Strain, ToolParts
from control.loop.cell import CellRuntime
from control.loop.homing_sequence import TURN_TOLERANCE, HomingSequence, JointHome
from control.loop.jogging import Jogging
from control.loop.neighbours import guard_itself
from control.loop.runtime import Runtime
from control.loop.watch import MeasuredLimits, Watch, WatchLimits
from control.model.arm import Arm, Drive
from control.model.cell import Cell
from control.model.drive import OWN_INPUT, JointMap
from control.motion.guard import Guard
from control.motion.joint_limits import JogLimits, JointLimits
from control.motion.joint_move import StopMotion, prepare
from control.recording.record import NoSink, Recorder, RowSink, layout_of
from control.safety.limits import SetPointLimits, UniqueTurn
from control.server.cell_requests import CellRequests
from control.server.requests import Requests
from control.servo import GravityCompensation, MotionTorque, Pid, Servo

PAUSE_LIMIT = 0.9  # of the boards' watchdog: a host with longer pauses is not fit to control an arm
OVERSPEED = 1.5  # of the speed limit: no controlled motion overshoots as much
IMPOSSIBLE = 2.0  # of the speed without load at the nominal supply: no motor turns its joint as fast
SWITCH_SLACK_rad = 0.01  # between encoder and joint: play, springs, and the hysteresis of a switch
RANGE_MARGIN_rad = 0.05
SET_POINT_MARGIN = 1.05  # of speed and acceleration: plans are checked at samples, set-points at every cycle
SLOPE_MOST = 1.1  # of an encoder's speed over its joint's: more than any scale error, disc or belt
HOMING_TRAVEL = 1.1  # of the joint's range
HOMING_ACCELERATION = 0.2  # of the joint's limit


@dataclasses.dataclass(frozen=True, slots=True)
class Assembly:
    """A runtime and the server of its requests."""

    runtime: Runtime
    requests: Requests


def assemble(
    arm: Arm,
    hardware: Hardware,
    period_s: float,
    camera: TipCamera | None = None,
    sink: RowSink | None = None,
    stopwatch_s: Callable[[], float] = time.perf_counter,
    about: Mapping[str, object] | None = None,
    strain: Strain | None = None,
) -> Assembly:
    """Build a runtime that is ready for its first cycle. MissingModel if arm.toml lacks data for control.

    `stopwatch_s` and `strain` (control.loop.arm_state) are what the recording says about the process.
    """
    prepare()
    limits, loads = JointLimits.of(arm), Loads(arm)
    tools = {tool.name: _tool_parts(arm.with_tool(tool.name), limits) for tool in arm.tools}
    names = tuple(_name_in_messages(arm, drive.joint) for drive in arm.drives)
    servo, measurement = _servo(arm, loads, period_s), _measurement(arm)
    parts = Parts(
        hardware=hardware,
        recorder=Recorder(layout_of(arm), sink or NoSink()),
        measurement=measurement,
        motor_leads=_motor_leads(arm),
        second_encoders=tuple(j for j, d in enumerate(arm.drives) if d.motor_counts_per_rev is not None),
        servo=servo,
        checks=_checks(arm, measurement, period_s, names),
        set_point_limits=tuple(_set_point_limits(drive, SET_POINT_MARGIN, SET_POINT_MARGIN) for drive in arm.drives),
        homing=lambda: HomingSequence(_homes(arm), hardware),
        gravity_compensation=_gravity_compensation(arm, servo, names, limits),
        stop_from=lambda state: StopMotion(state, limits),
        tools=tools,
        tool=tools[arm.tool.name],
        loads=loads,
        camera=camera,
        joint_names=names,
        period_s=period_s,
        stopwatch_s=stopwatch_s,
        strain=strain,
        do_counters_span=all(_does_counter_span(drive) for drive in arm.drives),
        board_stop=board_stop(arm, period_s),
        allows_unrecorded=arm.recording.unrecorded == "allow",
        payload_limit_kg=arm.limits.payload_limit_kg,
        aim_limits=tuple(_aim_limits(drive) for drive in arm.drives),
        gripper=_gripper(arm, hardware),
        outputs=_outputs(arm, hardware),
        unique_turns=tuple(_unique_turns(arm)),
        joint_side=JointSide.of(without_tool_mass(arm), loads.torques),
    )
    runtime = Runtime(parts)
    requests = Requests(runtime, limits, arm, dict(about or {}))
    requests.beside = guard_itself(arm, runtime)
    return Assembly(runtime, requests)


def _name_in_messages(arm: Arm, joint: int) -> str:
    """`joint 2`, with the name that arm.toml gives, as in `joint 2 (shoulder)`: `jog --joint` takes the number."""
    name = arm.joint_names[joint - 1]
    return name if name == f"joint {joint}" else f"joint {joint} ({name})"


def _checks(arm: Arm, measurement: Measurement, period_s: float, names: Sequence[str]) -> Checks:
    return Checks(
        watch=Watch(_watch_limits(arm, period_s), names),
        motors=cross_checks.CrossChecks(_motors(arm), _cross_check_limits(arm), names),
        indices=_indices(arm, measurement, names),
        switches=cross_checks.SwitchWatch([_switch_place(drive) for drive in arm.drives]),
        motor_counts=_motor_counts(arm, names),
        leads=cross_checks.LeadWatch(arm.limits.transmission_slack_rad, names),
        limit_switches=cross_checks.LimitSwitchWatch(list(_limit_switches(arm, names))),
    )


def _gravity_compensation(arm: Arm, servo: Servo, names: Sequence[str], limits: JointLimits) -> GravityCompensation:
    fastest_rad_s = [OVERSPEED * limit for limit in limits.speed_rad_s]
    return GravityCompensation(_motors(arm), servo.torque_model, names, fastest_rad_s)


def _outputs(arm: Arm, hardware: Hardware) -> Outputs | None:
    pins = hardware.end.pins
    return None if pins is None else Outputs(arm.digital, pins)


@dataclasses.dataclass(frozen=True, slots=True)
class CellAssembly:
    """The runtime of several arms, the server of its requests, and each arm's own by name."""

    runtime: CellRuntime
    requests: CellRequests
    of_arms: Mapping[str, Assembly]


def assemble_cell(cell: Cell, of_arms: Mapping[str, Assembly]) -> CellAssembly:
    """Put the assembled arms of a cell together."""
    runtime = CellRuntime(cell, {name: assembly.runtime for name, assembly in of_arms.items()})
    for name, assembly in of_arms.items():
        assembly.requests.beside = runtime.collisions.of_arms[name]
    requests = CellRequests(cell, runtime, {name: assembly.requests for name, assembly in of_arms.items()})
    return CellAssembly(runtime, requests, of_arms)


def _gripper(arm: Arm, hardware: Hardware) -> GripperControl | None:
    board = hardware.end.gripper
    if arm.gripper is None or board is None:
        return None
    if isinstance(board, PlacedOnBoard):
        return PlacedGripper(arm.gripper, board, arm.limits.stale_s)
    return GripperControl(arm.gripper, board, arm.limits.stale_s)


def _tool_parts(arm: Arm, limits: JointLimits) -> ToolParts:
    """What depends on where the tip is; the arm's present tool is on."""
    inverse, guard, jog_limits = InverseKinematics(arm), Guard(arm, limits), JogLimits.of(arm)
    inverse.prepare()
    return ToolParts(
        tool=arm.tool,
        kinematics=ForwardKinematics(arm),
        inverse=inverse,
        guard=guard,
        jogging=lambda is_homed: Jogging(jog_limits, inverse, guard if is_homed else None),
    )


def _motor_counts(arm: Arm, names: Sequence[str]) -> cross_checks.MotorCountWatch:
    """The comparison of both boards' counts."""
    per_radian = [JointMap(drive).counts_per_radian for drive in arm.drives]
    has_two = [drive.motor_counts_per_rev is not None for drive in arm.drives]
    return cross_checks.MotorCountWatch(per_radian, [drive.encoder_bits for drive in arm.drives], names, has_two)


def _motor_leads(arm: Arm) -> MotorLeads:
    """Of the joints with an encoder on each side of the gear."""
    maps = [JointMap(drive) for drive in arm.drives]
    motors = [JointMap(d.at_motor) if d.motor_counts_per_rev is not None else None for d in arm.drives]
    ratio = sum(e.parameters["ratio"] for e in arm.effects if e.effect == "belt_coupling")
    return MotorLeads(maps, motors, [drive.encoder_bits for drive in arm.drives], ratio)


def _does_counter_span(drive: Drive) -> bool:
    """Whether every angle of the joint's range has a unique count."""
    mapped, half = JointMap(drive), 1 << (drive.encoder_bits - 1)
    ends = (drive.joint_lower_rad, drive.joint_upper_rad)
    return all(abs(mapped.count(end)) < half for end in ends if math.isfinite(end))


def _measurement(arm: Arm) -> Measurement:
    fastest_rad_s = [
        IMPOSSIBLE * drive.supply_V / constant for drive, constant in zip(arm.drives, torque_constants_Nm_A(arm), strict=True)
    ]
    maps = [JointMap(drive) for drive in arm.drives]
    bits = [drive.encoder_bits for drive in arm.drives]
    return Measurement(maps, bits, fastest_rad_s, [_unseen_s(drive) for drive in arm.drives])


def _unseen_s(drive: Drive) -> float:
    """For how long a joint cannot turn by half of its counter: what it makes unseen is ambiguous beyond.

    A counter that covers the joint's range says the angle by itself; a wrong turn would lie outside of the range.
    """
    if _does_counter_span(drive):
        return math.inf
    half_rad = (1 << (drive.encoder_bits - 1)) * abs(JointMap(drive).radians_per_count)
    return half_rad / (OVERSPEED * drive.joint_speed_limit_rad_s)


def _indices(arm: Arm, measurement: Measurement, names: Sequence[str]) -> cross_checks.IndexWatch:
    return cross_checks.IndexWatch(
        [drive.encoder_counts_per_rev for drive in arm.drives],
        [JointMap(drive).count(drive.home.index_rad) if drive.home else None for drive in arm.drives],
        measurement.unwrapped_count,
        names,
    )


def _switch_place(drive: Drive) -> cross_checks.SwitchPlace | None:
    if (home := drive.home) is None:
        return None
    tolerance_rad = _edge_tolerance_rad(drive) + SWITCH_SLACK_rad
    return cross_checks.SwitchPlace(f"joint {drive.joint}", home.switch_rad, home.sense, tolerance_rad)


def _limit_switches(arm: Arm, names: Sequence[str]) -> Iterator[cross_checks.LimitSwitch]:
    for joint, drive in enumerate(arm.drives):
        if (switches := drive.limit_switches) is None:
            continue
        for end, pin, side, bit in (("lower", switches.lower, -1.0, LOWER_LIMIT), ("upper", switches.upper, 1.0, UPPER_LIMIT)):
            is_home = drive.home is not None and drive.home.switch == end
            if pin:
                is_high, edge_rad = switches.active == "high", _edge_tolerance_rad(drive) + SWITCH_SLACK_rad
                flag = bit if pin == OWN_INPUT else 0
                says = "its drive's own input" if flag else pin
                yield cross_checks.LimitSwitch(joint, names[joint], says, side, is_high, is_home, edge_rad, flag)


def _edge_tolerance_rad(drive: Drive) -> float:
    """How far a home switch may move: it tells turns of the motor apart, and is no worse beside an encoder on the joint."""
    return TURN_TOLERANCE * min(drive.encoder_turn_rad, 2.0 * math.pi / drive.gear_ratio)


def _cross_check_limits(arm: Arm) -> cross_checks.CrossCheckLimits:
    limits = arm.limits
    return cross_checks.CrossCheckLimits(
        limits.speed_contradiction_rad_s,
        limits.unexplained_torque,
        limits.supply_low,
        limits.supply_high,
        limits.temperature_degC,
    )


def _servo(arm: Arm, loads: Loads, period_s: float) -> Servo:
    modes = [OutputMode[drive.pid.mode.upper()] for drive in arm.drives]
    pids = []
    for drive, mode in zip(arm.drives, modes, strict=True):
        gains = gains_of(arm, drive.joint, period_s)
        limit = drive.current_limit_A if mode is OutputMode.CURRENT else drive.supply_V
        pids.append(Pid(gains, limit, period_s))
    shares = InertiaScale(arm) if OutputMode.CURRENT in modes else None
    return Servo(modes, _motors(arm), pids, MotionTorque(arm, loads), period_s, shares)


def _motors(arm: Arm) -> list[Motor]:
    constants = torque_constants_Nm_A(arm)
    return [_motor(arm, drive, constant) for drive, constant in zip(arm.drives, constants, strict=True)]


def _motor(arm: Arm, drive: Drive, joint_constant: float) -> Motor:
    kind = arm.kind_of(drive)
    return Motor(
        amperes_per_Nm=1.0 / joint_constant,
        resistance_ohm=drive.resistance_ohm,
        volts_per_rad_s=joint_constant,
        supply_V=drive.supply_V,
        current_limit_A=drive.current_limit_A,
        current_step_A=kind.current_step_A,
        current_is_newest=kind.current_is_newest,
        slack_rad=arm.limits.transmission_slack_rad if drive.encoder_on == "joint" else 0.0,
    )


def _unique_turns(arm: Arm) -> Iterator[UniqueTurn]:
    for joint, drive in enumerate(arm.drives):
        if (turn_rad := arm.unique_rad(drive)) < math.inf:
            ends = (drive.joint_lower_rad, drive.joint_upper_rad)
            yield UniqueTurn(joint, f"joint {drive.joint}", *ends, turn_rad)


def _watch_limits(arm: Arm, period_s: float) -> WatchLimits:
    joints = tuple(
        MeasuredLimits(
            lower_rad=drive.joint_lower_rad,
            upper_rad=drive.joint_upper_rad,
            range_margin_rad=RANGE_MARGIN_rad,
            speed_rad_s=OVERSPEED * drive.joint_speed_limit_rad_s,
            following_error_rad=arm.limits.following_error_rad,
            following_error_per_speed_s=arm.limits.following_error_per_speed_s,
        )
        for drive in arm.drives
    )
    missed_in_row = int(PAUSE_LIMIT * arm.limits.watchdog_s / period_s)
    return WatchLimits(joints, arm.limits.stale_s, arm.limits.watchdog_s, missed_in_row)


def _set_point_limits(drive: Drive, of_speed: float, of_acceleration: float) -> SetPointLimits:
    """The joint's range, and so many times its limits of speed and acceleration."""
    return SetPointLimits(
        drive.joint_lower_rad,
        drive.joint_upper_rad,
        of_speed * drive.joint_speed_limit_rad_s,
        of_acceleration * drive.joint_acceleration_limit_rad_s2,
    )


def _aim_limits(drive: Drive) -> SetPointLimits:
    """Limits of the encoder's set-point if it differs from the joint's: with the shares of scale, belt and gear offset."""
    most = SET_POINT_MARGIN * SLOPE_MOST
    return _set_point_limits(drive, most + SHARE_OF_SPEED, most + SHARE_OF_ACCELERATION)


def _homes(arm: Arm) -> list[tuple[int, JointHome]]:
    """Homing parameters of the joints that must home, in the order of the drives. MissingModel names one without them."""
    homes = []
    for joint, drive in enumerate(arm.drives):
        if arm.has_absolute_encoder(drive):
            continue
        if drive.home is None:
            raise MissingModel(
                f"arm {arm.name}: joint {drive.joint} cannot be homed: add [drive.home] with switch_rad and index_rad"
                " to its drive, or set its zero on the encoder board"
            )
        range_rad = drive.joint_upper_rad - drive.joint_lower_rad
        homes.append(
            (
                joint,
                JointHome(
                    name=f"joint {drive.joint}",
                    speed_rad_s=drive.home.speed_rad_s,
                    acceleration_rad_s2=HOMING_ACCELERATION * drive.joint_acceleration_limit_rad_s2,
                    backoff_rad=drive.home.backoff_rad,
                    travel_rad=HOMING_TRAVEL * range_rad,
                    switch_rad=drive.home.switch_rad,
                    index_rad=drive.home.index_rad,
                    sense=drive.home.sense,
                    edge_rad=_edge_tolerance_rad(drive),
                    turn_rad=drive.encoder_turn_rad,
                    count_rad=1.0 / abs(JointMap(drive).counts_per_radian),
                    index_count=JointMap(drive).count(drive.home.index_rad),
                    repeat_counts=round(arm.turn_of_home_rad(drive) * abs(JointMap(drive).counts_per_radian)),
                ),
            )
        )
    return homes
