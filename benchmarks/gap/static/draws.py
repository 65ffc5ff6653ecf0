"""Random hidden effects and random designs, for the score and the tests."""

from __future__ import annotations

import numpy as np

from benchmarks.gap.static.cases import Design
from benchmarks.gap.static.physics import Hidden

SIZES = {  # smallest and largest, drawn evenly in the logarithm
    "backlash": (0.002, 0.015), "joint_compliance": (300.0, 1500.0), "encoder_scale": (0.002, 0.015),
    "encoder_eccentricity": (0.002, 0.010), "belt_coupling": (0.004, 0.02), "thermal_drift": (0.002, 0.008),
    "link_flexure": (60.0, 600.0), "base_frame": (0.002, 0.006), "payload": (0.1, 0.5), "torque_constant": (0.08, 0.25),
    "link_inertia": (0.15, 0.6),
}  # fmt: skip
JOINTS: dict[str, tuple[int | None, ...]] = {
    "joint_compliance": (2, 3), "belt_coupling": (None,), "link_flexure": (2, 3), "base_frame": (None,), "payload": (None,),
    "torque_constant": (2, 3), "link_inertia": (2, 3),
}  # fmt: skip
ON_TIP = tuple(SIZES)[:8]
FOREIGN: dict[str, tuple[tuple[int | None, ...], float, float, float, float]] = {  # joints, sizes, more
    "slip": ((1, 2, 3), 0.002, 0.01, 0.3, 0.7),
    "bent rail": ((1, 2, 3), 0.002, 0.01, 0.0, 1.0),
    "hysteresis": ((2, 3), 0.001, 0.005, 0.0, 1.0),
    "ripple": ((1, 2, 3), 0.002, 0.006, 4.0, 9.0),
    "motor ripple": ((1, 2, 3), 0.001, 0.004, 0.0, 3.0),
    "slipping zero": ((1, 2, 3), 0.002, 0.008, 0.0, 1.0),
    "linear drift": ((1, 2, 3), 0.002, 0.008, 0.0, 1.0),
    "periodic drift": ((1, 2, 3), 0.001, 0.005, 1.0, 6.0),
    "stiffening": ((2, 3), 0.001, 0.004, 0.0, 1.0),
    "softening": ((2, 3), 0.0006, 0.003, 0.0, 1.0),
    "asymmetric compliance": ((2, 3), 0.0007, 0.003, 0.0, 1.0),
    "lost counts": ((1, 2, 3), 0.0001, 0.0005, 0.0, 1.0),
    "wobble": ((1, 2, 3), 0.001, 0.006, -3.0, 3.0),
    "loose tool": (
        (None,),
        0.0004,
        0.002,
        0.6,
        2.4,
    ),  # across the forearm it is equivalent to backlash of joint 3
    "camera scale": ((None,), 0.001, 0.01, 0.0, 1.0),
    "camera lens": ((None,), 0.001, 0.01, 0.0, 1.0),
    "camera skew": ((None,), 0.002, 0.01, 0.0, 1.0),
    "registration": ((None,), 0.0005, 0.003, 0.0, 3.0),
    "tilted table": ((None,), 0.003, 0.02, 0.0, 2.0),
    "late camera": ((None,), 0.002, 0.01, 0.0, 1.0),
}


def _log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def drawn(rng: np.random.Generator, among: tuple[str, ...] = tuple(SIZES)) -> Hidden:
    """A random effect of the list, with random size and joint."""
    effect = str(rng.choice(list(among)))
    joints = JOINTS.get(effect, (1, 2, 3))
    size = _log_uniform(rng, *SIZES[effect])
    if effect == "torque_constant":
        size = 1.0 + size * (1 if rng.uniform() < 0.5 else -1)
    more = {"encoder_eccentricity": rng.uniform(-3.1, 3.1), "base_frame": rng.uniform(-0.02, 0.02)}.get(
        effect, rng.uniform(400.0, 2400.0)
    )
    return Hidden(effect, joints[int(rng.integers(len(joints)))], size, float(more))


def drawn_foreign(rng: np.random.Generator) -> Hidden:
    """A random unlisted effect."""
    effect = str(rng.choice(list(FOREIGN)))
    joints, low, high, first, last = FOREIGN[effect]
    more = float(rng.uniform(first, last))
    return Hidden(effect, joints[int(rng.integers(len(joints)))], _log_uniform(rng, low, high), more)


def drawn_pair(rng: np.random.Generator, count: int = 2) -> tuple[Hidden, ...]:
    """Different effects, or the same on different joints."""
    found: dict[tuple[str, int | None], Hidden] = {}
    while len(found) < count:
        one = drawn(rng)
        found[(one.effect, one.joint)] = one
    return tuple(found.values())


def drawn_design(rng: np.random.Generator) -> Design:
    """A random design of 33 to 700 poses, with known or unknown noise."""
    rig = str(rng.choice(["reference", "reference", "six", "planar"]))
    tilts = ("normal", "roll", "pitch")[: int(rng.integers(1, 4))]
    visits = int(rng.choice([1, 2, 4, 5, 7]))
    has_repeats = visits >= 5
    return Design(
        rig=rig,
        tilts=tilts,
        step=int(rng.choice([1, 2, 4])),
        free=int(rng.choice([12, 25, 40])) if rig == "reference" else int(rng.integers(35, 100)),
        visits=visits,
        noise_m=float(np.exp(rng.uniform(np.log(5e-5), np.log(5e-4)))),
        has_currents=bool(rng.uniform() < 0.6),
        has_directions=bool(rng.uniform() < 0.8),
        has_payload=bool(rng.uniform() < 0.7),
        has_time=bool(rng.uniform() < 0.8),
        is_noise_told=bool(rng.uniform() < 0.7) or not has_repeats,
    )
