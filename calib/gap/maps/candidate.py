"""A table that a map may be: its variable, its nodes, and how smooth it is taken to be."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy import sparse

from calib.arm_problem.measured_maps import node_values, spline_columns
from calib.arrays import Array
from control.model.maps import NODES_LEAST, CorrectionMap, Corrects, Over

# Nodes by variable: their distance, and the most. What is finer than a node is not followed.
NODE_rad, NODES_MOST = (
    0.2,
    33,
)  # of a joint's angle: an eccentricity's fourth harmonic has eight nodes a period
NODES_OF_LOAD, NODES_OF_SPEED = 7, 13
MEASURED = 0.999  # of the values lie below the upper end of a table, and above its lower
LOAD_LEAST = 0.05  # of a load, by which it must change
# Of a motor turn: six nodes a period for a motor of few poles, of many, and for 72 periods a turn, the most that motors have.
NODES_OF_TURN = (36, 144, 432)
# Standard deviation of the bend from node to node, of the usual size: from a straight line's to no rule at all.
BENDS: Final = (0.03, 0.2, 1.0)
LEVEL: Final = 1.0  # standard deviation of the values themselves, of the usual size: they are hardly held


@dataclass(frozen=True, slots=True)
class Candidate:
    """One part of a map: the same in both directions, or, `is_directed`, with the sign of the motion."""

    joint: int
    corrects: Corrects
    over: Over
    count: int
    lower: float
    upper: float
    is_directed: bool = False

    @property
    def is_periodic(self) -> bool:
        """Whether it goes round."""
        return self.over == "motor_turn_rad"

    def columns(self, x: Array, direction: Array) -> sparse.csr_array:
        """What the spline of each node does at places x (m,) and directions (m,), (m, count)."""
        found = spline_columns(self.count, self.lower, self.upper, self.is_periodic, x)
        return sparse.csr_array(sparse.diags_array(direction) @ found) if self.is_directed else found

    def precision(self, bend: float) -> Array:
        """Inverse of the prior covariance of the splines' coefficients over the usual size squared, (count, count)."""
        unit = np.eye(self.count)
        ahead, behind = np.roll(unit, 1, axis=1), np.roll(unit, -1, axis=1)
        bends = ahead - 2.0 * unit + behind
        if not self.is_periodic:
            bends = bends[1:-1]
        return np.asarray(bends.T @ bends / bend**2 + unit / LEVEL**2)


def over_angle(joint: int, corrects: Corrects, q_rad: Array) -> tuple[Candidate, ...]:
    """Tables over a joint's angle."""
    lower, upper = _range(q_rad)
    count = min(max(math.ceil((upper - lower) / NODE_rad) + 1, NODES_LEAST), NODES_MOST)
    return _both(joint, corrects, "angle_rad", count, lower, upper) if upper - lower > NODE_rad else ()


def over_load(joint: int, corrects: Corrects, load_Nm: Array, least_Nm: float = 0.0) -> tuple[Candidate, ...]:
    """Tables over what a joint transmits; none where that changes by no more than `least_Nm`."""
    lower, upper = _range(load_Nm)
    is_varied = upper - lower > max(least_Nm, LOAD_LEAST * max(abs(lower), abs(upper)))
    return _both(joint, corrects, "load_Nm", NODES_OF_LOAD, lower, upper) if is_varied else ()


def over_speed(joint: int, speed_rad_s: Array) -> tuple[Candidate, ...]:
    """A table over the joint's speed, both signs."""
    lower, upper = _range(speed_rad_s)
    return (
        (Candidate(joint, "torque_Nm", "speed_rad_s", NODES_OF_SPEED, lower, upper),) if lower < upper else ()
    )


def over_turn(joint: int, travel_rad: float) -> tuple[Candidate, ...]:
    """Tables over a turn of the joint's motor, coarse to fine; none if it never went round (`travel_rad`, of the motor)."""
    if travel_rad < math.tau:
        return ()
    return tuple(
        Candidate(joint, "torque_Nm", "motor_turn_rad", count, 0.0, math.tau) for count in NODES_OF_TURN
    )


def _range(values: Array) -> tuple[float, float]:
    """Where nearly all were measured; beyond, a table keeps its end value."""
    lower, upper = np.quantile(values, (1.0 - MEASURED, MEASURED))
    return float(lower), float(upper)


def _both(
    joint: int, corrects: Corrects, over: Over, count: int, lower: float, upper: float
) -> tuple[Candidate, ...]:
    return tuple(
        Candidate(joint, corrects, over, count, lower, upper, is_directed) for is_directed in (False, True)
    )


def maps_of(parts: list[tuple[Candidate, Array]]) -> tuple[CorrectionMap, ...]:
    """Candidates with the coefficients of their splines as maps; both parts of one table become one."""
    tables: dict[tuple[int, Over], dict[bool, tuple[Candidate, Array]]] = {}
    for one, coefficients in parts:
        own = one, node_values(coefficients, one.is_periodic)
        tables.setdefault((one.joint, one.over), {})[one.is_directed] = own
    found = []
    for table in tables.values():
        one = next(iter(table.values()))[0]
        plain = table[False][1] if False in table else np.zeros(one.count)
        directed = tuple(table[True][1].tolist()) if True in table else ()
        found.append(
            CorrectionMap(
                one.joint, one.corrects, one.over, tuple(plain.tolist()), one.lower, one.upper, directed
            )
        )
    return tuple(found)
