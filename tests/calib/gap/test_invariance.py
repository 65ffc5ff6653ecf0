"""Answers follow from what was measured: not from how it was written down, nor from limits that nobody came near.

Names are the same exactly. Values are the same to 1e-5: iterations end within a thousandth of a standard deviation. Where a
recording is cut, filters lose rows at the cuts and other runs report: values are the same within one standard deviation.
"""

from __future__ import annotations

import csv
import dataclasses
import gzip
import json
import os
import subprocess
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from benchmarks.gap.static.cases import Design, Hidden, designed
from calib.gap.finding import EffectName, GapFinding
from calib.gap.log import Log, amperes_per
from calib.gap.poses.find import find
from calib.gap.poses.floor import noise_floor
from calib.gap.poses.linear import Residuals
from calib.gap.poses.outcome import StaticGap
from calib.gap.poses.recordings import parts, split
from calib.gap.workflow import find_gap, read_recordings
from calib.points.points import Points
from calib.points.writer import write_points
from control.model.arm import Arm
from control.model.effects import EFFECTS
from tests.calib.gap.series.prescribed import LONG, log_of, write_log

HIDDEN = (Hidden("encoder_scale", 1, 0.006), Hidden("backlash", 2, 0.004))
DESIGNS = (
    Design(rig="planar", free=36, visits=4),
    Design(rig="planar", free=36, visits=4, has_time=False),
    Design(rig="planar", free=36, visits=1),  # too few recordings: single poses report
    Design(step=8, free=12, has_time=False),
)


def shuffled(points: Points) -> tuple[Points, np.ndarray]:
    order = np.random.default_rng(5).permutation(len(points))
    return points.chosen(order), order


@pytest.mark.parametrize("design", DESIGNS)
def test_what_reports_what_is_left_out_in_turn_and_the_noise_are_the_same_poses_in_any_order(design: Design) -> None:
    arm, points = designed(71, (), design)
    other, order = shuffled(points)
    first, second = split(points), split(other)
    np.testing.assert_array_equal(second.report, first.report[order])
    np.testing.assert_array_equal(second.known, first.known[order])
    unplaced = dataclasses.replace(points, tip_m=np.full(points.tip_m.shape, np.nan))
    np.testing.assert_array_equal(parts(shuffled(unplaced)[0], 5), parts(unplaced, 5)[order])
    residuals = Residuals(np.array(points.tip_m), np.full(points.tip_m.shape, np.nan))
    same = Residuals(residuals.tip_m[order], residuals.turn_rad)
    assert noise_floor(arm, other, same).tip_m == pytest.approx(noise_floor(arm, points, residuals).tip_m, rel=1e-9)


@cache
def recorded(has_time: bool) -> tuple[Arm, Points, StaticGap]:
    arm, points = designed(72, HIDDEN, dataclasses.replace(DESIGNS[0], has_time=has_time))
    return arm, points, find(arm, points)


def require_same(one: StaticGap, other: StaticGap) -> None:
    told, again = (
        {e.name: {key: value for key, (value, _) in e.parameters.items()} for e in found.finding.effects}
        for found in (one, other)
    )
    assert told.keys() == again.keys() >= {EffectName(hidden.effect, hidden.joint) for hidden in HIDDEN}
    for name, parameters in told.items():
        assert again[name] == pytest.approx(parameters, rel=1e-5, abs=1e-8)
    assert other.finding.gap_after == pytest.approx(one.finding.gap_after, rel=1e-5)


@pytest.mark.parametrize(
    "has_time", [pytest.param(True, id="with times"), pytest.param(False, id="without times", marks=pytest.mark.nightly)]
)
def test_rows_in_another_order_and_current_limits_that_are_five_times_as_wide_have_the_same_answer(has_time: bool) -> None:
    arm, points, found = recorded(has_time)
    drives = tuple(dataclasses.replace(one, current_limit_A=5.0 * one.current_limit_A) for one in arm.drives)
    require_same(found, find(dataclasses.replace(arm, drives=drives), shuffled(points)[0]))


# Recordings as files: a table of rows (dicts of texts by column) that is written down in another way.
Table = list[dict[str, str]]
TRIED = ("load_friction", "coulomb_friction", "viscous_friction", "cogging")


def rubbing(joint: int, q: np.ndarray, speed: np.ndarray, link: np.ndarray) -> np.ndarray:
    return 0.2 * np.abs(link) * np.sign(speed) if joint == 1 else np.zeros_like(q)


@cache
def moved() -> Log:
    return log_of(LONG, rubbing)


def poses(folder: Path) -> tuple[Arm, Path]:
    arm, points, _ = recorded(True)
    write_points(folder / "points.csv", points)
    return arm, folder / "points.csv"


def series(folder: Path) -> tuple[Arm, Path]:
    write_log(moved(), folder / "log.csv.gz")
    return LONG, folder / "log.csv.gz"


def rows_of(path: Path) -> Table:
    with gzip.open(path, "rt") if path.suffix == ".gz" else path.open() as file:
        return list(csv.DictReader(file))


def written(path: Path, rows: Table) -> Path:
    with gzip.open(path, "wt", compresslevel=1) if path.suffix == ".gz" else path.open("w") as file:
        table = csv.DictWriter(file, rows[0].keys(), lineterminator="\n")
        table.writeheader()
        table.writerows(rows)
    return path


def answer(arm: Arm, paths: list[Path], unit: str = "A") -> GapFinding:
    logs = [path for path in paths if path.suffix == ".gz"]
    read = read_recordings(arm, [path for path in paths if path not in logs], logs, unit)
    without = [name for name in EFFECTS if name not in TRIED] if logs else ()
    return find_gap(arm, read.points, read.log, without=without).finding


@dataclasses.dataclass(frozen=True)
class Way:
    """How a recording is written down; two files: the later one first, no run in both."""

    unit: str = "A"
    are_columns_turned_round: bool = False
    files: int = 1

    def answer(self, arm: Arm, path: Path) -> GapFinding:
        rows = rows_of(path)
        for row in rows:
            for joint, factor in enumerate(amperes_per(arm, self.unit).tolist(), start=1):
                cell = row[f"i{joint}_A"]
                row[f"i{joint}_A"] = f"{float(cell) / factor:.12g}" if cell else ""
        if self.are_columns_turned_round:
            rows = [dict(reversed(row.items())) for row in rows]
        later = range(len(rows) // 2, len(rows))
        middle = next(k for k in later if "run" not in rows[k] or rows[k]["run"] != rows[k - 1]["run"])
        parts = [rows] if self.files == 1 else [rows[middle:], rows[:middle]]
        return answer(arm, [written(path.parent / f"{k}_{path.name}", part) for k, part in enumerate(parts)], self.unit)


WAYS = {
    "columns in another order": Way(are_columns_turned_round=True),
    "milliamperes": Way("mA"),
    "torques of the motors": Way("motor_Nm"),
    "two files, the later one first": Way(files=2),
    "all at once, in milliamperes": Way("mA", are_columns_turned_round=True, files=2),
    "all at once, in torques of the motors": Way("motor_Nm", are_columns_turned_round=True, files=2),
}


@cache
def plain(kind: Callable[[Path], tuple[Arm, Path]], folder: Path) -> GapFinding:
    arm, path = kind(folder)
    return answer(arm, [path])


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("plain")


def values_of(found: GapFinding) -> dict[EffectName, list[float]]:
    """Of each name its values with their standard deviations, and its probability."""
    return {
        one.name: [*(part for _, own in sorted(one.parameters.items()) for part in own), one.probability] for one in found.effects
    }


def require_equal(found: GapFinding, other: GapFinding, rel: float = 1e-5) -> None:
    told, again = values_of(found), values_of(other)
    assert again.keys() == told.keys()
    assert {frozenset(group) for group in other.ambiguous} == {frozenset(group) for group in found.ambiguous}
    for name, values in told.items():
        assert again[name] == pytest.approx(values, rel=rel, abs=1e-8, nan_ok=True)
    assert other.gap_after == pytest.approx(found.gap_after, rel=rel)


# All at once at each change, and each way by itself at night.
AT_EACH_CHANGE = (poses, "all at once, in milliamperes"), (series, "all at once, in torques of the motors")
PAIRS = [
    pytest.param(kind, way, id=f"{kind.__name__}-{way}", marks=[] if (kind, way) in AT_EACH_CHANGE else pytest.mark.nightly)
    for kind in (poses, series)
    for way in WAYS
]


@pytest.mark.usefixtures("without_motion")
@pytest.mark.parametrize(("kind", "way"), PAIRS)
def test_the_same_recording_written_down_in_another_way_has_the_same_answer(
    kind: Callable[[Path], tuple[Arm, Path]], way: str, folder: Path, tmp_path: Path
) -> None:
    found = plain(kind, folder)
    assert len(found.effects) > (kind is poses)
    require_equal(found, WAYS[way].answer(*kind(tmp_path)))


@pytest.mark.usefixtures("without_motion")
def test_runs_that_are_cut_in_two_have_the_same_names_and_the_values_within_their_standard_deviations(
    folder: Path, tmp_path: Path
) -> None:
    found = plain(series, folder)
    arm, path = series(tmp_path)
    rows = rows_of(path)
    for row in rows:
        row["run"] += "b" if float(row["t_s"]) >= 1.0 else "a"
    cut = answer(arm, [written(path, rows)])
    told, again = ({one.name: one.parameters for one in own.effects} for own in (found, cut))
    assert again.keys() == told.keys() == {EffectName("load_friction", 2)}
    for name, parameters in told.items():
        for key, (value, sd) in parameters.items():
            assert again[name][key][0] == pytest.approx(value, abs=sd)


ON_THREADS = """
import json, sys
from pathlib import Path
from tests.calib.gap.test_invariance import answer, poses, recorded, series, values_of, LONG
arm = {"points.csv": lambda: recorded(True)[0], "log.csv.gz": lambda: LONG}
for path in map(Path, sys.argv[1:]):
    found = answer(arm[path.name](), [path])
    print(json.dumps([found.gap_after, sorted((str(name), *values) for name, values in values_of(found).items())]))
"""


@pytest.mark.nightly
def test_one_processor_has_the_same_answer_as_two(folder: Path) -> None:
    paths = [str(kind(folder)[1]) for kind in (poses, series)]
    told = []
    for threads in "12":
        limits = {f"{name}_NUM_THREADS": threads for name in ("OPENBLAS", "OMP", "MKL")}
        done = subprocess.run(
            [sys.executable, "-c", ON_THREADS, *paths], env={**os.environ, **limits}, capture_output=True, text=True, check=True
        )
        told.append([json.loads(line) for line in done.stdout.splitlines()])
    assert len(told[0]) == 2
    for (gap, named), (other_gap, other) in zip(*told, strict=True):
        assert [name for name, *_ in named] == [name for name, *_ in other]
        assert other_gap == pytest.approx(gap, rel=1e-5)
        for (_, *values), (_, *others) in zip(named, other, strict=True):
            assert others == pytest.approx(values, rel=1e-5, abs=1e-8, nan_ok=True)


@pytest.mark.usefixtures("without_motion")
def test_neither_current_limits_nor_the_order_of_runs_say_anything_of_a_log(folder: Path) -> None:
    drives = tuple(dataclasses.replace(one, current_limit_A=6.0 * one.current_limit_A) for one in LONG.drives)
    without = [name for name in EFFECTS if name not in TRIED]
    found = plain(series, folder)
    other = find_gap(dataclasses.replace(LONG, drives=drives), None, Log(moved().runs[::-1]), without=without).finding
    assert values_of(found).keys() == {EffectName("load_friction", 2)}
    require_equal(found, other)
