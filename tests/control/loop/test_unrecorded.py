"""Motions while nothing is recorded: refused and stopped by default, or allowed by arm.toml."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

import pytest

from control.recording.recorder_state import RecorderState
from control.safety.modes import Mode
from tests.cell import RIGHT, Cell, holding_cell, scenario

FAR = [0.6, -0.3, 0.5]


class Disk:
    """A sink that can be full, or too slow."""

    def __init__(self) -> None:
        self.reason = ""
        self.takes_rows = True

    def write(self, row: bytes) -> bool:
        return self.takes_rows

    def state(self) -> RecorderState:
        return RecorderState(not self.reason, "arm.armlog", self.reason)

    def close(self) -> None:
        pass


@contextmanager
def cell_on(disk: Disk, policy: str) -> Iterator[Cell]:
    arm = replace(RIGHT, recording=replace(RIGHT.recording, unrecorded=policy))
    with holding_cell(scenario(), believed=arm, sink=disk) as cell:
        yield cell


def test_a_motion_that_runs_when_the_disk_fills_makes_a_controlled_stop_and_none_begins() -> None:
    disk = Disk()
    with cell_on(disk, "refuse") as cell:
        cell.start_move(FAR, speed=0.2)
        cell.run(0.3)
        disk.reason = "No space left on device"
        cell.until(lambda: cell.mode is Mode.STOPPING, 0.11)
        cell.until(lambda: cell.mode is Mode.HOLDING, 1.0)
        assert cell.faults == []
        assert cell.client.status()["was_stopped"]
        for request in ({"do": "move_joints", "q_rad": FAR}, {"do": "home", "again": True}):
            error = cell.refusal(**request)
            assert "nothing is recorded (No space left on device)" in error
            assert "unrecorded" in error
        assert cell.client.jog(joint=1, by_rad=0.01) == ""  # to get the arm away
        disk.reason = ""
        cell.run(0.11)
        cell.client.move_joints(FAR)


def test_a_disk_that_is_too_slow_is_no_recording_either() -> None:
    disk = Disk()
    with cell_on(disk, "refuse") as cell:
        disk.takes_rows = False
        cell.run(0.2)
        assert "the disk is too slow" in cell.refusal(do="move_joints", q_rad=FAR)
        disk.takes_rows = True
        cell.run(0.3)
        cell.start_move(FAR)


@pytest.mark.parametrize("reason", ["No space left on device"])
def test_an_arm_that_may_moves_unrecorded(reason: str) -> None:
    disk = Disk()
    with cell_on(disk, "allow") as cell:
        cell.start_move(FAR, speed=0.5)
        disk.reason = reason
        cell.run(0.3)
        assert cell.mode is Mode.MOVING
        cell.until(lambda: cell.mode is Mode.HOLDING, 5.0)
        cell.client.move_joints((0.1, -0.6, 0.2))
        assert any(reason in warning for warning in cell.client.status()["warnings"])
