"""Identification compared with pybotics and scipy's SLSQP on the same points; and its memory at 100,000 points.

pybotics runs as in its example, in a separate environment. SLSQP is called as is common, in metres and radians,
within the bounds, without a gradient, at its defaults; it minimises this repository's vectorised model, which favours it
compared with a loop. One processor thread for all.
"""

import json
import os
import statistics
import subprocess
import sys
from collections.abc import Iterator
from time import perf_counter

import numpy as np
import numpy.typing as npt

from benchmarks.peers.peer import Peer, PeerMissing
from benchmarks.table import BenchRow, compared
from calib.arm_problem.arm_model import ArmModel
from calib.arm_problem.observations import Observations
from calib.arm_problem.problem import ArmProblem
from calib.identify.objective import LeastSquares, Objective, objective_named, value_of
from calib.identify.solver import minimise
from control.model.description import load_arm

Array = npt.NDArray[np.float64]
FASTER = {33: 25.0, 300: 100.0, 3000: 200.0}  # than pybotics, at least
DEVIATION = np.array([0.003, 0.02, 0.003, 0.02])
NOISE_m = 0.00014
ROUNDS = 5
NO_WORSE = 1.0 + 1e-9
NAMES = {"e2": "E2", "e1": "E1", "lsq": "LSQ", "huber": "Huber"}
HUBER_m = 0.0003
MEMORY_POINTS = 100_000
MEMORY_PEERS = {"least_squares": "scipy least_squares, analytic Jacobian", "slsqp": "SLSQP, SI units, no gradient"}
MEMORY_FIGURES = (
    ("memory added at the peak", "peak_MB", "MB", 1.0),
    ("time", "took_s", "s", 1.0),
    ("objective", "objective", "mm^2", 1e6),
)
ONE_THREAD = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}


def rows() -> Iterator[BenchRow]:
    """Yield the rows as they are measured."""
    for count in FASTER:
        yield from _beside_pybotics(count)
    for count in FASTER:
        for name in NAMES:
            yield from _beside_slsqp(count, name)
    yield from _memory()


def points(count: int) -> tuple[Array, Array]:
    """Poses (m, 3) over the workspace, and tips (m, 3) of an arm off nominal, within the bounds, with noise."""
    rng = np.random.default_rng(count)
    model = ArmModel(load_arm("right"))
    true = model.nominal_dh + rng.uniform(-1.0, 1.0, (4, 4)) * DEVIATION
    q = rng.uniform(-1.2, 1.2, (count, 3))
    return q, model.tips(true, q) + rng.normal(0.0, NOISE_m, (count, 3))


def problem_of(count: int) -> ArmProblem:
    """All 16 DH parameters within 5 mm and 2 degrees."""
    return ArmProblem(ArmModel(load_arm("right")), Observations.of_tips(*points(count)))


def own(count: int, objective: Objective) -> tuple[float, float]:
    """Seconds, the median of some runs, and the objective; all starts and the nearest to nominal included."""
    times = []
    for _ in range(ROUNDS):
        start = perf_counter()
        value = minimise(problem_of(count), objective).value
        times.append(perf_counter() - start)
    return statistics.median(times), value


def _beside_pybotics(count: int) -> Iterator[BenchRow]:
    """Least squares; also with the example's residuals, if that takes less than an hour."""
    target = f"at least {FASTER[count]:.0f} times faster"
    label = f"least squares, {count} points, 16 parameters"
    took_s, value = own(count, LeastSquares())
    try:
        with Peer("identification_peer.py", {"dh": load_arm("right").dh.tolist()}, "identification") as peer:
            _require_same_arm(peer.answers)
            theirs, name = _identified(peer, count, "coordinates", "least_squares")
            again_s, _ = own(count, LeastSquares())  # before and after the peer: a change of load meets both
            own_ms = 1e3 * statistics.mean((took_s, again_s))
            yield compared(label, own_ms, "ms", name, 1e3 * theirs["took_s"], target, 1.0 / FASTER[count])
            yield _objectives(f"{label}: objective (theirs knows no bounds)", value, name, theirs)
            if count == min(FASTER):
                theirs, name = _identified(peer, count, "lengths", "as its example (lengths)")
                yield compared(label, own_ms, "ms", name, 1e3 * theirs["took_s"], "", None)
                yield _objectives(f"{label}: objective", value, name, theirs)
    except PeerMissing as error:
        yield compared(label, 1e3 * took_s, "ms", f"pybotics {error}", None, target, None)


def _identified(peer: Peer, count: int, kind: str, how: str) -> tuple[dict[str, float], str]:
    """The result of pybotics, and its name in the table."""
    q, tips = points(count)
    asked = {"q_rad": np.column_stack((q, np.zeros(count))).tolist(), "tip_m": tips.tolist()}
    found = peer.ask({**asked, "kind": kind})
    end = ", stopped" if found["status"] == 0 else ""
    return found, f"pybotics {peer.answers['version']}, {how}, {found['evaluations']} evaluations{end}"


def _objectives(label: str, value: float, name: str, theirs: dict[str, float]) -> BenchRow:
    return compared(label, 1e6 * value, "mm^2", name, 1e6 * theirs["objective"], "", None)


def _require_same_arm(answers: dict[str, list[list[float]]]) -> None:
    """Check that the peer's arm equals ours."""
    model = ArmModel(load_arm("right"))
    tips = model.tips(model.nominal_dh, np.array(answers["poses"])[:, :3])
    if not np.allclose(tips, answers["tips_m"], atol=1e-9):
        raise PeerMissing("computes another arm")


def slsqp(problem: ArmProblem, objective: Objective) -> float:
    """SLSQP as commonly called: metres and radians, bounds, no gradient, defaults. The objective where it ends."""
    from scipy.optimize import minimize

    scale = problem.scale

    def value(deviation: Array) -> float:
        return value_of(objective, problem.residuals(deviation / scale))

    bounds = [(-bound, bound) for bound in scale]
    end = minimize(value, np.zeros(len(scale)), method="SLSQP", bounds=bounds)
    return value(np.clip(end.x, -scale, scale))


def _beside_slsqp(count: int, name: str) -> list[BenchRow]:
    """The objective must never be worse; time beside it."""
    objective = objective_named(name, HUBER_m if name == "huber" else None)
    label = f"{NAMES[name]}, {count} points, 16 parameters"
    peer = "SLSQP, SI units, no gradient"
    start = perf_counter()
    theirs = slsqp(problem_of(count), objective)
    theirs_s = perf_counter() - start
    took_s, value = own(count, objective)
    power, unit = (1e3, "mm") if name in ("e1", "e2") else (1e6, "mm^2")
    return [
        compared(f"{label}: objective", power * value, unit, peer, power * theirs, "never worse", NO_WORSE),
        compared(f"{label}: time", 1e3 * took_s, "ms", peer, 1e3 * theirs_s, "", None),
    ]


def _memory() -> Iterator[BenchRow]:
    """Additional peak memory of a separate process with 100,000 points."""
    ours = _in_own_process("own")
    label = f"least squares, {MEMORY_POINTS} points"
    for solver, name in MEMORY_PEERS.items():
        theirs = _in_own_process(solver)
        for what, key, unit, power in MEMORY_FIGURES:
            yield compared(f"{label}: {what}", power * ours[key], unit, name, power * theirs[key], "", None)


def _in_own_process(solver: str) -> dict[str, float]:
    """Time and memory of one identification. RuntimeError with the process's last message if it fails."""
    done = subprocess.run(
        [sys.executable, "-m", "benchmarks.calibration.identification_memory", solver, str(MEMORY_POINTS)],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, **ONE_THREAD},
    )
    if done.returncode != 0:
        reason = (done.stderr.strip().splitlines() or ["no message"])[-1]
        raise RuntimeError(f"{solver} on {MEMORY_POINTS} points: status {done.returncode}: {reason}")
    found: dict[str, float] = json.loads(done.stdout)
    return found
