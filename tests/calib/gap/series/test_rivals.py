"""Which sets are looked at around themselves, beside the best."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

from calib.gap.finding import EffectName
from calib.gap.posterior.evidence import Weighed
from calib.gap.posterior.term import Block
from calib.gap.series.iterations import contests

SCALE, WAVE, COULOMB, SOFT = (
    EffectName("encoder_scale", 3),
    EffectName("encoder_eccentricity", 3),
    EffectName("coulomb_friction", 3),
    EffectName("joint_compliance", 3),
)
KEYS = [SCALE, WAVE, COULOMB, SOFT, Block(3, "load")]


def fit(*sets: tuple[float, list[Any]]) -> Any:
    """A fit whose best set is the first; its scale adds 800 to the log evidence, its friction 6."""
    gains = {SCALE: 800.0, COULOMB: 6.0}
    found = [
        Weighed(tuple((KEYS.index(key), 0) for key in keys), 1.0, log, tuple(gains.get(k, 0.0) for k in keys))
        for log, keys in sets
    ]
    terms = [SimpleNamespace(key=key) for key in KEYS]
    decision = SimpleNamespace(names=(SCALE, COULOMB))
    evidence = SimpleNamespace(terms=terms, sizes=lambda weighed: {})
    linear = SimpleNamespace(terms=terms)
    return SimpleNamespace(linear=linear, evidence=evidence, best=found[0], sets=tuple(found), decision=decision)


def test_what_explains_nine_tenths_of_a_name_in_its_place_is_its_rival() -> None:
    found = list(contests(fit((0.0, [SCALE, COULOMB]), (-51.0, [WAVE]), (-60.0, [WAVE, COULOMB]), (-800.0, [COULOMB]))))
    assert [(name, rival, one.log) for name, rival, one in found] == [(SCALE, WAVE, -51.0)]


def test_what_explains_less_a_block_and_what_comes_besides_are_none() -> None:
    sets = [(0.0, [SCALE, COULOMB]), (-5.5, [SCALE, WAVE, COULOMB]), (-30.0, [COULOMB, KEYS[4]]), (-120.0, [SOFT, COULOMB])]
    assert list(contests(fit(*sets))) == []
