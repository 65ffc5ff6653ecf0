"""pinocchio on an arm with orientation, in the peers' environment. JSON lines in and out, as in kinematics_peer.py.

Newton's method on position and orientation with pinocchio's own Jacobian and logarithm (its example of closed-loop inverse
kinematics), seeded by the pose before, to 1e-9 m and 1e-9 rad. Nothing of this repository is imported here.
"""

import importlib
import json
import sys
from time import perf_counter
from typing import Any

import numpy as np

pin: Any = importlib.import_module("pinocchio")  # only in the peers' environment

ACCURACY = 1e-9
MOST_STEPS = 50


def _turned(axis: str, angle: float, move: list[float]) -> Any:
    return pin.SE3(pin.utils.rotate(axis, angle), np.array(move))


def _model(arm: dict[str, Any]) -> tuple[Any, int]:
    """Modified DH: Rx(alpha) Tx(L), then the joint about z with its offset and d; all links turn."""
    model, parent, placement = pin.Model(), 0, pin.SE3.Identity()
    for number, (d, theta, length, alpha) in enumerate(arm["dh"]):
        placement = placement * _turned("x", alpha, [0.0, 0.0, 0.0]) * _turned("z", 0.0, [length, 0.0, 0.0])
        placement = placement * _turned("z", theta, [0.0, 0.0, d])
        parent = model.addJoint(parent, pin.JointModelRZ(), placement, f"joint{number}")
        placement = pin.SE3.Identity()
    tip = pin.SE3(np.eye(3), np.array(arm["tool_m"]))
    return model, model.addFrame(pin.Frame("tip", parent, 0, tip, pin.FrameType.OP_FRAME))


class Work:
    """The calls that are timed."""

    def __init__(self, arm: dict[str, Any]) -> None:
        self.model, self.tip = _model(arm)
        self.data = self.model.createData()
        self.targets = [pin.SE3(np.array(r), np.array(p)) for r, p in zip(arm["rotations"], arm["positions_m"], strict=True)]
        self.poses = [np.array(q) for q in arm["poses"]]

    def forward(self, q: Any) -> Any:
        """Pose and Jacobian of the tip."""
        pin.computeJointJacobians(self.model, self.data, q)
        pin.updateFramePlacement(self.model, self.data, self.tip)
        return self.data.oMf[self.tip], pin.getFrameJacobian(self.model, self.data, self.tip, pin.LOCAL)

    def follow(self) -> list[Any]:
        """Every target, each from the pose before."""
        q, found = self.poses[0], []
        for target in self.targets:
            for _ in range(MOST_STEPS):
                placed, jacobian = self.forward(q)
                error = pin.log6(placed.actInv(target)).vector
                if np.abs(error).max() < ACCURACY:
                    break
                q = q + np.linalg.solve(jacobian, error)
            found.append(q)
        return found

    def measure(self) -> dict[str, float]:
        """Microseconds a call."""
        times = {}
        for name, work in (("inverse_us", self.follow), ("forward_us", lambda: [self.forward(q) for q in self.poses])):
            work()  # untimed warm-up: the other process has used the caches
            start = perf_counter()
            work()
            times[name] = (perf_counter() - start) / len(self.poses) * 1e6
        return times

    def answers(self) -> dict[str, Any]:
        """The results, for comparison."""
        found = self.follow()
        errors = [
            np.abs(pin.log6(self.forward(q)[0].actInv(target)).vector).max()
            for q, target in zip(found, self.targets, strict=True)
        ]
        return {"q_rad": [q.tolist() for q in found], "largest_error": float(max(errors)), "version": pin.__version__}


def main() -> None:
    work = Work(json.loads(sys.stdin.readline()))
    print(json.dumps(work.answers()), flush=True)
    for _ in sys.stdin:
        print(json.dumps(work.measure()), flush=True)


if __name__ == "__main__":
    main()
