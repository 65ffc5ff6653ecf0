"""What a linearisation is made around, and the term of a law's response."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

from calib.arrays import Array
from calib.gap.finding import EffectName
from calib.gap.posterior.term import Key
from calib.gap.residuals.sizes import typical
from calib.gap.series.constants import USUAL, USUAL_OF
from calib.gap.series.departures import VARIABLE, departures
from calib.gap.series.scene import Response, Scene
from calib.gap.series.term import SeriesTerm, stacked
from calib.gap.signals.terms import Term as Law


@dataclass(frozen=True, slots=True)
class Around:
    """The model of a linearisation: known laws, laws found so far by key with their coefficients' residual rows."""

    scene: Scene
    known: tuple[Law, ...]
    found: dict[Key, Law]
    residual: Array

    @property
    def model(self) -> tuple[Law, ...]:
        """All of it."""
        return (*self.known, *self.found.values())

    def without(self, key: Key) -> tuple[tuple[Law, ...], Array]:
        """The model without a law, and its residual rows."""
        if key not in self.found:
            return self.model, self.residual
        rest = (*self.known, *(law for own, law in self.found.items() if own != key))
        return rest, self.scene.rows.residual(rest)


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
) -> Iterator[SeriesTerm]:
    """The term of a law's response per usual size; `more`: departures beside those of its variable."""
    if not laws:
        return
    joint = 0 if key.joint is None else key.joint - 1
    if key.effect == "belt_coupling":
        joint = 1
    departs = [own for own in (departures(around.scene, key.effect, joint, laws), more or {}) if own]
    parts = [laws, *departs, *nuisances]
    response = stacked(parts)
    count = next(iter(laws.values())).shape[1]
    width = next(iter(response.values())).shape[1]
    bends = sum(next(iter(own.values())).shape[1] for own in departs)
    yield SeriesTerm(
        key, str(key), count, bends, size, variant=variant, is_positive=is_positive,
        variable=VARIABLE.get(key.effect, ""), response=response, width=width, law=law, now=now, is_common=is_common,
        least=reach[0], most=reach[1],
    )  # fmt: skip
