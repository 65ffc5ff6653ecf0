"""The effects of a model, one record each: name, where it acts, parameters, law, and what the controller does about it.

An `[[effect]]` of an arm.toml is checked against this table (docs/formats.md); feed-forward, corrections, calibration and
the gap workflow read it. Torques are at the joint, angles are joint angles.

Their laws are pure functions: torques that a motor has to add, and joint angle minus encoder angle. Each law stands here
once, for the controller and for identification: of floats with `math`, of arrays with `numpy`. A friction torque is what the
motor has to add to overcome it. The sign of a speed is smooth, tanh(speed / SMOOTH_rad_s).
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal, Protocol

Value = Any  # float or numpy array
# Gears stick below some mrad/s, and a measured speed has no sign there. Wider, friction is missing in slow motion: at 10 mrad/s
# a width of 0.01 leaves out a quarter, this one 0.3 %.
SMOOTH_rad_s: Final = 0.003


class Functions(Protocol):
    """`math`, or `numpy` for arrays."""

    @property
    def tanh(self) -> Callable[[Value], Value]:
        """Hyperbolic tangent."""

    @property
    def exp(self) -> Callable[[Value], Value]:
        """Exponential function."""

    @property
    def sin(self) -> Callable[[Value], Value]:
        """Sine."""


Torque = Callable[[Value, Value, Value], Value]  # angle of joint or motor, joint speed, transmitted torque -> torque
TorqueLaw = Callable[[Mapping[str, float], Functions], Torque]  # of an effect's parameters


def direction(speed_rad_s: Value, f: Functions = math) -> Value:
    """Smooth sign of a speed, -1 to 1."""
    return f.tanh(speed_rad_s / SMOOTH_rad_s)


def coulomb_friction(p: Mapping[str, float], f: Functions = math) -> Torque:
    """Dry friction."""
    torque_Nm, tanh = p["torque_Nm"], f.tanh
    return lambda angle, speed, load: torque_Nm * tanh(speed / SMOOTH_rad_s)


def viscous_friction(p: Mapping[str, float], f: Functions = math) -> Torque:
    """Friction that grows with speed."""
    coefficient = p["coefficient_Nm_s_rad"]
    return lambda angle, speed, load: coefficient * speed


def stribeck_friction(p: Mapping[str, float], f: Functions = math) -> Torque:
    """Friction beyond Coulomb near rest, exp(-(v / v_s)^2) (Armstrong-Helouvry's Gaussian form)."""
    torque_Nm, scale, tanh, exp = p["torque_Nm"], p["speed_rad_s"], f.tanh, f.exp
    return lambda angle, speed, load: torque_Nm * exp(-((speed / scale) ** 2)) * tanh(speed / SMOOTH_rad_s)


def load_friction(p: Mapping[str, float], f: Functions = math) -> Torque:
    """Dry friction that grows with the torque that the gear transmits."""
    fraction, tanh = p["fraction"], f.tanh
    return lambda angle, speed, load: fraction * abs(load) * tanh(speed / SMOOTH_rad_s)


def asymmetric_friction(p: Mapping[str, float], f: Functions = math) -> Torque:
    """Additional Coulomb friction in the positive direction, and as much less in the negative; zero at rest."""
    torque_Nm, tanh = p["torque_Nm"], f.tanh
    return lambda angle, speed, load: torque_Nm * abs(tanh(speed / SMOOTH_rad_s))


def cogging(p: Mapping[str, float], f: Functions = math) -> Torque:
    """Torque that the motor has to add against cogging: `order` periods a turn of the angle, which is the motor's."""
    amplitude_Nm, order, phase, sin = p["amplitude_Nm"], p["order"], p["phase_rad"], f.sin
    return lambda angle, speed, load: amplitude_Nm * sin(order * angle + phase)


def backlash_rad(flank: Value, width_rad: Value) -> Value:
    """Joint angle minus motor angle, for backlash; `flank` is the sign of the transmitted torque."""
    return -0.5 * width_rad * flank


def compliance_rad(transmitted_Nm: Value, stiffness_Nm_rad: Value) -> Value:
    """Joint angle minus motor angle, for a compliant gear that transmits a torque from motor to joint."""
    return -transmitted_Nm / stiffness_Nm_rad


Place = Literal["joint", "link", "none", "joint or none"]
COUPLED: Final = 3  # the joint that `belt_coupling` moves: its belt runs over the shoulder
COUPLED_TO: Final = 2  # the joint whose angle says how far
# What the controller corrects: torques (feed-forward), encoder angles (encoder chain), motor angles (gears).
Corrected = Literal["torque", "encoder", "gear", "not"]


@dataclass(frozen=True, slots=True)
class LinearForm:
    """Parameters as unknowns that an effect is linear in, and back.

    `values` of the file's parameters; `parameters` of values; `slopes`: derivatives of the parameters by the values, one row a
    parameter; `is_possible`: whether values are those of an effect.
    """

    values: Callable[[Mapping[str, float]], tuple[float, ...]]
    parameters: Callable[[Sequence[float]], dict[str, float]]
    slopes: Callable[[Sequence[float]], tuple[tuple[float, ...], ...]]
    is_possible: Callable[[Sequence[float]], bool] = lambda v: True


def itself(parameter: str, nothing: float = 0.0) -> LinearForm:
    """The parameter, counted from the value at which there is no effect."""
    return LinearForm(lambda p: (p[parameter] - nothing,), lambda v: {parameter: v[0] + nothing}, lambda v: ((1.0,),))


def width(parameter: str) -> LinearForm:
    """The parameter, which is above 0."""
    return LinearForm(lambda p: (p[parameter],), lambda v: {parameter: v[0]}, lambda v: ((1.0,),), lambda v: v[0] > 0.0)


def inverse(parameter: str) -> LinearForm:
    """One over the parameter: the compliance of a stiffness, which is above 0."""
    return LinearForm(
        lambda p: (1.0 / p[parameter],), lambda v: {parameter: 1.0 / v[0]}, lambda v: ((-1.0 / v[0] ** 2,),), lambda v: v[0] > 0.0
    )


def wave(amplitude: str) -> LinearForm:
    """A sin(x + phase) = a sin(x) + b cos(x) with a = A cos(phase), b = A sin(phase)."""

    def values(p: Mapping[str, float]) -> tuple[float, ...]:
        return p[amplitude] * math.cos(p["phase_rad"]), p[amplitude] * math.sin(p["phase_rad"])

    def parameters(v: Sequence[float]) -> dict[str, float]:
        return {amplitude: math.hypot(v[0], v[1]), "phase_rad": math.atan2(v[1], v[0])}

    def slopes(v: Sequence[float]) -> tuple[tuple[float, ...], ...]:
        size = max(math.hypot(v[0], v[1]), 1e-300)
        return (v[0] / size, v[1] / size), (-v[1] / size / size, v[0] / size / size)

    return LinearForm(values, parameters, slopes, any)


@dataclass(frozen=True, slots=True)
class EffectKind:
    """The record of an effect."""

    place: Place  # what the key `joint` numbers
    required: tuple[str, ...]
    optional: tuple[str, ...] = ()
    positive: tuple[str, ...] = ()
    not_negative: tuple[str, ...] = ()
    pattern: str = ""  # parameter names beyond those listed
    one_of: tuple[str, ...] = ()  # exactly one of these
    linear: LinearForm | None = None  # its unknowns, in which two of a kind add up; None where they do not
    alike: tuple[str, ...] = ()  # parameters that have to be the same for that
    torque: TorqueLaw | None = None  # what the motor has to add
    is_dry: bool = False  # friction that holds at rest, up to torque_Nm
    is_of_motor: bool = False  # its torque follows the motor's angle, which takes a [[drive]]
    corrected: Corrected = "not"
    is_of_transmission: bool = False  # between motor and joint: an encoder on the joint sees what it does
    moves: int | None = None  # the joint that it moves, and the one whose angle says how far, if not the key `joint`
    follows: int | None = None


EFFECTS: Final[Mapping[str, EffectKind]] = {
    "link_geometry": EffectKind("none", (), pattern=r"link([1-9]\d*)_(d_m|theta_rad|L_m|alpha_rad)"),
    "base_frame": EffectKind("none", (), ("x_m", "y_m", "z_m", "rx_rad", "ry_rad", "rz_rad")),
    "encoder_scale": EffectKind("joint", ("scale",), linear=itself("scale"), corrected="encoder"),
    "encoder_eccentricity": EffectKind(
        "joint", ("amplitude_rad", "phase_rad"), linear=wave("amplitude_rad"), corrected="encoder"
    ),
    "backlash": EffectKind(
        "joint", ("width_rad",), not_negative=("width_rad",), linear=width("width_rad"), corrected="gear", is_of_transmission=True
    ),
    "joint_compliance": EffectKind(
        "joint",
        ("stiffness_Nm_rad",),
        ("damping_Nm_s_rad",),
        positive=("stiffness_Nm_rad",),
        not_negative=("damping_Nm_s_rad",),
        linear=inverse("stiffness_Nm_rad"),
        corrected="gear",
        is_of_transmission=True,
    ),
    "link_flexure": EffectKind("link", ("EI_Nm2",), positive=("EI_Nm2",), linear=inverse("EI_Nm2")),
    "belt_coupling": EffectKind(
        "none",
        ("ratio",),
        linear=itself("ratio"),
        corrected="encoder",
        is_of_transmission=True,
        moves=COUPLED,
        follows=COUPLED_TO,
    ),
    "thermal_drift": EffectKind(
        "joint or none",
        ("final_rad", "time_constant_s"),
        positive=("time_constant_s",),
        linear=itself("final_rad"),
        alike=("time_constant_s",),
    ),
    "payload": EffectKind("none", ("mass_kg",), linear=itself("mass_kg"), corrected="torque"),
    "coulomb_friction": EffectKind(
        "joint",
        ("torque_Nm",),
        not_negative=("torque_Nm",),
        linear=itself("torque_Nm"),
        torque=coulomb_friction,
        is_dry=True,
        corrected="torque",
    ),
    "viscous_friction": EffectKind(
        "joint",
        ("coefficient_Nm_s_rad",),
        not_negative=("coefficient_Nm_s_rad",),
        linear=itself("coefficient_Nm_s_rad"),
        torque=viscous_friction,
        corrected="torque",
    ),
    "stribeck_friction": EffectKind(
        "joint",
        ("torque_Nm", "speed_rad_s"),
        positive=("speed_rad_s",),
        not_negative=("torque_Nm",),
        torque=stribeck_friction,
        is_dry=True,
        corrected="torque",
    ),
    "load_friction": EffectKind(
        "joint", ("fraction",), not_negative=("fraction",), linear=itself("fraction"), torque=load_friction, corrected="torque"
    ),
    "asymmetric_friction": EffectKind(
        "joint", ("torque_Nm",), linear=itself("torque_Nm"), torque=asymmetric_friction, corrected="torque"
    ),
    "cogging": EffectKind(
        "joint",
        ("amplitude_Nm", "order", "phase_rad"),
        positive=("order",),
        linear=wave("amplitude_Nm"),
        alike=("order",),
        torque=cogging,
        is_of_motor=True,
        corrected="torque",
    ),
    "torque_constant": EffectKind(
        "joint", ("scale",), positive=("scale",), linear=itself("scale", nothing=1.0), corrected="torque"
    ),
    "command_delay": EffectKind("none", ("delay_s",), not_negative=("delay_s",), linear=itself("delay_s")),
    "supply_sag": EffectKind("none", ("resistance_ohm",), not_negative=("resistance_ohm",), linear=itself("resistance_ohm")),
    "link_inertia": EffectKind("link", (), one_of=("inertia_kg_m2", "mass_kg"), corrected="torque"),
}


def linear_values(effect: str, parameters: Mapping[str, float]) -> tuple[float, ...]:
    """The unknowns in which an effect is linear, of its parameters; none of one that is not."""
    linear = EFFECTS[effect].linear
    return () if linear is None else linear.values(parameters)


def corrected(how: Corrected) -> frozenset[str]:
    """The effects that the controller corrects in this way."""
    return frozenset(name for name, kind in EFFECTS.items() if kind.corrected == how)


def place_of(effect: str) -> Literal["joint", "link"]:
    """What the key `joint` of its `[[effect]]` numbers."""
    return "link" if effect in EFFECTS and EFFECTS[effect].place == "link" else "joint"


def moved_joint(effect: str, joint: int | None) -> int | None:
    """The joint (or link) that an effect moves, by the key `joint` of its `[[effect]]`."""
    kind = EFFECTS.get(effect)
    return joint if kind is None or kind.moves is None else kind.moves


def followed_joint(effect: str, joint: int | None) -> int | None:
    """The joint whose angle says how far an effect moves."""
    kind = EFFECTS.get(effect)
    return joint if kind is None or kind.follows is None else kind.follows


def total(effect: str, known: Mapping[str, float], further: Mapping[str, float]) -> Mapping[str, float]:
    """The parameters of two effects of one kind as those of one; `further` where no single one is the sum of both."""
    kind = EFFECTS[effect]
    if kind.one_of and known.keys() == further.keys():
        return {name: value + known[name] for name, value in further.items()}
    if kind.linear is None or any(known.get(name) != further.get(name) for name in kind.alike):
        return further
    summed = [a + b for a, b in zip(kind.linear.values(known), kind.linear.values(further), strict=True)]
    return {**known, **further, **kind.linear.parameters(summed)}


def parameter_names(kind: EffectKind) -> tuple[str, ...]:
    """Return the parameters of this kind of effect for an error message."""
    pattern = ("link<i>_d_m", "link<i>_theta_rad", "link<i>_L_m", "link<i>_alpha_rad") if kind.pattern else ()
    return (*kind.required, *kind.optional, *kind.one_of, *pattern)
