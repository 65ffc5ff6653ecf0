"""Builds a series from the named columns of any file format."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from console.visualisation.series import Array, Series, joined_runs
from control.model.arm import Arm

JOINT_FORMS: Final = {
    "q_rad": "q{}_rad", "q_set_rad": "q{}_set_rad", "current_A": "i{}_A", "voltage_V": "u{}_V",
    "supply_V": "supply{}_V", "temperature_C": "temperature{}_C",
}  # fmt: skip
JOINT_SIDE_FORMS: Final = (
    ("joint_rad", "joint{}_rad", "q_rad"), ("joint_set_rad", "joint{}_set_rad", "q_set_rad"),
)  # fmt: skip
LOOP_COLUMNS: Final = ("late_s", "busy_s", "missed", "page_faults", "switches", "age_s")
Report = Callable[[float], None]


def of_columns(
    name: str,
    columns: Mapping[str, NDArray[Any]],
    joint_count: int,
    modes: tuple[str, ...],
    arm: Arm | None,
    notes: tuple[str, ...] = (),
    run_names: tuple[str, ...] | None = None,
) -> Series:
    """Columns by the names of log.csv as a series; columns that are absent are NaN."""
    count = len(columns["t_s"])

    def column(key: str) -> Array:
        found = columns.get(key)
        return np.full(count, np.nan) if found is None else np.asarray(found, dtype=np.float64)

    def group(form: str) -> Array:
        return np.stack([column(form.format(joint)) for joint in range(1, joint_count + 1)], axis=1)

    numbers, run_names = _numbered_runs(column("run"), run_names)
    joints: dict[str, Any] = {key: group(form) for key, form in JOINT_FORMS.items()}
    for key, form, same in JOINT_SIDE_FORMS:
        joints[key] = group(form) if form.format(1) in columns else joints[same]
    mode = np.nan_to_num(column("mode"), nan=-1.0).astype(np.int64) if modes else np.full(count, -1)
    loop: dict[str, Any] = {key: column(key) for key in LOOP_COLUMNS}
    return Series(
        name=name,
        t_s=joined_runs(column("t_s"), numbers),
        run=numbers,
        runs=run_names,
        mode=mode,
        modes=modes,
        tip_m=np.stack([column(axis) for axis in ("x_m", "y_m", "z_m")], axis=1),
        arm=arm,
        notes=notes,
        **joints,
        **loop,
    )


def _numbered_runs(run: Array, names: tuple[str, ...] | None) -> tuple[NDArray[np.int64], tuple[str, ...]]:
    """Each row's index into the runs' names; without names, the numbers that occur are the names."""
    numbers = np.nan_to_num(run).astype(np.int64)
    if names is not None:
        return numbers, names
    found, numbers = np.unique(numbers, return_inverse=True)
    return numbers, tuple(str(number) for number in found)
