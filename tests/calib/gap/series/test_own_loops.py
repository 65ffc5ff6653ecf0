"""Servos: drives that close the loop themselves, and encoders whose steps a camera sees."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np
import pytest

from calib.arrays import frozen
from calib.gap.effects.catalogue import known_laws
from calib.gap.log import Log
from calib.gap.residuals.rows import ResidualRows
from calib.gap.signals.physics import Physics
from calib.gap.signals.recording import prepare
from control.kinematics.kinematics import ForwardKinematics
from control.model.arm import Arm
from control.model.drive import DrivePid
from tests.calib.gap.series.prescribed import LONG, log_of

EVERY, STEP_rad = 5, 0.0015  # of the samples: 100 a second, as a host reads servos


def rows_of(arm: Arm, log: Log) -> ResidualRows:
    return ResidualRows(Physics(arm, prepare(arm, log)), known_laws(arm))


def read_slowly(log: Log) -> Log:
    return Log(tuple(run.rows(slice(None, None, EVERY), run.name) for run in log.runs), log.sources)


def left_A(mode: Literal["voltage", "position"]) -> float:
    """What is left of currents that a drive's own loop has made, read by a host."""
    drives = tuple(replace(one, pid=DrivePid(mode)) for one in LONG.drives)
    arm = replace(LONG, drives=drives)
    rows = rows_of(arm, read_slowly(log_of(LONG, closes_loop=True)))
    residual = rows.residual(known_laws(arm))
    parts = [residual[cell.rows] * cell.floor for cell in rows.table.cells if cell.channel == "current_A"]
    return float(np.sqrt(np.mean(np.concatenate(parts) ** 2)))


def test_a_drive_that_closes_the_loop_holds_no_voltage_over_the_hosts_samples() -> None:
    """Its current is that of the moment; one that a held voltage drove would stand half a sample earlier."""
    assert left_A("position") < 0.5 * left_A("voltage")


def test_steps_of_encoders_are_in_the_tips_floor() -> None:
    fine = log_of(LONG)
    stepped = [replace(run, q_rad=frozen(np.round(run.q_rad / STEP_rad) * STEP_rad)) for run in fine.runs]
    floors = []
    for log in (fine, Log(tuple(stepped), fine.sources)):
        (tip,) = (cell for cell in rows_of(LONG, log).table.cells if cell.channel == "tip_m")
        floors.append(tip.floor)
    kinematics = ForwardKinematics(LONG)
    moved_m = np.concatenate(
        [kinematics.tips(one.q_rad) - kinematics.tips(other.q_rad) for one, other in zip(fine.runs, stepped, strict=True)]
    )
    assert floors[1] == pytest.approx(np.hypot(floors[0], np.sqrt(np.mean(moved_m**2))), rel=0.1)
    assert floors[1] > 1.5 * floors[0]
