"""Effects of a real arm as plant parameters: names and parameters as in the table of effects (docs/mock_robot.md).

Independent of control.model.effects on purpose, so that a hidden effect does not mirror the model that has to find it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import mujoco
import numpy as np

from hil_mocks.errors import ScenarioError

# Pose of the arm's base in the world of camera, table and hand: the effect `base_frame`.
#
# The world is the frame of table and camera; the effect is its pose in the arm's base frame: an origin and a rotation
# vector. The physics runs in the base frame, with the gravity of arm.toml; camera and hand use this conversion.

Point = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class BasePose:
    """The world's frame in the arm's base frame; the default is an arm at its nominal base pose."""

    origin_m: Point = (0.0, 0.0, 0.0)
    turn_rad: Point = (0.0, 0.0, 0.0)

    @property
    def is_nominal(self) -> bool:
        """Whether base frame and world are the same."""
        return not any((*self.origin_m, *self.turn_rad))

    def in_world(self, base_m: Sequence[float]) -> Point:
        """Convert a point of the base frame to the world."""
        shifted = np.subtract(base_m, self.origin_m)
        return self._turned(shifted, -1.0)

    def in_base(self, world_m: Sequence[float]) -> Point:
        """Convert a point of the world to the base frame."""
        return _point(np.add(self._turned(np.asarray(world_m, dtype=float), 1.0), self.origin_m))

    def _turned(self, vector: np.ndarray, sense: float) -> Point:
        angle_rad = float(np.linalg.norm(self.turn_rad))
        quaternion, turned = np.zeros(4), np.zeros(3)
        axis = np.array(self.turn_rad) / angle_rad if angle_rad > 0.0 else np.array([0.0, 0.0, 1.0])
        mujoco.mju_axisAngle2Quat(quaternion, axis, sense * angle_rad)
        mujoco.mju_rotVecQuat(turned, vector, quaternion)
        return _point(turned)


NOMINAL: Final = BasePose()


def _point(values: np.ndarray) -> Point:
    x, y, z = values.tolist()
    return x, y, z


@dataclass(frozen=True, slots=True)
class EffectEntry:
    """One `[[effect]]`: its name, its joint or link (1-based, 0: none), its parameters in SI units."""

    effect: str
    joint: int
    parameters: Mapping[str, float]


@dataclass(frozen=True, slots=True)
class JointEffects:
    """Effects of one drive and joint. Torques at the joint, angles joint angles."""

    backlash_rad: float = 0.0
    stiffness_Nm_rad: float = math.inf
    damping_Nm_s_rad: float = 0.0
    coulomb_Nm: float = 0.0
    asymmetry_Nm: float = 0.0
    viscous_Nm_s_rad: float = 0.0
    stribeck_Nm: float = 0.0
    stribeck_speed_rad_s: float = 0.0
    load_fraction: float = 0.0
    cogging_Nm: float = 0.0
    cogging_order: float = 0.0
    cogging_phase_rad: float = 0.0
    torque_constant_scale: float = 1.0
    encoder_scale: float = 0.0
    eccentricity_rad: float = 0.0
    eccentricity_phase_rad: float = 0.0
    drift_rad: float = 0.0
    drift_time_constant_s: float = 1.0


@dataclass(frozen=True, slots=True)
class PlantEffects:
    """All effects of a plant. `link_mass_kg` and `link_inertia_kg_m2` are beyond nominal, by 0-based link."""

    joints: tuple[JointEffects, ...]
    belt_ratio: float = 0.0
    payload_kg: float = 0.0
    command_delay_s: float = 0.0
    supply_resistance_ohm: float = 0.0
    link_mass_kg: Mapping[int, float] = field(default_factory=dict)
    link_inertia_kg_m2: Mapping[int, float] = field(default_factory=dict)
    dh_deviation: Mapping[tuple[int, str], float] = field(default_factory=dict)  # (0-based link, DH key)
    link_EI_Nm2: Mapping[int, float] = field(default_factory=dict)  # of 0-based links that bend
    base_pose: BasePose = NOMINAL


# Effect of a joint -> {parameter of the file: field of JointEffects}. A parameter in OPTIONAL may be absent.
_OF_JOINT: dict[str, dict[str, str]] = {
    "encoder_scale": {"scale": "encoder_scale"},
    "encoder_eccentricity": {"amplitude_rad": "eccentricity_rad", "phase_rad": "eccentricity_phase_rad"},
    "backlash": {"width_rad": "backlash_rad"},
    "joint_compliance": {"stiffness_Nm_rad": "stiffness_Nm_rad", "damping_Nm_s_rad": "damping_Nm_s_rad"},
    "thermal_drift": {"final_rad": "drift_rad", "time_constant_s": "drift_time_constant_s"},
    "coulomb_friction": {"torque_Nm": "coulomb_Nm"},
    "viscous_friction": {"coefficient_Nm_s_rad": "viscous_Nm_s_rad"},
    "stribeck_friction": {"torque_Nm": "stribeck_Nm", "speed_rad_s": "stribeck_speed_rad_s"},
    "load_friction": {"fraction": "load_fraction"},
    "asymmetric_friction": {"torque_Nm": "asymmetry_Nm"},
    "cogging": {"amplitude_Nm": "cogging_Nm", "order": "cogging_order", "phase_rad": "cogging_phase_rad"},
    "torque_constant": {"scale": "torque_constant_scale"},
}
_OF_ARM: dict[str, dict[str, str]] = {
    "belt_coupling": {"ratio": "belt_ratio"},
    "payload": {"mass_kg": "payload_kg"},
    "command_delay": {"delay_s": "command_delay_s"},
    "supply_sag": {"resistance_ohm": "supply_resistance_ohm"},
}
_OPTIONAL = {"damping_Nm_s_rad"}
_POSITIVE = {"EI_Nm2", "stiffness_Nm_rad", "time_constant_s", "speed_rad_s", "order"}
_NOT_NEGATIVE = {"width_rad", "torque_Nm", "coefficient_Nm_s_rad", "fraction", "amplitude_Nm", "delay_s", "resistance_ohm"}
_BASE_FRAME = ("x_m", "y_m", "z_m", "rx_rad", "ry_rad", "rz_rad")
KNOWN = (*_OF_JOINT, *_OF_ARM, "link_geometry", "link_inertia", "link_flexure", "base_frame")


def gather(entries: Sequence[EffectEntry], joints: int, links: int, where: str) -> PlantEffects:
    """Convert all entries; the later of two entries of the same effect and joint counts.

    Raises ScenarioError for invalid entries; `where` names the file.
    """
    effects = PlantEffects(joints=(JointEffects(),) * joints)
    for entry in entries:
        effects = _add(effects, entry, joints, links, f'{where}: effect "{entry.effect}"')
    return effects


def _add(effects: PlantEffects, entry: EffectEntry, joints: int, links: int, where: str) -> PlantEffects:
    name = entry.effect
    if name in _OF_JOINT:
        _check_index(entry.joint, joints, "joint", where)
        values = _renamed(entry, _OF_JOINT[name], where)
        at = entry.joint - 1
        changed = replace(effects.joints[at], **values)
        return replace(effects, joints=(*effects.joints[:at], changed, *effects.joints[at + 1 :]))
    if name in _OF_ARM:
        if name == "belt_coupling" and joints < 3:
            raise ScenarioError(f"{where}: couples joint 3 to joint 2, but the arm has {joints} joints.")
        (value,) = _renamed(entry, _OF_ARM[name], where).values()
        return _with_of_arm(effects, name, value)
    if name == "link_inertia":
        return _add_inertia(effects, entry, links, where)
    if name == "link_geometry":
        return replace(effects, dh_deviation={**effects.dh_deviation, **deviations(entry.parameters, links, where)})
    if name == "link_flexure":
        _check_index(entry.joint, links, "link", where)
        (EI_Nm2,) = _renamed(entry, {"EI_Nm2": "EI_Nm2"}, where).values()
        return replace(effects, link_EI_Nm2={**effects.link_EI_Nm2, entry.joint - 1: EI_Nm2})
    if name == "base_frame":
        return replace(effects, base_pose=_base_pose(entry, where))
    raise ScenarioError(f"{where} is unknown; known are {', '.join(sorted(KNOWN))}.")


def _base_pose(entry: EffectEntry, where: str) -> BasePose:
    """Pose of the world in the base frame; missing parameters are 0."""
    given = {**dict.fromkeys(_BASE_FRAME, 0.0), **entry.parameters}
    checked = _renamed(EffectEntry(entry.effect, 0, given), {key: key for key in _BASE_FRAME}, where)
    x, y, z, rx, ry, rz = (checked[key] for key in _BASE_FRAME)
    return BasePose((x, y, z), (rx, ry, rz))


def _with_of_arm(effects: PlantEffects, name: str, value: float) -> PlantEffects:
    match name:
        case "belt_coupling":
            return replace(effects, belt_ratio=value)
        case "payload":
            return replace(effects, payload_kg=value)
        case "command_delay":
            return replace(effects, command_delay_s=value)
        case _:
            return replace(effects, supply_resistance_ohm=value)


def _check_index(index: int, count: int, what: str, where: str) -> None:
    if not 1 <= index <= count:
        raise ScenarioError(f"{where}: joint must be a {what} number 1 to {count}, got {index}.")


def _renamed(entry: EffectEntry, names: Mapping[str, str], where: str) -> dict[str, float]:
    """The checked parameters of an entry by the plant's field names."""
    for key in entry.parameters:
        if key not in names:
            raise ScenarioError(f'{where}: unknown parameter "{key}"; expected {", ".join(names)}.')
    for key in names:
        if key not in entry.parameters and key not in _OPTIONAL:
            raise ScenarioError(f'{where}: parameter "{key}" is missing.')
    return {names[key]: _checked(key, value, where) for key, value in entry.parameters.items()}


def _checked(key: str, value: float, where: str) -> float:
    if not math.isfinite(value):
        raise ScenarioError(f'{where}: parameter "{key}" must be finite, got {value}.')
    if (key in _POSITIVE and value <= 0.0) or (key in _NOT_NEGATIVE and value < 0.0):
        raise ScenarioError(f'{where}: parameter "{key}" must be positive, or 0 where allowed, got {value:g}.')
    return float(value)


def _add_inertia(effects: PlantEffects, entry: EffectEntry, links: int, where: str) -> PlantEffects:
    _check_index(entry.joint, links, "link", where)
    if not entry.parameters or not set(entry.parameters) <= {"mass_kg", "inertia_kg_m2"}:
        raise ScenarioError(f"{where}: expected mass_kg or inertia_kg_m2, got {', '.join(entry.parameters) or 'nothing'}.")
    at = entry.joint - 1
    mass, inertia = dict(effects.link_mass_kg), dict(effects.link_inertia_kg_m2)
    mass[at] = float(entry.parameters.get("mass_kg", 0.0))
    inertia[at] = float(entry.parameters.get("inertia_kg_m2", 0.0))
    return replace(effects, link_mass_kg=mass, link_inertia_kg_m2=inertia)


def deviations(values: Mapping[str, float], links: int, where: str) -> dict[tuple[int, str], float]:
    """`link{i}_d_m`, `link{i}_theta_rad`, `link{i}_L_m`, `link{i}_alpha_rad` as {(0-based link, DH key): value}."""
    names = {f"link{i + 1}_{key}": (i, key) for i in range(links) for key in ("d_m", "theta_rad", "L_m", "alpha_rad")}
    for name in values:
        if name not in names:
            raise ScenarioError(f'{where}: unknown DH deviation "{name}"; expected link1_d_m to link{links}_alpha_rad.')
    return {names[name]: float(value) for name, value in values.items()}
