"""The same arm, scenario and seed give the same recording, byte for byte: what a replay is compared with."""

from __future__ import annotations

from pathlib import Path

import msgspec
import pytest

from control.recording.record import FileSink, Layout
from tests.cell import holding_cell, scenario

NEAR_HOME = (-0.1, 0.0, 0.6)


def record(path: Path, seed: int) -> bytes:
    """Home, move, average, and be disturbed by lost frames, on the demo's arm; its recording."""
    hidden = msgspec.structs.replace(scenario(NEAR_HOME, homed=False, base="demo"), seed=seed)
    sink = FileSink(path, Layout.of(3).header({"arm": "right"}))
    with holding_cell(hidden, sink=sink) as cell:
        cell.inject("drop_frames", "encoder", probability=0.05)
        cell.client.home()
        cell.client.move_joints((0.2, -0.1, 0.6))
        cell.client.average(0.05)
    sink.close()
    return path.read_bytes()


@pytest.fixture(scope="module")
def first(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    return record(tmp_path_factory.mktemp("first") / "a.armlog", 3)


def test_two_runs_with_the_same_seed_are_the_same_bytes(first: bytes, tmp_path: Path) -> None:
    assert record(tmp_path / "b.armlog", 3) == first


def test_another_seed_is_another_run(first: bytes, tmp_path: Path) -> None:
    assert record(tmp_path / "c.armlog", 4) != first
