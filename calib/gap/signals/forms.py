"""Forms of the effects: from a file's parameters to a term's values and back, with standard deviations."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from calib.arrays import Array
from calib.gap.finding import EffectName
from calib.gap.signals.terms import Term
from control.model.arm import Arm

PLAIN = {
    "coulomb_friction": "torque_Nm",
    "viscous_friction": "coefficient_Nm_s_rad",
    "load_friction": "fraction",
    "asymmetric_friction": "torque_Nm",
    "command_delay": "delay_s",
    "supply_sag": "resistance_ohm",
    "payload": "mass_kg",
    "backlash": "width_rad",
    "encoder_scale": "scale",
    "belt_coupling": "ratio",
}


def known_terms(arm: Arm) -> tuple[Term, ...]:
    """What the arm's file already has and what shows in time series."""
    terms = (from_file(EffectName(e.effect, e.joint), e.parameters) for e in arm.effects)
    return tuple(term for term in terms if term is not None)


def from_file(name: EffectName, given: Mapping[str, float]) -> Term | None:
    """The term of an `[[effect]]`; None for one that time series do not show."""
    effect = name.effect
    if effect == "backlash":
        return Term(name, effect, (given["width_rad"], 0.0))
    if effect in PLAIN:
        return Term(name, effect, (given[PLAIN[effect]],))
    if effect == "stribeck_friction":
        return Term(name, effect, (given["torque_Nm"], given["speed_rad_s"]))
    if effect == "cogging":
        amplitude, phase = given["amplitude_Nm"], given["phase_rad"]
        values = (amplitude * math.cos(phase), amplitude * math.sin(phase))
        return Term(name, effect, values, given["order"])
    if effect == "torque_constant":
        return Term(name, effect, (given["scale"] - 1.0,))
    if effect == "joint_compliance":
        stiffness = given["stiffness_Nm_rad"]
        return Term(name, effect, (1.0 / stiffness, given.get("damping_Nm_s_rad", 0.0), 0.0))
    if effect == "link_flexure":
        return Term(name, effect, (1.0 / given["EI_Nm2"],))
    if effect == "encoder_eccentricity":
        amplitude, phase = given["amplitude_rad"], given["phase_rad"]
        return Term(name, effect, (amplitude * math.cos(phase), amplitude * math.sin(phase)))
    if effect == "thermal_drift" and name.joint is not None:
        return Term(name, effect, (given["final_rad"], given["time_constant_s"]))
    if effect == "link_inertia":
        key = "mass_kg" if "mass_kg" in given else "inertia_kg_m2"
        return Term(name, key, (given[key],))
    return None


def parameters(term: Term, covariance: Array) -> dict[str, tuple[float, float]]:
    """A term's values as the file's parameters, each with its standard deviation."""
    effect, v = term.name.effect, term.values
    sd = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    if effect in PLAIN:
        return {PLAIN[effect]: (v[0], float(sd[0]))}
    if effect == "stribeck_friction":
        return {"torque_Nm": (v[0], float(sd[0])), "speed_rad_s": (v[1], float(sd[1]))}
    if effect in ("cogging", "encoder_eccentricity"):
        return _amplitude(term, covariance)
    if effect == "thermal_drift":
        return {"final_rad": (v[0], float(sd[0])), "time_constant_s": (v[1], float(sd[1]))}
    if effect == "torque_constant":
        return {"scale": (1.0 + v[0], float(sd[0]))}
    if effect == "joint_compliance":
        stiffness = 1.0 / v[0]
        found = {"stiffness_Nm_rad": (stiffness, float(sd[0]) * stiffness**2)}
        if len(v) > 1 and len(sd) > 1 and v[1] > 2.0 * sd[1]:
            found["damping_Nm_s_rad"] = (v[1], float(sd[1]))
        return found
    if effect == "link_flexure":
        return {"EI_Nm2": (1.0 / v[0], float(sd[0]) / v[0] ** 2)}
    if effect == "link_inertia":
        return {term.form: (v[0], float(sd[0]))}
    if effect == "base_frame":
        names = ("x_m", "y_m", "z_m", "rx_rad", "ry_rad", "rz_rad")
        return {name: (v[k], float(sd[k])) for k, name in enumerate(names)}
    if effect == "link_geometry":
        keys = ("d_m", "theta_rad", "L_m", "alpha_rad")
        named = {f"link{k // 4 + 1}_{keys[k % 4]}": (v[k], float(sd[k])) for k in range(len(v))}
        return {name: value for name, value in named.items() if value[0] != 0.0}
    return {f"value{k + 1}": (value, float(sd[k])) for k, value in enumerate(v)}


def _amplitude(term: Term, covariance: Array) -> dict[str, tuple[float, float]]:
    """A sin(x + phase) = c sin(x) + s cos(x) with c = A cos(phase), s = A sin(phase)."""
    c, s = term.values
    amplitude = math.hypot(c, s)
    unit = np.array([c, s]) / max(amplitude, 1e-30)
    across = np.array([-s, c]) / max(amplitude, 1e-30) ** 2
    sd_a = math.sqrt(max(float(unit @ covariance @ unit), 0.0))
    sd_p = math.sqrt(max(float(across @ covariance @ across), 0.0))
    phase = math.atan2(s, c)
    if term.name.effect == "cogging":
        return {
            "amplitude_Nm": (amplitude, sd_a),
            "order": (term.order, 0.0),
            "phase_rad": (phase, sd_p),
        }
    return {"amplitude_rad": (amplitude, sd_a), "phase_rad": (phase, sd_p)}
