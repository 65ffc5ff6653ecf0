"""One identification of many points by one solver in a separate process: time, objective, and peak memory.

python -m benchmarks.calibration.identification_memory own|least_squares|slsqp POINTS
"""

import importlib
import json
import sys
from collections.abc import Callable
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
import numpy.typing as npt

from benchmarks.calibration.identification import problem_of, slsqp
from calib.arm_problem.problem import ArmProblem
from calib.identify.objective import LeastSquares
from calib.identify.solver import minimise


def least_squares(problem: ArmProblem) -> float:
    """Scipy's, scaled, with the analytic Jacobian, at its defaults."""
    optimize: Any = importlib.import_module("scipy.optimize")
    k = len(problem.parameters)

    def jacobian(x: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        return problem.residuals_and_jacobian(x)[1].reshape(-1, k)

    end = optimize.least_squares(lambda x: problem.residuals(x).ravel(), np.zeros(k), jac=jacobian, bounds=(-1.0, 1.0))
    return float(end.cost)


def own(problem: ArmProblem) -> float:
    """This repository's, all starts included."""
    return minimise(problem, LeastSquares()).value


def slsqp_alone(problem: ArmProblem) -> float:
    """As commonly called."""
    return slsqp(problem, LeastSquares())


STATUS, CLEAR = Path("/proc/self/status"), Path("/proc/self/clear_refs")
RESET_PEAK = "5"  # man 5 proc: the peak becomes what is resident now
SOLVERS: dict[str, Callable[[ArmProblem], float]] = {"own": own, "least_squares": least_squares, "slsqp": slsqp_alone}


def _peak_kB() -> int:
    """Peak memory of this process since the reset."""
    lines = STATUS.read_text(encoding="ascii").splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmHWM"))


def main() -> None:
    """Imports and making the points come first; the peak is reset before the solver starts."""
    work, count = SOLVERS[sys.argv[1]], int(sys.argv[2])
    importlib.import_module("scipy.optimize")
    work(problem_of(50))
    problem = problem_of(count)
    CLEAR.write_text(RESET_PEAK, encoding="ascii")
    before_kB = _peak_kB()
    start = perf_counter()
    value = work(problem)
    took_s = perf_counter() - start
    added_kB = _peak_kB() - before_kB
    print(json.dumps({"took_s": took_s, "peak_MB": added_kB / 1024.0, "objective": value}))


if __name__ == "__main__":
    main()
