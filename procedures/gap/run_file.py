"""Recorded runs, one file each, and log.csv made from them on one clock.

A run file holds unaligned rows, one per cycle; `procedures.gap.timing` aligns them.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from calib.gap.log import LogFileError, Run
from calib.points.writer import replace_file
from control.model.arm import Arm
from control.tables import SAMPLES_MOST, opened_rows
from procedures.gap.timing import Aligned, Raw, aligned, clocks_of

TIP = ("x_m", "y_m", "z_m")
GROUPS = {"q{}_rad": "q_rad", "q{}_set_rad": "q_set_rad", "i{}_A": "current_A", "u{}_V": "voltage_V"}


class RunFile:
    """runs/NAME.csv in the folder of a recording."""

    @staticmethod
    def of(out: Path, name: str) -> Path:
        """The file of a run."""
        return out / "runs" / f"{name}.csv"

    @staticmethod
    def write(path: Path, rows: npt.NDArray[np.void], arm: Arm, payload_kg: float) -> None:
        """Write the rows of a run atomically.

        Where a board sets its motor's voltage itself, what the runtime told it beside position or current is none.
        """
        joints = range(1, arm.joint_count + 1)
        names = ["t_s", *_joint_names(arm.joint_count), *(f"counted{j}_s" for j in joints), *TIP]
        hidden = {f"u{drive.joint}_V" for drive in arm.drives if drive.pid.mode != "voltage"}
        table = np.column_stack(
            [
                np.full(len(rows), np.nan) if name in hidden else rows[name].astype(np.float64)
                for name in names
            ]
        )
        text = [",".join([*names, "payload_kg"])]
        text += [",".join([*(_cell(x, 12) for x in row), f"{payload_kg:g}"]) for row in table.tolist()]
        replace_file(path, ("\n".join(text) + "\n").encode())

    @staticmethod
    def read(path: Path, joint_count: int) -> Raw:
        """Read a run. LogFileError if it is not one that `write` has written."""
        try:
            return RunFile._read(path, joint_count)
        except (OSError, ValueError, KeyError, IndexError, StopIteration) as error:
            raise LogFileError(
                f"{path}: not a run of `armwright gap record` ({error or 'empty'}): remove it, and record it again"
            ) from None

    @staticmethod
    def _read(path: Path, joint_count: int) -> Raw:
        with opened_rows(path, ValueError, SAMPLES_MOST) as reader:
            header = next(reader)
            table = np.array([[float(cell or "nan") for cell in row] for row in reader])
        column = {name: table[:, k] for k, name in enumerate(header)}

        def group(form: str) -> npt.NDArray[np.float64]:
            return np.column_stack([column[form.format(j)] for j in range(1, joint_count + 1)])

        return Raw(
            column["t_s"], group("q{}_rad"), group("q{}_set_rad"), group("i{}_A"), group("u{}_V"), group("counted{}_s"),
            np.column_stack([column[name] for name in TIP]), float(column["payload_kg"][0]),
        )  # fmt: skip


def write_log(out: Path, arm: Arm, names: Sequence[str]) -> tuple[str, ...]:
    """Write log.csv from all runs, on one clock; returns messages about the delays removed."""
    n = arm.joint_count
    there = [(name, RunFile.of(out, name)) for name in names]
    runs = [(name, RunFile.read(path, n)) for name, path in there if path.exists()]
    if not runs:
        return ()
    rows = []
    for session in _by_runtime(runs):
        clocks = clocks_of(arm, [raw for _, raw in session])
        rows += [(name, aligned(arm, raw, clocks), raw.payload_kg) for name, raw in session]
    replace_file(out / "log.csv", log_text(n, rows).encode())
    return clocks.in_words()


def _by_runtime(runs: Sequence[tuple[str, Raw]]) -> list[list[tuple[str, Raw]]]:
    """The runs by the runtimes that recorded them: each has a clock of its own, and the boards may have gone on with theirs."""
    apart: list[list[tuple[str, Raw]]] = [[]]
    for name, raw in runs:
        if apart[-1] and raw.t_s[0] < apart[-1][-1][1].t_s[0]:
            apart.append([])
        apart[-1].append((name, raw))
    return apart


def log_text(joint_count: int, runs: Sequence[tuple[str, Aligned | Run, float]]) -> str:
    """log.csv of runs by their names, each with its payload [kg]; without the quantities that none of them has.

    An empty voltage would say that a driver is off: where a board sets a joint's voltage itself, the log has no voltages.
    """
    groups = [[getattr(run, name) for _, run, _ in runs] for name in GROUPS.values()]
    has = [any(np.isfinite(values).any() for values in group) for group in groups]
    has[-1] = bool(np.any([np.isfinite(volts).any(axis=0) for volts in groups[-1]], axis=0).all())
    has[-1] |= any(isinstance(run, Run) and run.is_commanded for _, run, _ in runs)  # then none: driver off
    names = [
        name
        for name, is_there in zip(_joint_names(joint_count), np.repeat(has, joint_count), strict=True)
        if is_there
    ]
    lines = [",".join(["run", "t_s", *names, *TIP, "payload_kg"])]
    for at, (name, run, payload_kg) in enumerate(runs):
        there = [group[at] for group, is_there in zip(groups, has, strict=True) if is_there]
        table = np.column_stack((run.t_s, *there, run.tip_m))
        end = f"{payload_kg:g}"
        lines += [",".join([name, *(_cell(x) for x in row), end]) for row in table.tolist()]
    return "\n".join(lines) + "\n"


def _joint_names(n: int) -> list[str]:
    """Column names by quantity."""
    return [form.format(j) for form in GROUPS for j in range(1, n + 1)]


def _cell(value: float, digits: int = 9) -> str:
    return "" if value != value else f"{value:.{digits}g}"
