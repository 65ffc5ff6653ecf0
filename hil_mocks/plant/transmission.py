"""Motors, gears and friction of a MuJoCo model: what stands between a drive and its link; and a link
that bends.

With an effect between motor and joint (backlash, compliance, a coupled belt) a motor-side hinge of inertia N^2 Jr is coupled to
the link's by a fixed tendon of motor - link + ratio * q2, all in joint angles. Without such an effect the rotor is the armature
of the link's hinge: exactly rigid, and cheaper.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from hil_mocks.errors import MockError
from hil_mocks.plant.effects import JointEffects, PlantEffects
from hil_mocks.plant.parts import ArmParts, DriveParts, LinkFrame, Matrix

# Hard rows: 0.9999 is MuJoCo's largest impedance; under 10 Nm such a row gives by some 1e-8 rad.
HARD = (0.9999, 0.9999, 0.001, 0.5, 2.0)
_BRISTLE_RAD = 2e-5  # presliding deflection of a LuGre bristle at breakaway; below any encoder's resolution
_BRISTLE_DAMPING_RATIO = 0.5
_LIGHT_LINK = 0.1  # smallest inertia of a link as a share of the reflected rotor's
_ROTOR_BODY_KG = 1e-9  # MuJoCo requires a mass; the effective inertia is the hinge's armature


class Transmissions:
    """Adds the drives of an arm to the specification that has its links."""

    def __init__(self, spec: Any, arm: ArmParts, effects: PlantEffects, timestep_s: float, link_share: float) -> None:
        self._spec, self._arm, self._effects = spec, arm, effects
        self._timestep_s, self._link_share = timestep_s, link_share
        self.bristles: list[list[tuple[str, float]]] = [[] for _ in arm.drives]
        """Per joint the actuators that are bristles, and the share of the friction that each carries."""

    def add(self) -> None:
        """Add gears, then bridges, then friction, each of all joints."""
        for j, drive in enumerate(self._arm.drives):
            self._transmission(j, drive, self._effects.joints[j])
        for j, drive in enumerate(self._arm.drives):
            self._bridge(j, drive, self._effects.joints[j])
        for j in range(len(self._arm.drives)):
            self._friction(j, self._effects.joints[j])

    def _is_rigid(self, j: int, effect: JointEffects) -> bool:
        coupled = j == 2 and self._effects.belt_ratio != 0.0
        return effect.backlash_rad == 0.0 and math.isinf(effect.stiffness_Nm_rad) and not coupled

    def _transmission(self, j: int, drive: DriveParts, effect: JointEffects) -> None:
        inertia = drive.gear_ratio**2 * drive.rotor_inertia_kg_m2
        if self._is_rigid(j, effect):
            self._spec.joint(f"q{j + 1}").armature = inertia
            return
        body = self._spec.worldbody.add_body(
            name=f"motor{j + 1}", mass=_ROTOR_BODY_KG, inertia=[_ROTOR_BODY_KG] * 3, explicitinertial=True
        )
        body.add_joint(name=f"m{j + 1}", type=mujoco.mjtJoint.mjJNT_HINGE, axis=[0.0, 0.0, 1.0], armature=inertia)
        tendon = self._spec.add_tendon(name=f"gear{j + 1}")
        tendon.wrap_joint(f"m{j + 1}", 1.0)
        tendon.wrap_joint(f"q{j + 1}", -1.0)
        if j == 2 and self._effects.belt_ratio != 0.0:
            tendon.wrap_joint("q2", self._effects.belt_ratio)
        self._gear(tendon, effect)

    def _gear(self, tendon: Any, effect: JointEffects) -> None:
        """A spring with backlash as its dead band; backlash with hard flanks; or a rigid coupling."""
        half = 0.5 * effect.backlash_rad
        if math.isfinite(effect.stiffness_Nm_rad):
            tendon.stiffness = [effect.stiffness_Nm_rad, 0.0, 0.0]
            tendon.damping = [effect.damping_Nm_s_rad, 0.0, 0.0]
            tendon.springlength = [-half, half]
        elif half > 0.0:
            tendon.limited = mujoco.mjtLimited.mjLIMITED_TRUE
            tendon.range = [-half, half]
            tendon.solref_limit, tendon.solimp_limit = [2.0 * self._timestep_s, 1.0], HARD
        else:
            row = self._spec.add_equality(type=mujoco.mjtEq.mjEQ_TENDON, objtype=mujoco.mjtObj.mjOBJ_TENDON, name1=tendon.name)
            row.solref, row.solimp = [2.0 * self._timestep_s, 1.0], HARD

    def motor_hinge(self, j: int) -> str:
        return f"q{j + 1}" if self._is_rigid(j, self._effects.joints[j]) else f"m{j + 1}"

    def _bridge(self, j: int, drive: DriveParts, effect: JointEffects) -> None:
        """The motor, referred to the joint: K = N kt in Nm/A and V s/rad; one state, the current."""
        K = drive.gear_ratio * drive.torque_constant_Nm_A * effect.torque_constant_scale
        actuator = self._add_actuator(f"bridge{j + 1}", self.motor_hinge(j))
        actuator.set_to_dcmotor(
            [K, K],
            drive.resistance_ohm,
            inductance=[drive.inductance_H, 0.0],
            # The effect is what the motor has to add; the magnets act the other way.
            cogging=[-effect.cogging_Nm, effect.cogging_order * drive.gear_ratio, effect.cogging_phase_rad],
        )
        actuator.actearly = True  # torque of the current at the step's end: second order instead of first

    def _add_actuator(self, name: str, hinge: str) -> Any:
        return self._spec.add_actuator(name=name, target=hinge, trntype=mujoco.mjtTrn.mjTRN_JOINT)

    def _friction(self, j: int, effect: JointEffects) -> None:
        """Coulomb friction as a hard row, viscous as damping; a falling (Stribeck) law as a native LuGre bristle."""
        for hinge, share in self.friction_shares(j):
            joint = self._spec.joint(hinge)
            joint.damping = [effect.viscous_Nm_s_rad * share, 0.0, 0.0]
            if effect.stribeck_Nm > 0.0:
                self._bristle(j, hinge, share, effect)
            else:
                joint.frictionloss = effect.coulomb_Nm * share
                # The row must exist so that load can raise it later.
                if effect.load_fraction > 0.0 and effect.coulomb_Nm == 0.0:
                    joint.frictionloss = 1e-6
                joint.solref_friction, joint.solimp_friction = [2.0 * self._timestep_s, 1.0], HARD

    def friction_shares(self, j: int) -> tuple[tuple[str, float], ...]:
        motor, link = self.motor_hinge(j), f"q{j + 1}"
        if motor == link:
            return ((link, 1.0),)
        return ((motor, 1.0 - self._link_share), (link, self._link_share))

    def _bristle(self, j: int, hinge: str, share: float, effect: JointEffects) -> None:
        if share <= 0.0:
            return
        static_Nm = (effect.coulomb_Nm + effect.stribeck_Nm) * share
        drive = self._arm.drives[j]
        inertia = drive.gear_ratio**2 * drive.rotor_inertia_kg_m2
        if hinge.startswith("q") and hinge != self.motor_hinge(j):
            inertia *= _LIGHT_LINK
        # An explicit bristle is stable while omega h stays below about 1; half of that keeps its response clean.
        stiffness = min(static_Nm / _BRISTLE_RAD, inertia * (0.5 / self._timestep_s) ** 2)
        damping = 2.0 * _BRISTLE_DAMPING_RATIO * math.sqrt(stiffness * inertia)
        name = f"bristle_{hinge}"
        actuator = self._add_actuator(name, hinge)
        actuator.set_to_dcmotor(
            [1e-12, 1e-12],
            1e12,  # a motor that carries no current: only its friction is wanted
            lugre=[stiffness, damping, effect.coulomb_Nm * share, static_Nm, effect.stribeck_speed_rad_s],
        )
        actuator.actearly = True
        self.bristles[j].append((name, share))


# A link that bends: the effect `link_flexure`, as a stiff joint in the middle of the link.
#
# Euler-Bernoulli cantilever of length L and bending stiffness EI, the same in both planes, with a transverse force F and a
# moment M at its end: it deflects there by F L^3/(3 EI) + M L^2/(2 EI) and turns by F L^2/(2 EI) + M L/(EI). Seen from the
# middle, where the moment is M + F L/2, the two decouple: the far half turns by (M + F L/2) / (EI/L), and its middle deflects
# by F / (12 EI/L^3). So two hinges of EI/L and two slides of 12 EI/L^3, across the beam at its middle, are the cantilever
# exactly, for small deflections. Along and about its axis the beam is rigid.
#
# The link's own mass m at a distance a from the root (F = m g across) bends it by F a^2 (3 L - a)/(6 EI) and F a^2/(2 EI) at
# the end. So does the part m a^2/(2 L (b - L/2)) of it that rides on the far half, at b = L (2 L - a)/(3 L - 2 a) from the
# root; the rest stays on the near half, where it keeps the centre of mass.

LOSS_S = 2e-4  # damping over stiffness: 2 % of critical at 30 Hz, as of a bolted aluminium link
_SHORTEST_M = 0.01
_LEAST_INERTIA_kg_m2 = 1e-6


@dataclass(frozen=True, slots=True)
class PointMass:
    """A part of a link's mass and its position in the link's frame."""

    mass_kg: float
    place_m: Matrix


@dataclass(frozen=True, slots=True)
class Beam:
    """A bending link in its own frame: its middle, two transverse axes, and the stiffness of its joints."""

    middle_m: Matrix  # (3,)
    across: tuple[Matrix, Matrix]
    length_m: float
    root_m: Matrix
    along: Matrix
    EI_Nm2: float

    @property
    def hinge_Nm_rad(self) -> float:
        """Stiffness of each hinge."""
        return self.EI_Nm2 / self.length_m

    @property
    def slide_N_m(self) -> float:
        """Stiffness of each slide."""
        return 12.0 * self.EI_Nm2 / self.length_m**3


def beam(root_m: Matrix, end_m: Matrix, EI_Nm2: float, where: str) -> Beam:
    """The beam between two points of a link's frame. MockError if they are too close."""
    way = end_m - root_m
    length = float(np.linalg.norm(way))
    if length < _SHORTEST_M:
        raise MockError(f"{where}: link_flexure bends {length:.4f} m of link; at least {_SHORTEST_M} m are needed.")
    along = way / length
    helper = np.eye(3)[int(np.argmin(np.abs(along)))]
    first = np.cross(along, helper)
    first /= np.linalg.norm(first)
    across = (first, np.cross(along, first))
    return Beam(root_m + 0.5 * way, across, length, root_m, along, EI_Nm2)


def ends_of(
    i: int, frames: Sequence[LinkFrame], is_revolute: Sequence[bool], is_standard: bool, tool_m: Matrix
) -> tuple[Matrix, Matrix]:
    """Ends of bending link i in its own frame: its joint, and the next one or the tip, including fixed links between.

    `frames` of all links in their parents'. By the standard convention a link's joint is at its parent's origin, by the modified
    one at its own.
    """
    is_at_origin = is_revolute[i] and not is_standard
    root_m = np.zeros(3) if is_at_origin else -frames[i].rotation.T @ frames[i].position_m
    end_m, rotation = np.zeros(3), np.eye(3)
    for frame, is_joint in zip(frames[i + 1 :], is_revolute[i + 1 :], strict=True):
        if is_joint and is_standard:
            return root_m, end_m
        end_m = end_m + rotation @ frame.position_m
        if is_joint:
            return root_m, end_m
        rotation = rotation @ frame.rotation
    return root_m, end_m + rotation @ tool_m


def split_mass(of: Beam, mass_kg: float, com_m: Matrix) -> tuple[PointMass, PointMass]:
    """A link's own mass as two points, on the near and on the far half of its beam, with the same centre of mass."""
    L = of.length_m
    offset = com_m - of.root_m
    a = min(max(float(offset @ of.along), 0.0), L)
    aside = offset - a * of.along
    b = L * (2.0 * L - a) / (3.0 * L - 2.0 * a)
    far_kg = mass_kg * a**2 / (2.0 * L * (b - 0.5 * L))
    near_kg = mass_kg - far_kg
    near_at = (mass_kg * a - far_kg * b) / near_kg if near_kg > 1e-12 else 0.0
    near, far = (of.root_m + at * of.along + aside for at in (near_at, b))
    return PointMass(near_kg, near), PointMass(far_kg, far)


def remaining_inertia(inertia_kg_m2: Matrix, com_m: Matrix, parts: tuple[PointMass, PointMass]) -> Matrix:
    """Remaining principal inertia (3,) of a link after subtracting that of its two mass points."""
    remaining_kg_m2: Matrix = np.array(inertia_kg_m2, dtype=float)
    for part in parts:
        r = part.place_m - com_m
        remaining_kg_m2 -= part.mass_kg * (float(r @ r) - r**2)
    least: Matrix = np.maximum(remaining_kg_m2, _LEAST_INERTIA_kg_m2)
    return least
