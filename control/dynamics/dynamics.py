"""Joint torques of the rigid arm: inverse dynamics, gravity, mass matrix; scalar for the loop, and in batches.

Rotors count as reflected inertia (ratio^2 times the rotor's), without gyroscopic terms. Friction and everything
between motor and joint are effects (`control.model.effects`).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from control.errors import ArmError, MissingModel
from control.kinematics.chain import checked_poses
from control.kinematics.tracing import Graph, Scalar, Symbol, compile_function, cos, shared, sin
from control.model.arm import Arm, Vector3

# Equations of motion of a DH chain by the recursive Newton-Euler algorithm.
#
# Siciliano, Sciavicco, Villani, Oriolo: Robotics: Modelling, Planning and Control, 7.5 (standard DH); for modified DH
# Craig: Introduction to Robotics, 6.5. Vectors of link i are in its own frame, moments are about its origin. The
# function is generic: floats, arrays of poses, or symbols.

Vector = tuple[Scalar, Scalar, Scalar]
ZERO: Vector3 = (0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class RigidLink:
    """One link: its DH row, its mass properties in its own frame, and the joint (0-based) that turns it."""

    dh: tuple[float, float, float, float]
    joint: int | None
    mass_kg: Scalar
    com_m: Vector3
    inertia_kg_m2: Vector3


@dataclass(frozen=True, slots=True)
class Chain:
    """The parameters of an arm that the equations need; the tool's mass is a point in the last frame."""

    bodies: tuple[RigidLink, ...]
    is_modified: bool
    tool_m: Vector3
    rotor_kg_m2: tuple[float, ...]  # of each joint, reflected: ratio^2 times the rotor's
    joint_count: int
    tool_kg: float
    tool_com_m: Vector3
    gravity_m_s2: Vector3  # base frame


def chain_of(arm: Arm) -> Chain:
    """Return the bodies of an arm; MissingModel names the masses that its file lacks."""
    _check_masses(arm)
    bodies = []
    joint = 0
    for link in arm.links:
        turns = link.joint == "revolute"
        row = (link.d_m, link.theta_rad, link.L_m, link.alpha_rad)
        mass, com, inertia = link.mass_kg or 0.0, link.com_m or ZERO, link.inertia_kg_m2 or ZERO
        bodies.append(RigidLink(row, joint if turns else None, mass, com, inertia))
        joint += turns
    rotors = {d.joint: d.gear_ratio**2 * d.rotor_inertia_kg_m2 for d in arm.drives}
    reflected = tuple(rotors.get(j, 0.0) for j in range(1, joint + 1))
    tool = arm.tool
    is_modified = arm.dh_convention == "modified"
    carried = (tool.position_m, reflected, joint, tool.mass_kg, tool.centre_m)
    return Chain(tuple(bodies), is_modified, *carried, arm.gravity_m_s2)


def has_masses(arm: Arm) -> bool:
    """Whether an arm's file has what the equations need."""
    try:
        _check_masses(arm)
    except MissingModel:
        return False
    return True


def _check_masses(arm: Arm) -> None:
    """A revolute link, or a fixed link after it, needs mass, com and inertia."""
    for number, link in enumerate(arm.links, start=1):
        carried = []
        for outboard in arm.links[number - 1 :]:
            if outboard is not link and outboard.joint == "revolute":
                break
            carried.append(outboard.mass_kg)
        lacks = [
            key for key, value in (("com_m", link.com_m), ("inertia_kg_m2", link.inertia_kg_m2)) if value is None and link.mass_kg
        ]
        if link.joint == "revolute" and all(mass is None for mass in carried):
            lacks = ["mass_kg", "com_m", "inertia_kg_m2"]
        if lacks:
            file = f" in {arm.path}" if arm.path else ""
            keys = ", ".join(lacks)
            raise MissingModel(f"arm {arm.name}: dynamics needs {keys} of [[link]] {number}{file}; add them")


def inverse_dynamics(
    chain: Chain, q: Sequence[Scalar], speed: Sequence[Scalar], acceleration: Sequence[Scalar], payload_kg: Scalar = 0.0
) -> list[Scalar]:
    """Return the joint torques [N m] for angles, speeds and accelerations."""
    turns, moves, forces, moments = _forward(chain, q, speed, acceleration, payload_kg)
    torques: list[Scalar] = [0.0] * chain.joint_count
    force, moment = ZERO, ZERO  # transmitted to the next link, in this link's frame
    for i in reversed(range(len(chain.bodies))):
        force, moment = _add(forces[i], force), _add(moments[i], moment)
        joint = chain.bodies[i].joint
        about_z = moment[2]
        force, moment = _rotate(turns[i], force), _rotate(turns[i], moment)
        moment = _add(moment, _cross(moves[i], force))
        if joint is not None:
            along_axis = about_z if chain.is_modified else moment[2]
            torques[joint] = along_axis + chain.rotor_kg_m2[joint] * acceleration[joint]
    return torques


def _forward(
    chain: Chain, q: Sequence[Scalar], speed: Sequence[Scalar], acceleration: Sequence[Scalar], payload_kg: Scalar
) -> tuple[list[list[Vector]], list[Vector], list[Vector], list[Vector]]:
    """From base to tip: each link's rotation, its origin in the previous frame, and its inertial force and moment.

    Gravity enters as an acceleration of the base (Siciliano 7.5).
    """
    omega, alpha = ZERO, ZERO
    x, y, z = chain.gravity_m_s2
    linear: Vector = (-x, -y, -z)
    turns, moves, forces, moments = [], [], [], []
    for number, body in enumerate(chain.bodies):
        angle = body.dh[1] if body.joint is None else body.dh[1] + q[body.joint]
        turn, move = _link_transform(body.dh, angle, chain.is_modified)
        rate = 0.0 if body.joint is None else speed[body.joint]
        push = 0.0 if body.joint is None else acceleration[body.joint]
        if chain.is_modified:
            linear = _rotate_back(turn, _add(linear, _carried(omega, alpha, move)))
            omega, alpha = _rotate_back(turn, omega), _rotate_back(turn, alpha)
            omega, alpha = _turned(omega, alpha, rate, push)
        else:
            omega, alpha = _turned(omega, alpha, rate, push)
            omega, alpha = _rotate_back(turn, omega), _rotate_back(turn, alpha)
            linear = _add(_rotate_back(turn, linear), _carried(omega, alpha, _rotate_back(turn, move)))
        force, moment = _inertial(body, omega, alpha, linear)
        if number == len(chain.bodies) - 1:
            for mass, place in _carried_masses(chain, payload_kg):
                extra, twist = _inertial(RigidLink(body.dh, None, mass, place, ZERO), omega, alpha, linear)
                force, moment = _add(force, extra), _add(moment, twist)
        turns.append(turn)
        moves.append(move)
        forces.append(force)
        moments.append(moment)
    return turns, moves, forces, moments


def _carried_masses(chain: Chain, payload_kg: Scalar) -> list[tuple[Scalar, Vector3]]:
    """Point masses in the last frame: the payload at the tip, and the tool."""
    tool: list[tuple[Scalar, Vector3]] = [(chain.tool_kg, chain.tool_com_m)] if chain.tool_kg else []
    return [(payload_kg, chain.tool_m), *tool]


def _turned(omega: Vector, alpha: Vector, rate: Scalar, push: Scalar) -> tuple[Vector, Vector]:
    """Add a joint that turns about the frame's z axis at `rate`, with `push` its acceleration."""
    about_z = (0.0, 0.0, rate)
    return _add(omega, about_z), _add(_add(alpha, (0.0, 0.0, push)), _cross(omega, about_z))


def _carried(omega: Vector, alpha: Vector, r: Vector) -> Vector:
    """Return the acceleration at r of a body over that of its origin: alpha x r + omega x (omega x r)."""
    return _add(_cross(alpha, r), _cross(omega, _cross(omega, r)))


def _inertial(body: RigidLink, omega: Vector, alpha: Vector, linear: Vector) -> tuple[Vector, Vector]:
    """Return the force that accelerates a body, and its moment about the body's origin."""
    at_com = _add(linear, _carried(omega, alpha, body.com_m))
    force = _scale(body.mass_kg, at_com)
    spin = _times(body.inertia_kg_m2, omega)
    moment = _add(_times(body.inertia_kg_m2, alpha), _cross(omega, spin))
    return force, _add(moment, _cross(body.com_m, force))


def _link_transform(dh: tuple[float, float, float, float], angle: Scalar, is_modified: bool) -> tuple[list[Vector], Vector]:
    """Return the rows of the rotation to the previous frame, and the origin in it."""
    d, _, length, alpha = dh
    c, s, ca, sa = cos(angle), sin(angle), cos(alpha), sin(alpha)
    if is_modified:
        return [(c, -s, 0.0), (s * ca, c * ca, -sa), (s * sa, c * sa, ca)], (length, -(d * sa), d * ca)
    return [(c, -(s * ca), s * sa), (s, c * ca, -(c * sa)), (0.0, sa, ca)], (length * c, length * s, d)


def _add(a: Vector, b: Vector) -> Vector:
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


def _scale(k: Scalar, a: Vector) -> Vector:
    return k * a[0], k * a[1], k * a[2]


def _times(a: Vector3, b: Vector) -> Vector:
    return a[0] * b[0], a[1] * b[1], a[2] * b[2]


def _cross(a: Vector, b: Vector) -> Vector:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def _rotate(rows: Sequence[Vector], a: Vector) -> Vector:
    x, y, z = (row[0] * a[0] + row[1] * a[1] + row[2] * a[2] for row in rows)
    return x, y, z


def _rotate_back(rows: Sequence[Vector], a: Vector) -> Vector:
    x, y, z = (rows[0][i] * a[0] + rows[1][i] * a[1] + rows[2][i] * a[2] for i in range(3))
    return x, y, z


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
        self.payload_kg = payload_kg
        self.joint_count = arm.joint_count

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Dynamics) and self._numbers == other._numbers

    def __hash__(self) -> int:
        return hash(self._numbers)

    @property
    def _numbers(self) -> tuple[Chain, float]:
        return self._chain, self.payload_kg

    @shared
    def inverse(self) -> Callable[[Sequence[float], Sequence[float], Sequence[float]], Floats]:
        """`inverse(q, speed, acceleration) -> torques` [rad, rad/s, rad/s^2 -> N m at the joints]."""
        q, speed, acceleration = self._symbols()
        torques = inverse_dynamics(self._chain, q, speed, acceleration, self.payload_kg)
        return compile_function("inverse_dynamics", [q, speed, acceleration], tuple(torques))

    @shared
    def gravity(self) -> Callable[[Sequence[float]], Floats]:
        """`gravity(q) -> torques` that hold the arm still [N m]."""
        q, *_ = self._symbols()
        still = [0.0] * self.joint_count
        return compile_function("gravity", [q], tuple(inverse_dynamics(self._chain, q, still, still, self.payload_kg)))

    @shared
    def mass_matrix(self) -> Callable[[Sequence[float]], tuple[Floats, ...]]:
        """`mass_matrix(q) -> n rows` [kg m^2], rotors included."""
        q, *_ = self._symbols()
        return compile_function("mass_matrix", [q], self._mass_rows(q))

    def torques(self, q: ArrayLike, speed: ArrayLike, acceleration: ArrayLike, payload_kg: ArrayLike | None = None) -> Array:
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
        for joint, column in enumerate(inverse_dynamics(self._chain, list(poses.T), still, still, payload)):
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
        torques = inverse_dynamics(self._chain, q, speed, acceleration, payload)
        return compile_function("torques", [q, speed, acceleration, payload], tuple(torques), np)

    def _symbols(self) -> tuple[list[Symbol], list[Symbol], list[Symbol]]:
        graph = Graph()
        numbers = range(1, self.joint_count + 1)
        q, speed, acceleration = ([graph.variable(f"{kind}{i}") for i in numbers] for kind in "qsa")
        return q, speed, acceleration

    def _mass_rows(self, q: Sequence[Scalar]) -> tuple[tuple[Scalar, ...], ...]:
        """Column j is the torque of a unit acceleration of joint j alone, without gravity and speed."""
        n, weightless = self.joint_count, replace(self._chain, gravity_m_s2=ZERO)
        still, units = [0.0] * n, np.eye(n).tolist()
        columns = [inverse_dynamics(weightless, q, still, unit, self.payload_kg) for unit in units]
        return tuple(tuple(columns[max(i, j)][min(i, j)] for j in range(n)) for i in range(n))
