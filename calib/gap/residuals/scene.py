"""What stands beside every row, so that laws and blocks are functions of it; and the model around which a fit is linearised."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Protocol

import numpy as np
import numpy.typing as npt
from scipy import sparse

from calib.arrays import Array
from calib.gap.posterior.constants import BENDS_LEAST, BLOCK_PRIOR, COMMON_PRIOR, NAME_PRIOR
from calib.gap.posterior.term import Key, Term
from calib.gap.posterior.told import Told
from calib.gap.residuals.rows import ChannelRows, ResidualRows, since_turn
from calib.gap.residuals.whitening import RowOrder
from calib.gap.signals.body import Load, sorted_terms
from calib.gap.signals.filters import Filters
from calib.gap.signals.physics import Physics
from calib.gap.signals.recording import EvenRun, RunSet
from calib.gap.signals.terms import Law, sampled_friction_Nm
from control.model.effects import direction

# Signals without their measurement noise, for the columns of what may be missing.
#
# Measured accelerations stand in every residual with their noise. A column with the same noise is drawn to minus one times it,
# and other columns then make up for what that takes off the motion. What a column is made of must therefore not have that noise
# (instrumental variables: Janot, Vandanjon, Gautier, IEEE Trans. Control Systems Technology 22 (2014) 132): a Wiener filter
# leaves of each frequency the share that is surely motion (or, of currents, current).
SMOOTHED_Hz = 2.0  # of the spectrum
NOISE_FROM = 0.7  # of the highest frequency: no arm moves there, and what is there is the sensor's noise
SURELY = 3.0  # times the noise: what is less may be noise


def without_noise(recording: RunSet) -> RunSet:
    """The same with motions, currents and voltages as far as they are surely no noise."""
    return replace(recording, runs=tuple(_smooth(run, recording.filters) for run in recording.runs))


def _smooth(run: EvenRun, filters: Filters) -> EvenRun:
    beside = (len(filters.state[0]) - 1) // 2  # samples at the end that the filter knows half
    of_angle, of_current = (_shares(signal, filters.rate_Hz) for signal in (run.q_raw, run.current_raw_A))
    speed, acceleration = (_passed(signal, of_angle, beside) for signal in (run.speed, run.acceleration))
    current, slope = (_passed(signal, of_current, beside) for signal in (run.current_A, run.current_slope))
    voltage = _passed(run.voltage_V, of_angle, beside)  # the controller answers to the angles' noise, too
    return replace(run, speed=speed, acceleration=acceleration, current_A=current, current_slope=slope, voltage_V=voltage)


def _passed(values: Array, shares: Array, beside: int) -> Array:
    """Values (m, n) with shares (frequencies, n) of what they consist of."""
    count = len(values)
    held = values.copy()
    held[count - beside :] = values[count - beside - 1]
    doubled = np.concatenate((held, held[::-1]))  # no step at the ends
    at = np.linspace(0.0, len(shares) - 1.0, count + 1)
    gain = np.stack([np.interp(at, np.arange(len(shares)), share) for share in shares.T], axis=1)
    return np.asarray(np.fft.irfft(np.fft.rfft(doubled, axis=0) * gain, 2 * count, axis=0)[:count])


def _shares(measured: Array, rate_Hz: float) -> Array:
    """What of each frequency is no noise, (frequencies, n)."""
    count = len(measured)
    ramp = np.linspace(0.0, 1.0, count)[:, None]
    level = measured - measured[0] - ramp * (measured[-1] - measured[0])
    power = np.abs(np.fft.rfft(level * np.hanning(count)[:, None], axis=0)) ** 2
    width = max(1, round(SMOOTHED_Hz * count / rate_Hz))
    kernel = np.ones(2 * width + 1) / (2 * width + 1)
    smooth = [np.convolve(np.pad(spectrum, width, mode="edge"), kernel, "valid") for spectrum in power.T]
    # the median of an exponential distribution is ln 2 of its mean
    noise = np.median(power[int(NOISE_FROM * len(power)) :], axis=0) / np.log(2.0)
    return np.asarray(np.clip(1.0 - SURELY * noise / np.maximum(np.stack(smooth, axis=1), 1e-300), 0.0, 1.0))


@dataclass(frozen=True, slots=True)
class Product:
    """Columns `of` (rows, l) times each of some shapes (d, rows / every), of which those `picked` (c,) are taken, less what the
    columns themselves do of these by `own` (l, c), times `size` (c,). Rows are made where they are asked for: all of them would
    be the largest part of all memory.
    """

    of: Array
    shapes: Array
    every: int
    picked: Places
    own: Array | None
    size: Array

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return len(self.of), len(self.size)

    def __getitem__(self, rows: slice) -> Array:
        of, (first, end, _), every = self.of[rows], rows.indices(len(self.of)), self.every
        shapes = self.shapes[:, first // every : -(-end // every)]
        if every > 1:
            shapes = np.repeat(shapes, every, axis=1)[:, first % every : first % every + len(of)]
        products = (shapes.T[:, :, None] * of[:, None, :]).reshape(len(of), len(shapes) * of.shape[1])
        if self.own is None:
            return np.asarray(products * self.size)
        picked = products if products.shape[1] == len(self.picked) else products[:, self.picked]
        picked -= of @ self.own
        picked *= self.size
        return np.asarray(picked)


@dataclass(frozen=True, slots=True)
class Columns:
    """Columns side by side."""

    parts: tuple[Array | Product, ...]

    @classmethod
    def of(cls, some: Iterable[Array | Product | Columns]) -> Columns:
        """What stands side by side already stays so."""
        parts = ([*one.parts] if isinstance(one, Columns) else [one] for one in some)
        return cls(tuple(itertools.chain(*parts)))

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.parts[0].shape[0], sum(part.shape[1] for part in self.parts)

    def __getitem__(self, rows: slice) -> Array:
        made = np.empty((len(range(*rows.indices(self.shape[0]))), self.shape[1]))
        end = 0
        for part in self.parts:
            own = part[rows]
            begin, end = end, end + own.shape[1]
            made[:, begin:end] = own
        return made

    def __matmul__(self, size: Array) -> Array:
        return np.asarray(self[:] @ size)


Response = Mapping[int, Array]  # of each cell (number) that something changes: (its rows, columns)
Responses = Mapping[int, Array | Product | Columns]
TIP_ROW_s = 0.03  # frames within it are one row of the evidence: joints move at up to some 7 Hz
AXES = 3
SHOWN = 0.98  # of the samples: a motor's largest current, peaks left out
USED_TO = 4.0  # times that current: motions of a recording take a quarter of what drives can give
LEAST_Nm = 1e-6
Places = npt.NDArray[np.intp]
Flags = npt.NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class RowConditions:
    """At every row of a cell: run, sample, time in the run, and (m, n) angles, speeds, accelerations, loads, currents."""

    run: Places
    sample: Places
    t_s: Array
    q: Array
    speed: Array
    acceleration: Array
    load_Nm: Array
    current_A: Array
    payload_kg: Array
    turned_rad: Array  # since the joint last turned round
    axis: Places  # of the tip's rows

    @classmethod
    def of(cls, runs: Sequence[EvenRun], load: list[Array], current: list[Array], turned: list[Array]) -> RowConditions:
        """Of every sample, run after run."""

        def joined(key: str) -> Array:
            return np.concatenate([getattr(run, key) for run in runs])

        number = np.repeat(np.arange(len(runs)), [len(run) for run in runs])
        return cls(
            number,
            np.concatenate([np.arange(len(run)) for run in runs]),
            np.concatenate([run.t_s - run.t_s[0] for run in runs]),
            joined("q"),
            joined("speed"),
            joined("acceleration"),
            np.concatenate(load),
            np.concatenate(current),
            joined("payload_kg"),
            np.concatenate(turned),
            np.zeros_like(number),
        )

    def at(self, places: Places, axes: int) -> RowConditions:
        """At some samples, `axes` rows each."""
        picked = {entry.name: getattr(self, entry.name)[places] for entry in fields(self)}
        return RowConditions(**picked | {"axis": np.arange(len(places)) % axes})

    @property
    def direction(self) -> Array:
        """Signs of the speeds, smooth through rest, (m, n)."""
        return np.asarray(direction(self.speed, np))


Shape = Callable[[RowConditions, int], Array]  # (c, rows), from what stands beside and the joint


@dataclass(frozen=True, slots=True)
class Thin:
    """The rows of a cell as evidence counts them: each a sum of some, over the root of their count, so that noise stays as it is.

    `mix` (thin rows, rows); None where each is its own. `step`: samples from one to the next, `stride` of them side by side.
    """

    run: Places
    sample: Places
    step: int
    stride: int
    mix: sparse.csr_array | None

    @classmethod
    def each(cls, run: Places, sample: Places, step: int) -> Thin:
        """All as they are."""
        return cls(run, sample, step, 1, None)

    @classmethod
    def of_frames(cls, run: Places, sample: Places, step: int, together: int) -> Thin:
        """Tips of three rows a frame, `together` frames that follow each other as one; what is left over is not used."""
        if together == 1:
            return cls(run, sample, step, AXES, None)
        frames, of_run = sample[::AXES], run[::AXES]
        begins = np.ones(len(frames), dtype=bool)
        begins[1:] = (np.diff(of_run) != 0) | (np.diff(frames) > step)
        count = np.arange(len(frames))
        since = count - np.maximum.accumulate(np.where(begins, count, 0))
        last = np.flatnonzero(since % together == together - 1)
        members = (AXES * (last[:, None, None] - np.arange(together)) + np.arange(AXES)[:, None]).reshape(-1)
        ends = np.arange(0, len(members) + 1, together)
        mix = sparse.csr_array((np.full(len(members), together**-0.5), members, ends), shape=(len(ends) - 1, len(sample)))
        middle = np.repeat(last - together // 2, AXES)
        return cls(of_run[middle], frames[middle], together * step, AXES, mix)

    def of(self, values: Array) -> Array:
        """Values (rows, ...) thinned."""
        return values if self.mix is None else np.asarray(self.mix @ values)

    def rows(self, columns: Columns, thin: slice) -> Array:
        """Some thin rows of columns (rows, c)."""
        if self.mix is None:
            return columns[thin]
        mix = self.mix[thin]
        needed = slice(int(mix.indices.min()), int(mix.indices.max()) + 1)
        return np.asarray(mix[:, needed] @ columns[needed])

    def all_of(self, flags: Flags) -> Flags:
        """Thin rows that consist of flagged ones alone."""
        return flags if self.mix is None else np.asarray((self.mix > 0.0) @ ~flags == 0)


def _given_Nm(physics: Physics) -> Array:
    """Of each joint, (n,): by its currents, else by the currents that its voltages drive through a motor at rest."""
    runs, arm = physics.recording.runs, physics.arm
    largest_Nm = []
    for j, drive in enumerate(arm.drives[: arm.joint_count]):
        if physics.recording.has_current:
            drawn = [run.current_A[run.usable[:, j], j] for run in runs]
            times = USED_TO
        else:
            drawn = [run.voltage_V[run.usable[:, j], j] / drive.resistance_ohm for run in runs]
            times = 1.0
        most_A = float(np.quantile(np.abs(np.concatenate(drawn)), SHOWN)) if any(map(len, drawn)) else 0.0
        largest_Nm.append(max(times * most_A * abs(float(physics.torque_per_A[j])), LEAST_Nm))
    return np.array(largest_Nm)


class Large(Protocol):
    """What is made anew where there is no room for it and another."""

    def forget(self) -> None:
        """Give the memory back."""


class SeriesScene:
    """Rows and what stands beside them.

    `rows` have what was measured, `columns` the same without its noise: of these everything is made that rows may follow.
    `given_Nm` (n,): what the motors can give, by what they gave: limits and supplies of a file say nothing about the data.
    `told`: what other recordings tell of changes beside what is known.
    """

    def __init__(self, rows: ResidualRows, known: Sequence[Law], told: Told | None = None) -> None:
        self.rows, self.told = rows, told
        self.cells = rows.table.cells
        self.given_Nm = _given_Nm(rows.physics)
        self.arm, self.recording = rows.physics.arm, rows.recording
        self.columns = rows.told_by(Physics(self.arm, without_noise(self.recording)))
        physics = self.columns.physics
        runs = physics.recording.runs
        load = physics.body.link_torques(Load())
        current = [_drawn(physics, run, load_Nm, known) for run, load_Nm in zip(runs, load, strict=True)]
        turned = [since_turn(run) for run in self.recording.runs]
        self.whole = RowConditions.of(runs, load, current, turned)
        self.beside = [self._beside(cell) for cell in self.cells]
        self.thinned = [self._thinned(cell, beside) for cell, beside in zip(self.cells, self.beside, strict=True)]
        ends = np.cumsum([0, *(len(thin.run) for thin in self.thinned)]).tolist()
        self.thin = [slice(first, end) for first, end in itertools.pairwise(ends)]
        self._shapes: dict[tuple[object, int, int], tuple[Array, list[int]]] = {}
        self._levers: dict[int, Array] = {}
        self._in_memory: Large | None = None
        self.keep(np.ones(len(rows.table.run), dtype=bool))

    def makes_room_for(self, large: Large) -> None:
        """Forget what is as large."""
        if self._in_memory is not None:
            self._in_memory.forget()
        self._in_memory = large

    def keep(self, usable: Flags) -> None:
        """Rows (k,) that models can speak of from now on; the others are like gaps."""
        self.usable = usable
        still = self.picked(usable)
        self.series = [
            RowOrder.of(thin.run, thin.sample, thin.step, thin.stride, still[rows])
            for thin, rows in zip(self.thinned, self.thin, strict=True)
        ]

    def picked(self, rows: Flags) -> Flags:
        """Thin rows all of whose rows (k,) are picked."""
        return np.concatenate([thin.all_of(rows[cell.rows]) for thin, cell in zip(self.thinned, self.cells, strict=True)])

    def _thinned(self, cell: ChannelRows, beside: RowConditions) -> Thin:
        """Rows of a current are thin already; frames of a quick camera are averaged, as far as a motion lets them."""
        if cell.joint >= 0:
            return Thin.each(beside.run, beside.sample, self.recording.filters.step)
        steps = np.concatenate([np.diff(run.frames) for run in self.recording.runs])
        step = int(np.median(steps)) if len(steps) else 1
        return Thin.of_frames(beside.run, beside.sample, step, max(1, round(TIP_ROW_s * self.recording.filters.rate_Hz / step)))

    def _beside(self, cell: ChannelRows) -> RowConditions:
        """What stands beside the rows of a cell."""
        table, begins = self.rows.table, np.searchsorted(self.whole.run, np.arange(len(self.recording.runs)))
        sample = np.round(table.t_s[cell.rows] * self.recording.filters.rate_Hz).astype(np.intp)
        return self.whole.at(begins[table.run[cell.rows]] + sample, AXES if cell.joint < 0 else 1)

    def shapes(self, functions: Sequence[Shape], joint: int, k: int) -> tuple[Array, list[int]]:
        """Functions of a joint (0-based) at the rows of a cell, (c, rows), and how many are of each; kept, as laws share them."""
        key = tuple(functions), joint, k
        if key not in self._shapes:
            found = [function(self.beside[k], joint) for function in functions]
            self._shapes[key] = np.concatenate(found), [len(own) for own in found]
        return self._shapes[key]

    def number(self, channel: str, joint: int = -1) -> int | None:
        """Of the cell of a channel and joint (0-based), if there is one."""
        return next((k for k, cell in enumerate(self.cells) if (cell.channel, cell.joint) == (channel, joint)), None)

    def split(self, columns: Array) -> dict[int, Array]:
        """Columns (rows, c) by cell, without the cells where they are nought."""
        by_cell = {}
        for k, cell in enumerate(self.cells):
            part = columns[cell.rows]
            if part.size and np.any(np.abs(part) > 1e-9):
                by_cell[k] = np.ascontiguousarray(part)
        return by_cell

    def torque(self, joint: int, torque_Nm: Array) -> dict[int, Array]:
        """The response to torques (c, samples) at a motor, filtered as the rows of its current are."""
        k = self.number("current_A", joint)
        if k is None:
            return {}
        size = float(self.rows.physics.torque_per_A[joint]) * self.cells[k].floor
        return {k: self.filtered(k, torque_Nm) / size}

    def filtered(self, k: int, values: Array) -> Array:
        """Values (c, samples) as the rows of a cell of currents are filtered, (its rows, c)."""
        beside, filters = self.beside[k], self.recording.filters
        passed = np.empty((len(beside.run), len(values)))
        for number in range(len(self.recording.runs)):
            mine = beside.run == number
            if mine.any():
                rows = filters.rows(values[:, self.whole.run == number].T)
                passed[mine] = rows[(beside.sample[mine] - filters.reach) // filters.step]
        return passed

    def ahead(self, joint: int, angle_rad: Array) -> dict[int, Product]:
        """The tips' response to a joint that is further than its encoder says by angles (c, tip rows)."""
        k, count = self.number("tip_m"), len(angle_rad)
        if k is None:
            return {}
        of_frames, lever = angle_rad[:, ::AXES].copy(), self._levers.setdefault(joint, self.lever_m(joint)[:, None])
        size = np.full(count, 1.0 / self.cells[k].floor)
        return {k: Product(lever, of_frames, AXES, np.arange(count), None, size)}

    def lever_m(self, joint: int) -> Array:
        """How each row of the tips follows a joint (0-based)."""
        parts = [jacobian[:, :, joint].ravel() for jacobian in self.rows.physics.tips.jacobians]
        return np.concatenate(parts)


def _drawn(physics: Physics, run: EvenRun, load_Nm: Array, known: Sequence[Law]) -> Array:
    """Currents of a run (m, n) that the known model asks for: measured ones would bring their own noise into every column."""
    torque = load_Nm + physics.body.rotor_kg_m2 * run.acceleration
    for law in sorted_terms(known).friction:
        j = law.index
        torque[:, j] += sampled_friction_Nm(law, run, torque[:, j], physics.gear_ratios[j])
    return np.asarray(torque / physics.torque_per_A)


@dataclass(frozen=True, slots=True)
class OperatingPoint:
    """The model of a linearisation: known laws, and laws found so far by key.

    `residual`: its rows; `smooth`: what it would have left if motions and currents had been measured without noise.
    """

    scene: SeriesScene
    known: tuple[Law, ...]
    laws: dict[Key, Law]
    residual: Array
    smooth: Array

    @classmethod
    def of(cls, scene: SeriesScene, known: Sequence[Law], laws: Mapping[Key, Law]) -> OperatingPoint:
        """With what it leaves."""
        model = (*known, *laws.values())
        return cls(scene, tuple(known), dict(laws), scene.rows.residual(model), scene.columns.residual(model))

    @property
    def model(self) -> tuple[Law, ...]:
        """All of it."""
        return (*self.known, *self.laws.values())

    def without(self, key: Key) -> tuple[tuple[Law, ...], Array]:
        """The model without a law, and its rows as columns are reckoned from them."""
        if key not in self.laws:
            return self.model, self.smooth
        rest = (*self.known, *(law for name, law in self.laws.items() if name != key))
        return rest, self.scene.columns.residual(rest)


# A term of the series' model: an effect or a nameless block in one variant, as what it does to the rows of every channel.


HELD_TURNS = 4
TURN_DOUBT = 0.1  # of a turn: to this a secant between two others follows from them


@dataclass(frozen=True, slots=True)
class SeriesTerm(Term):
    """Columns by cell, each (its rows, c): laws first, then departures, then nuisances, as of every Term.

    `law`: the physics' term for coefficients (c,) of all columns, in usual sizes; None for blocks.
    """

    response: Mapping[int, Columns] = field(default_factory=dict)
    law: Callable[[Array], Law] | None = None
    now: Array | None = None  # coefficients at which the model of this linearisation has it
    is_common: bool = False  # every gear has it, and the file says nothing of it
    curve: Curve | None = None
    alike: Array = field(default_factory=lambda: np.zeros((0, 1, 1)))  # see `departed`: no data tell this from the law

    @property
    def count(self) -> int:
        """How many columns."""
        return next((columns.shape[1] for columns in self.response.values()), 0)

    def departed_by(self, size: Array) -> float:
        """What the departures do together, with coefficients of all columns (c,), over what the law does, in all rows.

        Those of one variable look alike, and may take each other's place; those of a channel that hardly shows the law are noise.
        """
        ends, law, departs = (self.laws, self.laws + self.departures), 0.0, 0.0
        for columns in self.response.values():
            rows = columns[:]
            law += float(np.sum((rows[:, : ends[0]] @ size[: ends[0]]) ** 2))
            departs += float(np.sum((rows[:, slice(*ends)] @ size[slice(*ends)]) ** 2))
        return math.sqrt(departs / law) if law > 0.0 else 0.0

    @property
    def log_odds(self) -> float:
        """Of its key, before any data."""
        prior = COMMON_PRIOR if self.is_common else NAME_PRIOR if self.is_name else BLOCK_PRIOR
        return float(np.log(prior / (1.0 - prior)))


@dataclass(frozen=True, slots=True)
class Curve:
    """Of a law whose first value v bends its response: v is coefficient 0 times `size`, the coefficient at `place` says how the
    secant at `start` turns towards that at `near`; both follow from v.
    """

    place: int
    start: float
    near: float
    size: float

    def turned(self, first: float) -> tuple[float, float]:
        """The second of the two coefficients for the first, and its slope."""
        value = first * self.size
        scale = 1.0 / ((self.near - self.start) * self.start)
        return value * (value - self.start) * scale, (2.0 * value - self.start) * self.size * scale

    def held(self, mean: Array, covariance: Array) -> tuple[Array, Array]:
        """Coefficients (c,) and their covariance given that one value is behind both (the iterated update of a Kalman filter)."""
        estimate, spread = mean, covariance
        for _ in range(HELD_TURNS):
            second, slope = self.turned(float(estimate[0]))
            along = np.zeros(len(mean))
            along[[0, self.place]] = -slope, 1.0
            gain = covariance @ along / (float(along @ covariance @ along) + TURN_DOUBT**2)
            missed = float(estimate[self.place]) - second - float(along @ (estimate - mean))
            estimate, spread = mean - gain * missed, covariance - np.outer(gain, along @ covariance)
        return estimate, spread


def stacked(parts: Sequence[Responses]) -> dict[int, Columns]:
    """Responses side by side, nought where one has nothing."""
    cells = sorted({cell for part in parts for cell in part})
    widths = [next((columns.shape[1] for columns in part.values()), 1) for part in parts]
    joined = {}
    for cell in cells:
        rows = next(part[cell].shape[0] for part in parts if cell in part)
        nought = (np.broadcast_to(0.0, (rows, width)) for width in widths)
        joined[cell] = Columns.of(part.get(cell, none) for part, none in zip(parts, nought, strict=True))
    return joined


def scaled(response: Response, factor: float) -> dict[int, Array]:
    """All columns times a factor."""
    return {cell: columns * factor for cell, columns in response.items()}


def size_of(response: Response) -> Array:
    """Euclidean norm of each column over all cells, (c,)."""
    total: Array | float = 0.0
    for columns in response.values():
        total = total + np.sum(columns**2, axis=0)
    return np.asarray(np.sqrt(np.atleast_1d(total)))


def departed(law: Response, shapes: Mapping[int, Array]) -> tuple[dict[int, Product], Array]:
    """Each law's column times each shape (c, rows of a cell), what is the law itself taken off, as large as the law; and what
    was taken off: by how much each law's coefficients change with a departure as large as the law, (c, laws, laws).
    """
    products: dict[int, Array] = {}
    for cell, response in law.items():
        shape = shapes[cell]
        products[cell] = np.hstack([response * row[:, None] for row in shape])
    width = next(iter(products.values())).shape[1] if products else 0
    count = next(iter(law.values())).shape[1]
    if not width:
        return {}, np.zeros((0, count, count))
    across: Array = np.zeros((count, width))
    gram = np.zeros((len(across), len(across)))
    for cell, response in law.items():
        across = across + response.T @ products[cell]
        gram = gram + response.T @ response
    whole = float(np.sqrt(np.trace(gram) / len(gram)))
    share = np.linalg.lstsq(gram, across, rcond=None)[0]
    rest = {cell: products[cell] - response @ share for cell, response in law.items()}
    sizes = size_of(rest)
    apart = sizes > BENDS_LEAST * whole
    picked, of_size = np.flatnonzero(apart), np.asarray(whole / sizes[apart])
    columns = {
        cell: Product(own, shapes[cell], 1, picked, np.asarray(share[:, picked]), of_size)
        for cell, own in law.items()
        if apart.any()
    }
    projection = share / np.maximum(size_of(products), 1e-300) * whole
    return columns, np.moveaxis(projection.reshape(count, -1, count), 1, 0)
