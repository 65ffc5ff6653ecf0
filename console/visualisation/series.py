"""A recording as series over time: built from the named columns of any file format, thinned for drawing."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from control.errors import ArmError
from control.model.arm import Arm, Drive
from control.model.cell import Cell

JOINT_FORMS: Final = {
    "q_rad": "q{}_rad",
    "q_set_rad": "q{}_set_rad",
    "current_A": "i{}_A",
    "voltage_V": "u{}_V",
    "supply_V": "supply{}_V",
    "temperature_C": "temperature{}_C",
}
JOINT_SIDE_FORMS: Final = (("joint_rad", "joint{}_rad", "q_rad"), ("joint_set_rad", "joint{}_set_rad", "q_set_rad"))
LOOP_COLUMNS: Final = ("late_s", "busy_s", "missed", "page_faults", "switches", "age_s")
Report = Callable[[float], None]


def of_columns(
    name: str, columns: Mapping[str, NDArray[Any]], modes: tuple[str, ...], arm: Arm | None, notes: tuple[str, ...] = ()
) -> Series:
    """Columns by the names of log.csv as a series; columns that are absent are NaN. The numbers of its runs are their names."""
    count, joint_count = len(columns["t_s"]), joints_of(columns)

    def column(key: str) -> Array:
        found = columns.get(key)
        return np.full(count, np.nan) if found is None else np.asarray(found, dtype=np.float64)

    def group(form: str) -> Array:
        return np.stack([column(form.format(joint)) for joint in range(1, joint_count + 1)], axis=1)

    names, numbers = np.unique(np.nan_to_num(column("run")).astype(np.int64), return_inverse=True)
    joints: dict[str, Any] = {key: group(form) for key, form in JOINT_FORMS.items()}
    for key, form, same in JOINT_SIDE_FORMS:
        joints[key] = group(form) if form.format(1) in columns else joints[same]
    mode = np.nan_to_num(column("mode"), nan=-1.0).astype(np.int64) if modes else np.full(count, -1)
    loop: dict[str, Any] = {key: column(key) for key in LOOP_COLUMNS}
    return Series(
        name=name,
        t_s=joined_runs(column("t_s"), numbers),
        run=numbers,
        runs=tuple(map(str, names)),
        mode=mode,
        modes=modes,
        tip_m=np.stack([column(axis) for axis in ("x_m", "y_m", "z_m")], axis=1),
        arm=arm,
        notes=notes,
        **joints,
        **loop,
    )


def joints_of(columns: Iterable[str]) -> int:
    """How many joints have an angle among the columns."""
    return sum(name.startswith("q") and name.endswith("_rad") and name[1:-4].isdigit() for name in columns)


Array = NDArray[np.float64]
FOLLOWING_MODES: Final = ("HOLDING", "MOVING", "STOPPING", "JOGGING", "PAUSED")  # modes with valid set-points


@dataclass(frozen=True, slots=True, repr=False)
class Series:
    """m samples of n joints; NaN where nothing was measured.

    t_s (m,), increasing from the first sample (runs that each start at zero are concatenated); run (m,) indices into
    `runs`; mode (m,) indices into `modes`, -1 unknown; q_rad, q_set_rad of the encoders, joint_rad, joint_set_rad of the
    joints (the same if not recorded separately), current_A, voltage_V, supply_V, temperature_C (m, n);
    tip_m (m, 3) by the camera in the base frame; late_s, busy_s, missed, page_faults, switches, age_s (m,).
    `notes` are problems of the file. `arm`, or `cell`: then joints are in the order of its arms, and modes those of the first.
    """

    name: str
    t_s: Array
    run: NDArray[np.int64]
    runs: tuple[str, ...]
    mode: NDArray[np.int64]
    modes: tuple[str, ...]
    q_rad: Array
    q_set_rad: Array
    joint_rad: Array
    joint_set_rad: Array
    current_A: Array
    voltage_V: Array
    supply_V: Array
    temperature_C: Array
    tip_m: Array
    late_s: Array
    busy_s: Array
    missed: Array
    page_faults: Array
    switches: Array
    age_s: Array
    arm: Arm | None = None
    notes: tuple[str, ...] = ()
    cell: Cell | None = None

    def __repr__(self) -> str:
        """In one line: an interactive session prints what an expression gives."""
        duration_s = self.t_s[-1] - self.t_s[0] if len(self) else 0.0
        joints, runs = self.joint_count, len(self.runs_present)
        return f"<Series {self.name}: {len(self)} samples of {joints} joints, {duration_s:.2f} s, {runs} run{'s' * (runs != 1)}>"

    def __len__(self) -> int:
        """Number of samples."""
        return len(self.t_s)

    @property
    def joint_count(self) -> int:
        """N."""
        return int(self.q_rad.shape[1])

    def joint_name(self, joint: int) -> str:
        """Of a joint (1-based); with its arm's name if there are several."""
        if self.cell is None:
            return f"joint {joint}"
        arm, own = _owner(self.cell, joint)
        return f"{arm.name} {own}"

    def drive(self, joint: int) -> Drive | None:
        """Of a joint (1-based), if its arm is known and has one."""
        arm, own = (self.arm, joint) if self.cell is None else _owner(self.cell, joint)
        return next((one for one in arm.drives if one.joint == own), None) if arm is not None else None

    @property
    def period_s(self) -> float:
        """Usual time between samples; NaN for fewer than two."""
        return float(np.median(np.diff(self.t_s))) if len(self) > 1 else float("nan")

    @property
    def runs_present(self) -> tuple[str, ...]:
        """Names of the runs with samples, in order."""
        return tuple(self.runs[k] for k in np.unique(self.run))

    @property
    def following_error_rad(self) -> Array:
        """Set-point minus angle (m, n), NaN in modes without set-points."""
        error = self.q_set_rad - self.q_rad
        followed = [k for k, name in enumerate(self.modes) if name in FOLLOWING_MODES]
        is_known = self.mode >= 0
        error[is_known & ~np.isin(self.mode, followed)] = np.nan
        return error

    @property
    def is_placed(self) -> NDArray[np.bool_]:
        """Samples (m,) with valid angles: not during homing, nor before it."""
        if "HOMING" not in self.modes:
            return np.ones(len(self), dtype=bool)
        homing = self.mode == self.modes.index("HOMING")
        begun = np.maximum.accumulate(homing) if homing.any() else np.ones(len(self), dtype=bool)
        return np.asarray(begun & ~homing)

    def at(self, rows: NDArray[np.bool_] | NDArray[np.int64]) -> Series:
        """The samples at `rows`."""
        changed = {f.name: getattr(self, f.name)[rows] for f in fields(self) if f.name in _ROWS}
        return replace(self, **changed)


def _owner(cell: Cell, joint: int) -> tuple[Arm, int]:
    """The arm of a joint of all arms (1-based), and its number there."""
    for placed in cell.arms:
        if joint <= placed.arm.joint_count:
            return placed.arm, joint
        joint -= placed.arm.joint_count
    raise IndexError(joint)


_ROWS: Final = (
    "t_s",
    "run",
    "mode",
    "q_rad",
    "q_set_rad",
    "joint_rad",
    "joint_set_rad",
    "current_A",
    "voltage_V",
    "supply_V",
    "temperature_C",
    "tip_m",
    "late_s",
    "busy_s",
    "missed",
    "page_faults",
    "switches",
    "age_s",
)


def chosen(series: Series, run: str | None, from_s: float | None, to_s: float | None) -> Series:
    """The samples of one run and of a time span; ArmError lists the existing ones if there are none."""
    is_wanted = np.ones(len(series), dtype=bool)
    if run is not None:
        if run not in series.runs:
            raise ArmError(f'--run: expected one of {_listed(series.runs)}, got "{run}"')
        is_wanted &= series.run == series.runs.index(run)
    lower = -np.inf if from_s is None else from_s
    upper = np.inf if to_s is None else to_s
    if not lower < upper:
        raise ArmError(f"--from and --to: expected an increasing time span, got {lower:g} to {upper:g} s")
    is_wanted &= (series.t_s >= lower) & (series.t_s <= upper)
    if not is_wanted.any():
        ends = f"{series.t_s[0]:.3f} to {series.t_s[-1]:.3f} s" if len(series) else "no samples"
        raise ArmError(f"{series.name}: no samples between {lower:g} and {upper:g} s: it contains {ends}")
    return series.at(is_wanted)


def _listed(names: Sequence[str]) -> str:
    return ", ".join(names) if len(names) < 12 else f"{names[0]} to {names[-1]}"


def joined_runs(t_s: Array, run: NDArray[np.int64]) -> Array:
    """Times that increase over the whole file: a run that starts at zero again is appended to the last one."""
    steps = np.diff(t_s, prepend=t_s[:1])
    falls = steps < 0.0
    usual = float(np.median(steps[steps > 0.0])) if (steps > 0.0).any() else 0.0
    steps[falls] = usual
    if len(steps):
        steps[0] = 0.0
    return np.asarray(np.cumsum(steps))


BUCKETS: Final = 2000  # about the width of a figure in pixels
SEGMENT: Final = 2048  # samples of one piece of a spectrum
SHORTEST: Final = 64  # shortest piece to transform
PER_TURN: Final = 64  # samples of a motor turn
GAP: Final = 10.0  # periods without a sample; a shorter delay is only lateness of the host
TURNS: Final = 8  # of one piece of a spectrum over angle


def envelope(t: Array, values: Array) -> tuple[Array, Array]:
    """Minimum and maximum of each bucket of time, as one line (2 BUCKETS,); short series unchanged.

    Returns t, values; NaN where a bucket has no other values. No peak is lost, whatever its width.
    """
    if len(t) <= 4 * BUCKETS:
        return t, values
    starts = np.linspace(0, len(t), BUCKETS, endpoint=False).astype(np.int64)
    low, high = np.fmin.reduceat(values, starts), np.fmax.reduceat(values, starts)
    return np.repeat(t[starts], 2), np.stack([low, high], axis=1).ravel()


def with_gaps(t: Array, values: Array, period_s: float) -> tuple[Array, Array]:
    """Insert a NaN in each gap of time, so that lines do not bridge gaps."""
    if len(t) < 2:
        return t, values
    after = np.flatnonzero(np.diff(t) > GAP * max(period_s, 1e-9)) + 1
    return np.insert(t, after, t[after]), np.insert(values, after, np.nan)


def spectrum(t: Array, values: Array, period_s: float) -> tuple[Array, Array]:
    """Amplitude spectral density of the pieces without gaps: frequency [Hz], value/sqrt(Hz).

    Welch's method on each piece, linear trend removed, averaged by length; samples count as equally spaced. Both empty where
    no piece is long enough.
    """
    from scipy.signal import detrend, welch

    pieces = [piece for piece in _pieces(t, values, period_s) if piece.stop - piece.start >= SHORTEST]
    if not pieces:
        return np.empty(0), np.empty(0)
    length = min(SEGMENT, max(piece.stop - piece.start for piece in pieces))
    total, weight, frequency = np.zeros(length // 2 + 1), 0, np.empty(0)
    for piece in pieces:
        count = piece.stop - piece.start
        if count >= length:
            frequency, power = welch(values[piece], 1.0 / period_s, nperseg=length, detrend=detrend)
            total, weight = total + count * power, weight + count
    return frequency[1:], np.sqrt(total[1:] / weight)


def _pieces(t: Array, values: Array, period_s: float) -> list[slice]:
    """Longest runs of samples that are finite and without a gap in time."""
    is_good = np.isfinite(values)
    breaks = np.flatnonzero((np.diff(t, prepend=t[:1]) > GAP * period_s) | ~is_good)
    ends = np.unique(np.concatenate([[0], breaks, breaks + 1, [len(t)]]))
    ends = ends[ends <= len(t)]
    return [slice(a, b) for a, b in itertools.pairwise(ends) if is_good[a:b].all()]


def orders(motor_turns: Array, values: Array) -> tuple[Array, Array]:
    """Amplitude over the motor's angle: order [per motor turn], amplitude of the value at it.

    Each stretch that turns one way for at least `TURNS` turns is sampled again at equal angles; pieces of `TURNS` turns are
    averaged. Both empty where there is no such stretch.
    """
    powers = [piece for stretch in _one_way(motor_turns) for piece in _turn_spectra(motor_turns[stretch], values[stretch])]
    if not powers:
        return np.empty(0), np.empty(0)
    # a Hann window halves an amplitude, and one side of the spectrum has half of it: 4 / N together
    count = TURNS * PER_TURN
    amplitude = 4.0 / count * np.sqrt(np.mean(powers, axis=0))
    return np.arange(1, count // 2 + 1) / TURNS, amplitude[1:]


def _one_way(turns: Array) -> list[slice]:
    """Stretches in which the angle is finite and strictly rises or falls, `TURNS` turns at least."""
    direction = np.sign(np.diff(turns))
    direction[~np.isfinite(direction)] = 0.0
    changes = np.flatnonzero(np.diff(direction)) + 1
    ends = np.concatenate([[0], changes, [len(direction)]]).astype(np.int64)
    stretches = []
    for a, b in itertools.pairwise(ends):
        if b > a and direction[a] != 0.0 and abs(turns[b] - turns[a]) >= TURNS:
            stretches.append(slice(int(a), int(b) + 1))
    return stretches


def _turn_spectra(turns: Array, values: Array) -> list[Array]:
    if not np.isfinite(values).all():
        return []
    if turns[-1] < turns[0]:
        turns, values = turns[::-1], values[::-1]
    count, spectra = TURNS * PER_TURN, []
    window: NDArray[np.float64] = np.hanning(count)
    for k in range(int((turns[-1] - turns[0]) / TURNS)):
        grid = turns[0] + TURNS * k + np.arange(count) / PER_TURN
        inside = np.searchsorted(turns, [grid[0], grid[-1]])
        if inside[1] - inside[0] < count // 4:  # too fast for the sampling rate: higher orders would be wrong
            continue
        sampled = np.interp(grid, turns, values)
        line = np.polynomial.polynomial.polyfit(grid - grid[0], sampled, 1)
        sampled = sampled - line[0] - line[1] * (grid - grid[0])
        spectra.append(np.abs(np.fft.rfft(window * sampled)) ** 2)
    return spectra
