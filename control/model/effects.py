"""The effects of a model: names, where they act, and parameters (docs/formats.md).

An `[[effect]]` of an arm.toml is checked against this table. Torques are at the joint, angles are joint
angles.
"""

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final, Literal

Place = Literal["joint", "link", "none", "joint or none"]
COUPLED: Final = 3  # the joint that `belt_coupling` moves: its belt runs over the shoulder
COUPLED_TO: Final = 2  # the joint whose angle says how far


@dataclass(frozen=True, slots=True)
class EffectKind:
    """Requirements of one kind of effect; `place` says what the key `joint` numbers."""

    place: Place
    required: tuple[str, ...]
    optional: tuple[str, ...] = ()
    positive: tuple[str, ...] = ()
    not_negative: tuple[str, ...] = ()
    pattern: str = ""  # parameter names beyond those listed
    one_of: tuple[str, ...] = ()  # exactly one of these


EFFECTS: Final[Mapping[str, EffectKind]] = {
    "link_geometry": EffectKind("none", (), pattern=r"link([1-9]\d*)_(d_m|theta_rad|L_m|alpha_rad)"),
    "base_frame": EffectKind("none", (), ("x_m", "y_m", "z_m", "rx_rad", "ry_rad", "rz_rad")),
    "encoder_scale": EffectKind("joint", ("scale",)),
    "encoder_eccentricity": EffectKind("joint", ("amplitude_rad", "phase_rad")),
    "backlash": EffectKind("joint", ("width_rad",), not_negative=("width_rad",)),
    "joint_compliance": EffectKind(
        "joint",
        ("stiffness_Nm_rad",),
        ("damping_Nm_s_rad",),
        positive=("stiffness_Nm_rad",),
        not_negative=("damping_Nm_s_rad",),
    ),
    "link_flexure": EffectKind("link", ("EI_Nm2",), positive=("EI_Nm2",)),
    "belt_coupling": EffectKind("none", ("ratio",)),
    "thermal_drift": EffectKind(
        "joint or none", ("final_rad", "time_constant_s"), positive=("time_constant_s",)
    ),
    "payload": EffectKind("none", ("mass_kg",)),
    "coulomb_friction": EffectKind("joint", ("torque_Nm",), not_negative=("torque_Nm",)),
    "viscous_friction": EffectKind(
        "joint", ("coefficient_Nm_s_rad",), not_negative=("coefficient_Nm_s_rad",)
    ),
    "stribeck_friction": EffectKind(
        "joint", ("torque_Nm", "speed_rad_s"), positive=("speed_rad_s",), not_negative=("torque_Nm",)
    ),
    "load_friction": EffectKind("joint", ("fraction",), not_negative=("fraction",)),
    "asymmetric_friction": EffectKind("joint", ("torque_Nm",)),
    "cogging": EffectKind("joint", ("amplitude_Nm", "order", "phase_rad"), positive=("order",)),
    "torque_constant": EffectKind("joint", ("scale",), positive=("scale",)),
    "command_delay": EffectKind("none", ("delay_s",), not_negative=("delay_s",)),
    "supply_sag": EffectKind("none", ("resistance_ohm",), not_negative=("resistance_ohm",)),
    "link_inertia": EffectKind("link", (), one_of=("inertia_kg_m2", "mass_kg")),
}

Fault = Callable[[tuple[str, ...], str, str], Exception]


def parameter_names(kind: EffectKind) -> tuple[str, ...]:
    """Return the parameters of this kind of effect for an error message."""
    pattern = ("link<i>_d_m", "link<i>_theta_rad", "link<i>_L_m", "link<i>_alpha_rad") if kind.pattern else ()
    return (*kind.required, *kind.optional, *kind.one_of, *pattern)


def check_effect(
    name: str, joint: int | None, parameters: Mapping[str, float], joints: int, links: int, fault: Fault
) -> None:
    """Raise `fault(path inside the effect, expected, got)` if an effect does not conform to docs/formats.md."""
    kind = EFFECTS.get(name)
    if kind is None:
        raise fault(("effect",), "one of " + ", ".join(EFFECTS), f'"{name}"')
    _check_place(name, kind, joint, joints, links, fault)
    for parameter in kind.required:
        if parameter not in parameters:
            raise fault(("parameters",), f"{parameter} of the effect {name}", "none")
    for parameter, value in parameters.items():
        _check_parameter(name, kind, parameter, value, links, fault)
    given = [parameter for parameter in kind.one_of if parameter in parameters]
    if kind.one_of and len(given) != 1:
        raise fault(("parameters",), "exactly one of " + ", ".join(kind.one_of), f"{len(given)} of them")


def _check_place(
    name: str, kind: EffectKind, joint: int | None, joints: int, links: int, fault: Fault
) -> None:
    if kind.place == "none":
        if joint is not None:
            raise fault(("joint",), f"no joint for the effect {name}", str(joint))
    elif joint is None:
        if kind.place != "joint or none":
            raise fault(("joint",), f"the {kind.place} of the effect {name}", "nothing")
    else:
        count = joints if kind.place == "joint" else links
        if not 1 <= joint <= count:
            word = kind.place.removesuffix(" or none")
            raise fault(("joint",), f"a {word} from 1 to {count}", str(joint))


def _check_parameter(
    name: str, kind: EffectKind, parameter: str, value: float, links: int, fault: Fault
) -> None:
    path = ("parameters", parameter)
    matched = re.fullmatch(kind.pattern, parameter) if kind.pattern else None
    if matched is None and parameter not in (*kind.required, *kind.optional, *kind.one_of):
        names = ", ".join(parameter_names(kind))
        raise fault(path, f"one of the parameters {names} of {name}", "an unknown parameter")
    if matched is not None and int(matched[1]) > links:
        raise fault(path, f"a link from 1 to {links}", matched[1])
    if parameter in kind.positive and value <= 0:
        raise fault(path, "a positive number", str(value))
    if parameter in kind.not_negative and value < 0:
        raise fault(path, "a number not below 0", str(value))
