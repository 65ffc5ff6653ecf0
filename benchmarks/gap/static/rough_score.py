"""How often poses are answered right where no law is exact: exact and rough laws, many effects at once, nulls, what no list
names, effects that the file knows in part.

    python -m benchmarks.gap.static.rough_score --sorts rough many --cases 60 --first-seed 90000
"""

from __future__ import annotations

import argparse
import time
from collections import Counter

import numpy as np

from benchmarks.gap.static.cases import PARAMETER
from benchmarks.gap.static.rough_cases import Case, case
from benchmarks.studies import say
from calib.gap.finding import EffectName, GapFinding
from calib.gap.poses.find import find
from calib.gap.words import interval

SORTS = ("exact", "rough", "many", "null", "foreign", "known")


def main() -> None:
    """Run the study."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cases", type=int, default=60)
    parser.add_argument("--first-seed", type=int, default=90_000)
    parser.add_argument("--sorts", nargs="*", choices=SORTS, default=list(SORTS))
    given = parser.parse_args()
    for k, sort in enumerate(SORTS):
        if sort in given.sorts:
            _score(sort, given.first_seed + 1000 * k, given.cases)


def _score(sort: str, first: int, cases: int) -> None:
    tally: Counter[str] = Counter()
    errors: list[float] = []
    sds: list[float] = []
    held: list[bool] = []
    gaps: list[float] = []
    took: list[float] = []
    for seed in range(first, first + cases):
        one = case(sort, seed)
        began = time.process_time()
        found = find(one.arm, one.points).finding
        took.append(time.process_time() - began)
        _judge(one, found, tally, errors, sds, held, gaps, f"{sort} {seed}")
    numbers = "  ".join(f"{key} {count}" for key, count in sorted(tally.items()))
    more = f"; seconds median {np.median(took):.1f}, most {max(took):.1f}"
    if errors:
        more += (
            f"; parameters: median {100 * np.median(errors):.1f} %, within 10 % {sum(e <= 0.1 for e in errors)} of {len(errors)},"
            f" within 2 sd {sum(s <= 1.96 for s in sds)}, in their intervals {sum(held)} of {len(sds)}"
        )
    if gaps:
        more += f"; gap after median {np.median(gaps):.2f}, largest {max(gaps):.2f}, <= 1.3: {sum(g <= 1.3 for g in gaps)}"
    say(f"== {sort} {cases}: {numbers}{more}")


def _judge(
    one: Case,
    found: GapFinding,
    tally: Counter[str],
    errors: list[float],
    sds: list[float],
    held: list[bool],
    gaps: list[float],
    label: str,
) -> None:
    wanted = {EffectName(h.effect, h.joint): h for h in one.hidden} if one.is_listed else {}
    got = {e.name: e for e in found.effects if e.name.effect != "link_geometry"}
    could = {n.name for n in found.nameable if n.is_nameable}
    in_set = {name for names in found.ambiguous for name in names}
    right, wrong = wanted.keys() & got.keys(), got.keys() - wanted.keys()
    is_exact = got.keys() == wanted.keys()
    tally["exact"] += is_exact
    tally["nameable"] += bool(wanted) and wanted.keys() <= could
    tally["nameable right"] += bool(wanted) and wanted.keys() <= could and wanted.keys() <= got.keys()
    tally["right"] += bool(wanted) and len(right) == len(wanted)
    tally["right or set"] += bool(wanted) and wanted.keys() <= got.keys() | in_set
    tally["wrong name"] += bool(wrong)
    tally["unknown"] += found.unknown is not None
    for name in right:
        value, sd = got[name].parameters[PARAMETER[name.effect]]
        off = abs(value - wanted[name].value)
        if name.effect != "base_frame":
            errors.append(off / abs(wanted[name].value - (name.effect == "torque_constant")))
            sds.append(off / max(sd, 1e-300))
            lower, upper = interval(got[name], PARAMETER[name.effect])
            held.append(lower <= wanted[name].value <= upper)
    if wanted and len(right) == len(wanted):
        gaps.append(found.gap_after)
    if not is_exact or (one.is_listed and found.unknown is not None) or (wanted and found.gap_after > 1.3):
        say(
            f"  {label}: {[(h.effect, h.joint, round(h.value, 5)) for h in one.hidden]}: named"
            f" {[(str(n), {k: float(f'{v[0]:.4g}') for k, v in e.parameters.items()}) for n, e in got.items()]}, sets"
            f" {[[str(n) for n in s] for s in found.ambiguous]}, unknown {found.unknown and found.unknown.where}, gap"
            f" {found.gap_before:.1f} {found.gap_after:.2f}, nameable {wanted.keys() <= could}"
        )


if __name__ == "__main__":
    main()
