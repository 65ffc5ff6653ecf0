"""Scores the static half of the gap workflow on fresh recordings in which an effect is hidden: `make gap-score`.

Named cases draw effect, joint and size; open-set cases leave the hidden effect out of the list; nulls hide nothing. Seeds are
none of those on which thresholds were set (tests use 0 to 99). Prints the figures and every miss.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import numpy as np

sys.path[:0] = [str(Path(__file__).parents[1] / "tests" / "calib" / p) for p in (".", "gap")]
from static_cases import ARM, Hidden, case  # type: ignore[import-not-found]  # noqa: E402

from calib.gap.finding import EffectName  # noqa: E402
from calib.gap.static.find import StaticGap, find  # noqa: E402
from calib.gap.static.nameable import is_nameable  # noqa: E402

FIRST_SEED = 1000
SIZES = {  # smallest and largest, drawn evenly in the logarithm
    "backlash": (0.002, 0.015), "joint_compliance": (300.0, 1500.0), "encoder_scale": (0.002, 0.015),
    "encoder_eccentricity": (0.002, 0.010), "belt_coupling": (0.004, 0.02), "thermal_drift": (0.002, 0.008),
}  # fmt: skip
JOINTS = {"joint_compliance": (2, 3), "belt_coupling": (None,)}


def drawn(rng: np.random.Generator) -> Hidden:
    """One effect of some size on some joint."""
    effect = str(rng.choice(list(SIZES)))
    joints = JOINTS.get(effect, (1, 2, 3))
    low, high = SIZES[effect]
    size = float(np.exp(rng.uniform(np.log(low), np.log(high))))
    more = (
        float(rng.uniform(-3.1, 3.1))
        if effect == "encoder_eccentricity"
        else float(rng.uniform(400.0, 3000.0))
    )
    return Hidden(effect, joints[int(rng.integers(len(joints)))], size, more)


def names(found: StaticGap) -> list[EffectName]:
    """What was named beside the geometry."""
    return [e.name for e in found.finding.effects if e.name.effect != "link_geometry"]


def main() -> None:
    """Run the study."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cases", type=int, default=60, help="of each sort")
    parser.add_argument("--design", default="thin")
    given = parser.parse_args()
    began = time.perf_counter()
    score_named(given.cases, given.design)
    score_unnamed("nulls", given.cases, given.design, hide=False)
    score_unnamed("open set", given.cases, given.design, hide=True)
    sys.stdout.write(f"{time.perf_counter() - began:.0f} s\n")


def score_named(cases: int, design: str) -> None:
    """The hidden effect is in the list."""
    right = exact = nameable = right_nameable = exact_nameable = 0
    errors, gaps = [], []
    for seed in range(FIRST_SEED, FIRST_SEED + cases):
        hidden = drawn(np.random.default_rng(seed))
        found = find(ARM, case(seed, (hidden,), design))
        wanted, got = EffectName(hidden.effect, hidden.joint), names(found)
        could = {one.name: is_nameable(one) for one in found.finding.nameable}.get(wanted, False)
        nameable += could
        right += wanted in got
        exact += got == [wanted]
        right_nameable += could and wanted in got
        exact_nameable += could and got == [wanted]
        if got == [wanted]:
            value = next(iter(found.finding.effects[-1].parameters.values()))[0]
            errors.append(abs(value / hidden.value - 1.0))
            gaps.append(found.finding.gap_after)
        else:
            sys.stdout.write(
                f"  miss, seed {seed}: {hidden} named {[str(n) for n in got]}, ambiguous"
                f" {[[str(n) for n in s] for s in found.finding.ambiguous]}, unknown {found.finding.unknown}\n"
            )
    sys.stdout.write(
        f"named: {right} of {cases} right, {exact} exact; among {nameable} nameable {right_nameable} right,"
        f" {exact_nameable} exact; parameter error median {100 * np.median(errors):.1f} %, 90 % within"
        f" {100 * np.quantile(errors, 0.9):.1f} %; gap after: median {np.median(gaps):.3f}, largest {max(gaps):.3f}\n"
    )


def score_unnamed(what: str, cases: int, design: str, hide: bool) -> None:
    """Nothing hidden, or something that is not in the list: no name is right."""
    wrong = unknown = 0
    for seed in range(FIRST_SEED + 5000, FIRST_SEED + 5000 + cases):
        hidden = drawn(np.random.default_rng(seed))
        without = (hidden.effect,) if hide else ()
        found = find(ARM, case(seed, (hidden,) if hide else (), design), without=without)
        unknown += found.finding.unknown is not None
        if names(found):
            wrong += 1
            sys.stdout.write(
                f"  wrong name, seed {seed}: {hidden if hide else 'nothing'} named {names(found)}\n"
            )
    sys.stdout.write(f"{what}: {wrong} of {cases} with a wrong name; {unknown} unknown\n")


if __name__ == "__main__":
    main()
