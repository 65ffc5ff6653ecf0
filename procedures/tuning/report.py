"""The tuning report: margins and steps before and after, Bode and Nyquist plots of the measurements."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from calib.report.drawing import AFTER, BEFORE, svg
from calib.report.page import Section, bullets, page, pair, paragraph, table
from control.dynamics.tuning import Margins
from control.files import write_whole
from control.model.arm import Arm
from procedures.tuning.multisine import LOWEST_Hz
from procedures.tuning.procedure import LEAST_GAIN_dB, LEAST_PHASE_deg, Trial, Tuned, TuningResult

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MEASURED = "#1d2430"
TICKS_Hz = (2, 5, 10, 20, 50)


def header(arm: Arm) -> tuple[str, ...]:
    """Heads of the columns; the gains' units are those of the drives' modes."""
    unit = "/".join(sorted({"A" if drive.pid.mode == "current" else "V" for drive in arm.drives}))
    return (
        "joint", "gains", f"kp [{unit}/rad]", f"ki [{unit}/(rad s)]", f"kd [{unit} s/rad]", "gain margin", "phase margin",
        "crossover", "overshoot", "settling", "following error",
    )  # fmt: skip


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
            "", "designed", f"{design.gains.kp:.1f}", f"{design.gains.ki:.0f}", f"{design.gains.kd:.3f}",
            _dB(design.here.gain_dB), f"{design.here.phase_deg:.0f} deg",
            f"{design.here.crossover_rad_s / (2 * math.pi):.1f} Hz", "", "", "",
        ),
        _row(tuned.joint, "after", tuned.after),
    ]  # fmt: skip


def _row(joint: int, name: str, trial: Trial) -> tuple[str, ...]:
    found = trial.margins
    return (
        str(joint) if name == "before" else "", name,
        f"{trial.gains.kp:.1f}", f"{trial.gains.ki:.0f}", f"{trial.gains.kd:.3f}",
        *_measured(found),
        f"{trial.step.overshoot:.0%}", f"{1e3 * trial.step.settling_s:.0f} ms", f"{1e3 * trial.move.peak_error_rad:.2f} mrad",
    )  # fmt: skip


def _measured(found: Margins) -> tuple[str, str, str]:
    """Margins and crossover, if that is among the measured frequencies."""
    if math.isnan(found.phase_deg):
        return "", "", f"below {LOWEST_Hz:g} Hz"
    return (
        _dB(found.gain_dB),
        f"{found.phase_deg:.0f} deg",
        f"{found.crossover_rad_s / (2 * math.pi):.1f} Hz",
    )


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
    pictures += pair(
        svg((5.1, 3.0), lambda f: _steps(f, tuned)), svg((5.1, 3.0), lambda f: _errors(f, tuned))
    )
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


def _phase(
    loop: np.ndarray[tuple[int, ...], np.dtype[np.complex128]],
) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
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
