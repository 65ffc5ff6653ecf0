"""pybotics identifies the same arm from the same points in a separate environment. JSON lines in and out.

The first line gives the arm; every further line gives points and asks for one identification, as pybotics' example notebook
makes it (OptimizationHandler, scipy's least_squares from nominal, its defaults): "lengths" takes the distances as residuals, as
the example does, "coordinates" the three coordinates of each point. Nothing of this repository is imported here.
"""

import importlib
import json
import sys
from collections.abc import Callable
from importlib.metadata import version
from time import perf_counter
from typing import Any

import numpy as np

least_squares: Any = importlib.import_module("scipy.optimize").least_squares
chains: Any = importlib.import_module("pybotics.kinematic_chain")
optimization: Any = importlib.import_module("pybotics.optimization")
robots: Any = importlib.import_module("pybotics.robot")

FREE_TOOL = [True, False, False, True, False, False]  # x and turn about x


def robot_of(dh: Any) -> Any:
    """The arm in pybotics' modified DH: a standard link's L and alpha belong to the next link there, the last ones to the tool.

    The first modified link's own alpha and L are zero and stay so; the fixed last link is a joint that is always at 0.
    """
    before = np.vstack(([0.0, 0.0], dh[:-1, [3, 2]]))
    chain = chains.MDHKinematicChain.from_parameters(np.column_stack((before, dh[:, 1], dh[:, 0])))
    robot = robots.Robot(chain)
    tool = np.zeros(6)
    tool[0], tool[3] = dh[-1, 2], dh[-1, 3]
    robot.tool.vector = tool
    return robot


def handler_of(dh: Any) -> Any:
    """Everything free that standard DH has: four parameters a link."""
    chain_mask = [False, False] + [True] * (dh.size - 2)
    return optimization.OptimizationHandler(robot_of(dh), kinematic_chain_mask=chain_mask, tool_mask=FREE_TOOL)


def coordinates(vector: Any, handler: Any, qs: Any, positions: Any) -> Any:
    """Residuals point by point and axis by axis."""
    handler.apply_optimization_vector(vector)
    tips = [handler.robot.fk(q)[:3, 3] for q in qs]
    return (positions - tips).ravel()


def identified(dh: Any, question: dict[str, Any]) -> dict[str, Any]:
    """One identification with its cost."""
    handler = handler_of(dh)
    qs, positions = np.array(question["q_rad"]), np.array(question["tip_m"])
    kinds: dict[str, Callable[..., Any]] = {"coordinates": coordinates, "lengths": optimization.optimize_accuracy}
    residuals = kinds[question["kind"]]
    start = perf_counter()
    found = least_squares(residuals, handler.generate_optimization_vector(), args=(handler, qs, positions))
    took_s = perf_counter() - start
    return {"took_s": took_s, "objective": float(found.cost), "evaluations": int(found.nfev), "status": int(found.status)}


def main() -> None:
    dh = np.array(json.loads(sys.stdin.readline())["dh"])
    poses = np.random.default_rng(0).uniform(-1.0, 1.0, (5, len(dh)))
    poses[:, -1] = 0.0
    robot = robot_of(dh)
    tips = [robot.fk(q)[:3, 3].tolist() for q in poses]
    print(json.dumps({"version": version("pybotics"), "poses": poses.tolist(), "tips_m": tips}), flush=True)
    for line in sys.stdin:
        print(json.dumps(identified(dh, json.loads(line))), flush=True)


if __name__ == "__main__":
    main()
