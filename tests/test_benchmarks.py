"""Every section of `make bench` still runs: its rows at the smallest sizes, without peers. Its figures are no matter here."""

from __future__ import annotations

import ast
import importlib
import math
from pathlib import Path

import pytest

import benchmarks
from benchmarks.__main__ import SECTIONS
from benchmarks.loop.jobs import CIRCLE_SPEED_m_s, HEIGHT_m, circle
from benchmarks.peers.peer import PeerMissing
from control.model.arm import Arm
from control.model.table import table_of
from control.motion.plan import PlannedPath, plan_path
from control.motion.waypoints import Waypoints

SMALLEST: dict[str, dict[str, object]] = {
    "kinematics": {"ROUNDS": 1, "POSES": 4},
    "poses": {"ROUNDS": 1, "POINTS": 41},
    "collision": {"ROUNDS": 1, "POSES": 4},
    "control_cycle": {"ROUNDS": 1, "MEMORY_RUNS": 1},
    "cycle_by_joints": {"ROUNDS": 1, "AWAY_rad": 0.02},
    "wire": {"ROUNDS": 1, "CALLS": 1},
    "identification": {"ROUNDS": 1, "FASTER": {33: 25.0}, "NAMES": {"e2": "E2"}, "MEMORY_POINTS": 40},
    "tolerances": {"ARMS": 501},
    "tracking": {"SEEDS": (12,), "get_args": lambda _: ("voltage",)},
    "pose_tracking": {"SPEED_m_s": 0.3},
    "stepped": {"ROUNDS": 1, "HOLDING_S": 0.1, "MOVES_rad": ((0.1, -0.6, 0.5),)},
    "realtime": {"RATES_Hz": (500,), "HOLDING_S": 0.2},
    "console_load": {"TURNS": 1, "PHASE_S": 0.3, "SETTLE_S": 0.1},
}
NIGHTLY = {
    "control_cycle",
    "cycle_by_joints",
    "identification",
    "tolerances",
    "tracking",
    "pose_tracking",
    "stepped",
}  # seconds each
REALTIME = {"realtime", "console_load"}


def short_circuit(arm: Arm, turns: int = 1) -> PlannedPath:
    """Some cavities of the benchmarks' circle, and back to the first."""
    points = circle(table_of(arm), height_m=HEIGHT_m).points
    return plan_path(arm, Waypoints((*points[:3], points[0]), None), CIRCLE_SPEED_m_s)


def no_peer(*given: object) -> None:
    raise PeerMissing("is not wanted here")


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(
            name,
            marks=[
                *([pytest.mark.nightly] if name in NIGHTLY | REALTIME else []),
                *([pytest.mark.realtime] if name in REALTIME else []),
            ],
        )
        for name in SECTIONS
    ],
)
def test_a_section_of_the_benchmarks_measures_its_rows(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    section = importlib.import_module(SECTIONS[name][1])
    for size, value in SMALLEST[name].items():
        monkeypatch.setattr(section, size, value)
    monkeypatch.setattr(section, "circle_path", short_circuit, raising=False)
    monkeypatch.setattr(section, "Peer", no_peer, raising=False)
    rows = list(section.rows())
    assert rows
    assert [row.name for row in rows if not math.isfinite(row.value)] == []


def test_a_script_runs_when_all_of_it_is_defined() -> None:
    """A function below the lines that run the module is not there yet."""
    for path in sorted(Path(benchmarks.__file__).parent.rglob("*.py")):
        *before, _ = [ast.unparse(part) for part in ast.parse(path.read_text(encoding="utf-8")).body] or [""]
        assert not [part for part in before if part.startswith("if __name__")], path
