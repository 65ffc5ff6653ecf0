"""Hidden effects of the score's plants: listed and unlisted ones, with their sizes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

NAMES_TEXT = (
    "J K R L C V Fs vs load asym cog_A cog_n cog_phi k d w scale enc_scale ecc_A ecc_phi belt counts ratio"
    " drag cubic res spring posf warm soft mesh_A mesh_n ripple ripple_n dead droop driving sector sector_at"
    " cable cable_at ind"
)
NUMBERS = tuple(NAMES_TEXT.split())
LISTED_BY_JOINT = (
    "coulomb_friction",
    "viscous_friction",
    "stribeck_friction",
    "load_friction",
    "asymmetric_friction",
    "cogging",
    "torque_constant",
    "link_inertia",
    "joint_compliance",
    "backlash",
    "encoder_eccentricity",
    "encoder_scale",
    "thermal_drift",
)
LISTED = ("command_delay", "supply_sag", "payload", "belt_coupling", "link_geometry", "base_frame")
FOREIGN = (
    "drag",
    "cubic",
    "resistance",
    "spring",
    "position_friction",
    "warming",
    "slip",
    "presliding",
    "gear_ripple",
    "torque_ripple",
    "dead_time",
    "sensor_gain",
    "sensor_curve",
    "torque_droop",
    "driving_friction",
    "sector_friction",
    "cable",
    "inductance",
    "tooth_ripple",
    "camera_delay",
    "time_jitter",
)


@dataclass(slots=True)
class Hidden:
    """One case's plant beyond its file: parameters (n,) by name, whole-arm values, and what cameras and sensors do."""

    joints: dict[str, Array]
    whole: dict[str, float] = field(default_factory=dict)
    after: list[tuple[str, int, dict[str, float]]] = field(default_factory=list)
    mass_kg: dict[int, float] = field(default_factory=dict)
    inertia_kg_m2: dict[int, float] = field(default_factory=dict)
    torque_share: float = 1.0  # of the reference arm's torques


def nominal(drives: list[Mapping[str, float]], rng: np.random.Generator, share: float) -> dict[str, Array]:
    """Parameters of the joints without anything hidden; friction as the arm's file will say."""
    n = len(drives)
    p = {name: np.zeros(n) for name in NUMBERS}
    for drive in drives:
        j, ratio = int(drive["joint"]) - 1, drive["gear_ratio"]
        p["J"][j], p["K"][j] = ratio**2 * drive["rotor_inertia_kg_m2"], ratio * drive["torque_constant_Nm_A"]
        p["R"][j], p["L"][j] = drive["resistance_ohm"], drive["inductance_H"]
        p["ratio"][j], p["counts"][j] = ratio, drive["encoder_counts_per_rev"]
    p["vs"][:] = 0.05
    p["C"], p["V"] = share * rng.uniform(0.4, 0.9, n), share * rng.uniform(0.3, 0.9, n)
    return p


def hide(effect: str, joint: int, rng: np.random.Generator, hidden: Hidden, size: float) -> dict[str, object]:
    """Add an effect, `size` times its usual size; return its entry for truth.json."""
    make = _MAKERS.get(effect)
    if make is None:
        raise SystemExit(f"unknown effect {effect}: expected one of {', '.join(_MAKERS)}")
    return {"effect": effect, "joint": joint, "parameters": make(hidden, joint - 1, rng, size)}


Maker = Callable[[Hidden, int, np.random.Generator, float], dict[str, float]]


def _sign(rng: np.random.Generator) -> float:
    return float(rng.choice([-1.0, 1.0]))


def _joint(name: str, key: str, low: float, high: float, signed: bool = False, torque: bool = False) -> Maker:
    """A plain parameter of a joint; torques are shares of what the arm's drives can do."""

    def make(hidden: Hidden, j: int, rng: np.random.Generator, size: float) -> dict[str, float]:
        value = size * rng.uniform(low, high) * (_sign(rng) if signed else 1.0)
        value *= hidden.torque_share if torque else 1.0
        hidden.joints[name][j] += value
        return {key: value}

    return make


def _whole(name: str, key: str, low: float, high: float) -> Maker:
    def make(hidden: Hidden, j: int, rng: np.random.Generator, size: float) -> dict[str, float]:
        hidden.whole[name] = size * rng.uniform(low, high)
        return {key: hidden.whole[name]}

    return make


def _after(kind: str, **ranges: tuple[float, float]) -> Maker:
    """Effects of camera or sensors only; the first range is the size."""

    def make(hidden: Hidden, j: int, rng: np.random.Generator, size: float) -> dict[str, float]:
        values = {name: rng.uniform(*span) for name, span in ranges.items()}
        values[next(iter(ranges))] *= size
        hidden.after.append((kind, j, values))
        return values

    return make


def _stribeck(hidden: Hidden, j: int, rng: np.random.Generator, size: float) -> dict[str, float]:
    hidden.joints["Fs"][j] = torque = size * hidden.torque_share * rng.uniform(0.4, 1.5)
    hidden.joints["vs"][j] = speed = rng.uniform(0.025, 0.09)
    return {"torque_Nm": torque, "speed_rad_s": speed}


def _cogging(hidden: Hidden, j: int, rng: np.random.Generator, size: float) -> dict[str, float]:
    amplitude, order = size * hidden.torque_share * rng.uniform(0.2, 1.2), float(rng.integers(4, 15))
    phase = rng.uniform(-3.0, 3.0)
    for name, value in (("cog_A", amplitude), ("cog_n", order), ("cog_phi", phase)):
        hidden.joints[name][j] = value
    return {"amplitude_Nm": amplitude, "order": order, "phase_rad": phase}


def _torque_constant(hidden: Hidden, j: int, rng: np.random.Generator, size: float) -> dict[str, float]:
    hidden.joints["scale"][j] = value = size * _sign(rng) * rng.uniform(0.04, 0.15)
    return {"scale": 1.0 + value}


def _inertia(hidden: Hidden, j: int, rng: np.random.Generator, size: float) -> dict[str, float]:
    # For a vertical first joint only the link's inertia is observable, not its mass.
    if j == 0 or rng.uniform() < 0.5:
        hidden.inertia_kg_m2[j] = value = size * hidden.torque_share * rng.uniform(0.015, 0.05)
        return {"inertia_kg_m2": value}
    hidden.mass_kg[j] = value = size * hidden.torque_share * rng.uniform(0.1, 0.4)
    return {"mass_kg": value}


def _compliance(hidden: Hidden, j: int, rng: np.random.Generator, size: float) -> dict[str, float]:
    hidden.joints["k"][j] = value = hidden.torque_share * rng.uniform(150.0, 900.0) / size
    hidden.joints["d"][j] = hidden.torque_share * rng.uniform(0.4, 1.5)
    return {"stiffness_Nm_rad": value}


def _eccentricity(hidden: Hidden, j: int, rng: np.random.Generator, size: float) -> dict[str, float]:
    hidden.joints["ecc_A"][j] = amplitude = size * rng.uniform(0.002, 0.008)
    hidden.joints["ecc_phi"][j] = phase = rng.uniform(-3.0, 3.0)
    return {"amplitude_rad": amplitude, "phase_rad": phase}


def _belt(hidden: Hidden, j: int, rng: np.random.Generator, size: float) -> dict[str, float]:
    hidden.joints["belt"][2] = value = size * _sign(rng) * rng.uniform(0.004, 0.015)
    return {"ratio": value}


def _geometry(hidden: Hidden, j: int, rng: np.random.Generator, size: float) -> dict[str, float]:
    values = {f"link{j + 1}_L_m": size * _sign(rng) * rng.uniform(0.001, 0.003)}
    hidden.after.append(("link_geometry", j, {"L_m": next(iter(values.values()))}))
    return values


def _ripple(hidden: Hidden, j: int, rng: np.random.Generator, size: float) -> dict[str, float]:
    hidden.joints["ripple"][j] = value = size * rng.uniform(0.03, 0.1)
    hidden.joints["ripple_n"][j] = float(rng.integers(3, 12))
    return {"share": value}


def _mesh(hidden: Hidden, j: int, rng: np.random.Generator, size: float) -> dict[str, float]:
    """Teeth of a later gear stage: locked to the joint, but to no whole number per motor turn."""
    hidden.joints["mesh_A"][j] = value = size * hidden.torque_share * rng.uniform(0.2, 0.8)
    hidden.joints["mesh_n"][j] = rng.uniform(20.3, 70.7)
    return {"amplitude_Nm": value}


def _sector(hidden: Hidden, j: int, rng: np.random.Generator, size: float) -> dict[str, float]:
    hidden.joints["sector"][j] = value = size * hidden.torque_share * rng.uniform(0.3, 1.0)
    hidden.joints["sector_at"][j] = (0.0, -0.6, 0.1)[j] + rng.uniform(-0.15, 0.15)
    return {"torque_Nm": value}


def _cable(hidden: Hidden, j: int, rng: np.random.Generator, size: float) -> dict[str, float]:
    hidden.joints["cable"][j] = value = size * hidden.torque_share * rng.uniform(1.0, 4.0)
    hidden.joints["cable_at"][j] = (0.0, -0.6, 0.1)[j] + rng.uniform(-0.1, 0.2)
    return {"stiffness": value}


def _presliding(hidden: Hidden, j: int, rng: np.random.Generator, size: float) -> dict[str, float]:
    """Friction that builds up over milliradians: hysteresis at every reversal, Coulomb's at speed."""
    hidden.joints["soft"][j] = value = rng.uniform(40.0, 200.0) * hidden.torque_share / size
    return {"stiffness": value}


_MAKERS: dict[str, Maker] = {
    "coulomb_friction": _joint("C", "torque_Nm", 0.15, 0.8, torque=True),
    "viscous_friction": _joint("V", "coefficient_Nm_s_rad", 0.2, 1.2, torque=True),
    "stribeck_friction": _stribeck,
    "load_friction": _joint("load", "fraction", 0.06, 0.3),
    "asymmetric_friction": _joint("asym", "torque_Nm", 0.1, 0.4, signed=True, torque=True),
    "cogging": _cogging,
    "torque_constant": _torque_constant,
    "link_inertia": _inertia,
    "joint_compliance": _compliance,
    "backlash": _joint("w", "width_rad", 0.004, 0.02),
    "encoder_eccentricity": _eccentricity,
    "encoder_scale": _joint("enc_scale", "scale", 0.003, 0.012, signed=True),
    "thermal_drift": _after("thermal_drift", final_rad=(0.002, 0.008), time_constant_s=(1.0, 4.0)),
    "command_delay": _whole("delay", "delay_s", 0.0008, 0.004),
    "supply_sag": _whole("sag", "resistance_ohm", 0.05, 0.4),
    "payload": _whole("payload", "mass_kg", 0.05, 0.3),
    "belt_coupling": _belt,
    "link_geometry": _geometry,
    "base_frame": _after("base_frame", x_m=(0.001, 0.004), ry_rad=(0.001, 0.004)),
    "drag": _joint("drag", "coefficient", 0.4, 2.5, torque=True),
    "cubic": _joint("cubic", "coefficient", 0.3, 1.5, torque=True),
    "resistance": _joint("res", "share", 0.1, 0.4),
    "spring": _joint("spring", "stiffness", 0.5, 2.0, torque=True),
    "position_friction": _joint("posf", "torque", 0.3, 1.0, torque=True),
    "warming": _joint("warm", "torque", 0.2, 0.8, torque=True),
    "slip": _after("slip", angle_rad=(0.003, 0.01)),
    "presliding": _presliding,
    "gear_ripple": _mesh,
    "torque_ripple": _ripple,
    "dead_time": _joint("dead", "voltage_V", 0.1, 0.5),
    "sensor_gain": _after("sensor_gain", share=(0.04, 0.15)),
    "sensor_curve": _after("sensor_curve", cubic=(0.003, 0.02)),
    "torque_droop": _joint("droop", "share_per_A", 0.01, 0.04),
    "driving_friction": _joint("driving", "fraction", 0.1, 0.3),
    "sector_friction": _sector,
    "cable": _cable,
    "inductance": _joint("ind", "share", 2.0, 6.0),
    "tooth_ripple": _after("tooth_ripple", amplitude_rad=(0.001, 0.004), order=(8.0, 30.0)),
    "camera_delay": _after("camera_delay", delay_s=(0.004, 0.015)),
    "time_jitter": _after("time_jitter", share=(0.1, 0.3)),
}
