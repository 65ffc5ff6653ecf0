"""How well lengths calibrate the reference arm: `python -m benchmarks.calibration.distances`, a quarter of a minute.

Drawn arms of usual deviations; readings in random poses over the joints' ranges. The error is of tips over the whole workspace,
after the best rigid motion: where the base stands, unknown devices cannot say.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calib.arm_problem.assembly import Choice
from calib.arrays import Array, norms
from calib.boards import best_motion
from calib.distance_calibration import DistancePlan, DistancesFound, calibrate_with_distances
from calib.distances import WireKnowledge
from calib.points.points import Points, make_points
from control.kinematics.kinematics import ForwardKinematics
from control.model.arm import Arm
from control.model.description import load_arm

RIGHT = load_arm("right")
SIZES = np.array([0.004, 0.026, 0.004, 0.026])
ANCHORS_m = {"A": (0.9, -0.5, 0.1), "B": (0.2, 0.9, -0.1), "C": (-0.3, -0.8, 0.9)}
DIRECTION = np.array([0.6, 0.0, 0.8])
GAUGE_ZERO_m, WIRE_ZERO_m = -0.2, 0.35
SD_m = 1e-4
ARMS = 10
NOTHING = WireKnowledge()  # of wires: their points are identified, their zeros are none


@dataclass(frozen=True, slots=True)
class Recorded:
    """A true arm, and the points with lengths of it."""

    true: Arm
    points: Points


def poses(rng: np.random.Generator, count: int) -> Array:
    """Joint angles (count, n) over the whole ranges."""
    lower, upper = np.array(RIGHT.limits_rad).T
    return np.asarray(rng.uniform(lower, upper, (count, RIGHT.joint_count)))


def recorded(
    seed: int,
    wires: str = "",
    each: int = 40,
    gauge: int = 0,
    pairs: int = 0,
    tips: int = 0,
    zero_m: float = 0.0,
    sd_m: float = SD_m,
    poses_of: int | None = None,
) -> Recorded:
    """Readings of an arm: `each` of every wire by name, of a gauge, of pairs of poses, and measured tips.

    poses_of: a seed of other poses of the same arm.
    """
    rng = np.random.default_rng(seed)
    true = RIGHT.with_dh(RIGHT.dh + rng.uniform(-1.0, 1.0, RIGHT.dh.shape) * SIZES)
    rng = rng if poses_of is None else np.random.default_rng(poses_of)
    kinematics, q = ForwardKinematics(true), list[Array]()
    device, length = list[str](), list[float]()

    def read(name: str, angles: Array, lengths: Array) -> None:
        q.extend(angles)
        device.extend([name] * len(angles))
        length.extend(lengths.tolist())

    for wire in wires:
        angles = poses(rng, each)
        read(f"wire:{wire}", angles, zero_m + norms(kinematics.tips(angles) - ANCHORS_m[wire]))
    if gauge:
        angles = poses(rng, gauge)
        read("gauge:G", angles, GAUGE_ZERO_m + kinematics.tips(angles) @ DIRECTION)
    for pair in range(pairs):
        angles = poses(rng, 2)
        read(f"between:{pair}", angles, np.full(2, np.linalg.norm(np.diff(kinematics.tips(angles), axis=0))))
    noise, first = rng.normal(0.0, sd_m, len(length)), len(length) - 2 * pairs
    noise[first + 1 :: 2] = noise[first::2][:pairs]  # both lines of a pair state one length
    tip_rad = poses(rng, tips)
    seen = kinematics.tips(tip_rad) + rng.normal(0.0, sd_m, (tips, 3))
    return Recorded(true, _points(device, np.array(length) + noise, sd_m, np.array([*q, *tip_rad]), seen))


def _points(device: list[str], length_m: Array, sd_m: float, q_rad: Array, seen_m: Array) -> Points:
    """Readings (r,) of the first poses, tips (m - r, 3) of the others."""
    r, m = len(length_m), len(q_rad)
    none = [""] * (m - r)
    return make_points(
        ["free"] * m,
        [str(k) for k in range(m)],
        [1] * m,
        q_rad,
        np.concatenate((np.full((r, 3), np.nan), seen_m)),
        extra={
            "distance_of": (*device, *none),
            "distance_m": (*(f"{v:.9f}" for v in length_m), *none),
            "distance_sd_m": (*[f"{sd_m:g}"] * r, *none),
        },
    )


def calibrated(of: Recorded, wires: WireKnowledge = NOTHING, choice: Choice | None = None) -> DistancesFound:
    """The calibration of the nominal arm with these readings."""
    return calibrate_with_distances(RIGHT, of.points, Path("lengths.csv"), DistancePlan(choice or Choice(), wires))


def over_workspace_m(true: Arm, dh: Array, is_placed: bool = False) -> Array:
    """Errors of 300 tips (300,): after the best rigid motion, unless the devices are placed in the base frame."""
    angles = poses(np.random.default_rng(99), 300)
    ours, theirs = ForwardKinematics(RIGHT.with_dh(dh)).tips(angles), ForwardKinematics(true).tips(angles)
    return norms((ours if is_placed else best_motion(ours, theirs).of(ours)) - theirs)


def main() -> None:
    """The table of docs/distances.md."""
    cases: tuple[tuple[str, dict[str, object], WireKnowledge], ...] = (
        ("one wire, 40 readings", {"wires": "A"}, NOTHING),
        ("one wire, 100", {"wires": "A", "each": 100}, NOTHING),
        ("one wire, 40, unknown zero", {"wires": "A", "zero_m": WIRE_ZERO_m}, WireKnowledge(free_zero=True)),
        ("two wires, 20 each", {"wires": "AB", "each": 20}, NOTHING),
        ("two wires, 40 each", {"wires": "AB"}, NOTHING),
        (
            "two wires at known points, 20 each",
            {"wires": "AB", "each": 20},
            WireKnowledge(known_m={k: ANCHORS_m[k] for k in "AB"}),
        ),
        ("three wires at known points, 20 each", {"wires": "ABC", "each": 20}, WireKnowledge(known_m=ANCHORS_m)),
        ("one gauge, 40", {"gauge": 40}, NOTHING),
        ("40 distances between two poses", {"pairs": 40}, NOTHING),
        ("one wire, 40, and 10 tips", {"wires": "A", "tips": 10}, NOTHING),
    )
    for name, what, wires in cases:
        before, after, largest, ranks = [], [], [], []
        for seed in range(ARMS):
            of = recorded(seed, **what)  # type: ignore[arg-type]
            calibration = calibrated(of, wires)
            is_placed = bool(wires.known_m) or "tips" in what
            before.append(over_workspace_m(of.true, RIGHT.dh, is_placed).mean())
            errors = over_workspace_m(of.true, calibration.found.dh, is_placed)
            after.append(errors.mean())
            largest.append(errors.max())
            unknown = sum(len(device.parameters) for device in calibration.devices)
            ranks.append(calibration.found.rank - unknown)
        sys.stdout.write(
            f"{name:<40}{min(ranks)} to {max(ranks)} of {RIGHT.dh.size}: {1e3 * np.mean(before):6.2f} mm before,"
            f" {1e3 * np.mean(after):.3f} after, largest {1e3 * np.max(largest):.2f}\n"
        )


if __name__ == "__main__":
    main()
