"""Scores the static half of the gap workflow on new recordings with hidden effects: `make gap-score`.

Named cases draw an effect of the list, its joint and its size; pairs and triples two and three of them; open-set cases leave the
hidden effect out of the list, or hide unlisted effects; nulls hide nothing, with various designs, noises and arms. Seeds are
different from those used for thresholds (below 1000). Prints every miss, the confusion matrix and the figures.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from collections.abc import Callable

import numpy as np

from benchmarks.gap.static.cases import Design, designed, drawn, drawn_design, drawn_foreign, drawn_pair
from benchmarks.gap.static.physics import Hidden
from benchmarks.studies import say
from calib.gap.finding import EffectName
from calib.gap.poses.find import find
from calib.gap.poses.outcome import StaticGap

FIRST_SEED = 2000
FIRST_PARAMETER = {"base_frame": "x_m"}


def names(found: StaticGap) -> list[EffectName]:
    """The named effects besides geometry."""
    return [e.name for e in found.finding.effects if e.name.effect != "link_geometry"]


def name_of(one: Hidden) -> EffectName:
    """The effect's name in the finding."""
    return EffectName(one.effect, one.joint)


def main() -> None:
    """Run the study."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cases", type=int, default=60, help="of each sort")
    parser.add_argument("--first-seed", type=int, default=FIRST_SEED)
    parser.add_argument("--only", nargs="*", choices=tuple(PARTS), default=list(PARTS))
    given = parser.parse_args()
    began = time.perf_counter()
    for part in given.only:
        PARTS[part](given.first_seed, given.cases)
    say(f"{time.perf_counter() - began:.0f} s")


def score_named(first: int, cases: int) -> None:
    """The hidden effect is in the list."""
    matrix: Counter[tuple[str, str]] = Counter()
    tally: Counter[str] = Counter()
    errors, gaps, slowest = [], [], 0.0
    for seed in range(first, first + cases):
        hidden = drawn(np.random.default_rng(seed))
        found, took_s = _found(seed, (hidden,))
        wanted, got = name_of(hidden), names(found)
        could = {one.name: one.is_nameable for one in found.finding.nameable}.get(wanted, False)
        matrix[_short(wanted), _answer(found)] += 1
        tally.update(
            nameable=could,
            right=wanted in got,
            exact=got == [wanted],
            right_nameable=could and wanted in got,
            exact_nameable=could and got == [wanted],
            in_set=wanted not in got and any(wanted in one for one in found.finding.ambiguous),
        )
        slowest = max(slowest, took_s)
        if got == [wanted]:
            parameters = found.finding.effects[-1].parameters
            value = parameters.get(FIRST_PARAMETER.get(hidden.effect, ""), next(iter(parameters.values())))[0]
            errors.append(abs(value / hidden.value - 1.0))
            gaps.append(found.finding.gap_after)
            if gaps[-1] > 1.1:
                say(f"  seed {seed}: {hidden} right, and the gap after is {gaps[-1]:.2f}")
        else:
            _miss(seed, (hidden,), found)
    _table(matrix)
    say(
        f"named: {tally['right']} of {cases} right, {tally['exact']} exact, {tally['in_set']} in an ambiguous set; among"
        f" {tally['nameable']} nameable {tally['right_nameable']} right, {tally['exact_nameable']} exact; parameter error median"
        f" {100 * np.median(errors):.1f} %, 90 % within {100 * np.quantile(errors, 0.9):.1f} %,"
        f" {sum(e <= 0.1 for e in errors)} of {len(errors)} within 10 %; gap after: median {np.median(gaps):.3f}, largest"
        f" {max(gaps):.3f}; slowest {slowest:.1f} s"
    )


def score_several(first: int, cases: int, count: int) -> None:
    """Two or three effects at once."""
    tally: Counter[str] = Counter()
    for seed in range(first + 1000 * count, first + 1000 * count + cases // 2):
        hidden = drawn_pair(np.random.default_rng(seed), count)
        found, _ = _found(seed, hidden)
        wanted, got = {name_of(one) for one in hidden}, set(names(found))
        could = {one.name for one in found.finding.nameable if one.is_nameable}
        reported = got | {name for names_ in found.finding.ambiguous for name in names_}
        tally.update(
            exact=got == wanted,
            no_wrong=got <= wanted,
            some=bool(got & wanted),
            honest=wanted <= reported,
            nameable=wanted <= could,
            exact_nameable=wanted <= could and got == wanted,
        )
        if got != wanted:
            _miss(seed, hidden, found)
    say(
        f"{count} at once: {tally['exact']} of {cases // 2} exact, {tally['honest']} named or in an ambiguous set,"
        f" {tally['no_wrong']} without a wrong name; among {tally['nameable']} all nameable {tally['exact_nameable']} exact"
    )


def score_unlisted(first: int, cases: int) -> None:
    """The hidden effect is left out of the list."""
    _score_open("open set, left out", first + 5000, cases, lambda rng: (h := drawn(rng), (h.effect,), Design()))


def score_foreign(first: int, cases: int) -> None:
    """Score unlisted effects."""
    _score_open("open set, foreign", first + 6000, cases, lambda rng: (drawn_foreign(rng), (), Design()))


def score_nulls(first: int, cases: int) -> None:
    """Score recordings without hidden effects, in various designs."""
    _score_open("nulls", first + 7000, cases, lambda rng: (None, (), drawn_design(rng)))


Drawn = tuple[Hidden | None, tuple[str, ...], Design]


def _score_open(what: str, first: int, cases: int, draw: Callable[[np.random.Generator], Drawn]) -> None:
    matrix: Counter[tuple[str, str]] = Counter()
    wrong = unknown = 0
    for seed in range(first, first + cases):
        hidden, without, design = draw(np.random.default_rng(seed))
        found, _ = _found(seed, (hidden,) if hidden else (), without, design)
        matrix[hidden.effect if hidden else design.rig, _answer(found)] += 1
        unknown += found.finding.unknown is not None
        if names(found) or (hidden is None and found.finding.unknown is not None):
            wrong += bool(names(found))
            _miss(seed, (hidden,) if hidden else (design,), found)
    _table(matrix)
    say(f"{what}: {wrong} of {cases} with a wrong name; {unknown} unknown")


def _found(
    seed: int, hidden: tuple[Hidden, ...], without: tuple[str, ...] = (), design: Design | None = None
) -> tuple[StaticGap, float]:
    arm, points = designed(seed, hidden, design or Design())
    began = time.perf_counter()
    return find(arm, points, without=without), time.perf_counter() - began


def _answer(found: StaticGap) -> str:
    """One word for the confusion matrix."""
    if got := names(found):
        return "+".join(_short(name) for name in got)
    if found.finding.unknown is not None:
        return "unknown"
    return "set" if found.finding.ambiguous else "nothing"


def _short(name: EffectName) -> str:
    return f"{name.effect}{name.joint or ''}"


def _miss(seed: int, hidden: tuple[object, ...], found: StaticGap) -> None:
    ambiguous = [[_short(n) for n in s] for s in found.finding.ambiguous]
    where = found.finding.unknown
    say(
        f"  seed {seed}: {hidden}: named {[_short(n) for n in names(found)]}, ambiguous {ambiguous}, unknown"
        f" {where and (where.where, str(where.nearest), where.explained)}"
    )


def _table(matrix: Counter[tuple[str, str]]) -> None:
    """Rows: hidden effects; columns: answers."""
    for row in sorted({row for row, _ in matrix}):
        cells = [f"{answer} {count}" for (own, answer), count in matrix.most_common() if own == row]
        say(f"  {row:24} {', '.join(cells)}")


PARTS: dict[str, Callable[[int, int], None]] = {
    "named": score_named,
    "pairs": lambda first, cases: score_several(first, cases, 2),
    "triples": lambda first, cases: score_several(first, cases, 3),
    "unlisted": score_unlisted,
    "foreign": score_foreign,
    "nulls": score_nulls,
}

if __name__ == "__main__":
    main()
