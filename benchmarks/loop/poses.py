"""Position and orientation of a six-joint arm in modified DH: one call, a path's points, and a whole plan; against pinocchio."""

import contextlib
import math
from collections.abc import Callable
from typing import Any

import numpy as np

from benchmarks.arms import SEVEN, SIX, circle_in_place
from benchmarks.peers.peer import Peer, PeerMissing
from benchmarks.table import BenchRow, compared, seconds_a_call
from control.kinematics.kinematics import ForwardKinematics, PoseKinematics, Poses
from control.kinematics.pose_inverse import ACCURACY, Targets, solve, task_of
from control.motion.plan import plan_path

ROUNDS = 15
POINTS = 1000
SEEDS_APART = 20  # points: a planner's seeds are 20 mm apart
LIMIT_us = 40.0


def rows() -> list[BenchRow]:
    """Return the measured rows."""
    arm = PoseKinematics(ForwardKinematics(SIX))
    path_rad, seeds_rad = _path()
    tip = arm.batch(path_rad)
    peer, name = _peer(path_rad, tip)
    task, targets = task_of(arm, True), Targets(tip.position_m, tip.rotation)
    solution = solve(arm, task, targets, seeds_rad)
    if np.abs(solution.error).max() > ACCURACY or np.abs(solution.q_rad - path_rad).max() > 1e-6:
        raise ValueError(f"six joints: the path is missed by {np.abs(solution.error).max():.2g}")
    one = path_rad.tolist()
    work: dict[str, tuple[Callable[[], object], int]] = {
        "inverse": (lambda: solve(arm, task, targets, seeds_rad), POINTS),
        "forward": (lambda: [arm.at(*q) for q in one], POINTS),
        "batch": (lambda: arm.batch(path_rad), POINTS),
    }
    own, theirs = dict.fromkeys(work, math.inf), dict[str, float]()
    with peer if peer is not None else contextlib.nullcontext():
        for _ in range(ROUNDS):
            for key, (run, calls) in work.items():
                run()  # untimed warm-up: the peer has used the caches
                own[key] = min(own[key], 1e6 * seconds_a_call(run, calls))
            if peer is not None:
                for key, us in peer.ask("measure").items():
                    theirs[key] = min(theirs.get(key, math.inf), us)
    inverse = "inverse kinematics, 6 joints with orientation, to 1e-9 m and rad, along a path"
    us = own["inverse"]
    return [
        BenchRow(inverse, us, "us", "the limit", LIMIT_us, us / LIMIT_us, "under 40 us", us < LIMIT_us),
        compared(inverse, us, "us", name, theirs.get("inverse_us"), "faster", 1.0),
        compared("pose and Jacobian, one call", own["forward"], "us", name, theirs.get("forward_us"), "", None),
        compared("pose and Jacobian, a batch of 1000", own["batch"], "us", name, theirs.get("forward_us"), "faster", 1.0),
        BenchRow("plan of a circle with orientation, 6 joints", _plan_ms(SIX), "ms"),
        BenchRow("plan of a circle with orientation, 7 joints", _plan_ms(SEVEN), "ms"),
    ]


def _path() -> tuple[np.ndarray, np.ndarray]:
    """Joint angles (m, 6) along a smooth way around the rest pose, and linear seeds between every 20th of them."""
    assert SIX.rest is not None
    turn = np.linspace(0.0, 2.0 * np.pi, POINTS)[:, None]
    path = np.array(SIX.rest.q_rad) + 0.25 * np.sin(turn * np.array([1, 2, 1, 3, 1, 2]))
    known = np.append(np.arange(0, POINTS - 1, SEEDS_APART), POINTS - 1)
    seeds = [np.interp(np.arange(POINTS), known, column[known]) for column in path.T]
    return path, np.stack(seeds, axis=1)


def _peer(path_rad: np.ndarray, tip: Poses) -> tuple[Peer | None, str]:
    """Pinocchio on the same path, and its name for the table; None where it cannot run."""
    task: dict[str, Any] = {
        "dh": SIX.dh.tolist(),
        "tool_m": SIX.tool.position_m,
        "poses": path_rad.tolist(),
        "positions_m": tip.position_m.tolist(),
        "rotations": tip.rotation.tolist(),
    }
    try:
        peer = Peer("pose_peer.py", task)
    except PeerMissing as error:
        return None, f"pinocchio {error}"
    name = f"pinocchio {peer.answers['version']}"
    if peer.answers["largest_error"] > ACCURACY or not np.allclose(peer.answers["q_rad"], path_rad, atol=1e-6):
        return None, f"{name} computes something else"
    return peer, name


def _plan_ms(arm: Any) -> float:
    return 1e3 * min(seconds_a_call(lambda: plan_path(arm, circle_in_place(arm, tilt_rad=0.2), 0.1), 1) for _ in range(3))
