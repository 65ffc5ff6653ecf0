"""The whole tuning: measure each joint, design gains, test old and new gains on the arm; and its table and page."""

from __future__ import annotations

import contextlib
import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from calib.report.page import AFTER, BEFORE, Section, bullets, page, pair, paragraph, svg, table
from control.dynamics.dynamics import Dynamics
from control.dynamics.gains import (
    Gains,
    LoopDesign,
    Margins,
    MarginsUnmet,
    MotorFit,
    Tuner,
    fit_motor,
    gains_of,
    has_play_in_loop,
    margins,
)
from control.errors import ArmError, MissingModel
from control.files import write_whole
from control.model.arm import Arm, DrivePid
from control.plain_text import Advance
from control.server.client import ArmFaulted
from firmware_iface.clock import Clock
from procedures.tuning_session import (
    PERIOD_S,
    LOWEST_Hz,
    MeasuredResponse,
    MoveResponse,
    PASS_SPEED_rad_s,
    PoorResponse,
    StepResponse,
    TuningSession,
    multisine,
    usable,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


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

    def slower(self, joint: int, measured: Margins) -> _Chosen:
        """The next design, after the arm itself had these margins."""
        before = self.design.here.crossover_rad_s
        design = _rounded(self.tuner, self.tuner.design_at(SHYNESS * self.design.pole_rad_s))
        caution = (
            f"joint {joint}: gains for {_hertz(before)} gave {measured.gain_dB:.1f} dB and {measured.phase_deg:.0f} deg on the"
            f" arm, so it was tuned to {_hertz(design.here.crossover_rad_s)}"
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
    require_loop(arm, options.joints)
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
            before[joint] = _try(session, measuring, joint, options)
            chosen[joint] = _designed(measuring, joint, before[joint], options, pose)
    for _ in range(TRIALS):
        tuned_arm = with_gains(arm, {joint: choice.design.gains for joint, choice in chosen.items()})
        after = _tried(in_voltage_mode(tuned_arm), clock, options, pose, advance)
        short = [joint for joint in options.joints if not _is_met(after[joint].margins)]
        if not short or options.bandwidth_Hz is not None:
            break
        for joint in short:
            chosen[joint] = chosen[joint].slower(joint, after[joint].margins)
    tuned = []
    for joint in options.joints:
        choice = chosen[joint]
        _require_margins(joint, after[joint])
        tuned.append(Tuned(joint, choice.fit, choice.design, choice.inertia_ratios, before[joint], after[joint], choice.cautions))
    return TuningResult(tuned_arm, tuple(tuned))


def _tried(arm: Arm, clock: Clock, options: TuningOptions, pose: tuple[float, ...], advance: Advance) -> dict[int, Trial]:
    """The new gains on the arm, joint after joint."""
    after: dict[int, Trial] = {}
    count = len(options.joints)
    with TuningSession(arm, clock) as session:
        session.client.move_joints(pose, CENTRE_SPEED)
        for number, joint in enumerate(options.joints):
            advance(f"joint {joint}: the new gains", (number + 0.5 + count) / (2 * count + 1))
            after[joint] = _try(session, arm, joint, options)
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
    return tuple(drive.joint for drive in arm.drives if drive.pid.mode != "position" or "voltage" in arm.kind_of(drive).modes)


def require_loop(arm: Arm, joints: tuple[int, ...]) -> None:
    """NotTuned where a board closes the loop of a joint itself, or of all."""
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


def _try(session: TuningSession, arm: Arm, joint: int, options: TuningOptions) -> Trial:
    """Measure with the gains of the session's runtime."""
    drive = arm.drive(joint)
    unit = 1.0 if drive.pid.mode == "current" else drive.resistance_ohm
    current_A = drive.current_limit_A if math.isfinite(drive.current_limit_A) else drive.supply_V / drive.resistance_ohm
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
    return Trial(gains_of(arm, joint, session.period_s), found, good, step, move)


def _designed(arm: Arm, joint: int, before: Trial, options: TuningOptions, pose: tuple[float, ...]) -> _Chosen:
    measured = before.measured
    if has_play_in_loop(arm.drive(joint)) and measured.distortion > NOT_LINEAR:
        raise NotTuned(
            f"joint {joint}: {measured.distortion:.0%} of its response is nonlinear (limit {NOT_LINEAR:.0%}), and its encoder is"
            " behind the gear: it has play or friction, in which gains from a response hunt; leave kp, ki and kd out of its"
            " [drive.pid], so that they come from the model, and tune the others with --joint"
        )
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


def _is_met(measured: Margins) -> bool:
    return measured.meet(LEAST_GAIN_dB, LEAST_PHASE_deg)


def _require_margins(joint: int, after: Trial) -> None:
    """The measured margins must meet the design."""
    if not _is_met(after.margins):
        raise NotTuned(
            f"joint {joint}: the new gains gave {after.margins.gain_dB:.1f} dB and {after.margins.phase_deg:.0f} deg,"
            f" expected {LEAST_GAIN_dB:g} dB and {LEAST_PHASE_deg:g} deg: the response changes with motion; give a"
            " lower --bandwidth"
        )


MEASURED = "#1d2430"
TICKS_Hz = (2, 5, 10, 20, 50)


def header(arm: Arm) -> tuple[str, ...]:
    """Heads of the columns; the gains' units are those of the drives' modes."""
    unit = "/".join(sorted({"A" if drive.pid.mode == "current" else "V" for drive in arm.drives}))
    return (
        "joint",
        "gains",
        f"kp [{unit}/rad]",
        f"ki [{unit}/(rad s)]",
        f"kd [{unit} s/rad]",
        "gain margin",
        "phase margin",
        "crossover",
        "overshoot",
        "settling",
        "following error",
    )


def write_report(result: TuningResult, path: Path, about: str) -> None:
    """One HTML file without outside resources."""
    parts = [_summary(result), *(_joint(tuned) for tuned in result.joints)]
    write_whole(path, page("Tuning", result.arm.name, about, parts))


def rows(tuned: Tuned) -> list[tuple[str, ...]]:
    """Before, designed, after: one row each, as text."""
    design = tuned.design
    return [
        _row(tuned.joint, "before", tuned.before),
        (
            "",
            "designed",
            f"{design.gains.kp:.1f}",
            f"{design.gains.ki:.0f}",
            f"{design.gains.kd:.3f}",
            _dB(design.here.gain_dB),
            f"{design.here.phase_deg:.0f} deg",
            f"{design.here.crossover_rad_s / (2 * math.pi):.1f} Hz",
            "",
            "",
            "",
        ),
        _row(tuned.joint, "after", tuned.after),
    ]


def _row(joint: int, name: str, trial: Trial) -> tuple[str, ...]:
    measured = trial.margins
    return (
        str(joint) if name == "before" else "",
        name,
        f"{trial.gains.kp:.1f}",
        f"{trial.gains.ki:.0f}",
        f"{trial.gains.kd:.3f}",
        *_measured(measured),
        f"{trial.step.overshoot:.0%}",
        f"{1e3 * trial.step.settling_s:.0f} ms",
        f"{1e3 * trial.move.peak_error_rad:.2f} mrad",
    )


def _measured(measured: Margins) -> tuple[str, str, str]:
    """Margins and crossover, if that is among the measured frequencies."""
    if math.isnan(measured.phase_deg):
        return "", "", f"below {LOWEST_Hz:g} Hz"
    return (_dB(measured.gain_dB), f"{measured.phase_deg:.0f} deg", f"{measured.crossover_rad_s / (2 * math.pi):.1f} Hz")


def _dB(value: float) -> str:
    return "beyond" if value == math.inf else f"{value:.1f} dB"


def _summary(result: TuningResult) -> Section:
    lines = [line for tuned in result.joints for line in rows(tuned)]
    wanted = (
        f"Margins are measured on the arm and include delay and filters. They are at least {LEAST_GAIN_dB:g} dB and"
        f" {LEAST_PHASE_deg:g} deg at every inertia that a joint can have by arm.toml. Overshoot and settling time (5"
        " %) are those of a set-point step of 5 mrad, harsher than any planned motion. The following error is the"
        " largest of a move at the joint's own limits."
    )
    notes = [worst_pose(tuned) for tuned in result.joints]
    notes += [caution for tuned in result.joints for caution in tuned.cautions]
    return Section("Results", paragraph(wanted) + table(header(result.arm), lines) + bullets(notes))


def worst_pose(tuned: Tuned) -> str:
    """Margins at the joint's least favourable inertia."""
    worst = tuned.design.worst
    return (
        f"joint {tuned.joint}: {_dB(worst.gain_dB)} and {worst.phase_deg:.0f} deg at the least favourable inertia"
        f" ({min(tuned.inertia_ratios):.2g} to {max(tuned.inertia_ratios):.2g} times that of this pose, by arm.toml)"
    )


def _joint(tuned: Tuned) -> Section:
    fit = tuned.fit
    words = (
        f"A motor model with b = {fit.b:.2f} rad/(V s²), a = {fit.a_1_s:.1f} 1/s and {1e3 * fit.delay_s:.1f} ms of"
        f" delay fits the measurement to {fit.residual:.1%}. {tuned.before.measured.distortion:.1%} of the response"
        f" is nonlinear; noise is {tuned.before.measured.noise:.2%}."
    )
    pictures = pair(svg((5.1, 4.6), lambda f: _bode(f, tuned)), svg((5.1, 4.6), lambda f: _nyquist(f, tuned)))
    pictures += pair(svg((5.1, 3.0), lambda f: _steps(f, tuned)), svg((5.1, 3.0), lambda f: _errors(f, tuned)))
    return Section(f"Joint {tuned.joint}", paragraph(words) + pictures)


def _bode(figure: Figure, tuned: Tuned) -> None:
    top, bottom = figure.subplots(2, 1, sharex=True)
    figure.subplots_adjust(left=0.14, right=0.98, top=0.93, bottom=0.11, hspace=0.12)
    for trial, colour, name in ((tuned.before, BEFORE, "before"), (tuned.after, AFTER, "after")):
        f_Hz = trial.measured.response.omega_rad_s / (2.0 * np.pi)
        top.semilogx(f_Hz, 20.0 * np.log10(np.abs(trial.measured.loop)), "o-", ms=3, color=colour, label=name)
        bottom.semilogx(f_Hz, _phase(trial.measured.loop), "o-", ms=3, color=colour)
    top.axhline(0.0, color=MEASURED, lw=0.8)
    bottom.axhline(-180.0, color=MEASURED, lw=0.8)
    bottom.axhline(-180.0 + LEAST_PHASE_deg, color=MEASURED, lw=0.8, ls=":")
    bottom.set_xticks(TICKS_Hz, [f"{tick:g}" for tick in TICKS_Hz])
    bottom.minorticks_off()
    top.set_title("measured loop C P")
    top.set_ylabel("gain [dB]")
    bottom.set_ylabel("phase [deg]")
    bottom.set_xlabel("frequency [Hz]")
    top.legend()


def _phase(loop: np.ndarray[tuple[int, ...], np.dtype[np.complex128]]) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    phase = np.degrees(np.unwrap(np.angle(loop)))
    return np.asarray(phase - 360.0 * np.round((phase[0] + 135.0) / 360.0))


def _nyquist(figure: Figure, tuned: Tuned) -> None:
    axes = figure.subplots()
    figure.subplots_adjust(left=0.14, right=0.98, top=0.93, bottom=0.11)
    angle = np.linspace(0.0, 2.0 * np.pi, 200)
    axes.plot(np.cos(angle), np.sin(angle), color=MEASURED, lw=0.6, ls=":")
    for trial, colour, name in ((tuned.before, BEFORE, "before"), (tuned.after, AFTER, "after")):
        axes.plot(trial.measured.loop.real, trial.measured.loop.imag, "o-", ms=3, color=colour, label=name)
    axes.plot(-1.0, 0.0, "+", ms=10, color=MEASURED)
    axes.annotate("-1", (-1.0, 0.0), textcoords="offset points", xytext=(-14, 4), fontsize=9)
    axes.set_xlim(-2.5, 1.0)
    axes.set_ylim(-2.5, 1.0)
    axes.set_aspect("equal")
    axes.set_title("Nyquist, measured")
    axes.set_xlabel("real")
    axes.set_ylabel("imaginary")
    axes.legend(loc="lower right")


def _steps(figure: Figure, tuned: Tuned) -> None:
    axes = _small(figure)
    for trial, colour, name in ((tuned.before, BEFORE, "before"), (tuned.after, AFTER, "after")):
        axes.plot(1e3 * np.array(trial.step.t_s), trial.step.share, color=colour, label=name)
    axes.axhline(1.0, color=MEASURED, lw=0.6)
    axes.set_xlim(0.0, 400.0)
    axes.set_title("set-point step of 5 mrad")
    axes.set_xlabel("time [ms]")
    axes.set_ylabel("angle over step")
    axes.legend(loc="lower right")


def _errors(figure: Figure, tuned: Tuned) -> None:
    axes = _small(figure)
    for trial, colour, name in ((tuned.before, BEFORE, "before"), (tuned.after, AFTER, "after")):
        error = np.array(trial.move.set_rad) - np.array(trial.move.angle_rad)
        axes.plot(trial.move.t_s, 1e3 * error, color=colour, label=name)
    axes.set_title("following error, move of 0.2 rad")
    axes.set_xlabel("time [s]")
    axes.set_ylabel("error [mrad]")
    axes.legend(loc="upper right")


def _small(figure: Figure) -> Axes:
    figure.subplots_adjust(left=0.14, right=0.98, top=0.88, bottom=0.17)
    return figure.subplots()
