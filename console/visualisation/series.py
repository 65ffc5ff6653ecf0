"""The time series of a recording, independent of the file format."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from control.errors import ArmError
from control.model.arm import Arm, Drive
from control.model.cell import Cell

Array = NDArray[np.float64]
FOLLOWING_MODES: Final = (
    "HOLDING",
    "MOVING",
    "STOPPING",
    "JOGGING",
    "PAUSED",
)  # modes with valid set-points


@dataclass(frozen=True, slots=True)
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
    "t_s", "run", "mode", "q_rad", "q_set_rad", "joint_rad", "joint_set_rad", "current_A", "voltage_V", "supply_V",
    "temperature_C", "tip_m", "late_s", "busy_s", "missed", "page_faults", "switches", "age_s",
)  # fmt: skip


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
