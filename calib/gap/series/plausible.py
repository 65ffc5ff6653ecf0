"""Columns that cannot be what they say: another unit, another sign, a sensor that never speaks.

What is wrong is said and its channel left out, so that the others still give an answer.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from calib.arrays import Array
from calib.gap.signals.body import Body, Load
from calib.gap.signals.held import not_held
from calib.gap.signals.recording import Recording, UnusableLogError
from control.kinematics.kinematics import Kinematics
from control.model.arm import Arm

TOGETHER = 0.6  # correlation from which the factor between two signals means something
WITHIN = 2.5  # factor that no effect of the list reaches
AS_TORQUE = 1.4  # factor within which torques are those that the motion needs: friction adds to them
THOUSAND = (200.0, 5000.0)
SLOWEST_s, FASTEST_s = 0.1, 2e-5  # between samples
MOVES_rad = 1e-3
FAR = 0.25  # of the arm's reach: the tip is nowhere near
MOVING_rad_s = 0.01


@dataclass(frozen=True, slots=True)
class _Fit:
    factor: float
    correlation: float


def plausible(arm: Arm, recording: Recording) -> Recording:
    """The recording without channels that cannot be right, each with a sentence; UnusableLogError if none is left."""
    _check_time(recording)
    if all(np.ptp(run.q_raw, axis=0).max() < MOVES_rad for run in recording.runs):
        raise UnusableLogError("log: no joint moves in any run: nothing can be said of its dynamics")
    said: list[str] = []
    current = recording.has_current and not _is_silent(recording, "i{}_A", said)
    voltage = recording.has_voltage and not _is_silent(recording, "u{}_V", said)
    if current:
        current = not _found(said, _wrong_current(arm, recording))
    if voltage and current:
        voltage = not _found(said, _wrong_voltage(arm, recording) or not_held(arm, recording))
    tip = recording.has_tip and not _found(said, _wrong_tip(arm, recording))
    if not (current or voltage or tip):
        what = "; ".join(said) or "no currents, voltages or tips"
        raise UnusableLogError(f"log: nothing to compare the model with: {what}")
    return replace(
        recording,
        has_current=current,
        has_voltage=voltage,
        has_tip=tip,
        warnings=(*recording.warnings, *said),
    )


def _found(said: list[str], sentence: str) -> bool:
    if sentence:
        said.append(sentence)
    return bool(sentence)


def _check_time(recording: Recording) -> None:
    period = 1.0 / recording.filters.rate_Hz
    if period > SLOWEST_s:
        like = ": are they milliseconds?" if period >= 0.5 else ": too slow for the dynamics of an arm"
        raise UnusableLogError(f"log: t_s advances by {period:g} s a sample{like}")
    if period < FASTEST_s:
        raise UnusableLogError(f"log: t_s advances by {period:g} s a sample: expected seconds")


def _is_silent(recording: Recording, column: str, said: list[str]) -> bool:
    """A sensor whose value never changes while its joint moves."""
    is_current = column.startswith("i")
    for j in range(recording.runs[0].q.shape[1]):
        runs = [run for run in recording.runs if np.ptp(run.q_raw[:, j]) > MOVES_rad]
        parts = [(run.current_raw_A if is_current else run.voltage_V)[:, j] for run in runs]
        if parts and all(np.ptp(part) == 0.0 for part in parts):
            name = column.format(j + 1)
            said.append(f"{name} is {parts[0][0]:g} throughout while the joint moves: its kind is not used")
            return True
    return False


def _wrong_current(arm: Arm, recording: Recording) -> str:
    """Currents beside those that the motion needs."""
    fits = _current_fits(arm, recording)
    if _are_torques(arm, fits):
        return (
            "i1_A ... look like torques of the joints in N m, not currents: divide each by its drive's torque constant and gear"
            " ratio; the currents are not used"
        )
    for joint, fit in fits.items():
        sentence = _factor_in_words(f"i{joint}_A", "the motion needs", fit)
        if sentence:
            return f"{sentence}: the currents are not used"
    return ""


def _are_torques(arm: Arm, fits: Mapping[int, _Fit]) -> bool:
    """Whether the joints' torques explain the columns, and currents do not."""
    known = {joint: fit.factor for joint, fit in fits.items() if fit.correlation > TOGETHER}
    if not known:
        return False
    as_current = np.log(list(known.values()))
    drives = [arm.drive(joint) for joint in known]
    as_torque = as_current - np.log([drive.torque_constant_Nm_A * drive.gear_ratio for drive in drives])
    return bool(
        np.abs(as_torque).max() < np.log(AS_TORQUE)
        and np.abs(as_current).min() > 2.0 * np.abs(as_torque).max()
        and np.abs(as_current).min() > np.log(AS_TORQUE)
    )


def _current_fits(arm: Arm, recording: Recording) -> dict[int, _Fit]:
    """Measured currents as factors of those that the motion needs, by joint (1-based)."""
    fits = {}
    body = Body(arm, recording)
    torques = body.link_torques(Load())
    for drive in arm.drives:
        j = drive.joint - 1
        known = {e.effect: e.parameters for e in arm.effects if e.joint == drive.joint}
        dry = known.get("coulomb_friction", {}).get("torque_Nm", 0.0)
        wet = known.get("viscous_friction", {}).get("coefficient_Nm_s_rad", 0.0)
        expected, measured = [], []
        for run, torque in zip(recording.runs, torques, strict=True):
            v, keep = run.speed[:, j], np.abs(run.speed[:, j]) > MOVING_rad_s
            whole = torque[:, j] + body.rotor_kg_m2[j] * run.acceleration[:, j] + dry * np.sign(v) + wet * v
            expected.append(whole[keep] / (drive.torque_constant_Nm_A * drive.gear_ratio))
            measured.append(run.current_A[keep, j])
        fits[drive.joint] = _fit(expected, measured)
    return fits


def _wrong_voltage(arm: Arm, recording: Recording) -> str:
    """Voltages beside what currents and speeds need."""
    for drive in arm.drives:
        j = drive.joint - 1
        K = drive.torque_constant_Nm_A * drive.gear_ratio
        needed = [drive.resistance_ohm * run.current_A[:, j] + K * run.speed[:, j] for run in recording.runs]
        given = [run.voltage_V[:, j] for run in recording.runs]
        fit = _fit(needed, given)
        name = f"u{drive.joint}_V"
        sentence = _factor_in_words(name, "current and speed need", fit)
        if abs(fit.correlation) > TOGETHER:
            if abs(fit.factor * drive.supply_V / 100.0 - 1.0) < 0.15 and drive.supply_V < 60.0:
                sentence = f"{name} looks like percent of the supply, not volts"
            elif abs(fit.factor * drive.supply_V - 1.0) < 0.15:
                sentence = f"{name} looks like a share of the supply, not volts"
        if sentence:
            return f"{sentence}: the voltages are not used"
    return ""


def _fit(expected: list[Array], measured: list[Array]) -> _Fit:
    x, y = np.concatenate(expected), np.concatenate(measured)
    if len(x) < 100:
        return _Fit(1.0, 0.0)
    size = float(np.linalg.norm(x) * np.linalg.norm(y))
    if size == 0.0:
        return _Fit(1.0, 0.0)
    return _Fit(float(x @ y / max(float(x @ x), 1e-30)), float(x @ y) / size)


def _factor_in_words(name: str, what: str, fit: _Fit) -> str:
    if abs(fit.correlation) < TOGETHER:
        return ""
    size = abs(fit.factor)
    if fit.factor < 0.0 and size < WITHIN:
        return f"{name} has the other sign than {what}"
    if THOUSAND[0] < size < THOUSAND[1]:
        return f"{name} is {size:.0f} times what {what}: it looks like thousandths of its unit"
    if THOUSAND[0] < 1.0 / size < THOUSAND[1]:
        return f"{name} is {size:.2g} times what {what}: it looks like thousands of its unit"
    return ""


def _wrong_tip(arm: Arm, recording: Recording) -> str:
    kinematics = Kinematics(arm)
    reach = sum(abs(link.L_m) + abs(link.d_m) for link in arm.links)
    seen = np.concatenate([run.tip_m for run in recording.runs])
    expected = np.concatenate([kinematics.tips(run.q_raw[run.frames]) for run in recording.runs])
    far = float(np.median(np.linalg.norm(seen - expected, axis=1)))
    size = float(np.median(np.linalg.norm(seen, axis=1)))
    if size > 50.0 * reach:
        return (
            f"the tip is {size:.0f} m away, the arm reaches {reach:.2f} m: millimetres? The tip is not used"
        )
    if far > FAR * reach:
        return (
            f"the tip is {far:.2f} m from where the angles put it: another frame, or another arm's log?"
            " The tip is not used"
        )
    return ""
