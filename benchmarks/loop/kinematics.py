"""Kinematics and dynamics, one call and in batches: against a hand-inlined closed form, and against pinocchio.

Own and peer's runs alternate, so that a change of clock or load affects both; the fastest run counts.
"""

import contextlib
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from benchmarks.peers.peer import Peer, PeerMissing
from benchmarks.table import BenchRow, compared, seconds_a_call
from control.dynamics.dynamics import Dynamics
from control.kinematics.inverse import Branch, InverseKinematics
from control.kinematics.kinematics import ForwardKinematics
from control.model.arm import Arm
from control.model.description import load_arm

ROUNDS = 25
POSES = 200
BOUNDS = np.array([5e-3, np.radians(2.0), 5e-3, np.radians(2.0)])  # of a calibration (SpringerPlus 5:1771)
FRONT_UP = Branch("front", "up")
PINOCCHIO = "pinocchio"
Pose = tuple[float, ...]


def hand_inlined(q1: float, q2: float, q3: float, sin: Any = math.sin, cos: Any = math.cos) -> tuple[float, float, float]:
    """The reference arm's tip as one would write it by hand."""
    c, s, q23 = cos(q1), sin(q1), q2 + q3
    reach = 0.3543 * cos(q23) - 0.4 * sin(q2)
    return c * reach - 0.012 * s, s * reach + 0.012 * c, 0.4 * cos(q2) + 0.3543 * sin(q23) + 0.076


def calibrated_arm() -> Arm:
    """The reference arm with every DH parameter off nominal, within a calibration's bounds."""
    arm = load_arm("right")
    return arm.with_dh(arm.dh + np.random.default_rng(7).uniform(-1.0, 1.0, arm.dh.shape) * BOUNDS)


def rows() -> list[BenchRow]:
    """Return the measured rows."""
    arm = calibrated_arm()
    poses = _poses()
    work = _own_work(arm, poses)
    peer_name = PINOCCHIO
    peer: Peer | None = None
    try:
        peer = Peer("kinematics_peer.py", _task(arm, poses))
        peer_name = f"{PINOCCHIO} {peer.answers['version']}"
        _require_same_answers(arm, poses, peer.answers)
    except PeerMissing as error:
        peer_name = f"{PINOCCHIO} {error}"
    with peer if peer is not None else contextlib.nullcontext():
        own, theirs = _alternate(work, peer)
    return _table(own, theirs, peer_name)


def _poses() -> list[Pose]:
    """Poses within the limits, away from singular ones, and in the branch "front, up"."""
    scatter = np.random.default_rng(1).uniform([-1.0, -1.4, -0.6], [1.0, -0.6, 0.4], (POSES, 3))
    return [tuple(q) for q in scatter.tolist()]


def _own_work(arm: Arm, poses: Sequence[Pose]) -> dict[str, tuple[Callable[[], object], int]]:
    """The timed work: name -> (work, calls in it)."""
    nominal, k = ForwardKinematics(load_arm("right")), ForwardKinematics(arm)
    inverse, exact = InverseKinematics(arm), InverseKinematics(load_arm("right"))
    targets, exact_targets = [k.tip(*q) for q in poses], [nominal.tip(*q) for q in poses]
    close = [(q1 + 6e-4, q2 - 6e-4, q3) for q1, q2, q3 in poses]  # one 2 ms cycle at 0.3 rad/s
    hand, traced, calibrated, torques = hand_inlined, nominal.tip, k.tip, Dynamics(arm).inverse
    q33, q3000 = np.array(poses[:33]), np.tile(np.array(poses), (15, 1))
    n = len(poses)
    return {
        "hand": (lambda: [hand(a, b, c) for a, b, c in poses], n),
        "traced": (lambda: [traced(a, b, c) for a, b, c in poses], n),
        "calibrated": (lambda: [calibrated(a, b, c) for a, b, c in poses], n),
        "closed form": (lambda: [exact.solve(p, FRONT_UP) for p in exact_targets], n),
        "inverse": (lambda: [inverse.solve(p, FRONT_UP) for p in targets], n),
        "follow": (lambda: [inverse.follow(p, q) for p, q in zip(targets, close, strict=True)], n),
        "dynamics": (lambda: [torques(q, q, q) for q in poses], n),
        "identification 33": (lambda: [k.identification_jacobian(q33) for _ in range(20)], 20),
        "identification 3000": (lambda: [k.identification_jacobian(q3000) for _ in range(3)], 3),
    }


def _alternate(work: dict[str, tuple[Callable[[], object], int]], peer: Peer | None) -> tuple[dict[str, float], dict[str, float]]:
    """Return the fastest microseconds a call of every own and every peer's work."""
    own = dict.fromkeys(work, math.inf)
    theirs: dict[str, float] = {}
    for _ in range(ROUNDS):
        for name, (run, calls) in work.items():
            run()  # untimed warm-up: the peer has used the caches
            own[name] = min(own[name], 1e6 * seconds_a_call(run, calls))
        if peer is not None:
            for name, us in peer.ask("measure").items():
                theirs[name] = min(theirs.get(name, math.inf), us)
    return own, theirs


def _table(own: dict[str, float], theirs: dict[str, float], peer: str) -> list[BenchRow]:
    def row(name: str, key: str, peer_key: str, target: str = "", largest: float | None = None) -> BenchRow:
        return compared(name, own[key], "us", peer, theirs.get(peer_key), target, largest)

    return [
        compared(
            "forward kinematics, reference arm",
            own["traced"],
            "us",
            "hand-inlined closed form",
            own["hand"],
            "at most 1.2 times",
            1.2,
        ),
        row("forward kinematics, calibrated (16 parameters)", "calibrated", "forward_us"),
        BenchRow("inverse kinematics, reference arm, closed form with checks", own["closed form"], "us"),
        row("inverse kinematics, calibrated, to 1e-9 m", "inverse", "inverse_us", "faster", 1.0),
        row("inverse kinematics, calibrated, next point of a path", "follow", "inverse_us", "faster", 1.0),
        row("inverse dynamics, calibrated", "dynamics", "dynamics_us"),
        BenchRow("identification Jacobian, 33 poses", own["identification 33"], "us"),
        BenchRow("identification Jacobian, 3000 poses", own["identification 3000"], "us"),
    ]


def _task(arm: Arm, poses: Sequence[Pose]) -> dict[str, Any]:
    """The arm and the work in the peer's terms; its descent starts where ours does, at the nominal arm's pose."""
    k, nominal = ForwardKinematics(arm), InverseKinematics(load_arm("right"))
    targets = [k.tip(*q) for q in poses]
    rotors = iter([d.gear_ratio**2 * d.rotor_inertia_kg_m2 for d in arm.drives])
    links = [
        {
            "dh": [link.d_m, link.theta_rad, link.L_m, link.alpha_rad],
            "revolute": turns,
            "mass_kg": link.mass_kg,
            "com_m": link.com_m,
            "inertia_kg_m2": link.inertia_kg_m2,
            "rotor_kg_m2": next(rotors) if turns else 0.0,
        }
        for link, turns in zip(arm.links, arm.joints, strict=True)
    ]
    seeds = [nominal.solve(p, FRONT_UP) for p in targets]
    return {"gravity_m_s2": arm.gravity_m_s2, "links": links, "poses": poses, "targets": targets, "seeds": seeds}


def _require_same_answers(arm: Arm, poses: Sequence[Pose], answers: dict[str, Any]) -> None:
    """Check that both compute the same."""
    k, torques = ForwardKinematics(arm), Dynamics(arm).inverse
    same = (
        np.allclose(k.tips(poses), answers["tips_m"], atol=1e-12)
        and np.allclose([torques(q, q, q) for q in poses], answers["torques_Nm"], atol=1e-9)
        and max(answers["inverse_errors_m"]) < 1e-9
    )
    if not same:
        raise PeerMissing("computes something else")
