"""The effect hidden by `armwright demo gap`: effect, joint and size, drawn by a seed or chosen."""

from __future__ import annotations

import dataclasses
import random
from collections.abc import Mapping
from dataclasses import dataclass

from calib.errors import CalibrationError
from control.model.arm import Arm, Effect

Range = tuple[float, float]
GEOMETRY = {
    "d_m": 0.002,
    "theta_rad": 0.01,
    "L_m": 0.002,
    "alpha_rad": 0.01,
}  # also hidden, within these bounds
# Sizes that matter in practice. Joint 1 is vertical: nothing loads its spring at rest.
SIZES: Mapping[str, tuple[tuple[int, ...], Mapping[str, Range]]] = {
    "backlash": ((1, 2, 3), {"width_rad": (0.003, 0.008)}),
    "joint_compliance": ((2, 3), {"stiffness_Nm_rad": (250.0, 600.0)}),
    "encoder_scale": ((1, 2, 3), {"scale": (0.004, 0.010)}),
    "encoder_eccentricity": ((1, 2, 3), {"amplitude_rad": (0.003, 0.006), "phase_rad": (-3.0, 3.0)}),
    "belt_coupling": ((), {"ratio": (0.006, 0.015)}),
    "thermal_drift": ((1, 2, 3), {"final_rad": (0.004, 0.008), "time_constant_s": (40.0, 90.0)}),
    "coulomb_friction": ((1, 2, 3), {"torque_Nm": (0.4, 1.0)}),
    "viscous_friction": ((1, 2, 3), {"coefficient_Nm_s_rad": (0.5, 1.5)}),
    "stribeck_friction": ((1, 2, 3), {"torque_Nm": (0.5, 1.0), "speed_rad_s": (0.03, 0.08)}),
    "load_friction": ((2, 3), {"fraction": (0.10, 0.20)}),
    "asymmetric_friction": ((1, 2, 3), {"torque_Nm": (0.2, 0.5)}),
    "cogging": ((1, 2, 3), {"amplitude_Nm": (0.3, 0.6), "order": (4.0, 10.0), "phase_rad": (-3.0, 3.0)}),
    "torque_constant": ((1, 2, 3), {"scale": (0.92, 0.96)}),
    "link_inertia": ((2, 3), {"mass_kg": (0.15, 0.35)}),
    "payload": ((), {"mass_kg": (0.12, 0.30)}),
    "command_delay": ((), {"delay_s": (0.002, 0.004)}),
    "supply_sag": ((), {"resistance_ohm": (0.05, 0.12)}),
}  # fmt: skip
WHOLE = ("order",)  # integer parameters
# The demo draws from these by default: effects that the loop corrects or feeds forward, so the result shows on the arm.
DRAWN = (
    "backlash", "joint_compliance", "encoder_scale", "encoder_eccentricity", "belt_coupling", "viscous_friction",
    "coulomb_friction", "load_friction",
)  # fmt: skip
ON_TIP = (
    "backlash",
    "joint_compliance",
    "encoder_scale",
    "encoder_eccentricity",
    "belt_coupling",
    "thermal_drift",
)
KNOWN = (
    (1.0, 1.2),
    (1.2, 1.5),
    (0.7, 0.8),
)  # Coulomb [N m] and viscous [N m s/rad] friction in the arm's file


@dataclass(frozen=True, slots=True)
class Hidden:
    """The effect in the mock arm, unknown to the run."""

    effect: str
    joint: int | None
    parameters: Mapping[str, float]

    def __str__(self) -> str:
        """As `backlash on joint 2 (width_rad = 0.0051)`."""
        where = (
            f" on {'link' if self.effect == 'link_inertia' else 'joint'} {self.joint}" if self.joint else ""
        )
        values = ", ".join(f"{name} = {value:.4g}" for name, value in self.parameters.items())
        return f"{self.effect}{where} ({values})"

    def as_scenario(self, name: str, seed: int) -> str:
        """TOML of a scenario with this effect and small geometric errors."""
        joint = f"joint = {self.joint}\n" if self.joint else ""
        values = ", ".join(f"{key} = {value!r}" for key, value in self.parameters.items())
        geometry = "".join(f"{key} = {value}\n" for key, value in GEOMETRY.items())
        return (
            f'name = "{name}"\nseed = {seed}\n\n[plant]\ntimestep_s = 0.0005\n\n[true_dh]\n{geometry}\n'
            f'[[effect]]\neffect = "{self.effect}"\n{joint}parameters = {{ {values} }}\n'
        )


def drawn(seed: int, effect: str | None, joint: int | None) -> Hidden:
    """Draw the effect: as chosen, the rest by the seed. CalibrationError if the effect cannot act on the joint."""
    draw = random.Random(f"gap {seed}")
    name = effect or draw.choice(DRAWN)
    if name not in SIZES:
        raise CalibrationError(f'--effect: expected one of {", ".join(SIZES)}, got "{name}"')
    joints, sizes = SIZES[name]
    if joint is not None and joint not in joints:
        places = f"joint {' or '.join(map(str, joints))}" if joints else "no joint (it acts on the whole arm)"
        raise CalibrationError(f"--joint: expected {places} for {name}, got {joint}")
    at = joint or (draw.choice(joints) if joints else None)
    values = {key: draw.uniform(*between) for key, between in sizes.items()}
    rounded = {
        key: float(round(value)) if key in WHOLE else float(f"{value:.4g}") for key, value in values.items()
    }
    return Hidden(name, at, rounded)


def with_known_friction(arm: Arm) -> Arm:
    """The arm with known friction, as any gear has; the hidden effect is added to it."""
    has = {effect.effect for effect in arm.effects}
    added = [
        Effect(name, j + 1, {key: KNOWN[min(j, len(KNOWN) - 1)][k]})
        for j in range(arm.joint_count)
        for k, (name, key) in enumerate(
            (("coulomb_friction", "torque_Nm"), ("viscous_friction", "coefficient_Nm_s_rad"))
        )
        if name not in has
    ]
    return dataclasses.replace(arm, effects=(*arm.effects, *added))


def beyond_known(hidden: Hidden, arm: Arm) -> Hidden:
    """The plant's effect: if the file has a part of it, the sum."""
    for known in arm.effects:
        if (known.effect, known.joint) == (hidden.effect, hidden.joint):
            total = {key: value + known.parameters.get(key, 0.0) for key, value in hidden.parameters.items()}
            return Hidden(hidden.effect, hidden.joint, total)
    return hidden
