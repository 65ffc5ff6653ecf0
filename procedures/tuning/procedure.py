"""The whole tuning: measure each joint, design gains, test old and new gains on the arm."""

import contextlib
import math
from dataclasses import dataclass, replace

import numpy as np

from control.dynamics.dynamics import Dynamics
from control.dynamics.gains import Gains, gains_of
from control.dynamics.tuning import LoopDesign, Margins, MarginsUnmet, MotorFit, Tuner, fit_motor, margins
from control.errors import ArmError, MissingModel
from control.model.arm import Arm, DrivePid
from control.progress import Advance
from control.server.client import ArmFaulted
from firmware_iface.clock import Clock
from procedures.tuning.multisine import PERIOD_S, MeasuredResponse, PoorResponse, multisine, usable
from procedures.tuning.session import MoveResponse, PASS_SPEED_rad_s, StepResponse, TuningSession

LEAST_GAIN_dB, LEAST_PHASE_deg = 6.0, 45.0
RESERVE_dB, RESERVE_deg = 2.0, 10.0  # margin if no bandwidth is requested: an arm ages
# Where the delay of a slow loop leaves no such reserve, the phase's goes first: a load takes gain margin, and delay phase.
RESERVES = ((RESERVE_dB, RESERVE_deg), (RESERVE_dB, 0.0), (0.0, 0.0))
SHYNESS = 0.7  # factor on the poles for a compliant or nonlinear joint: margins do not cover backlash
TRIALS = 3  # of gains on the arm, if no bandwidth is requested: slower by SHYNESS where the measured margins fall short
NOT_LINEAR = 0.08
MISFIT = 0.25  # fit residual above which the drive train is compliant
LEAST_COHERENCE = 0.9
STEP_RAD = 0.005
MOVE_RAD = 0.2
ROOM_RAD = 0.08  # from a pass to the joint's limit
CENTRE_SPEED = 0.3


class NotTuned(ArmError):
    """A joint was not tuned; the message gives the reason, and nothing is written."""


@dataclass(frozen=True, slots=True)
class TuningOptions:
    """Options of the operator; None: chosen automatically."""

    joints: tuple[int, ...]
    bandwidth_Hz: float | None = None
    amplitude: float = 0.25
    pose_rad: tuple[float, ...] | None = None


@dataclass(frozen=True, slots=True)
class Trial:
    """A test of gains on the arm: margins by the loop's own output, a step and a move."""

    gains: Gains
    margins: Margins
    measured: MeasuredResponse
    step: StepResponse
    move: MoveResponse


@dataclass(frozen=True, slots=True)
class Tuned:
    """One joint."""

    joint: int
    fit: MotorFit
    design: LoopDesign
    inertia_ratios: tuple[float, ...]
    before: Trial
    after: Trial
    cautions: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class _Chosen:
    """A design for one joint, what it was made with, and what there is to say about it."""

    tuner: Tuner
    fit: MotorFit
    design: LoopDesign
    inertia_ratios: tuple[float, ...]
    cautions: tuple[str, ...]

    def slower(self, joint: int, found: Margins) -> "_Chosen":
        """The next design, after the arm itself had these margins."""
        before = self.design.here.crossover_rad_s
        design = _rounded(self.tuner, self.tuner.design_at(SHYNESS * self.design.pole_rad_s))
        caution = (
            f"joint {joint}: gains for {_hertz(before)} gave {found.gain_dB:.1f} dB and {found.phase_deg:.0f} deg on the arm,"
            f" so it was tuned to {_hertz(design.here.crossover_rad_s)}"
        )
        return replace(self, design=design, cautions=(*self.cautions, caution))


@dataclass(frozen=True, slots=True)
class TuningResult:
    """The new arm, and the tuning of each joint."""

    arm: Arm
    joints: tuple[Tuned, ...]


def tune(arm: Arm, clock: Clock, options: TuningOptions, advance: Advance) -> TuningResult:
    """Measure, design and test. Raises NotTuned, ArmFaulted, and the errors of connecting; the drives are then off.

    Gains are set only in the runtimes started here; the arm's own file never changes.
    """
    _require_loop(arm, options.joints)
    pose = _pose(arm, options)
    measuring = in_voltage_mode(arm)
    advance("homing", 0.0)
    chosen: dict[int, _Chosen] = {}
    before: dict[int, Trial] = {}
    total = 2 * len(options.joints) + 1
    with TuningSession(measuring, clock) as session:
        session.client.move_joints(pose, CENTRE_SPEED)
        for number, joint in enumerate(options.joints):
            advance(f"joint {joint}: response with the present gains", (number + 0.5) / total)
            before[joint], fitted = _try(session, measuring, joint, options)
            chosen[joint] = _designed(measuring, joint, before[joint], fitted, options, pose)
    for _ in range(TRIALS):
        tuned = with_gains(arm, {joint: one.design.gains for joint, one in chosen.items()})
        after = _tried(in_voltage_mode(tuned), clock, options, pose, advance)
        short = [joint for joint in options.joints if not _is_met(after[joint].margins)]
        if not short or options.bandwidth_Hz is not None:
            break
        for joint in short:
            chosen[joint] = chosen[joint].slower(joint, after[joint].margins)
    joints = []
    for joint in options.joints:
        one = chosen[joint]
        _require_margins(joint, after[joint])
        joints.append(
            Tuned(joint, one.fit, one.design, one.inertia_ratios, before[joint], after[joint], one.cautions)
        )
    return TuningResult(tuned, tuple(joints))


def _tried(
    arm: Arm, clock: Clock, options: TuningOptions, pose: tuple[float, ...], advance: Advance
) -> dict[int, Trial]:
    """The new gains on the arm, joint after joint."""
    after: dict[int, Trial] = {}
    count = len(options.joints)
    with TuningSession(arm, clock) as session:
        session.client.move_joints(pose, CENTRE_SPEED)
        for number, joint in enumerate(options.joints):
            advance(f"joint {joint}: the new gains", (number + 0.5 + count) / (2 * count + 1))
            after[joint], _ = _try(session, arm, joint, options)
    return after


def in_voltage_mode(arm: Arm) -> Arm:
    """Move the PID from the board to the loop where the board allows it: same gains and units, and its output is recorded."""
    drives = tuple(
        replace(drive, pid=replace(drive.pid, mode="voltage"))
        if drive.pid.mode == "position" and "voltage" in arm.kind_of(drive).modes
        else drive
        for drive in arm.drives
    )
    return replace(arm, drives=drives)


def tunable(arm: Arm) -> tuple[int, ...]:
    """The joints whose controller is in this loop, or can be; the others' boards close the loop by gains of their own."""
    return tuple(
        drive.joint
        for drive in arm.drives
        if drive.pid.mode != "position" or "voltage" in arm.kind_of(drive).modes
    )


def _require_loop(arm: Arm, joints: tuple[int, ...]) -> None:
    can = tunable(arm)
    beyond = [str(joint) for joint in joints if joint not in can]
    if beyond or not joints:
        which = f"joint {', '.join(beyond)}" if beyond else "every joint"
        raise NotTuned(
            f"arm {arm.name}: the board of {which} closes the position loop by its own gains, which armwright does not set:"
            " tune it with the vendor's tool (docs/boards.md)"
        )


def _pose(arm: Arm, options: TuningOptions) -> tuple[float, ...]:
    """The pose for tuning: as given, else at rest, else mid-range; with enough range for the motions."""
    pose = options.pose_rad or (arm.rest.q_rad if arm.rest else None)
    if pose is None:
        pose = tuple(0.5 * (a + b) if math.isfinite(a + b) else 0.0 for a, b in arm.limits_rad)
    half_rad = 0.5 * PASS_SPEED_rad_s * PERIOD_S + 0.1 + ROOM_RAD
    for joint in options.joints:
        lower, upper = arm.limits_rad[joint - 1]
        at = pose[joint - 1]
        if at - half_rad < lower or at + max(half_rad, MOVE_RAD + ROOM_RAD) > upper:
            raise NotTuned(
                f"joint {joint}: not enough range at {at:.2f} rad: a pass needs {half_rad:.2f} rad to either side,"
                f" the range is {lower:.2f} to {upper:.2f} rad; give another --pose"
            )
    return tuple(pose)


def _try(
    session: TuningSession, arm: Arm, joint: int, options: TuningOptions
) -> tuple[Trial, MeasuredResponse]:
    """Measure with the gains of the session's runtime."""
    drive = arm.drive(joint)
    unit = 1.0 if drive.pid.mode == "current" else drive.resistance_ohm
    current_A = (
        drive.current_limit_A
        if math.isfinite(drive.current_limit_A)
        else drive.supply_V / drive.resistance_ohm
    )
    amplitude = options.amplitude * current_A * unit
    home = session.angles_rad()
    try:
        measured = session.excite(joint, multisine(PERIOD_S, 1.0 / session.period_s), amplitude)
        session.client.move_joints(home, CENTRE_SPEED)
        step = session.step(joint, STEP_RAD)
        move = session.move(joint, MOVE_RAD)
    except ArmFaulted as fault:
        raise ArmFaulted(f"joint {joint} was not tuned and keeps its old gains: {fault}") from None
    try:
        good = usable(measured, LEAST_COHERENCE)
    except PoorResponse as poor:
        raise NotTuned(f"joint {joint}: {poor}") from None
    found = margins(good.response.omega_rad_s, good.loop)
    return Trial(gains_of(arm, joint, session.period_s), found, good, step, move), good


def _designed(
    arm: Arm,
    joint: int,
    before: Trial,
    measured: MeasuredResponse,
    options: TuningOptions,
    pose: tuple[float, ...],
) -> _Chosen:
    fit = fit_motor(measured.response)
    ratios = inertia_ratios(arm, joint, pose)
    tuner = Tuner(measured.response, fit, 1.0 / arm.usual_rate_Hz, before.gains.derivative_filter_s, ratios)
    cautions = _cautions(joint, fit, measured)
    try:
        if options.bandwidth_Hz is not None:
            wanted = 2.0 * math.pi * options.bandwidth_Hz
            design = tuner.at_bandwidth(wanted, LEAST_GAIN_dB, LEAST_PHASE_deg)
        else:
            design, reserves = _fastest(tuner)
            has_reserve = reserves == RESERVES[0]
            slower = tuner.design_at(SHYNESS * design.pole_rad_s)
            if cautions and slower.worst.meet(LEAST_GAIN_dB, LEAST_PHASE_deg):
                design = slower
            cautions = cautions if has_reserve else (*cautions, _no_reserve(joint, fit, design))
    except MarginsUnmet as unmet:
        raise NotTuned(f"joint {joint}: {unmet}") from None
    return _Chosen(tuner, fit, _rounded(tuner, design), ratios, cautions)


def _fastest(tuner: Tuner) -> tuple[LoopDesign, tuple[float, float]]:
    """The fastest design with the largest of RESERVES that there is, and that reserve. Raises MarginsUnmet."""
    for gain_dB, phase_deg in RESERVES[:-1]:
        with contextlib.suppress(MarginsUnmet):
            return tuner.fastest(LEAST_GAIN_dB + gain_dB, LEAST_PHASE_deg + phase_deg), (gain_dB, phase_deg)
    return tuner.fastest(LEAST_GAIN_dB, LEAST_PHASE_deg), RESERVES[-1]


def _no_reserve(joint: int, fit: MotorFit, design: LoopDesign) -> str:
    worst = design.worst
    return (
        f"joint {joint}: {fit.delay_s * 1e3:.0f} ms from a command to the count that shows it leave margins of"
        f" {worst.gain_dB:.1f} dB and {worst.phase_deg:.0f} deg over the joint's poses: a faster loop or status rate gives more"
    )


def _hertz(omega_rad_s: float) -> str:
    return f"{omega_rad_s / (2.0 * math.pi):.1f} Hz"


def _rounded(tuner: Tuner, design: LoopDesign) -> LoopDesign:
    """Gains rounded as in the file."""
    gains = design.gains
    kp, ki, kd = (float(f"{value:.5g}") for value in (gains.kp, gains.ki, gains.kd))
    short = Gains(kp, ki, kd, gains.derivative_filter_s)
    return replace(design, gains=short, here=tuner.margins_of(short))


def inertia_ratios(arm: Arm, joint: int, pose: tuple[float, ...]) -> tuple[float, ...]:
    """Least, present and largest inertia of a joint over its poses, relative to the present one; 1 without masses."""
    try:
        dynamics = Dynamics(arm)
        lower, upper = np.clip(np.array(arm.limits_rad), -np.pi, np.pi).T
        poses = np.random.default_rng(0).uniform(lower, upper, (200, arm.joint_count))
        diagonal = dynamics.mass_matrices(poses)[:, joint - 1, joint - 1]
        here = dynamics.mass_matrix(pose)[joint - 1][joint - 1]
    except MissingModel:
        return (1.0,)
    return (float(min(diagonal.min() / here, 1.0)), 1.0, float(max(diagonal.max() / here, 1.0)))


def _cautions(joint: int, fit: MotorFit, measured: MeasuredResponse) -> tuple[str, ...]:
    cautions = []
    if measured.distortion > NOT_LINEAR:
        cautions.append(
            f"joint {joint}: {measured.distortion:.0%} of its response is nonlinear (backlash, friction): the margins"
            " are less reliable, so the loop was tuned slower than they allow"
        )
    if fit.residual > MISFIT:
        cautions.append(
            f"joint {joint}: its response differs by {fit.residual:.0%} from that of a stiff joint: the drive train"
            " is compliant, so the loop was tuned slower than the margins allow"
        )
    return tuple(cautions)


def with_gains(arm: Arm, gains: dict[int, Gains]) -> Arm:
    drives = []
    for drive in arm.drives:
        chosen = gains.get(drive.joint)
        if chosen is not None:
            pid = DrivePid(drive.pid.mode, chosen.kp, chosen.ki, chosen.kd, chosen.derivative_filter_s)
            drive = replace(drive, pid=pid)
        drives.append(drive)
    return replace(arm, drives=tuple(drives))


def _is_met(found: Margins) -> bool:
    return found.meet(LEAST_GAIN_dB, LEAST_PHASE_deg)


def _require_margins(joint: int, after: Trial) -> None:
    """The measured margins must meet the design."""
    if not _is_met(after.margins):
        raise NotTuned(
            f"joint {joint}: the new gains gave {after.margins.gain_dB:.1f} dB and {after.margins.phase_deg:.0f} deg,"
            f" expected {LEAST_GAIN_dB:g} dB and {LEAST_PHASE_deg:g} deg: the response changes with motion; give a"
            " lower --bandwidth"
        )
