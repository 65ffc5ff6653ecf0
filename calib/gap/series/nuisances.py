"""What is never known better: integrated out of every set, so that nothing of it is taken for an effect.

Nominal values are right to a part of the smallest size that is worth a name, and parts whose laws the file has depart from
them as all real parts do.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from calib.gap.effects.catalogue import comes_round, is_gear, series_of, usual
from calib.gap.effects.departures import departures
from calib.gap.finding import EffectName
from calib.gap.posterior.constants import DEPARTURES, IMMATERIAL
from calib.gap.posterior.term import Block, Key
from calib.gap.residuals.operating_point import OperatingPoint
from calib.gap.residuals.term import SeriesTerm, scaled
from calib.gap.signals.terms import Law

KNOWN_DEPARTURE = DEPARTURES[2]
NUISANCES = Block(0, "nuisances")


def nuisances(around: OperatingPoint, terms: Sequence[SeriesTerm]) -> Iterator[SeriesTerm]:
    """Terms of prior standard deviation one.

    Of a gear that gives way a little only what the tip shows: what its link does to the currents follows the noise of the
    measured accelerations, which the residual has, too.
    """
    variants: dict[tuple[Key, str], list[SeriesTerm]] = {}
    for one in terms:
        variants.setdefault((one.key, one.words), []).append(one)
    for some in variants.values():
        one = some[len(some) // 2]
        is_small = isinstance(one.key, EffectName) and not comes_round(one.key.effect)
        if is_small or (isinstance(one.key, Block) and one.count == 1):
            own = {
                cell: columns[:, : one.laws]
                for cell, columns in one.response.items()
                if not (isinstance(one.key, EffectName) and is_gear(one.key.effect))
                or around.scene.cells[cell].joint < 0
            }
            effect = one.key.effect if isinstance(one.key, EffectName) else one.key.variable
            if own:
                yield _nuisance(str(one.key), scaled(own, IMMATERIAL / usual(effect)), one.laws)
    for law in around.known:
        yield from _departing(around, law)


def _departing(around: OperatingPoint, law: Law) -> Iterator[SeriesTerm]:
    series = series_of(law.name.effect)
    if law.form.acts != "motor" or series is None or law.name.joint is None:
        return
    column = around.scene.split(around.scene.columns.friction_slope(law)[:, None])
    bent, _ = departures(around.scene, series.departs, law.name.joint - 1, column)
    if bent:
        yield _nuisance(
            f"{law.name}, as it departs", scaled(bent, KNOWN_DEPARTURE), next(iter(bent.values())).shape[1]
        )


def _nuisance(words: str, response: dict[int, np.ndarray], width: int) -> SeriesTerm:
    return SeriesTerm(NUISANCES, words, width, 0, 1.0, response=response, width=width)
