"""Joint torques of the rigid arm: inverse dynamics, gravity, mass matrix; scalar for the loop, and in batches.

Rotors count as reflected inertia (ratio^2 times the rotor's), without gyroscopic terms. Friction and everything
between motor and joint are effects (`control.model.effects`).
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from control.dynamics.rigid_body import Chain, chain_of, inverse_dynamics
from control.errors import ArmError
from control.kinematics.chain import checked_poses
from control.kinematics.straight_line import compile_function, shared
from control.kinematics.tracing import Graph, Scalar, Symbol
from control.model.arm import Arm, Vector3

Array = NDArray[np.float64]
Floats = tuple[float, ...]


class Dynamics:
    """The equations of motion of one arm, with a point mass `payload_kg` at its tip.

    Equal where the numbers are.
    Raises MissingModel, which names the masses that the arm's file lacks.
    """

    def __init__(self, arm: Arm, payload_kg: float = 0.0) -> None:
        if not (payload_kg >= 0.0 and np.isfinite(payload_kg)):
            raise ArmError(f"payload_kg: expected a mass not below 0, got {payload_kg}")
        self._chain = chain_of(arm)
        self._gravity = arm.gravity_m_s2
        self.payload_kg = payload_kg
        self.joint_count = arm.joint_count

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Dynamics) and self._numbers == other._numbers

    def __hash__(self) -> int:
        return hash(self._numbers)

    @property
    def _numbers(self) -> tuple[Chain, Vector3, float]:
        return self._chain, self._gravity, self.payload_kg

    @shared
    def inverse(self) -> Callable[[Sequence[float], Sequence[float], Sequence[float]], Floats]:
        """`inverse(q, speed, acceleration) -> torques` [rad, rad/s, rad/s^2 -> N m at the joints]."""
        q, speed, acceleration = self._symbols()
        torques = self._torques(q, speed, acceleration, self._gravity, self.payload_kg)
        return compile_function("inverse_dynamics", [q, speed, acceleration], tuple(torques))

    @shared
    def gravity(self) -> Callable[[Sequence[float]], Floats]:
        """`gravity(q) -> torques` that hold the arm still [N m]."""
        q, *_ = self._symbols()
        still = [0.0] * self.joint_count
        return compile_function(
            "gravity", [q], tuple(self._torques(q, still, still, self._gravity, self.payload_kg))
        )

    @shared
    def mass_matrix(self) -> Callable[[Sequence[float]], tuple[Floats, ...]]:
        """`mass_matrix(q) -> n rows` [kg m^2], rotors included."""
        q, *_ = self._symbols()
        return compile_function("mass_matrix", [q], self._mass_rows(q))

    def torques(
        self, q: ArrayLike, speed: ArrayLike, acceleration: ArrayLike, payload_kg: ArrayLike | None = None
    ) -> Array:
        """Return the torques (m, n) of m states, each argument (m, n); a payload for each (m,), or one for all."""
        states = [checked_poses(part, self.joint_count) for part in (q, speed, acceleration)]
        if len({part.shape for part in states}) != 1:
            raise ArmError(f"states: expected equal shapes, got {', '.join(str(s.shape) for s in states)}")
        payload = np.asarray(self.payload_kg if payload_kg is None else payload_kg, dtype=np.float64)
        columns = self._batch(*(part.T for part in states), payload)
        result = np.empty(states[0].shape)
        for joint, column in enumerate(columns):
            result[:, joint] = column
        return result

    def gravities(self, q: ArrayLike, payload_kg: ArrayLike | None = None) -> Array:
        """Return the torques (m, n) that hold the arm still in poses (m, n), with payloads as in `torques`.

        Computed on arrays: without speeds little is left to do, and arms that differ by a hair would each be traced and compiled.
        """
        poses, still = checked_poses(q, self.joint_count), [0.0] * self.joint_count
        payload = np.asarray(self.payload_kg if payload_kg is None else payload_kg, dtype=np.float64)
        result = np.empty(poses.shape)
        for joint, column in enumerate(self._torques(list(poses.T), still, still, self._gravity, payload)):
            result[:, joint] = column
        return result

    def mass_matrices(self, q: ArrayLike) -> Array:
        """Return the mass matrices (m, n, n) [kg m^2] of poses (m, n)."""
        poses = checked_poses(q, self.joint_count)
        rows = self._mass_rows(list(poses.T))
        result = np.empty((len(poses), self.joint_count, self.joint_count))
        for i, row in enumerate(rows):
            for j, entry in enumerate(row):
                result[:, i, j] = entry
        return result

    @shared
    def _batch(self) -> Callable[..., Any]:
        q, speed, acceleration = self._symbols()
        payload = q[0].graph.variable("payload")
        torques = self._torques(q, speed, acceleration, self._gravity, payload)
        return compile_function("torques", [q, speed, acceleration, payload], tuple(torques), np)

    def _symbols(self) -> tuple[list[Symbol], list[Symbol], list[Symbol]]:
        graph = Graph()
        numbers = range(1, self.joint_count + 1)
        q, speed, acceleration = ([graph.variable(f"{kind}{i}") for i in numbers] for kind in "qsa")
        return q, speed, acceleration

    def _mass_rows(self, q: Sequence[Scalar]) -> tuple[tuple[Scalar, ...], ...]:
        """Column j is the torque of a unit acceleration of joint j alone, without gravity and speed."""
        n = self.joint_count
        still, units = [0.0] * n, np.eye(n).tolist()
        columns = [self._torques(q, still, unit, (0.0, 0.0, 0.0), self.payload_kg) for unit in units]
        return tuple(tuple(columns[max(i, j)][min(i, j)] for j in range(n)) for i in range(n))

    def _torques(
        self,
        q: Sequence[Scalar],
        speed: Sequence[Scalar],
        acceleration: Sequence[Scalar],
        gravity: Sequence[float],
        payload_kg: Scalar,
    ) -> list[Scalar]:
        return inverse_dynamics(self._chain, q, speed, acceleration, gravity, payload_kg)
