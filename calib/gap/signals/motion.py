"""Motion from voltage: the model driven by the recorded voltages, in short windows and in closed loop.

Open loop an arm soon goes its own way, so that a window is a fifth of a second from a measured state; many start all over each
run and run side by side. In closed loop a run is simulated whole: what its angles are off by goes through the gains of the arm's
file into the voltage. A linear controller in the log would have done so too; where it had other gains, the errors are as this
arm's own loop would leave them. Both are checks in radians of what was named from currents and tips, and take no part in naming.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from calib.arrays import Array
from calib.gap.signals.forward import Forward, begin
from calib.gap.signals.physics import Physics
from calib.gap.signals.terms import Law
from control.dynamics.gains import gains_of
from control.errors import MissingModel

Places = npt.NDArray[np.intp]
WINDOW_s, BETWEEN_s = 0.2, 0.25
FEWEST_WINDOWS = 3  # of the held-out runs
RUNAWAY_rad = 100.0  # off: a simulated arm that is 16 turns away has left the recording for good
OPEN, CLOSED = "q_rad", "q_loop_rad"


@dataclass(frozen=True, slots=True)
class MotionGap:
    """Root mean square of simulated less measured angles [rad] on the held-out runs, and the floor of that."""

    floor_rad: float
    before_rad: float
    after_rad: float


def motion_gaps(
    physics: Physics, known: Sequence[Law], model: Sequence[Law], report: Sequence[str]
) -> dict[str, MotionGap]:
    """By channel, OPEN and CLOSED; without voltages, or with too little to simulate, there is none of them."""
    if not physics.recording.has_voltage:
        return {}
    kept = [k for k, run in enumerate(physics.recording.runs) if run.name in report]
    found: dict[str, Windows | Loop] = {OPEN: Windows(physics, kept), CLOSED: Loop(physics, kept)}
    gaps = {name: part.gap(known, model) for name, part in found.items() if part.suffices}
    return {name: one for name, one in gaps.items() if math.isfinite(one.before_rad + one.after_rad)}


class Windows:
    """Windows all over some runs, side by side."""

    def __init__(self, physics: Physics, runs: Sequence[int]) -> None:
        self._physics = physics
        self._period = 1.0 / physics.recording.filters.rate_Hz
        self.length = max(2, round(WINDOW_s / self._period))
        places = [self._starts(np.asarray(physics.recording.runs[k].usable.all(axis=1))) for k in runs]
        of_run = [np.full(len(starts), k) for k, starts in zip(runs, places, strict=True)]
        self.run: Places = np.concatenate([*of_run, np.zeros(0)]).astype(np.intp)
        self.start: Places = np.concatenate([*places, np.zeros(0)]).astype(np.intp)

    def _starts(self, usable: npt.NDArray[np.bool_]) -> Places:
        starts = np.arange(2, len(usable) - self.length - 1, max(1, round(BETWEEN_s / self._period)))
        kept = [k for k in starts.tolist() if usable[k : k + self.length].all()]
        return np.array(kept, dtype=np.intp)

    @property
    def suffices(self) -> bool:
        """Whether there are enough."""
        return len(self.run) >= FEWEST_WINDOWS

    def gap(self, known: Sequence[Law], model: Sequence[Law]) -> MotionGap:
        """With the model as it was and as it is."""
        after = self.errors(model)
        before = after if tuple(known) == tuple(model) else self.errors(known)
        return MotionGap(self._floor(after), _rms(before), _rms(after))

    def errors(self, model: Sequence[Law]) -> Array:
        """Simulated less measured angles, (length, W, n)."""
        runs = self._physics.recording.runs
        payload = np.array([float(runs[k].payload_kg[s]) for k, s in zip(self.run, self.start, strict=True)])
        forward = Forward(self._physics, model, payload)
        state = begin(self._physics, model, self.run.tolist(), self.start.tolist())
        whole, _ = forward.delay
        result = np.empty((self.length, *state.q.shape))
        for s in range(self.length):
            result[s] = state.motor - self._at("q_raw", s)
            if _runs_away(result[s]):
                result[s:] = np.inf
                break
            newer, older = (self._at("voltage_V", s - whole - back) for back in (0, 1))
            forward.advance(state, newer, older, self._at("is_off", s).astype(bool))
        return result

    def _at(self, name: str, ahead: int) -> Array:
        runs = self._physics.recording.runs
        return np.stack(
            [getattr(runs[k], name)[max(s + ahead, 0)] for k, s in zip(self.run, self.start, strict=True)]
        )

    def _floor(self, errors: Array) -> float:
        """From repeats, in windows that begin at the same sample, and what the encoders' steps leave of a first speed."""
        grown = max(1.0, self._physics.recording.filters.speed_gain * WINDOW_s / np.sqrt(3.0))
        differences: list[Array] = []
        for one, other in _pairs(self._physics, self.run.tolist()):
            a, b = np.flatnonzero(self.run == one), np.flatnonzero(self.run == other)
            _, in_a, in_b = np.intersect1d(self.start[a], self.start[b], return_indices=True)
            differences.append(_apart(errors[:, a[in_a]], errors[:, b[in_b]]))
        return _floor(self._physics, differences, grown)


class Loop:
    """Whole runs, with feedback that keeps the simulated arm beside the measured one."""

    def __init__(self, physics: Physics, runs: Sequence[int]) -> None:
        self._physics, self._runs = physics, list(runs)
        self._period = 1.0 / physics.recording.filters.rate_Hz
        self._gains = _gains(physics)
        usable = [np.asarray(physics.recording.runs[k].usable.all(axis=1)) for k in self._runs]
        self._starts = [int(np.argmax(flags)) for flags in usable]
        self._lengths = [
            len(flags) - start - 1 if flags.any() else 0
            for flags, start in zip(usable, self._starts, strict=True)
        ]

    @property
    def suffices(self) -> bool:
        """Whether there are runs that the driver drove all through, and gains for them."""
        if self._gains is None or not self._runs or min(self._lengths) * self._period < WINDOW_s:
            return False
        return not any(self._physics.recording.runs[k].is_off.any() for k in self._runs)

    def gap(self, known: Sequence[Law], model: Sequence[Law]) -> MotionGap:
        """With the model as it was and as it is."""
        after = self.errors(model)
        before = after if tuple(known) == tuple(model) else self.errors(known)
        differences = []
        for one, other in _pairs(self._physics, self._runs):
            a, b = (after[self._runs.index(k)] for k in (one, other))
            common = min(len(a), len(b))
            differences.append(_apart(a[:common], b[:common]))
        floor = _floor(self._physics, differences, 1.0)
        return MotionGap(floor, _rms(np.concatenate(before)), _rms(np.concatenate(after)))

    def errors(self, model: Sequence[Law]) -> list[Array]:
        """Simulated less measured angles, (samples, n) of each run."""
        assert self._gains is not None
        recording, kp, ki, kd = self._physics.recording, *self._gains
        runs = [recording.runs[k] for k in self._runs]
        payload = np.array([float(np.median(run.payload_kg)) for run in runs])
        forward = Forward(self._physics, model, payload)
        state = begin(self._physics, model, self._runs, self._starts)
        whole, _ = forward.delay
        longest = max(self._lengths)
        sum_rad_s, result = np.zeros_like(state.q), np.empty((longest, *state.q.shape))
        back = [np.zeros_like(state.q)] * (whole + 2)  # feedback is late as the voltages are

        def at(name: str, s: int) -> Array:
            places = (
                max(min(start + s, len(run) - 1), 0) for start, run in zip(self._starts, runs, strict=True)
            )
            return np.stack([getattr(run, name)[place] for run, place in zip(runs, places, strict=True)])

        for s in range(longest):
            result[s] = state.motor - at("q_raw", s)
            if _runs_away(result[s]):
                result[s:] = np.inf
                break
            sum_rad_s -= self._period * result[s]
            feedback = kp * -result[s] + ki * sum_rad_s + kd * (at("speed", s) - state.motor_speed)
            back = [feedback, *back[:-1]]
            newer = at("voltage_V", s - whole) + back[whole]
            older = at("voltage_V", s - whole - 1) + back[whole + 1]
            forward.advance(state, newer, older, np.zeros(state.q.shape, dtype=bool))
        return [result[:length, w] for w, length in enumerate(self._lengths)]


def _runs_away(error_rad: Array) -> bool:
    """Whether a model has lost its recording: gains of a fast loop do not hold an arm at a slow log's rate."""
    return not float(np.abs(error_rad).max()) < RUNAWAY_rad


def _gains(physics: Physics) -> tuple[Array, Array, Array] | None:
    """Of all joints in volts; None where the arm's file has none and they cannot be derived."""
    arm = physics.arm
    try:
        gains = [gains_of(arm, drive.joint) for drive in arm.drives]
    except MissingModel:
        return None
    volts = np.array([d.resistance_ohm if d.pid.mode == "current" else 1.0 for d in arm.drives])
    kp, ki, kd = (
        volts * np.array(column) for column in zip(*((g.kp, g.ki, g.kd) for g in gains), strict=True)
    )
    return kp, ki, kd


def _pairs(physics: Physics, runs: Sequence[int]) -> list[tuple[int, int]]:
    """Runs among these that repeat each other, neighbours in their group."""
    among = set(runs)
    groups = ([k for k in group if k in among] for group in physics.recording.repeats)
    return [pair for group in groups for pair in itertools.pairwise(group)]


def _apart(one: Array, other: Array) -> Array:
    """Their difference; not a number where both have run away."""
    with np.errstate(invalid="ignore"):
        return np.asarray(one - other).ravel()


def _floor(physics: Physics, differences: Sequence[Array], grown: float) -> float:
    steps = [2.0 * np.pi / (d.encoder_counts_per_rev * d.gear_ratio) for d in physics.arm.drives]
    by_steps = grown * float(np.sqrt(np.mean(np.square(steps)) / 12.0))
    found = [part for part in differences if part.size and np.isfinite(part).all()]
    repeated = _rms(np.concatenate(found)) / float(np.sqrt(2.0)) if found else 0.0
    return float(np.hypot(repeated, by_steps))


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))
