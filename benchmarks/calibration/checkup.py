"""Check-ups of arms on which something has changed since their calibration: how often is the decision right?

The arms are made without this project's kinematics and dynamics (benchmarks.gap.static); each has play and a spring before.
"""

from __future__ import annotations

import argparse
from collections import Counter
from functools import cache

import numpy as np

from benchmarks.calibration.trust_coverage import session
from benchmarks.gap.static.cases import ARM, NOISE_m
from benchmarks.gap.static.physics import Hidden
from calib.arrays import Array
from calib.checkup import CheckupDecision, checkup_plan, decide, expectation_of
from calib.points.points import Points, make_points

SORTS = {  # what happens to joint j, and the right decision
    "nothing": "fine",
    "drifted zero": "recalibrate",
    "slipped encoder": "inspect joint",
    "worn play": "inspect joint",
    "loose link": "inspect joint",
}
PLAY_rad, STIFFNESS_Nm_rad = 1.2e-3, 4000.0


@cache
def visits_of(seed: int) -> tuple[Array, Array]:
    """Joint angles and directions of the check-up that is designed for this arm, (m, n) each."""
    plan = checkup_plan(ARM, before(seed))
    q = np.array([visit.q_rad for visit in plan.visits])
    return q, np.array([visit.direction for visit in plan.visits], dtype=float)


@cache
def before(seed: int) -> Points:
    """The points of the calibration."""
    return session(seed, sound(), np.zeros((1, 3))).points


def sound() -> tuple[Hidden, ...]:
    """What the arm has from the start."""
    return (*(Hidden("backlash", j, PLAY_rad) for j in (1, 2, 3)), Hidden("joint_compliance", 2, STIFFNESS_Nm_rad))


def checked(seed: int, sort: str, joint: int) -> CheckupDecision:
    """The decision about an arm on whose joint this has happened."""
    rng = np.random.default_rng(seed + 1)
    hidden = list(sound())
    if sort == "worn play":
        hidden[joint - 1] = Hidden("backlash", joint, PLAY_rad + rng.uniform(4e-3, 8e-3))
    if sort == "loose link":
        kept = [one for one in hidden if (one.effect, one.joint) != ("joint_compliance", joint)]
        hidden = [*kept, Hidden("joint_compliance", joint, {2: 700.0, 3: 150.0}[joint] * rng.uniform(0.8, 1.2))]
    q, direction = visits_of(seed)
    moved = np.zeros(3)
    if sort == "drifted zero":
        moved[joint - 1] = rng.choice((-1.0, 1.0)) * rng.uniform(2e-3, 5e-3)
    if sort == "slipped encoder":
        moved[joint - 1] = rng.choice((-1.0, 1.0)) * rng.uniform(0.012, 0.04)
    made = session(seed, tuple(hidden), q, direction)
    at = made.unseen
    tip = made.true_m + rng.normal(0.0, NOISE_m, made.true_m.shape)
    names = [f"c{k}" for k in range(len(q))]
    points = make_points(["free"] * len(q), names, [1] * len(q), at.q_rad - moved, tip, at.direction, at.current_A)
    return decide(expectation_of(ARM, before(seed), points))


def is_right(found: CheckupDecision, sort: str, joint: int) -> bool:
    """Whether the action is the right one, of the right joint."""
    wanted = SORTS[sort]
    return found.action == (f"{wanted} {joint}" if wanted == "inspect joint" else wanted)


def main() -> None:
    """Print how often the decision was right, not sure, and wrong, and the wrong ones."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cases", type=int, default=12)
    parser.add_argument("--first-seed", type=int, default=7000)
    args = parser.parse_args()
    for sort in SORTS:
        tally: Counter[str] = Counter()
        for seed in range(args.first_seed, args.first_seed + args.cases):
            joint = 2 + seed % 2 if sort == "loose link" else 1 + seed % 3
            found = checked(seed, sort, joint)
            said = "right" if is_right(found, sort, joint) else "wrong"
            said = said if found.is_sure else f"not sure, likeliest {said}"
            tally[said] += 1
            if said == "wrong":
                print(f"  {sort} {seed}, joint {joint}: {found.action} ({found.probability:.2f})", flush=True)
        print(f"{sort}: {', '.join(f'{count} {said}' for said, count in sorted(tally.items()))}", flush=True)


if __name__ == "__main__":
    main()
