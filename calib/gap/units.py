"""Units in which controllers log what their motors do: currents, their shares of a limit, or torques."""

from __future__ import annotations

import dataclasses
import math
from types import MappingProxyType
from typing import Final

import numpy as np

from calib.arrays import Array, frozen
from calib.errors import CalibrationError
from calib.gap.log import Log
from calib.points.points import Points
from control.model.arm import Arm, Drive

# What --current-unit accepts, and what it means in words.
UNITS: Final = MappingProxyType(
    {
        "A": "amperes",
        "mA": "milliamperes",
        "percent": "percent of the drives' current limits",
        "Nm": "torques of the joints in N m",
        "motor_Nm": "torques of the motors in N m",
    }
)
AMPERES: Final = "A"
TORQUES: Final = "Nm"
FINE_COUNTS: Final = 1 << 24  # of an encoder that nobody described: the steps that the data show are coarser
IDEAL: Final = Drive(1, 1.0, FINE_COUNTS, 1.0, 1.0, 1e6)


def amperes_per(arm: Arm, unit: str) -> Array:
    """Motor current of each joint for one of a unit, (n,); CalibrationError for a unit that is not known."""
    if unit not in UNITS:
        raise CalibrationError(f'--current-unit: expected one of {", ".join(UNITS)}, got "{unit}"')
    drives = [arm.drive(joint + 1) for joint in range(arm.joint_count)]
    per_motor_Nm = np.array([1.0 / drive.torque_constant_Nm_A for drive in drives])
    match unit:
        case "mA":
            return np.full(len(drives), 1e-3)
        case "percent":
            return np.array([drive.current_limit_A / 100.0 for drive in drives])
        case "Nm":
            return np.asarray(per_motor_Nm / np.array([drive.gear_ratio for drive in drives]))
        case "motor_Nm":
            return per_motor_Nm
        case _:
            return np.ones(len(drives))


def with_ideal_drives(arm: Arm) -> Arm:
    """The arm with a drive of one newton metre per ampere, without gear and rotor, on every joint that has none.

    For torques: what an arm's masses tell of them needs no motor.
    """
    has = {drive.joint: drive for drive in arm.drives}
    joints = range(1, arm.joint_count + 1)
    return dataclasses.replace(
        arm, drives=tuple(has.get(j, dataclasses.replace(IDEAL, joint=j)) for j in joints)
    )


def without_voltages(log: Log) -> Log:
    """The log without its voltages, which say nothing where motors are not known."""
    runs = tuple(
        dataclasses.replace(run, voltage_V=frozen(run.voltage_V * math.nan), is_commanded=False)
        for run in log.runs
    )
    return dataclasses.replace(log, runs=runs)


def points_in_amperes(arm: Arm, points: Points, unit: str) -> Points:
    """Poses whose columns i1_A ... are of another unit."""
    if unit == AMPERES:
        return points
    return dataclasses.replace(points, current_A=frozen(points.current_A * amperes_per(arm, unit)))


def log_in_amperes(arm: Arm, log: Log, unit: str) -> Log:
    """Time series whose columns i1_A ... are of another unit."""
    if unit == AMPERES:
        return log
    factor = amperes_per(arm, unit)
    runs = tuple(dataclasses.replace(run, current_A=frozen(run.current_A * factor)) for run in log.runs)
    return dataclasses.replace(log, runs=runs)
