"""The static half of `make gap-score` as answers of `gap_matrix`: the draws of gap_static_score, one case at a time."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks.gap.matrix import Answer, Hidden, Truth, answer
from benchmarks.gap.static.cases import PARAMETER, Design, designed, drawn, drawn_design, drawn_foreign, drawn_pair
from calib.gap.finding import EffectName
from calib.gap.poses.find import find

FIRST_SEED = 3000
SORTS = ("nothing", "one", "two", "left out", "foreign")


@dataclass(frozen=True, slots=True)
class StaticAsked:
    """One case: its sort and seed."""

    sort: str
    seed: int

    def __str__(self) -> str:
        """As `poses, foreign, seed 3`."""
        return f"poses, {self.sort}, seed {self.seed}"


def plan(count: int, first_seed: int = FIRST_SEED) -> list[StaticAsked]:
    """`count` cases of each sort; every seed once."""
    return [StaticAsked(sort, first_seed + 1000 * k + i) for i in range(count) for k, sort in enumerate(SORTS)]


def asked(case: StaticAsked) -> list[Answer]:
    """The answer to one case."""
    rng = np.random.default_rng(case.seed)
    hidden, design = _hidden(case.sort, rng)
    without = tuple(one.effect for one in hidden) if case.sort == "left out" else ()
    arm, points = designed(case.seed, hidden, design)
    began = time.process_time()
    found = find(arm, points, without=without).finding
    seconds = time.process_time() - began
    could = {one.name for one in found.nameable if one.is_nameable}
    names = tuple(Hidden(EffectName(one.effect, one.joint), _parameters(one)) for one in hidden)
    truth = Truth(names, case.sort not in ("left out", "foreign"), is_crooked=True)
    return [answer(str(case), truth, found, could, seconds)]


def _hidden(sort: str, rng: np.random.Generator) -> tuple[tuple[Any, ...], Any]:
    match sort:
        case "nothing":
            return (), drawn_design(rng)
        case "two":
            return drawn_pair(rng), Design()
        case "foreign":
            return (drawn_foreign(rng),), Design()
        case _:
            return (drawn(rng),), Design()


def _parameters(one: Any) -> dict[str, float]:
    return {PARAMETER[one.effect]: one.value} if one.effect in PARAMETER else {}
