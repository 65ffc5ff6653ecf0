"""Poses and time series of one mock arm, each alone and together: `python -m benchmarks.gap.mock.together --cases 6`.

Every arm is crooked, has dry friction that its file states, and hides one to three effects of either level. Counted are names
that are right, wrong and missed; together must have at least as many right as the better of the two alone.
"""

from __future__ import annotations

import argparse
import os
import time
from collections import Counter
from collections.abc import Collection
from concurrent.futures import ProcessPoolExecutor

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # the matrices are small: more threads only wait

import numpy as np

from benchmarks.arms import arm_named
from benchmarks.gap.mock.cases import DYNAMIC, STATIC, Level, arm_with_friction, entry, joints_of
from benchmarks.gap.mock.motion import motion_case
from benchmarks.gap.mock.static import geometry_of, static_case
from benchmarks.studies import say
from calib.gap.finding import GEOMETRY, EffectName, GapFinding
from calib.gap.log import Log
from calib.gap.workflow import find_gap
from calib.points.points import Points
from control.model.arm import Arm
from hil_mocks.plant.effects import EffectEntry

BOTH = tuple(name for name in STATIC if name in DYNAMIC)  # which both levels may show
FRAME = "base_frame"


def hidden_in(arm: Arm, seed: int) -> tuple[EffectEntry, ...]:
    """One to three effects, each of another name: one that both levels show, then any."""
    rng = np.random.default_rng([seed, 7])
    names = [str(rng.choice(BOTH)), *map(str, rng.permutation([*{**STATIC, **DYNAMIC}]))]
    found: list[EffectEntry] = []
    for name in dict.fromkeys(names):
        level: Level = "static" if name in STATIC else "dynamic"
        joints = joints_of(name, level, arm)
        if joints and name not in ("thermal_drift", "payload"):  # which are of a session, not of the arm
            small, _, large = (STATIC if level == "static" else DYNAMIC)[name]
            size = float(np.exp(rng.uniform(*sorted((np.log(small), np.log(large))))))
            found.append(entry(name, int(rng.choice(joints)), size, rng))
        if len(found) == 1 + seed % 3:
            break
    return tuple(found)


def names_of(found: GapFinding) -> set[EffectName]:
    """Names, geometry and frames apart."""
    return {one.name for one in found.effects if one.name.effect not in (GEOMETRY, FRAME)}


def recorded(arm: Arm, seed: int) -> tuple[Arm, tuple[EffectEntry, ...], Points, Log]:
    """The arm as its file knows it, what is hidden, and its poses and time series."""
    known, hidden = arm_with_friction(arm, seed), hidden_in(arm, seed)
    bent = geometry_of(arm, np.random.default_rng(seed))
    points = static_case(known, (*hidden, bent), seed, is_crooked=False, has_unknown_friction=False)
    return known, hidden, points, motion_case(known, (*hidden, bent), seed)


def judged(arm_name: str, seed: int) -> tuple[str, dict[str, Counter[str]]]:
    """A line, and the counts of an arm by way of looking at it."""
    known, hidden, points, log = recorded(arm_named(arm_name), seed)
    began = time.process_time()
    poses = find_gap(known, points=points).finding
    series = find_gap(known, log=log).finding
    both = find_gap(known, points=points, log=log).finding
    truth = {EffectName(one.effect, one.joint or None) for one in hidden}
    count, parts = {}, []
    for way, found in (("poses", poses), ("series", series), ("together", both)):
        count[way] = counted(truth, names_of(found), found)
        sets = [[str(name) for name in names] for names in found.ambiguous]
        parts.append(
            f"{way}: {' '.join(sorted(map(str, names_of(found)))) or '-'}{f' sets {sets}' if sets else ''}"
            f"{' unknown' if found.unknown else ''} {found.gap_before:.2f} -> {found.gap_after:.2f}"
        )
    hid = " ".join(f"{one.effect}{one.joint or ''} {next(iter(one.parameters.values())):.3g}" for one in hidden)
    return f"{seed} hides {hid}\n    " + "\n    ".join(parts) + f"\n    {time.process_time() - began:.0f} s", count


def counted(truth: Collection[EffectName], named: set[EffectName], found: GapFinding) -> Counter[str]:
    """Names that are right, wrong and missed, and whether all is right."""
    wrong = named - set(truth)
    return Counter(
        right=len(named & set(truth)),
        wrong=len(wrong),
        missed=len(set(truth) - named),
        all=int(named == set(truth)),
        unknown=int(found.unknown is not None),
    )


def main() -> None:
    """Print a paragraph an arm and the sums."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--arm", default="right", help="arm.toml, an arm that ships, or one of benchmarks.arms (four, six ...)")
    parser.add_argument("--cases", type=int, default=20)
    parser.add_argument("--first-seed", type=int, default=8000)
    parser.add_argument("--processes", type=int, default=2)
    given = parser.parse_args()
    total: dict[str, Counter[str]] = {}
    with ProcessPoolExecutor(given.processes) as pool:
        seeds = range(given.first_seed, given.first_seed + given.cases)
        for line, count in pool.map(judged, [given.arm] * len(seeds), seeds):
            say(line)
            for way, own in count.items():
                total[way] = total.get(way, Counter()) + own
    for way, own in total.items():
        say(f"== {way} {given.cases}: " + "  ".join(f"{key} {number}" for key, number in sorted(own.items())))


if __name__ == "__main__":
    main()
