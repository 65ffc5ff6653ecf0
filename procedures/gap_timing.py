"""Time alignment of a recording: angles, currents, voltages and tips of log.csv share one clock.

A row holds the latest values received: the current of the last cycle (a reference board answers a command with the mean of the
last millisecond before it, docs/motor_board.md; a bought board measures after it), an encoder report up to a cycle old, and an
older camera frame. While a voltage u is held, the winding current follows R i(t) = u - k_t N dq/dt(t - L/R). It falls by k_t N
a / R per second, which shifts the mean to the time of the command. Angles that are late by d leave k_t N a d in the balance,
which gives d. Resistance, motor constant and a command delay are fitted as well, so that none of them is mistaken for age. The
camera's age is that for which its tips follow those of the encoders, apart from smooth functions of the pose, backlash and
compliance.

"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib.arrays import Array, Mask, frozen
from calib.capture.alignment import JointMotion, after_leaps, begins_s
from calib.gap.log import Log, LoggedRun
from control.kinematics.kinematics import ForwardKinematics
from control.model.arm import Arm
from control.recording.record import LEAD_FIELD

MEAN_s = 1e-3  # over which a board averages a current, before the command that it answers
SMOOTH = 4  # cycles: width of the filter applied to all channels
ROUNDS = 3
OLDEST_ENCODER = 3.0  # cycles; a larger estimate is not an age
OLDEST_CAMERA_s = 0.2
MOVING_rad_s = 0.01
LEAST_ROWS = 200


@dataclass(frozen=True, slots=True)
class Raw:
    """A run as recorded, m cycles of n joints.

    t_s (m,); q, set-points, current, voltage (m, n); counted_s (m, n): when each angle was latched, by its board's clock; tip_m
    (m, 3), NaN without frame; lead_rad (m, n): how far each motor is ahead of its joint, NaN where no pair of counts came.
    """

    t_s: Array
    q_rad: Array
    q_set_rad: Array
    current_A: Array
    voltage_V: Array
    counted_s: Array
    tip_m: Array
    payload_kg: float
    lead_rad: Array

    @property
    def period_s(self) -> float:
        """Period of the cycle."""
        return float(np.median(np.diff(self.t_s)))


@dataclass(frozen=True, slots=True)
class Aligned:
    """A run on one clock, t_s from 0: the values at each time, and the voltage that starts there."""

    t_s: Array
    q_rad: Array
    q_set_rad: Array
    current_A: Array
    voltage_V: Array
    tip_m: Array
    lead_rad: Array


@dataclass(frozen=True, slots=True)
class BoardClock:
    """A board's clock on the loop's: t = since_s + offset_s + (1 + rate) (board time - since_s)."""

    since_s: float
    offset_s: float
    rate: float = 0.0

    def loop_s(self, board_s: Array) -> Array:
        """Convert board times to loop times."""
        return self.since_s + self.offset_s + (1.0 + self.rate) * (board_s - self.since_s)


@dataclass(frozen=True, slots=True)
class Clocks:
    """The clock of every joint's encoder board, and the age of camera frames in their rows (NaN: no camera)."""

    encoder: tuple[BoardClock, ...]
    camera_s: float
    angle_age_s: float

    def in_words(self) -> tuple[str, ...]:
        """Describe the delays removed."""
        camera = "" if math.isnan(self.camera_s) else f", camera frames {1e3 * self.camera_s:.1f} ms"
        return ((f"Delays removed from the log: angles {1e3 * self.angle_age_s:.2f} ms on average{camera}, currents one cycle."),)


def clocks_of(arm: Arm, runs: Sequence[Raw]) -> Clocks:
    """Estimate the clocks from all runs.

    Without voltages or currents, counts of bought boards are as old as the host noted, others half a cycle on average.
    """
    joints = range(arm.joint_count)
    boards: dict[int, list[int]] = {}
    for j in joints:
        boards.setdefault(arm.drive(j + 1).encoder_board, []).append(j)
    by_joint: dict[int, BoardClock] = {}
    for own in boards.values():
        by_joint.update(dict.fromkeys(own, _board_clock(arm, runs, own)))
    clocks = tuple(by_joint[j] for j in joints)
    ages = [float(np.mean(raw.t_s - clocks[0].loop_s(raw.counted_s[:, 0]))) for raw in runs]
    return Clocks(clocks, _camera_age_s(arm, runs, clocks), float(np.mean(ages)))


def aligned(arm: Arm, raw: Raw, clocks: Clocks) -> Aligned:
    """Rows k = 1 ... m - 2, at the time when row k's voltage started."""
    at = raw.t_s[1:-1]
    q = np.column_stack([_angle(raw, j, clock, at) for j, clock in enumerate(clocks.encoder)])
    mean_s = np.where(_is_newest(arm), 0.0, MEAN_s)
    current = _currents(arm, raw) + 0.5 * mean_s * _current_slope_A_s(arm, q, raw.period_s)
    tip = _tips(arm, raw, clocks, at)
    return Aligned(at - at[0], q, raw.q_set_rad[1:-1], current, raw.voltage_V[1:-1], tip, raw.lead_rad[1:-1])


def lead_rad_of(run: Aligned | LoggedRun, joint_count: int) -> Array:
    """How far each motor is ahead of its joint (m, n), NaN where no pair of counts came."""
    if isinstance(run, Aligned):
        return run.lead_rad
    none = ("",) * len(run)
    columns = [run.extra.get(LEAD_FIELD[0].format(j), none) for j in range(1, joint_count + 1)]
    return np.column_stack([_numbers(column) for column in columns])


def _is_newest(arm: Arm) -> Mask:
    """Which joints' boards measure the current after the last command, (n,); the others answer a command with what was before."""
    drives = (arm.drive(j + 1) for j in range(arm.joint_count))
    return np.array([arm.kind_of(drive).current_is_newest for drive in drives])


def _currents(arm: Arm, raw: Raw) -> Array:
    """The currents under the voltage of row k - 1, for rows k = 1 ... m - 2: received in row k, or a cycle later."""
    return np.where(_is_newest(arm), raw.current_A[1:-1], raw.current_A[2:])


@dataclass(frozen=True, slots=True)
class Frames:
    """Camera frames: taken_s (k,), tip_m (k, 3), and the joints' angles and speeds (k, n) then."""

    taken_s: Array
    tip_m: Array
    q_rad: Array
    speed_rad_s: Array


def tips_at_rows(arm: Arm, at: Array, frames: Frames) -> Array:
    """Tips (m, 3) at the times `at` (m,) of rows, NaN without frame: each at its nearest row, moved on by the tip's speed."""
    tips = np.full((len(at), 3), np.nan)
    half_s = 0.5 * float(np.median(np.diff(at)))
    after = np.clip(np.searchsorted(at, frames.taken_s), 1, len(at) - 1)
    row = np.where(frames.taken_s - at[after - 1] < at[after] - frames.taken_s, after - 1, after)
    ahead_s = at[row] - frames.taken_s
    near = np.abs(ahead_s) <= 1.01 * half_s
    if not near.any():
        return tips
    moving = np.einsum("mij,mj->mi", ForwardKinematics(arm).jacobians(frames.q_rad[near]), frames.speed_rad_s[near])
    tips[row[near]] = frames.tip_m[near] + ahead_s[near, None] * moving
    return tips


def _tips(arm: Arm, raw: Raw, clocks: Clocks, at: Array) -> Array:
    """Tips of the camera, at the rows' times."""
    if math.isnan(clocks.camera_s):
        return np.full((len(at), 3), np.nan)
    sees = _sees(raw)
    taken_s = raw.t_s[sees] - clocks.camera_s
    q, speed, _ = _motion(raw, clocks.encoder, taken_s)
    return tips_at_rows(arm, at, Frames(taken_s, raw.tip_m[sees], q, speed))


def _current_slope_A_s(arm: Arm, q: Array, period_s: float) -> Array:
    """Slope of the motor currents while a voltage is held, (m, n): the back-EMF grows with the acceleration."""
    slopes = np.zeros_like(q)
    for j in range(q.shape[1]):
        drive = arm.drive(j + 1)
        per_speed = drive.torque_constant_Nm_A * drive.gear_ratio / drive.resistance_ohm
        slopes[:, j] = -per_speed * _filtered(q[:, j], 2, period_s, keep=True)
    return slopes


def _board_clock(arm: Arm, runs: Sequence[Raw], joints: Sequence[int]) -> BoardClock:
    """The clock of the board of these joints (0-based)."""
    period = runs[0].period_s
    ahead_s = np.concatenate([raw.t_s - raw.counted_s[:, joints[0]] for raw in runs])
    since, mean_s = float(runs[0].counted_s[0, joints[0]]), float(np.mean(ahead_s))
    first = BoardClock(since, mean_s - 0.5 * period)
    if arm.drive(joints[0] + 1).encoder_board < 0:  # a bought board's counts have the host's time
        is_loops = 0.0 <= mean_s <= OLDEST_ENCODER * period  # else the times of an exported log, which begins at 0
        first = BoardClock(since, 0.0 if is_loops else float(ahead_s.min()))
    clock, information = first, np.zeros((2, 2))
    for _ in range(ROUNDS):
        information, pull = np.zeros((2, 2)), np.zeros(2)
        for j in joints:
            own, towards = _later(arm, runs, j, clock)
            information += own
            pull += towards
        if np.linalg.matrix_rank(information) < 2:
            return first
        later, faster = np.linalg.solve(information, pull)
        clock = BoardClock(since, clock.offset_s - float(later), clock.rate - float(faster))
    oldest = max(float(np.mean(raw.t_s - clock.loop_s(raw.counted_s[:, joints[0]]))) for raw in runs)
    return clock if -0.1 * period <= oldest <= OLDEST_ENCODER * period else first


def _later(arm: Arm, runs: Sequence[Raw], j: int, clock: BoardClock) -> tuple[Array, Array]:
    """Normal equations (2, 2), (2,) of the clock's offset and rate from the angles of joint j (0-based)."""
    drive = arm.drive(j + 1)
    mean_s = 0.0 if arm.kind_of(drive).current_is_newest else MEAN_s
    constant = drive.torque_constant_Nm_A * drive.gear_ratio
    values, columns = [], []
    for raw in runs:
        current, voltage = _currents(arm, raw)[:, j], raw.voltage_V[:-2, j]
        if len(current) < LEAST_ROWS or not (np.isfinite(current).all() and np.isfinite(voltage).all()):
            continue
        behind_s = drive.lag_s + 0.5 * mean_s  # delay of the current with respect to the speed
        q = _angle(raw, j, clock, raw.t_s[1:-1] - behind_s)
        speed, bend = (_filtered(q, order, raw.period_s) for order in (1, 2))
        i, u, rise = (_filtered(current, 0, 1.0), _filtered(voltage, 0, 1.0), _filtered(voltage, 1, raw.period_s))
        values.append(u - drive.resistance_ohm * i - constant * speed)
        since_s = np.full(len(i), float(np.mean(raw.counted_s[:, j])) - clock.since_s)
        columns.append(np.column_stack((constant * bend, constant * bend * since_s, i, speed, rise, np.ones_like(i))))
    if not values:
        return np.zeros((2, 2)), np.zeros(2)
    design, value = np.concatenate(columns), np.concatenate(values)
    solution, *_ = np.linalg.lstsq(design, value, rcond=None)
    others = design[:, 2:]
    alone = design[:, :2] - others @ np.linalg.lstsq(others, design[:, :2], rcond=None)[0]
    information = alone.T @ alone / max(float(np.mean((value - design @ solution) ** 2)), 1e-12)
    return information, information @ solution[:2]


def _angle(raw: Raw, j: int, clock: BoardClock, at_s: Array) -> Array:
    """The angle of joint j (0-based) at times of the loop's clock."""
    latched, first = np.unique(raw.counted_s[:, j], return_index=True)  # a report may have been in two rows
    return _cubic(at_s, clock.loop_s(latched), raw.q_rad[first, j])


def _camera_age_s(arm: Arm, runs: Sequence[Raw], clocks: Sequence[BoardClock]) -> float:
    """Age of the camera frames; NaN if there are too few."""
    if sum(int(_sees(raw).sum()) for raw in runs) < LEAST_ROWS:
        return math.nan
    kinematics, age = ForwardKinematics(arm), 0.0
    for _ in range(ROUNDS):
        value, design = _camera_rows(kinematics, runs, clocks, age)
        found, *_ = np.linalg.lstsq(design, value, rcond=None)
        age += float(found[0])
    return age if 0.0 <= age <= OLDEST_CAMERA_s else math.nan


def _camera_rows(
    kinematics: ForwardKinematics, runs: Sequence[Raw], clocks: Sequence[BoardClock], age_s: float
) -> tuple[Array, Array]:
    """Measured minus modelled tips, and the regressors, additional age first."""
    values, columns = [], []
    for raw in runs:
        sees = _sees(raw)
        at = raw.t_s[sees] - age_s
        within = (at > raw.t_s[0]) & (at < raw.t_s[-1])
        if not within.any():
            continue
        at, seen = at[within], raw.tip_m[sees][within]
        q, speed, bend = _motion(raw, clocks, at)
        jacobians = kinematics.jacobians(q)
        moving = np.einsum("mij,mj->mi", jacobians, speed)
        values.append((seen - kinematics.tips(q)).ravel())
        loose = jacobians * np.tanh(speed / MOVING_rad_s)[:, None, :]
        springy = jacobians * bend[:, None, :]
        smooth = np.einsum("mk,ia->miak", _shapes(q), np.eye(3)).reshape(len(q), 3, -1)
        own = np.concatenate((-moving[:, :, None], loose, springy, smooth), axis=2)
        columns.append(own.reshape(-1, own.shape[2]))
    return np.concatenate(values), np.concatenate(columns)


def _motion(raw: Raw, clocks: Sequence[BoardClock], at_s: Array) -> tuple[Array, Array, Array]:
    """Angles, speeds and accelerations (k, n) at given times."""
    parts = [np.column_stack([_angle(raw, j, clock, at_s) for j, clock in enumerate(clocks)])]
    even = [_angle(raw, j, clock, raw.t_s) for j, clock in enumerate(clocks)]
    for order in (1, 2):
        filtered = [_filtered(values, order, raw.period_s, keep=True) for values in even]
        parts.append(np.column_stack([np.interp(at_s, raw.t_s, values) for values in filtered]))
    return parts[0], parts[1], parts[2]


def _shapes(q: Array) -> Array:
    """Smooth regressors: 1, q and its products (m, k)."""
    n = q.shape[1]
    products = [q[:, a] * q[:, b] for a in range(n) for b in range(a, n)]
    return np.column_stack((np.ones(len(q)), q, *products))


def _sees(raw: Raw) -> Mask:
    return np.asarray(np.isfinite(raw.tip_m).all(axis=1))


def _filtered(values: Array, order: int, period_s: float, keep: bool = False) -> Array:
    """Filter by a Gaussian or its first or second derivative; `keep`: same length, ends unfiltered."""
    half = 4 * SMOOTH
    s = np.arange(-half, half + 1) / SMOOTH
    bell = np.exp(-0.5 * s * s)
    bell /= bell.sum()
    kernel = (bell, -s * bell / SMOOTH, (s * s - 1.0) * bell / SMOOTH**2)[order]
    if order == 2:  # zero curvature for a constant, although the kernel is truncated
        kernel = kernel - kernel.mean()
    padded = np.concatenate((np.full(half, values[0]), values, np.full(half, values[-1]))) if keep else values
    return np.asarray(np.convolve(padded, kernel, mode="valid") / period_s**order)


def _cubic(at: Array, times: Array, values: Array) -> Array:
    """Interpolate by the cubic through the four nearest samples (Lagrange); beyond the ends, the last value."""
    k = np.clip(np.searchsorted(times, at) - 1, 1, len(times) - 3)
    x = np.clip(at, times[0], times[-1])
    places = [times[k + shift] for shift in (-1, 0, 1, 2)]
    total = np.zeros(len(at))
    for a in range(4):
        share = np.ones(len(at))
        for b in range(4):
            if a != b:
                share *= (x - places[b]) / (places[a] - places[b])
        total += share * values[k + a - 1]
    return total


# A log of the runtime, and the tips that a motion capture system has seen of the same motion, on one clock.
#
# A row of a log holds angles that are older than the row: by the period of the board's reports and by the way of a report to
# the host. The boards' time stamps (columns counted1_s ...) say when each was latched, currents and voltages how old that is.


LEAST_LOGGED_ROWS = 10
STRAY_s, DRIFT = 0.05, 1e-3  # of a board's clock against the loop's: late reports, and two crystals
NO_STAMPS = (
    "the log has no time stamps of the encoder boards (counted1_s ...): times are those of its rows, whose angles are older"
)


def on_one_clock(arm: Arm, log: Log, run: str | None) -> tuple[Log, tuple[str, ...]]:
    """The log (or one run of it) with the angles, currents and voltages that belong to each row's time, and what was done."""
    runs = [logged for logged in log.runs if run is None or logged.name == run]
    raws = [_raw(logged, begin_s, arm.joint_count) for logged, begin_s in zip(runs, begins_s(runs), strict=True)]
    stamped = [raw for raw in raws if raw is not None]
    if not stamped or len(stamped) < len(raws):
        return replace(log, runs=tuple(runs)), (NO_STAMPS,)
    clocks = clocks_of(arm, stamped)
    pairs = zip(runs, stamped, strict=True)
    return replace(log, runs=tuple(_placed(arm, logged, raw, clocks) for logged, raw in pairs)), clocks.in_words()


def with_tips(arm: Arm, log: Log, motion: JointMotion, seen_s: Array, tip_m: Array) -> Log:
    """The log with tips (k, 3) in the base frame, seen at times (k,) of its clock."""
    inside = np.isfinite(tip_m).all(axis=1) & (motion.covers(seen_s) > 0.0)
    frames = Frames(seen_s[inside], tip_m[inside], *motion.at(seen_s[inside]))
    starts = begins_s(log.runs)
    return replace(
        log,
        runs=tuple(
            replace(one, tip_m=frozen(tips_at_rows(arm, one.t_s + begin_s, frames)))
            for one, begin_s in zip(log.runs, starts, strict=True)
        ),
    )


def _raw(run: LoggedRun, begin_s: float, joint_count: int) -> Raw | None:
    """As the runtime recorded it; None without time stamps that follow the log's clock. What is before homing says nothing."""
    columns = [run.extra.get(f"counted{j}_s") for j in range(1, joint_count + 1)]
    first = after_leaps(run.t_s, run.q_rad)
    if len(run) - first < LEAST_LOGGED_ROWS or any(column is None for column in columns):
        return None
    counted_s = np.column_stack([_numbers(column or ()) for column in columns])[first:]
    t_s = run.t_s[first:] + begin_s
    ahead_s = t_s[:, None] - counted_s
    if not (np.ptp(ahead_s, axis=0) < STRAY_s + DRIFT * np.ptp(t_s)).all():
        return None
    homed = run.rows(slice(first, None))
    return Raw(
        t_s,
        homed.q_rad,
        homed.q_set_rad,
        homed.current_A,
        homed.voltage_V,
        counted_s,
        homed.tip_m,
        homed.payload,
        lead_rad_of(homed, joint_count),
    )


def _numbers(texts: Sequence[str]) -> Array:
    """NaN for what is none."""
    try:
        return np.array([float(text or "nan") for text in texts])
    except ValueError:
        return np.full(len(texts), np.nan)


def _placed(arm: Arm, run: LoggedRun, raw: Raw, clocks: Clocks) -> LoggedRun:
    """The rows of a run that have one before and one after them."""
    resampled, inner = aligned(arm, raw, clocks), run.rows(slice(len(run) - len(raw.t_s) + 1, -1))
    return replace(
        inner,
        q_rad=frozen(resampled.q_rad),
        current_A=frozen(resampled.current_A),
        voltage_V=frozen(resampled.voltage_V),
        tip_m=frozen(resampled.tip_m),
    )
