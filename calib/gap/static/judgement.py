"""Whether what was decided is enough: a name is kept only if nothing is left that says that its law is another one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from calib.arrays import Mask
from calib.gap.finding import EffectName, Unknown
from calib.gap.poses.candidate import Candidate
from calib.gap.poses.floor import Floor
from calib.gap.poses.model import Fitted
from calib.gap.poses.shape import WHOLE_ARM, Shape
from calib.gap.static.remainder import Remainder

EXPLAINED_LEAST = (
    0.9  # share of the excess over the floor below which a name beside a remainder would be a proxy
)
HALF = (
    0.5  # of the excess: beside noise, not structure, a name is a proxy only if it explains the lesser part
)
NEGLIGIBLE = (
    5e-4  # of the excess that was explained: a law that is right to 2 % is no other law for what it leaves
)
UNSTRUCTURED = 1.1  # times the floor that residuals without any structure may be before it is said
SURE_sd = 2.0  # standard deviations of the floor itself that they may be beyond that


@dataclass(frozen=True, slots=True)
class Judgement:
    """What is kept of the accepted effects, and what is unknown."""

    kept: tuple[Candidate, ...]
    unknown: Unknown | None


def judge(
    accepted: Sequence[Candidate],
    leader: EffectName | None,
    bare: Fitted,
    fit: Fitted,
    left: Sequence[Remainder],
    rows: Mask,
    floor: Floor,
) -> Judgement:
    """`bare` has the geometry alone, `fit` the best explanation, in which `leader` explains most; `left` still pays beside it."""
    explained = explained_share(bare, fit, rows, floor.tip_m)
    if not left:
        unknown = _unstructured(fit, rows, floor, accepted, explained)
        is_little = unknown is not None and explained < HALF
        return Judgement(() if is_little else tuple(accepted), unknown)
    excess = (bare.rms_m(rows) / floor.tip_m) ** 2 - 1.0
    large = [two for two in left if two.square > NEGLIGIBLE * excess]
    withdrawn = [
        one
        for one in accepted
        if explained < EXPLAINED_LEAST or any(_is_same_cause(one, two) for two in large)
    ]
    kept = tuple(one for one in accepted if one not in withdrawn)
    if any(one.name == leader for one in kept):  # what is left is beside a name, and has no proxy of its own
        return Judgement(kept, Unknown(_where(left), None, 0.0))
    return Judgement(kept, Unknown(_where(left), leader, round(explained, 3)))


def _where(left: Sequence[Remainder]) -> str:
    """The shape that explains most of what is left; where that is no joint's, also the joint that would do most."""
    best = left[0].shape
    joint = next((one.shape for one in left if one.shape.joint != WHOLE_ARM), None)
    if best.joint != WHOLE_ARM or joint is None or best.words.startswith("joint"):
        return best.words
    return f"{best.words} (if it is a joint, then {joint.words})"


def explained_share(bare: Fitted, fit: Fitted, rows: Mask, noise_m: float) -> float:
    """How much of the excess of the mean square over the noise floor the effects take away."""
    before = (bare.rms_m(rows) / noise_m) ** 2 - 1.0
    after = max(0.0, (fit.rms_m(rows) / noise_m) ** 2 - 1.0)
    return 1.0 - after / before if before > 0.0 else 0.0


def _unstructured(
    fit: Fitted, rows: Mask, floor: Floor, accepted: Sequence[Candidate], explained: float
) -> Unknown | None:
    """A remainder without a shape is noise that the floor does not know of, unless the floor is known no better than that."""
    times = fit.rms_m(rows) / floor.tip_m
    if times <= UNSTRUCTURED + SURE_sd * floor.doubt:
        return None
    where = f"everywhere alike: without any structure, {times:.2f} times the noise floor that was given"
    return Unknown(where, accepted[0].name if accepted else None, round(explained, 3))


def is_same_joint(one: Candidate, shape: Shape) -> bool:
    """Whether a shape acts on the joint of an effect: a guess there makes every name there a guess."""
    return shape.joint == (3 if one.name.effect == "belt_coupling" else one.name.joint)


def _is_same_cause(one: Candidate, remainder: Remainder) -> bool:
    """Whether a remainder depends on what the law of an effect depends on: then that law has the wrong form."""
    shape = remainder.shape
    joint = 3 if one.name.effect == "belt_coupling" else one.name.joint
    if shape.joint != joint:
        return False
    if one.name.effect in ("encoder_scale", "encoder_eccentricity"):
        return shape.variable == f"q{joint}"
    if one.name.effect == "belt_coupling":
        return shape.variable == "q2"
    if one.name.effect == "thermal_drift":
        return shape.variable == "time"
    return shape.variable != "time"
