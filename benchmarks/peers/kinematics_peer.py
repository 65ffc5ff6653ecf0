"""pinocchio on the same arm, in the peers' environment. JSON lines in and out.

The first line describes the arm and the work; for every further line the work is timed once, and the answer gives
microseconds a call. Nothing of this repository is imported here.
"""

import importlib
import json
import sys
from collections.abc import Callable
from time import perf_counter
from typing import Any

import numpy as np

pin: Any = importlib.import_module("pinocchio")  # only in the peers' environment

DAMPING = 1e-12
ACCURACY_M = 1e-9
MOST_STEPS = 100


def _placed(d: float, theta: float, length: float, alpha: float) -> Any:
    along_z = pin.SE3(pin.utils.rotate("z", theta), np.array([0.0, 0.0, d]))
    return along_z * pin.SE3(pin.utils.rotate("x", alpha), np.array([length, 0.0, 0.0]))


def _model(arm: dict[str, Any]) -> tuple[Any, int]:
    """Standard DH: joint i turns about z of the previous frame, so a joint is at the end of the previous link."""
    model = pin.Model()
    model.gravity.linear = np.array(arm["gravity_m_s2"])
    parent, placement = 0, pin.SE3.Identity()
    rotors = []
    for number, link in enumerate(arm["links"]):
        if link["revolute"]:
            parent = model.addJoint(parent, pin.JointModelRZ(), placement, f"joint{number}")
            placement = pin.SE3.Identity()
            rotors.append(link["rotor_kg_m2"])
        placement = placement * _placed(*link["dh"])
        if link["mass_kg"]:
            inertia = pin.Inertia(link["mass_kg"], np.array(link["com_m"]), np.diag(link["inertia_kg_m2"]))
            model.appendBodyToJoint(parent, inertia, placement)
    tip = model.addFrame(pin.Frame("tip", parent, 0, placement, pin.FrameType.OP_FRAME))
    model.armature = np.array(rotors)
    return model, tip


class Work:
    """The calls that are timed."""

    def __init__(self, arm: dict[str, Any]) -> None:
        self.model, self.tip = _model(arm)
        self.data = self.model.createData()
        self.poses = [np.array(q) for q in arm["poses"]]
        self.seeds = [np.array(q) for q in arm["seeds"]]
        self.targets = [np.array(p) for p in arm["targets"]]

    def forward(self, q: Any) -> Any:
        """Tip position."""
        pin.framesForwardKinematics(self.model, self.data, q)
        return self.data.oMf[self.tip].translation

    def inverse(self, target: Any, q: Any) -> Any:
        """Pinocchio's own iterative scheme (its example of closed-loop inverse kinematics), for the position."""
        model, data, tip = self.model, self.data, self.tip
        for _ in range(MOST_STEPS):
            jacobian = pin.computeFrameJacobian(model, data, q, tip, pin.LOCAL_WORLD_ALIGNED)[:3]
            pin.updateFramePlacement(model, data, tip)
            error = target - data.oMf[tip].translation
            if error @ error < ACCURACY_M * ACCURACY_M:
                break
            step = jacobian.T @ np.linalg.solve(jacobian @ jacobian.T + DAMPING * np.eye(3), error)
            q = pin.integrate(model, q, step)
        return q

    def dynamics(self, q: Any) -> Any:
        """Joint torques."""
        return pin.rnea(self.model, self.data, q, q, q)

    def measure(self) -> dict[str, float]:
        """Microseconds a call."""
        return {
            "forward_us": _us(lambda: [self.forward(q) for q in self.poses], len(self.poses)),
            "inverse_us": _us(
                lambda: [self.inverse(p, q) for p, q in zip(self.targets, self.seeds, strict=True)], len(self.poses)
            ),
            "dynamics_us": _us(lambda: [self.dynamics(q) for q in self.poses], len(self.poses)),
        }

    def answers(self) -> dict[str, Any]:
        """The results, for comparison."""
        found = [self.inverse(p, q) for p, q in zip(self.targets, self.seeds, strict=True)]
        return {
            "tips_m": [self.forward(q).tolist() for q in self.poses],
            "inverse_errors_m": [float(np.linalg.norm(self.forward(q) - p)) for p, q in zip(self.targets, found, strict=True)],
            "torques_Nm": [self.dynamics(q).tolist() for q in self.poses],
            "version": pin.__version__,
        }


def _us(work: Callable[[], object], calls: int) -> float:
    work()  # untimed warm-up: the other process has used the caches
    start = perf_counter()
    work()
    return (perf_counter() - start) / calls * 1e6


def main() -> None:
    work = Work(json.loads(sys.stdin.readline()))
    print(json.dumps(work.answers()), flush=True)
    for _ in sys.stdin:
        print(json.dumps(work.measure()), flush=True)


if __name__ == "__main__":
    main()
