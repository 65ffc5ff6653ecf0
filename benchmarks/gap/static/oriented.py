"""What measured orientations add: the same six-joint arm and hidden effects, seen by position alone and with orientation.

    python -m benchmarks.gap.static.oriented --cases 20

Effects of the wrist, drawn per case, and as many nulls. The tip lies on joint 6's axis: no position shows that joint.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
from collections import Counter

import numpy as np

from benchmarks.gap.static.cases import SIZES, Design, designed
from benchmarks.gap.static.physics import Hidden
from benchmarks.gap.static.score import name_of, names
from calib.gap.poses.find import find

FIRST_SEED = 31_000
DESIGN = Design(rig="six", free=36)
TURN_NOISE_rad = (2e-4, 2e-3)  # of a laser tracker's target, and of a camera's
WRIST: dict[str, tuple[int, ...]] = {
    "backlash": (4, 5),
    "joint_compliance": (4, 5),
    "encoder_scale": (4, 5, 6),
    "encoder_eccentricity": (4, 5, 6),
    "thermal_drift": (4, 5, 6),
    "link_flexure": (3, 5),
}


def drawn_wrist(rng: np.random.Generator) -> Hidden:
    """An effect of the wrist with random joint and size."""
    effect = str(rng.choice(list(WRIST)))
    low, high = SIZES[effect]
    more = rng.uniform(-3.1, 3.1) if effect == "encoder_eccentricity" else rng.uniform(400.0, 2400.0)
    return Hidden(effect, int(rng.choice(WRIST[effect])), float(np.exp(rng.uniform(np.log(low), np.log(high)))), more)


def seen(seed: int, hidden: tuple[Hidden, ...], turn_noise_rad: float) -> str:
    """Right, in a set, nothing, unknown, or wrong."""
    arm, points = designed(seed, hidden, dataclasses.replace(DESIGN, turn_noise_rad=turn_noise_rad))
    found = find(arm, points)
    wanted, got = {name_of(one) for one in hidden}, set(names(found))
    if got - wanted:
        return "wrong"
    if got == wanted and hidden:
        return "right"
    if any(wanted & set(one) for one in found.finding.ambiguous):
        return "in a set"
    return "unknown" if found.finding.unknown is not None else "nothing"


def main() -> None:
    """Run the study."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cases", type=int, default=20)
    count = parser.parse_args().cases
    tally: dict[str, Counter[str]] = {}
    for seed in range(FIRST_SEED, FIRST_SEED + count):
        rng = np.random.default_rng(seed)
        hidden, noise = drawn_wrist(rng), float(np.exp(rng.uniform(*np.log(TURN_NOISE_rad))))
        answers = [seen(seed, (hidden,), 0.0), seen(seed, (hidden,), noise), seen(seed + 500, (), noise)]
        for sort, answer in zip(("by position", "with orientation", "nulls"), answers, strict=True):
            tally.setdefault(sort, Counter())[answer] += 1
        sys.stdout.write(f"{seed} {hidden} ({1e3 * noise:.2f} mrad): {', '.join(answers)}\n")
        sys.stdout.flush()
    for sort, counted in tally.items():
        sys.stdout.write(f"{sort}: {', '.join(f'{n} {word}' for word, n in counted.most_common())}\n")


if __name__ == "__main__":
    main()
