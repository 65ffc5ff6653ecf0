"""The time of a capture on the encoders' clock, from a motion that both have seen.

    t = offset + (1 + rate) tau

First where the speeds of tip and body correlate best, which needs to know neither where the system stands nor where the body is
on the arm. Then least squares of positions: tip(q(t)) against the body in a frame of unknown place. The arm's deviations (a prior
of half the usual bounds) and the body's place on the last link are unknown, too: an uncalibrated arm does not shift the
time. The covariance is that of blocks of time (a sandwich), because residuals of neighbouring frames are alike.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import maximum_filter1d, minimum_filter1d

from calib.arm_problem.arm_model import ANGLE_BOUND_rad, ArmModel, LENGTH_BOUND_m
from calib.arm_problem.observations import cross_matrix, rotation_of
from calib.arrays import Array, norms
from calib.boards import best_motion
from calib.capture.tracks import BodyTrack, CaptureError, Mask
from calib.gap.log import Log, LoggedRun
from control.model.arm import Arm

STEP_s = 0.01  # of the correlation
LEAST_OVERLAP_s = 3.0
LEAST_CORRELATION, RIVAL, LOBE_s = 0.7, 0.9, 1.0
MOVING_m_s = 0.01
FRAMES = 1500  # used for the fine step
RATE_FROM_s = 60.0  # a rate of 10 ppm is 0.6 ms in a minute
BODY_m, FRAME_m, RATE = 0.1, 10.0, 1e-3  # prior sizes: body on the last link, place of the system, clocks
STEPS, BLOCKS = 12, 24
WORST_s = 0.02
CLIP = 3.0
FAR_OFF_m = 0.02  # residual that no arm within the bounds leaves
NOISE_LEAST_m = 1e-5


@dataclass(frozen=True, slots=True)
class Alignment:
    """t = offset_s + (1 + rate) tau. rate and rate_sd are 0 if the recording is too short to tell.

    correlation: of the speeds; residual_m: of a coordinate of the positions.
    """

    offset_s: float
    offset_sd_s: float
    rate: float
    rate_sd: float
    correlation: float
    residual_m: float

    def log_time(self, capture_s: Array) -> Array:
        """Times of the capture on the encoders' clock."""
        return np.asarray(self.offset_s + (1.0 + self.rate) * capture_s)

    def in_words(self) -> str:
        """A sentence for the operator."""
        rate = f", and runs {1e6 * self.rate:+.1f} ppm (sd {1e6 * self.rate_sd:.1f}) against it" if self.rate_sd else ""
        return (
            f"the capture begins at {self.offset_s:.4f} s (sd {1e3 * self.offset_sd_s:.2f} ms) of the encoders' clock{rate};"
            f" speeds correlate by {self.correlation:.3f}, positions in motion agree to {1e3 * self.residual_m:.1f} mm"
        )


def align(arm: Arm, motion: JointMotion, capture_s: Array, body: BodyTrack) -> Alignment:
    """The capture's time on the log's clock. CaptureError if the motion cannot tell."""
    model = ArmModel(arm)
    tips = model.tips(arm.dh, motion.q_rad)
    offset_s, correlation = _coarse(motion, tips, capture_s, body)
    return _fine(_overlap(model, motion, capture_s, body, offset_s), correlation)


def _coarse(motion: JointMotion, tips: Array, capture_s: Array, body: BodyTrack) -> tuple[float, float]:
    """Offset and correlation of the speeds, by masked normalised cross-correlation (Padfield, 2012)."""
    ours, begin_s = _gridded(motion.t_s, tips, np.ones(len(tips), dtype=bool))
    theirs, their_begin_s = _gridded(capture_s, body.position_m, body.is_seen)
    if not len(theirs) or np.isfinite(theirs).sum() * STEP_s < LEAST_OVERLAP_s:
        raise CaptureError(f"the body is seen for less than {LEAST_OVERLAP_s:g} s: too little to find the time")
    score = _scores(ours, theirs)
    best = int(np.argmax(score))
    lag_s = (np.arange(len(score)) - (len(theirs) - 1)) * STEP_s
    if score[best] < 0.0:
        raise CaptureError(
            f"log and capture have no {LEAST_OVERLAP_s:g} s in common in which both tip and body move: is it the body on the last"
            " link, and the log of this motion?"
        )
    if not score[best] >= LEAST_CORRELATION:
        raise CaptureError(
            f"the speeds of tip and body agree nowhere (correlation {score[best]:.2f} at best): is it the body on the last link,"
            " and the log of this motion?"
        )
    rivals = np.where(np.abs(lag_s - lag_s[best]) > LOBE_s, score, -1.0)
    if rivals.max() > RIVAL * score[best] and rivals.max() > LEAST_CORRELATION:
        raise CaptureError(
            f"the motion cannot tell the time: shifted by {lag_s[int(np.argmax(rivals))] - lag_s[best]:+.1f} s it fits as well"
            f" (correlation {rivals.max():.2f} against {score[best]:.2f}); record a motion that does not repeat itself"
        )
    return float(lag_s[best] + begin_s - their_begin_s), float(score[best])


def _gridded(t_s: Array, places: Array, seen: Mask) -> tuple[Array, float]:
    """Speeds [m/s] every STEP_s, NaN where unknown, and the time of the first."""
    known = np.flatnonzero(seen)
    if len(known) < 2:
        return np.zeros(0), 0.0
    grid = np.arange(t_s[0], t_s[-1], STEP_s)
    half = 2.5 * STEP_s
    ends = [np.column_stack([np.interp(grid + s, t_s[known], places[known, k]) for k in range(3)]) for s in (half, -half)]
    speed = norms(ends[0] - ends[1]) / (2.0 * half)
    after = np.clip(np.searchsorted(t_s[known], grid), 1, len(known) - 1)
    is_gap = t_s[known][after] - t_s[known][after - 1] > 4.0 * STEP_s
    return np.where(is_gap, np.nan, speed), float(grid[0])


def _scores(ours: Array, theirs: Array) -> Array:
    """Correlation at every lag of `theirs`, -1 where too little overlaps or too little moves there."""
    size = 1 << int(np.ceil(np.log2(len(ours) + len(theirs))))
    seen = [np.isfinite(one).astype(float) for one in (ours, theirs)]
    a, b = (np.nan_to_num(one) for one in (ours, theirs))

    def crossed(first: Array, second: Array) -> Array:
        product = np.fft.rfft(first, size) * np.fft.rfft(second[::-1], size)
        return np.asarray(np.fft.irfft(product, size)[: len(ours) + len(theirs) - 1])

    count = np.maximum(crossed(seen[0], seen[1]), 1e-9)
    sum_a, sum_b = crossed(a, seen[1]), crossed(seen[0], b)
    spread_a = crossed(a * a, seen[1]) - sum_a**2 / count
    spread_b = crossed(seen[0], b * b) - sum_b**2 / count
    moves = (spread_a > MOVING_m_s**2 * count) & (spread_b > MOVING_m_s**2 * count)
    enough = (count * STEP_s > LEAST_OVERLAP_s) & (spread_b > 0.5 * spread_b.max()) & moves
    scale = np.sqrt(np.maximum(spread_a * spread_b, 1e-30))
    return np.where(enough, (crossed(a, b) - sum_a * sum_b / count) / scale, -1.0)


@dataclass(frozen=True, slots=True)
class _Overlap:
    """The frames (m,) that lie in the log at a rough offset: body (m, 3), time, and the middle of the times."""

    model: ArmModel
    motion: JointMotion
    seen_m: Array
    tau_s: Array
    offset_s: float

    @property
    def middle_s(self) -> float:
        """Of the capture's clock, about which a rate turns."""
        return float(self.tau_s.mean())

    @property
    def is_long(self) -> bool:
        """Whether it tells a rate."""
        return float(np.ptp(self.tau_s)) >= RATE_FROM_s


def _overlap(model: ArmModel, motion: JointMotion, capture_s: Array, body: BodyTrack, offset_s: float) -> _Overlap:
    rows = np.flatnonzero(body.is_seen & (motion.covers(offset_s + capture_s) > 0.0))
    rows = rows[:: max(1, len(rows) // FRAMES)]
    span_s = float(np.ptp(capture_s[rows])) if len(rows) else 0.0
    if span_s < LEAST_OVERLAP_s:
        raise CaptureError(f"log and capture overlap by {span_s:.1f} s: {LEAST_OVERLAP_s:g} s are needed at least")
    return _Overlap(model, motion, body.position_m[rows], capture_s[rows], offset_s)


def _fine(both: _Overlap, correlation: float) -> Alignment:
    """Least squares, and what the fit says of its own time. CaptureError if that is nothing."""
    x, spread, noise_m = _solved(both)
    to_begin = np.array([1.0, -both.middle_s if both.is_long else 0.0])  # x has the offset at the middle
    sd_s = float(np.sqrt(to_begin @ spread[-2:, -2:] @ to_begin))
    if noise_m > FAR_OFF_m:
        raise CaptureError(
            f"positions of body and tip disagree by {1e3 * noise_m:.0f} mm at the best time: is it the body on the last link,"
            " and the log of this motion?"
        )
    if not sd_s < WORST_s:
        raise CaptureError(
            f"the motion cannot tell the time: the offset is known to {1e3 * sd_s:.0f} ms only; record faster motions"
        )
    rate, rate_sd = (float(x[-1]), float(np.sqrt(spread[-1, -1]))) if both.is_long else (0.0, 0.0)
    return Alignment(both.offset_s + float(to_begin @ x[-2:]), sd_s, rate, rate_sd, correlation, noise_m)


def _solved(both: _Overlap) -> tuple[Array, Array, float]:
    """Deviations of the arm, place of the body, (frame,) offset and rate; their covariance; noise: Gauss-Newton."""
    prior = _prior(both.model, both.is_long)
    x = np.zeros(len(prior))
    tips = both.model.tips(both.model.nominal_dh, both.motion.at(both.offset_s + both.tau_s)[0])
    frame = best_motion(both.seen_m, tips)
    turn, shift = frame.rotation, frame.shift_m
    for _ in range(STEPS):
        residual, jacobian = _linearised(both, x, turn, shift)
        noise_m, weight = _weights(residual)
        gram = np.einsum("m,mik,mil->kl", weight, jacobian, jacobian)
        information = gram / noise_m**2 + np.diag(prior**-2.0)
        gradient = np.einsum("m,mik,mi->k", weight, jacobian, residual) / noise_m**2 - x / prior**2
        step = np.linalg.solve(information, gradient)
        x = x + step
        turn, shift = rotation_of(step[-5:-2]) @ turn, shift + step[-8:-5]
        x[-8:-2] = 0.0
    residual, jacobian = _linearised(both, x, turn, shift)
    pieces = np.einsum("m,mik,mi->mk", weight, jacobian, residual) / noise_m**2
    blocks = np.array([piece.sum(axis=0) for piece in np.array_split(pieces, BLOCKS)])
    inverse = np.linalg.inv(information)
    return x, inverse @ (blocks.T @ blocks + np.diag(prior**-2.0)) @ inverse, noise_m


def _weights(residual: Array) -> tuple[float, Array]:
    """Noise of a coordinate by the median, and Huber's weights (m,): a frame that is far off says little."""
    far = norms(residual)
    noise_m = max(NOISE_LEAST_m, float(np.median(far)) / 1.538)  # of the norm of three standard normals
    return noise_m, np.minimum(1.0, CLIP * noise_m / np.maximum(far, NOISE_LEAST_m))


def _prior(model: ArmModel, is_long: bool) -> Array:
    """Sizes of the unknowns: DH, body, frame (shift, turn), offset, rate; a rate that a short recording cannot tell is none."""
    dh = 0.5 * np.tile([LENGTH_BOUND_m, ANGLE_BOUND_rad, LENGTH_BOUND_m, ANGLE_BOUND_rad], len(model.nominal_dh))
    rate = RATE if is_long else 1e-12
    return np.concatenate((dh, [BODY_m] * 3, [FRAME_m] * 3, [np.pi] * 3, [1.0, rate]))


def _linearised(both: _Overlap, x: Array, turn: Array, shift: Array) -> tuple[Array, Array]:
    """Body in the base frame minus tip (m, 3), and minus its derivatives (m, 3, k)."""
    model, tau = both.model, both.tau_s
    size, about_s = model.nominal_dh.size, tau - both.middle_s
    dh = model.nominal_dh + x[:size].reshape(-1, 4)
    q, speed = both.motion.at(both.offset_s + x[-2] + tau + x[-1] * about_s)
    slopes = model.slopes(dh, q, model.nominal_tool_m + x[size : size + 3])
    velocity = np.einsum("mij,mj->mi", slopes.by_dh[:, :, list(model.theta_places)], speed)
    turned = both.seen_m @ turn.T
    jacobian = np.concatenate((slopes.by_dh, slopes.by_tool, np.zeros((len(tau), 3, 8))), axis=2)
    jacobian[:, :, size + 3 : size + 6] = -np.eye(3)
    for axis in range(3):
        jacobian[:, :, size + 6 + axis] = -(turned @ cross_matrix(np.eye(3)[axis]).T)
    jacobian[:, :, -2] = velocity
    jacobian[:, :, -1] = velocity * about_s[:, None]
    return turned + shift - slopes.tips, jacobian


# An arm that hunts about its place rests: point and angles are means over the same time.
STILL_rad, STILL_s = 1e-3, 0.2
LEAP_rad, FASTEST_rad_s = 0.02, 50.0  # between samples; beyond both it is no motion
SLOPE_s = 0.05  # over which speeds are taken: a count of an encoder is no speed


@dataclass(frozen=True, slots=True)
class JointMotion:
    """Joint angles q_rad (m, n) at t_s (m,), increasing; speeds (m, n)."""

    t_s: Array
    q_rad: Array
    speed_rad_s: Array

    @classmethod
    def of(cls, log: Log, run: str | None) -> tuple[JointMotion, tuple[str, ...]]:
        """Of one run, or of all if they are on one clock: by t_s, or by the column `cycle` of our own exports.

        What comes before a leap of an angle is left out, and said: homing gives a joint its zero. CaptureError names the runs.
        """
        names = [logged.name for logged in log.runs]
        runs = [logged for logged in log.runs if run is None or logged.name == run]
        if not runs:
            raise CaptureError(f'{log.sources[0]}: no run "{run}": expected one of {", ".join(names)}')
        t_s = np.concatenate([logged.t_s + begin_s for logged, begin_s in zip(runs, begins_s(runs), strict=True)])
        if len(t_s) < 10 or not (np.diff(t_s) > 0.0).all():
            raise CaptureError(
                f"{log.sources[0]}: its runs have clocks of their own, or too few samples: give the captured one with --run"
                f" ({', '.join(names)})"
            )
        q_rad = np.concatenate([logged.q_rad for logged in runs])
        first = after_leaps(t_s, q_rad)
        if len(t_s) - first < 10:
            raise CaptureError(f"{log.sources[0]}: an angle leaps at its end: nothing is left behind it")
        said = (f"the log before {t_s[first]:.2f} s is not used: an angle leaps there, as by homing",) if first else ()
        return cls(t_s[first:], q_rad[first:], _speeds(t_s[first:], q_rad[first:])), said

    def at(self, t_s: Array) -> tuple[Array, Array]:
        """Joint angles and speeds (k, n) at times within the log, linearly between samples."""
        columns = range(self.q_rad.shape[1])
        q = np.column_stack([np.interp(t_s, self.t_s, self.q_rad[:, j]) for j in columns])
        speed = np.column_stack([np.interp(t_s, self.t_s, self.speed_rad_s[:, j]) for j in columns])
        return q, speed

    def covers(self, t_s: Array) -> Array:
        """(k,), whether times are within the log, and not in a gap of it."""
        after = np.clip(np.searchsorted(self.t_s, t_s), 1, len(self.t_s) - 1)
        gap = self.t_s[after] - self.t_s[after - 1]
        return np.asarray((t_s >= self.t_s[0]) & (t_s <= self.t_s[-1]) & (gap < 2.0 * SLOPE_s), dtype=float)

    def rests(self, least_s: float) -> list[tuple[float, float]]:
        """Begin and end of every time of `least_s` or more in which no joint turned by STILL_rad and a count within STILL_s."""
        changes = np.abs(np.diff(self.q_rad, axis=0))
        count_rad = np.min(changes, axis=0, where=changes > 0.0, initial=np.inf)
        window = max(round(STILL_s / float(np.median(np.diff(self.t_s)))), 1)
        spread = maximum_filter1d(self.q_rad, window, axis=0) - minimum_filter1d(self.q_rad, window, axis=0)
        still = (spread < STILL_rad + np.where(np.isfinite(count_rad), count_rad, 0.0)).all(axis=1)
        edges = np.flatnonzero(np.diff(np.concatenate(([False], still, [False])).astype(int)))
        half_s = 0.5 * STILL_s
        begins = np.maximum(self.t_s[edges[::2]] - half_s, self.t_s[0]).tolist()
        ends = np.minimum(self.t_s[edges[1::2] - 1] + half_s, self.t_s[-1]).tolist()
        return [(a, b) for a, b in zip(begins, ends, strict=True) if b - a >= least_s]


def after_leaps(t_s: Array, q_rad: Array) -> int:
    """The first sample behind the last leap of an angle; homing gives a joint its zero."""
    leaps = np.abs(np.diff(q_rad, axis=0)).max(axis=1) > LEAP_rad + FASTEST_rad_s * np.diff(t_s)
    return int(np.flatnonzero(leaps)[-1]) + 1 if leaps.any() else 0


def begins_s(runs: Sequence[LoggedRun]) -> list[float]:
    """What to add to each run's times: where runs begin at 0 again, their cycles say how long after the run before."""
    begins, cycles = [0.0], [one.extra.get("cycle") for one in runs]
    for before, after, first, then in zip(runs[:-1], runs[1:], cycles[:-1], cycles[1:], strict=True):
        is_later = float(after.t_s[0]) > float(before.t_s[-1])
        if is_later or not first or not then or len(before) < 2:
            begins.append(begins[-1] if is_later else 0.0)
            continue
        counts = [float(text) for text in (first[0], first[-1], then[0])]
        period_s = float(np.ptp(before.t_s)) / max(counts[1] - counts[0], 1.0)
        end_s = begins[-1] + float(before.t_s[-1])
        begins.append(end_s + (counts[2] - counts[1]) * period_s - float(after.t_s[0]))
    return begins


def _speeds(t_s: Array, values: Array) -> Array:
    """Difference quotients over SLOPE_s around each sample."""
    before, after = np.maximum(t_s - 0.5 * SLOPE_s, t_s[0]), np.minimum(t_s + 0.5 * SLOPE_s, t_s[-1])
    columns = [(np.interp(after, t_s, column) - np.interp(before, t_s, column)) / (after - before) for column in values.T]
    return np.column_stack(columns)
