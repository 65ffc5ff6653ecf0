"""Static effects (docs/formats.md), linear in their parameters: joint = encoder + sum of p * slope, and likewise the tip.

| effect | what is identified | slope |
| --- | --- | --- |
| encoder_scale of joint j | encoder_scale<j> = scale | q_j |
| encoder_eccentricity | eccentricity<j>_sin, _cos = amplitude cos(phase), sin(phase) | sin q_j, cos q_j |
| backlash | backlash<j> = width | -flank / 2, if the flank is known |
| | backlash<j>_unclear1 .. 8, _led = mean of width times flank | -leaning / 2, if it is not: driven, hand-guided poses |
| joint_compliance | compliance<j> = 1 / stiffness | -gravity torque |
| | compliance<j>_held = link-side share of friction / stiffness | -held friction |
| belt_coupling | belt_coupling = ratio | q_2, of joint 3 |
| thermal_drift | thermal_drift<j> = final angle | 1 - exp(-t / the file's time constant) |
| link_flexure | flexure<k> = 1 / EI of link k | the beam's displacement and turn: of the tip |

Signs as in control.model.effects; flank, gravity torque and held friction as in control.dynamics.static_pose,
from currents and directions of the points. How friction is shared between motor and link is unknown, hence the side
parameters, which are not part of the effect. An effect is requested by name and joint: "backlash:2", "belt_coupling".
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import chain, repeat
from typing import TYPE_CHECKING, Final

import numpy as np
import numpy.typing as npt

from calib.arm_problem.arm_model import ArmModel
from calib.arm_problem.link_bending import FLEXURE, Bending, bending, link_frames
from calib.arm_problem.observations import Correction
from calib.arrays import Array, frozen
from calib.errors import CalibrationError
from calib.points.points import Points
from calib.settling import Settling
from control.dynamics.dynamics import has_masses
from control.dynamics.feedforward import own_payload_kg, with_link_inertia
from control.dynamics.static_pose import RestingPose, resting
from control.model.arm import Arm, Effect
from control.model.effects import COUPLED, COUPLED_TO, EFFECTS, backlash_rad, compliance_rad, linear_values, moved_joint, place_of
from control.model.maps import CorrectionMap, pieces
from control.model.tolerances import TOLERANCE_OF, Spread

if TYPE_CHECKING:
    from scipy import sparse

Key = tuple[str, int | None]  # effect and joint
SAME_rad = 1e-10  # a joint's angle below which loads are the same: a tenth of a nanometre at a metre


def corrections(arm: Arm, points: Points, wanted: Sequence[str]) -> tuple[Correction, ...]:
    """The linear parameters of the wanted effects, starting from those that the arm already has.

    CalibrationError for an unknown effect or joint; MissingModel if a flank or torque is needed and the
    arm's file lacks masses.
    """
    return _corrections(arm, resting_points(arm, points), wanted)


def _corrections(arm: Arm, at: RestingPoints, wanted: Sequence[str]) -> tuple[Correction, ...]:
    has = {(effect.effect, effect.joint): effect for effect in arm.effects}
    made = []
    for key in dict.fromkeys(effect_key(text, arm) for text in wanted):
        before, spread = has.get(key), _spread(arm, *key)
        starts = linear_values(key[0], before.parameters) if before is not None else ()
        for term, start in zip(LAWS[key[0]], chain(starts, repeat(0.0)), strict=False):
            slope = term.slope(at, key[1] or 0)
            if not term.is_side or slope.any():
                joint = 1 if term.is_of_tip else moved_joint(*key) or 0
                whole = _of_joint(slope, joint, arm.joint_count)
                bent = at.bent(key[1] or 0) if term.is_of_tip else None
                tip, turn = (None, None) if bent is None else map(frozen, bent)
                one = Correction(term.name(key[1]), term.unit, whole, term.bound, start, slope_m=tip, turn_rad=turn)
                if spread is not None:  # a side parameter is a share of the effect, either way
                    mean = 0.0 if term.is_side else spread.centre
                    one = dataclasses.replace(one, sd=math.hypot(spread.sd_about, spread.centre - mean), made=mean)
                made.append(one)
    return tuple(made)


def _spread(arm: Arm, effect: str, joint: int | None) -> Spread | None:
    """How exactly a part is made, where its tolerance is the effect's parameter; None: unknown."""
    if arm.tolerances is None or joint is None or effect not in TOLERANCE_OF:
        return None
    spread: Spread | None = getattr(arm.tolerances.of_joint(joint), TOLERANCE_OF[effect])
    return spread


def made_effects(arm: Arm) -> tuple[str, ...]:
    """The effects that an arm has by its tolerances, such as "backlash:2": they are there, and only how large is open.

    Without masses nothing says on which flank a gear lies: then no play is among them.
    """
    stated = _stated(arm)
    return tuple(f"{effect}:{joint}" for effect, joint in stated if effect != "backlash" or has_masses(arm))


def about_made_effects(arm: Arm) -> tuple[str, ...]:
    """A sentence where play that tolerances state cannot be identified."""
    if has_masses(arm) or not any(effect == "backlash" for effect, _ in _stated(arm)):
        return ()
    return (
        f"arm {arm.name}: [tolerances] says what play its gears have, and on which flank they lie follows from the masses of its"
        " links, which the file lacks: no play is identified; add mass_kg, com_m and inertia_kg_m2",
    )


def _stated(arm: Arm) -> list[tuple[str, int]]:
    """Effects and joints whose tolerance the arm's file has."""
    joints = range(1, arm.joint_count + 1)
    pairs = [(effect, joint) for effect in TOLERANCE_OF for joint in joints if arm.is_behind_encoder(effect, joint)]
    return [(effect, joint) for effect, joint in pairs if _spread(arm, effect, joint) is not None]


def known_corrections(arm: Arm, points: Points, wanted: Sequence[str] = ()) -> Array:
    """Joint minus encoder angles by the arm's own static effects and maps, (m, n) [rad], except effects in `wanted`.

    What a link's bending does is `link_bending.known_bending`.
    """
    return _known(arm, resting_points(arm, points), wanted)


def resting_points(arm: Arm, points: Points, near_rad: Array | None = None) -> RestingPoints:
    """The points at the joints' angles that the arm's own effects and maps give; they begin at `near_rad`, if it is there.

    Loads act there, and soft and loose gears follow loads: q = encoder + added(q), repeated at every pose until q settles. Where
    gravity turns round, a loose gear may lie on either flank.
    """
    joint_rad, settling = points.q_rad if near_rad is None else near_rad, Settling()
    while settling.goes_on:
        wanted = points.q_rad + _known(arm, RestingPoints(arm, points, frozen(joint_rad)), ())
        step_rad = np.abs(wanted - joint_rad).max(axis=1, initial=0.0)
        joint_rad = np.where(settling.takes(step_rad, SAME_rad)[:, None], wanted, joint_rad)
    return RestingPoints(arm, points, frozen(joint_rad))


def _known(arm: Arm, at: RestingPoints, wanted: Sequence[str]) -> Array:
    points, left_out = at.points, {effect_key(text, arm) for text in wanted}
    known = [
        f"{effect.effect}:{effect.joint}" if effect.joint is not None else effect.effect
        for effect in arm.effects
        if effect.effect in LAWS
        and effect.effect != FLEXURE
        and (effect.effect, effect.joint) not in left_out
        and arm.is_behind_encoder(effect.effect, effect.joint)
        if effect.joint is not None or effect.effect == COUPLING
    ]
    shift = np.zeros(points.q_rad.shape)
    for correction in _corrections(arm, at, known):
        shift += correction.nominal * correction.slope_rad
    for entry in arm.maps:
        if entry.corrects == "angle_rad":
            place = at.gravity_Nm(entry.joint) if entry.over == "load_Nm" else at.q_rad(entry.joint)
            shift[:, entry.joint - 1] += along(entry, place, points.direction[:, entry.joint - 1])
    return frozen(shift)


def effects_of(values: Mapping[str, float]) -> tuple[Effect, ...]:
    """Effects of docs/formats.md from the corrections' values by name, without unphysical ones."""
    effects = []
    for (name, joint), linear in _gathered(values).items():
        parameters = _parameters(name, linear)
        if parameters is not None:
            effects.append(Effect(name, joint, parameters))
    return tuple(effects)


def with_effects(arm: Arm, values: Mapping[str, float]) -> Arm:
    """The arm with the effects of these corrections in place of its own; of these, parameters that are not identified stay."""
    known = {(effect.effect, effect.joint): effect.parameters for effect in arm.effects}
    replaced = set(_gathered(values))
    others = [effect for effect in arm.effects if (effect.effect, effect.joint) not in replaced]
    found = [Effect(e.effect, e.joint, {**known.get((e.effect, e.joint), {}), **e.parameters}) for e in effects_of(values)]
    return dataclasses.replace(arm, effects=(*others, *found))


def _parameters(effect: str, values: Sequence[float]) -> dict[str, float] | None:
    """As arm.toml has them; None where these values are no such effect."""
    linear = EFFECTS[effect].linear
    return linear.parameters(values) if linear is not None and linear.is_possible(values) else None


def impossible(values: Mapping[str, float]) -> tuple[Key, ...]:
    """Effects and joints of these corrections that no part can have: no play and no compliance is below nought."""
    return tuple(key for key, linear in _gathered(values).items() if _parameters(key[0], linear) is None)


def unphysical(values: Mapping[str, float]) -> tuple[str, ...]:
    """A sentence for each effect that is `impossible`."""
    return tuple(
        f"{name} of joint {joint}: its estimate is below zero, which is physically impossible; it is omitted. Either these"
        " points do not show the effect, or another effect is present."
        for name, joint in impossible(values)
    )


def unclear_flanks(arm: Arm, points: Points, wanted: Sequence[str]) -> tuple[str, ...]:
    """A sentence for each requested backlash whose flank is unknown in some poses, or never changes."""
    at = resting_points(arm, points)
    sentences = []
    for name, joint in (effect_key(text, arm) for text in wanted):
        if name == "backlash" and joint is not None:
            sentences += _about_flanks(at.resting.flank[:, joint - 1], joint)
    return tuple(sentences)


def _about_flanks(flank: Array, joint: int) -> list[str]:
    open_count, sides = int(np.sum(flank == 0.0)), set(flank[flank != 0.0].tolist())
    sentences = []
    if open_count:
        sentences.append(
            f"backlash of joint {joint}: currents, directions and gravity do not determine the gear's flank in {open_count} of"
            f" {len(flank)} poses; their mean position in the backlash is identified."
        )
    if len(sides) < 2:
        sentences.append(
            f"backlash of joint {joint}: the gear lies on the same flank in every pose with a known flank; its backlash cannot be"
            " distinguished from the joint's zero. Take poses from both sides, or where gravity changes sign."
        )
    return sentences


def effect_key(text: str, arm: Arm) -> Key:
    """Effect and joint of "backlash:2"."""
    name, colon, number = text.partition(":")
    if name not in LAWS:
        raise CalibrationError(f'effect: expected one of {_choices()}, got "{text}"')
    if name == COUPLING:
        if colon or arm.joint_count < COUPLED:
            raise CalibrationError(
                f'effect: expected {COUPLING} without a joint, on an arm of three joints or more, got "{text}" for'
                f" {arm.joint_count}"
            )
        return _shown(name, None, arm)
    place, most = place_of(name), len(arm.links) if place_of(name) == "link" else arm.joint_count
    if not number.isdecimal() or not 1 <= int(number) <= most:
        raise CalibrationError(f'effect: expected a {place} from 1 to {most}, as in {name}:1, got "{text}"')
    return _shown(name, int(number), arm)


def _shown(name: str, joint: int | None, arm: Arm) -> Key:
    """CalibrationError where the transmission does nothing to the encoder's angle."""
    if not arm.is_behind_encoder(name, joint):
        raise CalibrationError(
            f'effect: {name} of joint {moved_joint(name, joint)}: expected an encoder on the motor, got encoder_on = "joint":'
            " poses show nothing of what is between motor and joint"
        )
    return name, joint


def _choices() -> str:
    return ", ".join(name if name == COUPLING else f"{name}:<joint>" for name in LAWS)


def _of_joint(slope: Array, joint: int, joint_count: int) -> Array:
    """(m, n), zero but for the column of `joint`."""
    columns = np.zeros((len(slope), joint_count))
    columns[:, joint - 1] = slope
    return frozen(columns)


def _gathered(values: Mapping[str, float]) -> dict[Key, list[float]]:
    """Values by effect and joint, in the order of the law's terms; CalibrationError for an unknown name."""
    by_effect: dict[Key, dict[int, float]] = {}
    for name, value in values.items():
        effect, joint, place = _named(name)
        by_effect.setdefault((effect, joint), {})[place] = value
    return {key: [places.get(k, 0.0) for k in range(len(LAWS[key[0]]))] for key, places in by_effect.items()}


def _named(name: str) -> tuple[str, int | None, int]:
    """Effect, joint and place among its terms of a correction's name."""
    for effect, law in LAWS.items():
        for place, term in enumerate(law):
            middle = name.removeprefix(term.head).removesuffix(term.tail)
            if effect == COUPLING and name == COUPLING:
                return effect, None, place
            if middle.isdecimal() and term.name(int(middle)) == name:
                return effect, int(middle), place
    raise CalibrationError(f'no correction is called "{name}"')


COUPLING: Final = "belt_coupling"
DRIFT: Final = "thermal_drift"
SHARE_PARTS: Final = 8
FOLLOW_LOADS: Final = ("joint_compliance", FLEXURE)  # without a jump


class RestingPoints:
    """The points and, computed on demand from masses and drives, the state of their gears at joint angles joint_rad (m, n)."""

    def __init__(self, arm: Arm, points: Points, joint_rad: Array) -> None:
        self.points, self.joint_rad, self._arm = points, joint_rad, arm

    @cached_property
    def resting(self) -> RestingPose:
        """The state of the gears. MissingModel if the arm's file lacks masses."""
        seen = self.points
        payload_kg = np.nan_to_num(seen.payload_kg)
        return resting(self._arm, self.joint_rad, seen.direction, seen.current_A, payload_kg)

    def q_rad(self, joint: int) -> Array:
        """Encoder angles (m,) of a joint, 1-based."""
        return np.asarray(self.points.q_rad[:, joint - 1])

    def flank(self, joint: int) -> Array:
        """Flanks (m,) of a joint's gear, 0 where unclear."""
        return np.asarray(self.resting.flank[:, joint - 1])

    def gravity_Nm(self, joint: int) -> Array:
        """Gravity torque (m,) of a joint."""
        return np.asarray(self.resting.gravity_Nm[:, joint - 1])

    def held_Nm(self, joint: int) -> Array:
        """Friction (m,) that a joint's motor holds."""
        return np.asarray(self.resting.held_Nm[:, joint - 1])

    def warmed(self, joint: int) -> Array:
        """The share (m,) of its final value that a joint's drift has reached since the recording began, 0 where no time is known.

        CalibrationError unless the arm's file says how fast: the drift is not linear in its time constant.
        """
        drifts = [e for e in self._arm.effects if (e.effect, e.joint) == (DRIFT, joint)]
        if not drifts:
            raise CalibrationError(
                f"{DRIFT} of joint {joint}: arm {self._arm.name} has no [[effect]] that says its time_constant_s; `armwright gap`"
                " finds it"
            )
        return np.nan_to_num(1.0 - np.exp(-self.points.elapsed_s / drifts[0].parameters["time_constant_s"]))

    def bent(self, link: int) -> Bending:
        """What a link's bending does to the tip and to the last link, per 1 / EI."""
        arm = with_link_inertia(self._arm)
        loads_kg = np.nan_to_num(self.points.payload_kg) + own_payload_kg(arm)
        return bending(arm, link_frames(ArmModel(arm), arm.dh, self.joint_rad), loads_kg, link)

    def led_side(self, joint: int) -> Array:
        """The flank (m,) near which the gear lies after hand guiding, if the motor does not push it, else 0."""
        return self._leaning(joint, self.resting.is_led[:, joint - 1])

    def unclear_side(self, joint: int, part: int) -> Array:
        """The flank (m,) by friction alone if a driven joint's is unclear, else 0.

        `part` of SHARE_PARTS: friction decides if its link-side share exceeds -gravity / held torque; poses with
        that ratio in this part of 0 .. 1 change flank together.
        """
        gravity, held = self.gravity_Nm(joint), self.held_Nm(joint)
        ratio = np.divide(-gravity, held, out=np.zeros(held.shape), where=held != 0.0)
        which = np.clip(np.floor(SHARE_PARTS * ratio), 0, SHARE_PARTS - 1)
        return self._leaning(joint, ~self.resting.is_led[:, joint - 1] & (which == part))

    def _leaning(self, joint: int, counts: npt.NDArray[np.bool_]) -> Array:
        of = joint - 1
        return np.where(counts & (self.resting.flank[:, of] == 0.0), self.resting.leaning[:, of], 0.0)


Slope = Callable[[RestingPoints, int], Array]


@dataclass(frozen=True, slots=True)
class LawTerm:
    """One linear parameter: name before and after the number of joint or link, unit, bound, slope (m,) of the joint's angle.

    `is_side`: not part of the effect, and omitted if it has no influence. `is_of_tip`: no joint moves, but a link bends.
    """

    head: str
    tail: str
    unit: str
    bound: float
    slope: Slope
    is_side: bool = False
    is_of_tip: bool = False

    def name(self, joint: int | None) -> str:
        """backlash2, eccentricity2_sin, belt_coupling."""
        return f"{self.head}{joint or ''}{self.tail}"


def _unclear(part: int) -> LawTerm:
    """Mean position in the backlash of the unclear poses of one part of SHARE_PARTS."""

    def slope(at: RestingPoints, joint: int) -> Array:
        return np.asarray(backlash_rad(at.unclear_side(joint, part), 1.0))

    return LawTerm("backlash", f"_unclear{part + 1}", "rad", 0.05, slope, True)


def _harmonic(part: Callable[[Array], Array]) -> Slope:
    """Sine or cosine of the joint's angle."""
    return lambda at, joint: part(at.q_rad(joint))


# Of each effect its linear parameters: first those of its record (control.model.effects), then side parameters.
LAWS: Final[Mapping[str, tuple[LawTerm, ...]]] = {
    "encoder_scale": (LawTerm("encoder_scale", "", "1", 0.05, lambda at, j: at.q_rad(j)),),
    "encoder_eccentricity": (
        LawTerm("eccentricity", "_sin", "rad", 0.05, _harmonic(np.sin)),
        LawTerm("eccentricity", "_cos", "rad", 0.05, _harmonic(np.cos)),
    ),
    "backlash": (
        LawTerm("backlash", "", "rad", 0.05, lambda at, j: backlash_rad(at.flank(j), 1.0)),
        *(_unclear(part) for part in range(SHARE_PARTS)),
        LawTerm("backlash", "_led", "rad", 0.05, lambda at, j: backlash_rad(at.led_side(j), 1.0), True),
    ),
    "joint_compliance": (
        LawTerm("compliance", "", "rad/Nm", 0.01, lambda at, j: compliance_rad(at.gravity_Nm(j), 1.0)),
        LawTerm("compliance", "_held", "rad/Nm", 0.01, lambda at, j: compliance_rad(at.held_Nm(j), 1.0), True),
    ),
    COUPLING: (LawTerm(COUPLING, "", "1", 0.1, lambda at, j: at.q_rad(COUPLED_TO)),),
    DRIFT: (LawTerm(DRIFT, "", "rad", 0.05, lambda at, j: at.warmed(j)),),
    FLEXURE: (LawTerm("flexure", "", "1/(N m2)", 0.1, lambda at, k: np.zeros(len(at.points)), is_of_tip=True),),
}


# Measured maps of an arm along many poses or samples: the controller's spline as arrays, and as what is linear in its unknowns.
#
# A table's spline is a sum of uniform cubic B-splines, one a node, mirrored at the ends (de Boor, A Practical Guide to Splines,
# ch. IX).


def spline_columns(count: int, lower: float, upper: float, is_periodic: bool, x: Array) -> sparse.csr_array:
    """What the B-spline of each node does at places x (m,), (m, count)."""
    from scipy import sparse

    piece, t = _place(count, lower, upper, is_periodic, x)
    weights = np.array([(1.0 - t) ** 3, 3.0 * t**3 - 6.0 * t**2 + 4.0, -3.0 * t**3 + 3.0 * t**2 + 3.0 * t + 1.0, t**3]) / 6.0
    nodes = piece + np.arange(-1, 3)[:, None]
    rows = np.broadcast_to(np.arange(len(x)), nodes.shape)
    return sparse.csr_array((weights.ravel(), (rows.ravel(), _inside(nodes, count, is_periodic).ravel())), (len(x), count))


def node_values(coefficients: Array, is_periodic: bool) -> Array:
    """A table's values at its nodes from the coefficients of their B-splines."""
    count = len(coefficients)
    beside = _inside(np.arange(count) + np.array([[-1], [0], [1]]), count, is_periodic)
    return np.asarray(np.array([1.0, 4.0, 1.0]) / 6.0 @ coefficients[beside])


def along(correction: CorrectionMap, x: Array, direction: Array) -> Array:
    """What a map adds at x (m,), with the direction of motion (m,), -1 to 1."""
    piece, t = _place(len(correction.values), correction.lower, correction.upper, correction.is_periodic, x)
    added = _value(correction.values, correction.is_periodic, piece, t)
    if correction.by_direction:
        added = added + direction * _value(correction.by_direction, correction.is_periodic, piece, t)
    return added


def _value(values: tuple[float, ...], is_periodic: bool, piece: Array, t: Array) -> Array:
    a, b, c, d = np.array(pieces(values, is_periodic))[piece].T
    return np.asarray(a + t * (b + t * (c + t * d)))


def _place(count: int, lower: float, upper: float, is_periodic: bool, x: Array) -> tuple[Array, Array]:
    """Piece of each x and place in it, 0 to 1; beyond its ends a table is its end."""
    steps = count if is_periodic else count - 1
    at = (x - lower) * (steps / (upper - lower))
    at = np.mod(at, count) if is_periodic else np.clip(at, 0.0, steps)
    piece = np.minimum(at.astype(np.intp), steps - 1)
    return piece, at - piece


def _inside(nodes: Array, count: int, is_periodic: bool) -> Array:
    """Nodes beyond the ends as those that stand for them."""
    if is_periodic:
        return np.asarray(nodes % count)
    last = count - 1
    return np.asarray(last - np.abs(last - np.abs(nodes)))
