"""Time series from the mock arm's physics: eleven runs of 8 s at 500 Hz, slow to fast, two repeated, one with both loads."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from benchmarks.gap.mock.rig import CAMERA_NOISE_m, CONTROL_Hz, MockRig, Trace, effects_with
from calib.arrays import Array, frozen
from calib.gap.log import Log, LoggedRun
from control.model.arm import Arm
from hil_mocks.plant.effects import EffectEntry

CURRENT_NOISE_A = 0.01
SECONDS, EASE_S, REST_S = 8.0, 1.0, 1.0
CAMERA_EVERY = 5  # samples
PAYLOAD_kg = 0.5
LOADED = (6, 9)  # runs
ORDER = ("slow", "creep", "free", "sweep", "fast", "ramps", "other", "slow", "third", "ramps", "free")


def motion_case(arm: Arm, hidden: Sequence[EffectEntry], seed: int, seconds: float = SECONDS, link_share: float = 0.5) -> Log:
    """The runs of an arm with these effects; frictions of arm.toml are real, and the controller feeds them forward."""
    rng = np.random.default_rng(seed)
    effects = effects_with(arm, hidden)
    sets = _set_points(arm, rng, seconds)
    runs = []
    for k, name in enumerate(ORDER):
        payload = PAYLOAD_kg if k in LOADED else 0.0
        rig = MockRig(arm, effects, sets[name][0].tolist(), payload, pieces=2, link_share=link_share)
        rig.follow(np.tile(sets[name][0], (round(REST_S * CONTROL_Hz), 1)))
        trace = rig.follow(sets[name], range(0, len(sets[name]), CAMERA_EVERY))
        runs.append(_run(str(k + 1), sets[name], trace, payload, rng))
    return Log(tuple(runs), ("log.csv",))


def _run(name: str, sets: Array, trace: Trace, payload_kg: float, rng: np.random.Generator) -> LoggedRun:
    m = len(sets)
    return LoggedRun(
        name,
        frozen(np.arange(m) / CONTROL_Hz),
        frozen(trace.q_rad),
        frozen(np.round(sets, 7)),
        frozen(trace.current_A + rng.normal(0.0, CURRENT_NOISE_A, sets.shape)),
        frozen(trace.voltage_V),
        frozen(np.full(m, payload_kg)),
        frozen(trace.tip_m + rng.normal(0.0, CAMERA_NOISE_m, (m, 3))),
    )


def _set_points(arm: Arm, rng: np.random.Generator, seconds: float) -> dict[str, Array]:
    """Set-points (m, n) by the name of a run, each from the middle of the range and at rest."""
    lower, upper = np.clip(np.array(arm.limits_rad), -1.5, 1.5).T
    middle, half = 0.5 * (lower + upper), 0.5 * (upper - lower)
    t = np.arange(round(seconds * CONTROL_Hz)) / CONTROL_Hz
    ease = np.clip(t / EASE_S, 0.0, 1.0)
    ease = (ease**3 * (10.0 - 15.0 * ease + 6.0 * ease**2))[:, None]
    n = arm.joint_count

    def waves(share: float, low_Hz: float, high_Hz: float, count: int = 4) -> Array:
        """A sum of sines of each joint, within this share of its range."""
        f = rng.uniform(low_Hz, high_Hz, (count, n))
        phase = rng.uniform(0.0, 2.0 * np.pi, (count, n))
        out = np.sin(2.0 * np.pi * f * t[:, None, None] + phase).sum(axis=1) / count
        return np.asarray(middle + share * half * out * ease)

    def ramps() -> Array:
        """There and back, joints at different times and speeds, with rounded corners."""
        period = rng.uniform(3.2, 4.8, n)
        triangle = 2.0 / np.pi * np.arcsin(0.998 * np.sin(2.0 * np.pi * t[:, None] / period))
        return np.asarray(middle + 0.42 * half * triangle * ease)

    def sweep() -> Array:
        turn = 2.0 * np.pi * (0.2 * t + 0.5 * 2.4 / seconds * t**2)
        return np.asarray(middle + 0.1 * half * np.sin(turn[:, None] + np.arange(n)) * ease)

    return {
        "slow": waves(0.45, 0.10, 0.25, 2),
        "creep": waves(0.08, 0.12, 0.25, 2),
        "free": waves(0.7, 0.1, 0.7),
        "sweep": sweep(),
        "fast": waves(0.03, 2.0, 7.0, 5),
        "ramps": ramps(),
        "other": waves(0.7, 0.1, 0.7),
        "third": waves(0.7, 0.1, 0.8),
    }
