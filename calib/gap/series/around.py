"""What a linearisation is made around, and the term of a law's response."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

from calib.arrays import Array
from calib.gap.finding import EffectName
from calib.gap.posterior.term import Key
from calib.gap.residuals.sizes import typical
from calib.gap.series.constants import USUAL, USUAL_OF
from calib.gap.series.departures import VARIABLE, departures
from calib.gap.series.scene import Response, Scene
from calib.gap.series.term import Curve, SeriesTerm, stacked
from calib.gap.signals.terms import Term as Law


@dataclass(frozen=True, slots=True)
class Around:
    """The model of a linearisation: known laws, and laws found so far by key.

    `residual`: its rows; `smooth`: what it would have left if motions and currents had been measured without noise.
    """

    scene: Scene
    known: tuple[Law, ...]
    found: dict[Key, Law]
    residual: Array
    smooth: Array

    @classmethod
    def of(cls, scene: Scene, known: Sequence[Law], found: Mapping[Key, Law]) -> Around:
        """With what it leaves."""
        model = (*known, *found.values())
        return cls(
            scene, tuple(known), dict(found), scene.rows.residual(model), scene.columns.residual(model)
        )

    @property
    def model(self) -> tuple[Law, ...]:
        """All of it."""
        return (*self.known, *self.found.values())

    def without(self, key: Key) -> tuple[tuple[Law, ...], Array]:
        """The model without a law, and its rows as columns are reckoned from them."""
        if key not in self.found:
            return self.model, self.smooth
        rest = (*self.known, *(law for own, law in self.found.items() if own != key))
        return rest, self.scene.columns.residual(rest)


def usual(effect: str) -> float:
    """The usual size of an effect, in smallest sizes worth a name."""
    return USUAL_OF.get(effect, USUAL)


def size_of_law(around: Around, law: Law) -> float:
    return usual(law.form) * typical(around.scene.arm, law.form, law.index)


def made(
    around: Around,
    key: EffectName,
    laws: Response,
    size: float,
    law: Callable[[Array], Law],
    nuisances: Sequence[Response] = (),
    variant: float = 0.0,
    is_positive: bool = False,
    now: Array | None = None,
    more: Response | None = None,
    is_common: bool = False,
    reach: tuple[float, float] = (0.0, math.inf),
    towards: tuple[float, float] | None = None,
) -> Iterator[SeriesTerm]:
    """The term of a law's response per usual size; `more`: departures beside those of its variable.

    `towards`: the law's first value at which its response is a secant, and that at which the first nuisance has it.
    """
    if not laws:
        return
    joint = 0 if key.joint is None else key.joint - 1
    if key.effect == "belt_coupling":
        joint = 1
    bent, alike = departures(around.scene, key.effect, joint, laws)
    departs = [own for own in (bent, more or {}) if own]
    parts = [laws, *departs, *nuisances]
    response = stacked(parts)
    count = next(iter(laws.values())).shape[1]
    width = next(iter(response.values())).shape[1]
    bends = sum(next(iter(own.values())).shape[1] for own in departs)
    curve = None if towards is None else Curve(count + bends, *towards, size)
    yield SeriesTerm(
        key, str(key), count, bends, size, variant=variant, is_positive=is_positive,
        variable=VARIABLE.get(key.effect, ""), response=response, width=width, law=law, now=now, is_common=is_common,
        least=reach[0], most=reach[1], alike=alike, curve=curve,
    )  # fmt: skip
