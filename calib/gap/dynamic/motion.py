"""Motion from voltage: the model released from measured states, driven by the recorded voltages over short windows.

Open loop an arm soon goes its own way, so that a window is a fifth of a second; many start all over each run and run side
by side. It is a check in radians of what was named from currents and tips, and takes no part in naming.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from calib.arrays import Array
from calib.gap.dynamic.body import Load
from calib.gap.dynamic.laws import friction_Nm
from calib.gap.dynamic.physics import Parts, Physics, sorted_terms
from calib.gap.dynamic.terms import Term

WINDOW_s, BETWEEN_s = 0.2, 0.25
SUBSTEP_s = 0.0004
FEWEST_WINDOWS = 3  # of a run


@dataclass(frozen=True, slots=True)
class MotionGap:
    """Root mean square of a window's angles beside the measured ones [rad], on the runs kept apart, and their floor."""

    floor_rad: float
    before_rad: float
    after_rad: float
    windows: int


@dataclass(frozen=True, slots=True)
class _State:
    """What the laws of friction ask of a motion, (W, n)."""

    q: Array
    speed: Array
    acceleration: Array
    t_s: Array


class Windows:
    """All windows of a recording, side by side."""

    def __init__(self, physics: Physics) -> None:
        self._physics = physics
        recording = physics.recording
        self._period = 1.0 / recording.filters.rate_Hz
        self.length = max(2, round(WINDOW_s / self._period))
        places = [self._starts(np.asarray(run.usable.all(axis=1))) for run in recording.runs]
        self.run = np.concatenate([np.full(len(starts), k) for k, starts in enumerate(places)]).astype(
            np.intp
        )
        self.start = np.concatenate(places).astype(np.intp)

    def _starts(self, usable: npt.NDArray[np.bool_]) -> npt.NDArray[np.intp]:
        starts = np.arange(2, len(usable) - self.length - 1, max(1, round(BETWEEN_s / self._period)))
        kept = [k for k in starts.tolist() if usable[k : k + self.length].all()]
        return np.array(kept, dtype=np.intp)

    def errors(self, model: Sequence[Term]) -> Array:
        """Simulated less measured angles, (length, W, n)."""
        physics, runs = self._physics, self._physics.recording.runs
        q, v, i = (self._at(name, 0) for name in ("q", "speed", "current_A"))
        parts = sorted_terms(model)
        if not physics.recording.has_current:
            K = physics.torque_per_A
            i = (self._at("voltage_V", 0) - K * v) / physics.resistance_ohm
        payload = np.array([float(runs[k].payload_kg[s]) for k, s in zip(self.run, self.start, strict=True)])
        result = np.empty((self.length, *q.shape))
        steps = max(2, round(self._period / SUBSTEP_s))
        whole, within = divmod(parts.delay_s, self._period)
        a = self._at("acceleration", 0)
        for s in range(self.length):
            result[s] = q - self._at("q_raw", s)
            bias, inverse = self._body(parts.load, q, v, payload)
            newer, older = (self._at("voltage_V", s - int(whole) - back) for back in (0, 1))
            is_off = self._at("is_off", s).astype(bool)
            link = bias + np.einsum("wij,wj->wi", np.linalg.inv(inverse), a) - physics.body.rotor_kg_m2 * a
            for step in range(steps):
                volt = older if (step + 0.5) * self._period / steps < within else newer
                i = np.where(is_off, 0.0, self._current(parts, volt, v, i, self._period / steps))
                torque = physics.torque_per_A * physics.scales(parts) * i
                for term in parts.friction:
                    j = term.index
                    state = _State(q, v, a, np.full(len(q), s * self._period))
                    torque[:, j] -= friction_Nm(term, state, j, link[:, j], physics.gear_ratios[j])
                a = np.einsum("wij,wj->wi", inverse, torque - bias)
                v = v + a * self._period / steps
                q = q + v * self._period / steps
        return result

    def _at(self, name: str, ahead: int) -> Array:
        runs = self._physics.recording.runs
        return np.stack(
            [getattr(runs[k], name)[s + ahead] for k, s in zip(self.run, self.start, strict=True)]
        )

    def _current(self, parts: Parts, volt: Array, v: Array, i: Array, h: float) -> Array:
        physics = self._physics
        seen = physics.sagged(parts, volt, i)
        target = (seen - physics.torque_per_A * physics.scales(parts) * v) / physics.resistance_ohm
        lag = np.maximum(physics.lag_s, 1e-9)
        return np.asarray(target + (i - target) * np.exp(-h / lag))

    def _body(self, load: Load, q: Array, v: Array, payload: Array) -> tuple[Array, Array]:
        """Bias torques (W, n) and inverse mass matrices (W, n, n)."""
        n, dynamics = q.shape[1], self._physics.body.dynamics(load)
        units = np.vstack([np.zeros((1, n)), np.eye(n)])
        rows = np.repeat(units, len(q), axis=0)
        carried = np.tile(np.maximum(payload + load.payload_kg, 0.0), n + 1)
        found = dynamics.torques(np.tile(q, (n + 1, 1)), np.tile(v, (n + 1, 1)), rows, carried)
        torques = found.reshape(n + 1, len(q), n)
        return torques[0], np.linalg.inv(np.moveaxis(torques[1:] - torques[0], 0, 2))


def motion_gap(
    physics: Physics, known: Sequence[Term], model: Sequence[Term], report: Sequence[str]
) -> MotionGap | None:
    """The check on the runs named in `report`; None without voltages, for elastic gears, or with too few windows."""
    recording = physics.recording
    if not recording.has_voltage or sorted_terms(model).elastic or sorted_terms(known).elastic:
        return None
    windows = Windows(physics)
    kept = np.isin(windows.run, [k for k, run in enumerate(recording.runs) if run.name in report])
    if int(kept.sum()) < FEWEST_WINDOWS:
        return None
    before, after = windows.errors(known), windows.errors(model)
    return MotionGap(
        _floor(physics, windows, after), _rms(before[:, kept]), _rms(after[:, kept]), int(kept.sum())
    )


def _floor(physics: Physics, windows: Windows, errors: Array) -> float:
    """From repeats, in windows that begin at the same sample, and what the encoders' steps leave of a first speed."""
    drives, gain = physics.arm.drives, physics.recording.filters.speed_gain
    steps = [2.0 * np.pi / (d.encoder_counts_per_rev * d.gear_ratio) / np.sqrt(12.0) for d in drives]
    by_steps = float(np.sqrt(np.mean(np.square(steps)))) * max(1.0, gain * WINDOW_s / np.sqrt(3.0))
    differences = []
    for group in physics.recording.repeats:
        for one, other in itertools.pairwise(group):
            a, b = np.flatnonzero(windows.run == one), np.flatnonzero(windows.run == other)
            _, in_a, in_b = np.intersect1d(windows.start[a], windows.start[b], return_indices=True)
            differences.append(errors[:, a[in_a]] - errors[:, b[in_b]])
    found = [part for part in differences if part.size]
    repeated = _rms(np.concatenate(found, axis=1)) / float(np.sqrt(2.0)) if found else 0.0
    return float(np.hypot(repeated, by_steps))


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))
