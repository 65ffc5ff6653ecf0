"""Columns that cannot be what they say: another unit, another sign, a sensor that never speaks.

What is wrong is said and its channel left out, so that the others still give an answer.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from calib.arrays import Array
from calib.gap.log import UNITS, amperes_per
from calib.gap.signals.body import BodyTorques, Load
from calib.gap.signals.recording import RunSet, UnusableLogError
from calib.gap.signals.sampling import is_resampled
from control.kinematics.kinematics import ForwardKinematics
from control.model.arm import Arm

# Whether the recorded voltages are those that drove the windings: a log that was thinned out lacks what came between.
#
# What is rough in a current follows from what is rough in its voltage, within a sample or a delay. Third differences
# leave the rough part; least squares say how much of a volt's change the current that follows shows. A motor that turns away
# under its voltage draws less at the end of a slow sample: what the windings and masses alone would show is the measure.
# Of what should show: whole logs at 100 to 1000 samples a second have 0.7 to 1.2, those of which every second to tenth sample
# is there at most 0.65 in most cases.
SHOWN = 0.68
SURE = 0.3  # standard deviation of what shows: joints whose currents are too noisy to tell do not count
LATEST_s = 0.01  # of a delay


def not_held(arm: Arm, recording: RunSet) -> str:
    """A sentence if the voltages cannot be what was held between the samples; empty if they can, or nothing tells."""
    share = shown(arm, recording)
    if share is None or share > SHOWN:
        return ""
    rate = recording.filters.rate_Hz
    return (
        f"the currents follow the quick changes of the voltages to {max(share, 0.0):.0%}: others were held between"
        f" these samples ({rate:.0f} a second; was the log thinned out?). The voltages are not used; record every sample"
    )


def shown(arm: Arm, recording: RunSet) -> float | None:
    """What the currents show of the voltages' quick changes over what they should; None where noise hides it."""
    period = 1.0 / recording.filters.rate_Hz
    windings = BodyTorques(arm, recording).windings()[0]
    # A motor turns away under its voltage, and its current goes back: what is left of it in the mean over a sample.
    turned = period * windings.torque_per_A**2 / np.diag(windings.inertia_kg_m2) / windings.resistance_ohm
    expected = -np.expm1(-turned) / turned
    responses = []
    for drive in arm.drives:
        j = drive.joint - 1
        followed = _followed(recording, j, drive.resistance_ohm)
        if followed is not None and followed[1] < SURE:
            responses.append(np.array(followed) / expected[j])
    if not responses:
        return None
    shares, deviations = np.array(responses).T
    return float(np.average(shares, weights=deviations**-2.0))  # a joint whose voltage is smooth says little


def _followed(recording: RunSet, j: int, resistance_ohm: float) -> tuple[float, float] | None:
    """Share of a voltage's quick change in the currents that follow it, and its deviation; None where it never changes."""
    period = 1.0 / recording.filters.rate_Hz
    lags = int(np.ceil(LATEST_s / period)) + 2
    square, pull, power, count = np.zeros((lags + 1, lags + 1)), np.zeros(lags + 1), 0.0, 0
    for run in recording.runs:
        current = np.diff(run.current_raw_A[:, j], 3)
        voltage = np.diff(run.voltage_V[:, j] / resistance_ohm, 3)
        if len(current) <= 2 * lags or np.any(run.is_off[:, j]):
            continue
        past, seen = _past(voltage, lags), current[lags:]
        square += past.T @ past
        pull += past.T @ seen
        power += float(seen @ seen)
        count += len(seen)
    if not count or float(np.trace(square)) == 0.0:
        return None
    square += 1e-9 * float(np.trace(square)) * np.eye(lags + 1)
    factors = np.linalg.solve(square, pull)
    noise = max(power - float(factors @ pull), 0.0) / count
    deviation = float(np.sqrt(noise * np.max(np.diag(np.linalg.inv(square)))))
    # A delay that is no whole number of samples divides a change between two of them.
    return float(np.max(factors[:-1] + factors[1:])), max(deviation, 1e-6)


def _past(values: Array, lags: int) -> Array:
    """Values (m,) as (m - lags, lags + 1): each row from its own sample back."""
    return np.stack([values[lags - k : len(values) - k] for k in range(lags + 1)], axis=1)


TOGETHER = 0.6  # correlation from which the factor between two signals means something
WITHIN = 2.5  # factor that no effect of the list reaches
AS_UNIT = 1.4  # factor within which a column is what the motion needs in another unit: friction under load adds to it
THOUSAND = (200.0, 5000.0)
SLOWEST_s, FASTEST_s = 0.1, 2e-5  # between samples
MOVES_rad = 1e-3
FAR = 0.25  # of the arm's reach: the tip is nowhere near
MOVING_rad_s = 0.01
FEWEST = 100  # samples that tell a factor
EXPLAINED = 0.9  # of a voltage by current and speed, so that these tell the drive's constants
NOTHING = (
    "expected columns of currents (i1_A ...; torques and other units with --current-unit), voltages (u1_V ...) or tips"
    " (x_m, y_m, z_m)"
)


@dataclass(frozen=True, slots=True)
class _Fit:
    factor: float
    correlation: float


def plausible(arm: Arm, recording: RunSet) -> RunSet:
    """The recording without channels that cannot be right, each with a sentence; UnusableLogError if none is left."""
    _check_time(recording)
    if all(np.ptp(run.q_raw, axis=0).max() < MOVES_rad for run in recording.runs):
        raise UnusableLogError("log: no joint moves in any run: nothing can be said about its dynamics")
    sentences: list[str] = []
    current = recording.has_current and not _is_silent(recording, "i{}_A", sentences)
    voltage = recording.has_voltage and not _is_silent(recording, "u{}_V", sentences)
    is_in_volts = current and voltage and not _wrong_voltage(arm, recording)
    if is_in_volts and _found(sentences, _placeholders(arm, recording)):
        current = voltage = False
    if current:
        current = not _found(sentences, _wrong_current(arm, recording))
    if voltage and current:
        wrong = _resampled(recording) or _wrong_voltage(arm, recording) or not_held(arm, recording)
        voltage = not _found(sentences, wrong)
    tip = recording.has_tip and not _found(sentences, _wrong_tip(arm, recording))
    if not (current or voltage or tip):
        what = "; ".join(sentences) or NOTHING
        raise UnusableLogError(f"log: nothing to compare the model with: {what}")
    return replace(recording, has_current=current, has_voltage=voltage, has_tip=tip, warnings=(*recording.warnings, *sentences))


def _found(sentences: list[str], sentence: str) -> bool:
    if sentence:
        sentences.append(sentence)
    return bool(sentence)


def _resampled(recording: RunSet) -> str:
    if not is_resampled([run.current_raw_A for run in recording.runs]):
        return ""
    return (
        "many samples lie on a line between others: the log was brought to another rate, and which voltages were held between"
        " the measured samples is lost; the voltages are not used; record every sample as it is"
    )


def _check_time(recording: RunSet) -> None:
    period = 1.0 / recording.filters.rate_Hz
    if period > SLOWEST_s:
        like = ": are they milliseconds?" if period >= 0.5 else ": too slow for the dynamics of an arm"
        raise UnusableLogError(f"log: t_s advances by {period:g} s a sample{like}")
    if period < FASTEST_s:
        raise UnusableLogError(f"log: t_s advances by {period:g} s a sample: expected seconds")


def _is_silent(recording: RunSet, column: str, sentences: list[str]) -> bool:
    """A sensor whose value never changes while its joint moves; with the driver off, nothing else is expected of it."""
    is_current = column.startswith("i")
    for j in range(recording.runs[0].q.shape[1]):
        runs = [run for run in recording.runs if np.ptp(run.q_raw[:, j]) > MOVES_rad]
        parts = [
            (run.current_raw_A if is_current else run.voltage_V)[~run.is_off[:, j], j]
            if recording.has_voltage
            else run.current_raw_A[:, j]
            for run in runs
        ]
        driven = [part for part in parts if len(part)]
        if driven and all(np.ptp(part) == 0.0 for part in driven):
            name = column.format(j + 1)
            sentences.append(f"{name} is {driven[0][0]:g} throughout while the joint moves: its kind is not used")
            return True
    return False


def _wrong_current(arm: Arm, recording: RunSet) -> str:
    """Currents beside those that the motion needs."""
    fits = _current_fits(arm, recording)
    sentence = _another_unit(arm, fits)
    if sentence:
        return sentence
    for joint, fit in fits.items():
        sentence = _factor_in_words(f"i{joint}_A", "the motion needs", fit)
        if sentence:
            return f"{sentence}: the currents are not used"
    return ""


def _another_unit(arm: Arm, fits: Mapping[int, _Fit]) -> str:
    """What the columns of currents look like, if all joints say that they are no amperes; empty if they may be."""
    known = {joint: fit.factor for joint, fit in fits.items() if fit.correlation > TOGETHER}
    if not known:
        return ""
    size = np.log(list(known.values()))
    places = [joint - 1 for joint in known]
    off = {unit: size + np.log(amperes_per(arm, unit)[places]) for unit in UNITS}
    nearest = min(off, key=lambda unit: float(np.abs(off[unit]).max()))
    far = float(np.abs(off[nearest]).max())
    is_no_current = float(np.abs(off["A"]).min()) > max(2.0 * far, np.log(AS_UNIT))
    columns = ", ".join(f"i{joint}_A" for joint in known)
    if is_no_current and far < np.log(AS_UNIT):
        return f"{columns} look like {UNITS[nearest]}, not amperes: give --current-unit {nearest}; the currents are not used"
    if len(known) > 1 and float(np.abs(size).min()) > np.log(WITHIN) and float(np.ptp(size)) < np.log(AS_UNIT):
        return (
            f"{columns} are {np.exp(size.mean()):.2g} times what the motion needs, the same on all joints: another unit? See"
            " --current-unit; the currents are not used"
        )
    return ""


def _current_fits(arm: Arm, recording: RunSet) -> dict[int, _Fit]:
    """Measured currents as factors of those that the motion needs, by joint (1-based); its friction is left free."""
    fits = {}
    body, filters = BodyTorques(arm, recording), recording.filters
    torques = body.link_torques(Load())
    for drive in arm.drives:
        j = drive.joint - 1
        parts = []
        for run, torque in zip(recording.runs, torques, strict=True):
            v = run.speed[:, j]
            needed = (torque[:, j] + body.rotor_kg_m2[j] * run.acceleration[:, j]) / drive.gear_ratio
            columns = np.stack((needed / drive.torque_constant_Nm_A, run.current_A[:, j], np.sign(v), v), axis=1)
            parts.append(filters.rows(columns)[np.abs(filters.rows(v)) > MOVING_rad_s])
        expected, measured, *friction = np.concatenate(parts).T
        beside = np.linalg.qr(np.stack(friction, axis=1))[0]
        rest = [signal - beside @ (beside.T @ signal) for signal in (expected, measured)]
        fits[drive.joint] = _fit(*([signal] for signal in rest))
    return fits


def _placeholders(arm: Arm, recording: RunSet) -> str:
    """Drives whose back-EMF is far from the file's torque constant: voltages and speeds tell it whatever the currents' unit."""
    off = []
    for drive in arm.drives:
        constant = drive.torque_constant_Nm_A * drive.gear_ratio
        voltage_V, columns = _electrical(recording, drive.joint - 1)
        if len(voltage_V) < FEWEST:
            continue
        (resistance, back_emf, _), explained = _fitted(voltage_V, columns)
        _, by_file = _fitted(voltage_V - constant * columns[:, 1], columns[:, ::2], voltage_V)
        if by_file < EXPLAINED < explained and not 1.0 / WITHIN < back_emf / constant < WITHIN:
            off.append((drive, back_emf / drive.gear_ratio, resistance))
    if not off:
        return ""
    drives = ", ".join(str(drive.joint) for drive, _, _ in off)
    worst, constant, resistance = max(off, key=lambda entry: abs(math.log(max(entry[1], 1e-9) / entry[0].torque_constant_Nm_A)))
    return (
        f"drives {drives}: torque_constant_Nm_A and resistance_ohm in arm.toml do not fit the voltages (drive {worst.joint}:"
        f" {worst.torque_constant_Nm_A:.3g} and {worst.resistance_ohm:.3g}; the log shows {constant:.3g} and {resistance:.3g}):"
        " placeholders? Correct them; currents and voltages are not used"
    )


def _electrical(recording: RunSet, j: int) -> tuple[Array, Array]:
    """Voltages (m,) of a drive, and its currents, speeds and ones (m, 3)."""
    driven = [~run.is_off[:, j] for run in recording.runs]
    columns = [
        np.stack((run.current_A[on, j], run.speed[on, j], np.ones(int(on.sum()))), axis=1)
        for run, on in zip(recording.runs, driven, strict=True)
    ]
    voltage_V = [run.voltage_V[on, j] for run, on in zip(recording.runs, driven, strict=True)]
    return np.concatenate(voltage_V), np.concatenate(columns)


def _fitted(wanted: Array, columns: Array, of: Array | None = None) -> tuple[Array, float]:
    """Least squares, and the share of the variance of `of` (default: what is fitted) that is explained."""
    size, *_ = np.linalg.lstsq(columns, wanted, rcond=None)
    whole = float(np.var(wanted if of is None else of))
    remaining = float(np.var(wanted - columns @ size))
    return np.asarray(size, dtype=float), 1.0 - remaining / whole if whole > 0.0 else 0.0


def _wrong_voltage(arm: Arm, recording: RunSet) -> str:
    """Voltages beside what currents and speeds need."""
    for drive in arm.drives:
        j = drive.joint - 1
        K = drive.torque_constant_Nm_A * drive.gear_ratio
        needed = [drive.resistance_ohm * run.current_A[:, j] + K * run.speed[:, j] for run in recording.runs]
        measured = [run.voltage_V[:, j] for run in recording.runs]
        fit = _fit(needed, measured)
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
    if len(x) < FEWEST:
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


def _wrong_tip(arm: Arm, recording: RunSet) -> str:
    kinematics = ForwardKinematics(arm)
    reach = sum(abs(link.L_m) + abs(link.d_m) for link in arm.links)
    seen = np.concatenate([run.tip_m for run in recording.runs])
    expected = np.concatenate([kinematics.tips(run.q_raw[run.frames]) for run in recording.runs])
    far = float(np.median(np.linalg.norm(seen - expected, axis=1)))
    size = float(np.median(np.linalg.norm(seen, axis=1)))
    if size > 50.0 * reach:
        return f"the tip is {size:.0f} m away, the arm reaches {reach:.2f} m: millimetres? The tip is not used"
    if far > FAR * reach:
        return f"the tip is {far:.2f} m from where the angles put it: another frame, or another arm's log? The tip is not used"
    return ""
