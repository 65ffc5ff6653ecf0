"""Residuals as rows over their noise floor: one vector for all channels and runs, with what each row stands for.

A cell is one channel of one joint: the current that the motion needs, the voltage's current, or the tip.
"""

from __future__ import annotations

import copy
import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from calib.arrays import Array
from calib.gap.signals.body import Load, sorted_terms
from calib.gap.signals.physics import Physics, Prediction
from calib.gap.signals.recording import EvenRun, Flags, RunSet, UnusableLogError, spread
from calib.gap.signals.terms import Law, motor_ahead, sampled_friction_Nm
from control.model.effects import SMOOTH_rad_s

SLOW_rad_s = 0.008  # below, friction of real joints is pre-sliding, and no law here speaks of that
PRESLIDING_rad = 0.0005  # since a joint turned: within it friction is a spring, as long as it may take
LANDING_s = 0.04  # the reach of a row's filter around an impact
NOISE_SPEEDS = 4.0  # standard deviations of the measured speed that count as rest


CHANNELS = {"current_A": "current", "voltage_as_A": "voltage", "tip_m": "tip"}  # in words


@dataclass(frozen=True, slots=True)
class ChannelRows:
    """A channel of a joint (0-based; -1: the tip): its rows in the vector, and its noise floor in SI."""

    channel: str
    joint: int
    rows: slice
    floor: float

    def __str__(self) -> str:
        """As `current of joint 2`."""
        what = CHANNELS.get(self.channel, self.channel)
        return what if self.joint < 0 else f"{what} of joint {self.joint + 1}"


@dataclass(frozen=True, slots=True)
class RowTable:
    """Which rows there are: cells, the run of each row, and the motion beside it."""

    cells: tuple[ChannelRows, ...]
    run: npt.NDArray[np.intp]
    t_s: Array
    q_rad: Array
    speed_rad_s: Array
    load_Nm: Array
    scale: Array  # the floor of each row
    floor_source: str


class ResidualRows:
    """Makes residual rows of models."""

    def __init__(self, physics: Physics, model: Sequence[Law]) -> None:
        self.physics = physics
        self.recording = physics.recording
        self._masks = [_mask(self.recording, run) for run in self.recording.runs]
        self._electrical = [_driven_rows(self.recording, run) for run in self.recording.runs]
        self.table = self._tabled(model)

    def told_by(self, physics: Physics) -> ResidualRows:
        """The same rows, at the same floors, of another account of the same motions."""
        rows = copy.copy(self)
        rows.physics, rows.recording = physics, physics.recording
        return rows

    def residual(self, model: Sequence[Law]) -> Array:
        """Rows (k,): model less measurement over the floor."""
        whole = np.concatenate([part for _, _, part, *_ in self._blocks(self.physics.predict(model))])
        return np.asarray(whole / self.table.scale)

    def resting(self, model: Sequence[Law]) -> Flags:
        """Rows (k,) that a model with play can speak of: not those of a current while its joint flies and lands.

        How hard a flank is decides an impact's current, and nothing here measures that; when it happens follows from
        the model alone, never from the residual.
        """
        result = np.ones(len(self.table.run), dtype=bool)
        filters = self.recording.filters
        for j, runs in self.physics.following.flights(model).items():
            reach = round(LANDING_s * filters.rate_Hz)
            near = [spread(moving[:, None], reach)[filters.places(len(moving)), 0] for moving in runs]
            usable = np.concatenate([~flags[self._masks[k][:, j]] for k, flags in enumerate(near)])
            for cell in self.table.cells:
                if cell.channel == "current_A" and cell.joint == j:
                    result[cell.rows] = usable
        return result

    def friction_slope(self, term: Law, model: Sequence[Law] = ()) -> Array:
        """What a friction or cogging term of these values adds to the rows (k,); of a model only what motors turn beyond
        their encoders counts.
        """
        angles = sorted_terms(model).angles
        physics, j, result = self.physics, term.index, np.zeros(len(self.table.run))
        gear, K = physics.arm.drives[j].gear_ratio, physics.torque_per_A[j]
        parts = []
        for k, run in enumerate(self.recording.runs):
            ahead = motor_ahead(angles, run.q, run.t_s)[:, j] if angles else 0.0
            torque = sampled_friction_Nm(term, run, physics.body.link_torques(Load())[k][:, j], gear, ahead)
            parts.append(self.recording.filters.rows(torque)[self._masks[k][:, j]])
        for cell in self.table.cells:
            if cell.channel == "current_A" and cell.joint == j:
                result[cell.rows] = np.concatenate(parts) / (K * cell.floor)
        return result

    def _blocks(self, predictions: list[Prediction]) -> list[Block]:
        """(channel, joint, rows, run, sample of each row), cell by cell and run by run."""
        blocks: list[Block] = []
        recording, filters = self.recording, self.recording.filters
        n = self.physics.arm.joint_count
        current = [filters.rows(p.current_A) for p in predictions]
        with_voltage = recording.has_current and recording.has_voltage
        voltage = [filters.rows(p.voltage_as_A) if with_voltage else None for p in predictions]
        places = [filters.places(len(run)) for run in recording.runs]
        if recording.has_current or recording.has_voltage:
            for j in range(n):
                for k, rows in enumerate(current):
                    keep = self._masks[k][:, j]
                    blocks.append(("current_A", j, rows[keep, j], k, places[k][keep]))
        if with_voltage:
            for j in range(n):
                for k, residual in enumerate(voltage):
                    keep = self._electrical[k][:, j]
                    if residual is not None:
                        blocks.append(("voltage_as_A", j, residual[keep, j], k, places[k][keep]))
        if recording.has_tip:
            for k, prediction in enumerate(predictions):
                frames = np.repeat(recording.runs[k].frames, 3)
                blocks.append(("tip_m", -1, prediction.tip_m.ravel(), k, frames))
        return blocks

    def _tabled(self, model: Sequence[Law]) -> RowTable:
        blocks = self._blocks(self.physics.predict(model))
        levels, source = floors(self.physics, blocks)
        load = self.physics.body.link_torques(Load())
        cells, columns, start = [], [], 0
        run: list[Array] = []
        for key in dict.fromkeys((channel, joint) for channel, joint, *_ in blocks):
            mine = [block for block in blocks if block[:2] == key]
            count = sum(len(block[2]) for block in mine)
            cells.append(ChannelRows(key[0], key[1], slice(start, start + count), levels[key]))
            start += count
            for _, joint, values, k, places in mine:
                motion, j = self.recording.runs[k], max(joint, 0)
                run.append(np.full(len(values), k))
                columns.append(
                    np.stack(
                        [
                            motion.t_s[places] - motion.t_s[0],
                            motion.q[places, j],
                            motion.speed[places, j],
                            load[k][places, j],
                            np.full(len(values), levels[key]),
                        ]
                    )
                )
        t, q, speed, torque, scale = np.concatenate(columns, axis=1)
        return RowTable(tuple(cells), np.concatenate(run).astype(np.intp), t, q, speed, torque, scale, source)


def without_motion(table: RowTable) -> tuple[str, ...]:
    """A sentence about cells without a single row; UnusableLogError where there is no row at all."""
    empty = [cell for cell in table.cells if cell.rows.start == cell.rows.stop]
    if not empty:
        return ()
    why = (
        f"no stretch in which the joint moves one way, faster than {1e3 * SLOW_rad_s:g} mrad/s and than its encoder's steps show:"
        " slower, friction follows no law; record faster motions"
    )
    if len(empty) == len(table.cells):
        raise UnusableLogError(f"log: {why}")
    return (f"{', '.join(map(str, empty))}: {why}",)


def _sound_rows(recording: RunSet, run: EvenRun) -> Flags:
    """Rows (rows, n) whose samples are all usable."""
    reach = recording.filters.reach // 2  # beyond this the row filter has hardly any weight
    sound = ~spread(~run.usable, reach)
    return np.asarray(sound[recording.filters.places(len(run))])


def _driven_rows(recording: RunSet, run: EvenRun) -> Flags:
    """Rows (rows, n) whose driver is on all the time: the voltage of an open circuit is nobody's command."""
    filters = recording.filters
    near = spread(run.is_off, filters.reach // 2 + (len(filters.state[0]) - 1) // 2)
    return np.asarray(_sound_rows(recording, run) & ~near[filters.places(len(run))])


def _mask(recording: RunSet, run: EvenRun) -> Flags:
    """Rows in which the joint really moves, one way."""
    filters = recording.filters
    rest = max(SMOOTH_rad_s, NOISE_SPEEDS * 0.5 * _speed_noise(recording, run))
    slow = max(SLOW_rad_s, NOISE_SPEEDS * _speed_noise(recording, run))
    turns = np.abs(run.speed) < rest
    turns[1:] |= np.sign(run.speed[1:]) != np.sign(run.speed[:-1])
    turns |= since_turn(run) < PRESLIDING_rad
    reach = round(0.032 * filters.rate_Hz)
    ok = ~spread(turns, reach) & (np.abs(run.speed) > slow)
    if not recording.has_current:
        switched = np.zeros_like(run.is_off)
        switched[1:] = run.is_off[1:] != run.is_off[:-1]
        ok &= ~spread(switched, reach + (len(filters.state[0]) - 1) // 2)
    return np.asarray(ok[filters.places(len(run))] & _sound_rows(recording, run))


def since_turn(run: EvenRun) -> Array:
    """How far each joint has gone since it last turned round [rad], (m, n)."""
    sign = np.sign(run.speed)
    turned = np.vstack([np.ones((1, sign.shape[1]), dtype=bool), sign[1:] != sign[:-1]])
    last = np.maximum.accumulate(np.where(turned, np.arange(len(sign))[:, None], 0), axis=0)
    return np.asarray(np.abs(run.q - np.take_along_axis(run.q, last, axis=0)))


def _speed_noise(recording: RunSet, run: EvenRun) -> float:
    """Standard deviation of the speeds from the encoders' steps, the coarsest joint's."""
    steps = [np.diff(np.unique(column)) for column in run.q_raw.T]
    smallest = [float(np.min(step[step > 1e-7])) if np.any(step > 1e-7) else 0.0 for step in steps]
    return float(max(smallest) / np.sqrt(12.0) * recording.filters.speed_gain)


# The noise floor of each cell: from repeats, but not below what an encoder's step leaves; else from the data sheet.
Places = npt.NDArray[np.intp]
Block = tuple[str, int, Array, int, Places]
Key = tuple[str, int]
NORMAL = 1.4826  # standard deviation of a normal distribution over its median absolute deviation
PRINTED_rad = 2e-7  # between angles: less is the printing's
FEWEST = 50  # rows of a pair of repeats that make a floor


def floors(physics: Physics, blocks: list[Block]) -> tuple[dict[Key, float], str]:
    """SI floors by cell and where they come from."""
    keys = list(dict.fromkeys((channel, joint) for channel, joint, *_ in blocks))
    result: dict[Key, float] = {}
    source = "repeats"
    for key in keys:
        by_run = {k: (places, values) for *name, values, k, places in blocks if tuple(name) == key}
        repeated = _from_repeats(physics, by_run, 3 if key[0] == "tip_m" else 1)
        if repeated is None:
            source = "data sheet, encoder steps and the currents' own noise"
        noise, step = _from_noise(physics, key)
        # Repeats of the same motion meet the same encoder steps: their difference cannot show that part.
        result[key] = float(np.hypot(noise if repeated is None else repeated, step))
    return result, source


def _from_repeats(physics: Physics, by_run: dict[int, tuple[Places, Array]], axes: int) -> float | None:
    """Repeats differ by noise alone: their residuals' difference over sqrt 2; the middle of all pairs."""
    differences = []
    for group in physics.recording.repeats:
        for a, b in itertools.pairwise(group):
            differences.append(_difference(*by_run[a], *by_run[b], axes))
    differing = [d for d in differences if len(d) >= FEWEST and d.any()]  # what never differs repeats nothing
    if not differing:
        return None
    pooled = np.concatenate(differing)
    robust = NORMAL * float(np.median(np.abs(pooled - np.median(pooled))))
    plain = float(np.sqrt(np.mean(pooled**2)))
    # Where a few rows differ by far more (a stick-slip that falls differently) the middle is the noise.
    return float((robust if plain > 1.3 * robust else plain) / np.sqrt(2.0))


def _difference(places_a: Places, a: Array, places_b: Places, b: Array, axes: int) -> Array:
    _, in_a, in_b = np.intersect1d(places_a[::axes], places_b[::axes], return_indices=True)
    if not len(in_a):
        return np.zeros(0)
    return np.asarray((a.reshape(-1, axes)[in_a] - b.reshape(-1, axes)[in_b]).ravel())


def _from_noise(physics: Physics, key: Key) -> tuple[float, float]:
    """What the sensor's noise leaves in a row, and what the steps of the encoder leave."""
    channel, joint = key
    if channel == "tip_m":
        camera = physics.arm.camera
        noise_m = camera.position_noise_m if camera and camera.position_noise_m > 0 else 0.0005
        return noise_m, _steps_at_tip_m(physics)
    recording = physics.recording
    K, R = float(physics.torque_per_A[joint]), physics.arm.drives[joint].resistance_ohm
    drive = physics.arm.drives[joint]
    step = 2.0 * np.pi / drive.counts_per_joint_turn
    angle = max(step, _seen_step(physics, joint, step)) / np.sqrt(12.0)
    bent = np.convolve(recording.filters.state[2], recording.filters.row)
    turning = np.convolve(recording.filters.state[1], recording.filters.row)
    inertia_kg_m2 = np.concatenate(physics.body.own_inertia(Load(), joint))
    inertia = float(physics.body.rotor_kg_m2[joint] + np.median(inertia_kg_m2))
    bends = float(np.linalg.norm(bent)) * inertia / K
    turns = float(np.linalg.norm(turning)) * K / R
    by_channel = bends if channel == "current_A" else turns
    if channel == "current_A" and not recording.has_current:  # the current is then the voltage's, less the speed's
        by_channel = float(np.hypot(bends, turns))
    noise = 0.0
    if recording.has_current:  # white, the middle of all runs
        noise = float(np.median([physics.current_roughness(k, joint) for k in range(len(recording.runs))]))
    return noise * recording.filters.row_gain, angle * by_channel


def _steps_at_tip_m(physics: Physics) -> float:
    """What the steps of all recorded angles leave of one axis of the tip."""
    steps = np.array([_seen_step(physics, j, PRINTED_rad) for j in range(physics.arm.joint_count)])
    moved_m = np.concatenate(physics.tips.jacobians) * (steps / np.sqrt(12.0))
    return float(np.sqrt(np.mean(np.sum(moved_m**2, axis=(1, 2))) / 3.0))


def _seen_step(physics: Physics, joint: int, step: float) -> float:
    """The step of the recorded angles, which may be coarser than the encoder's: the smallest between neighbours."""
    steps_rad = [np.diff(np.unique(run.q_raw[:, joint])) for run in physics.recording.runs]
    counted = np.concatenate([part[part > 0.5 * step] for part in steps_rad])  # less is the printing's
    return float(counted.min()) if len(counted) else 0.0
