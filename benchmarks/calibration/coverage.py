"""Do nominal 95 % intervals cover the truth in 95 % of simulated sessions? `make coverage-study` prints the table.

The reference arm, deviations drawn within a share of their bounds, camera noise of 0.14 mm. DH parameters that the points
do not determine beside the others keep their nominal values, in truth and in the fit, so that every other one can be
scored in every session. `sd` scores deviation +- t sd, `interval` Estimate.interval.
"""

from __future__ import annotations

import argparse
import itertools
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from benchmarks.studies import add_options
from calib.arm_problem.arm_model import ArmModel, dh_names
from calib.arm_problem.observations import Frame, Observations
from calib.arm_problem.problem import ArmProblem
from calib.arrays import Array, frozen
from calib.identify.determinability import Sensitivity, determinability
from calib.identify.identification import Estimate, uncertainty
from calib.identify.objective import Huber, Objective, objective_named
from calib.identify.solver import minimise
from calib.studies import Executor, InProcess, executor, task_rng
from control.model.arm import Arm
from control.model.description import load_arm
from control.model.table import board_cavities, board_origin, board_rotation, table_of

NOISE_m = 0.00014
OWN_SHARE = 0.02  # largest undetermined share of a scored parameter
KINDS = ("known", "tool", "boards")


@dataclass(frozen=True, slots=True)
class Session:
    """A simulated session: points_count points, unknowns besides DH, deviations up to `size` bounds."""

    kind: str
    points_count: int
    objective: str
    size: float = 0.5


@dataclass(slots=True)
class Tally:
    """Number of scores, coverage of each kind of interval, and normalised errors."""

    count: int = 0
    by_sd: int = 0
    by_interval: int = 0
    resting: int = 0
    scores: list[float] = field(default_factory=list)

    def add(self, estimate: Estimate, truth: float, quantile: float) -> None:
        """One parameter of one session."""
        self.count += 1
        lower, upper = estimate.interval
        self.by_interval += lower <= truth <= upper
        if estimate.is_at_bound:
            self.resting += 1
        else:
            score = (estimate.deviation - truth) / estimate.sd
            self.scores.append(score)
            self.by_sd += abs(score) <= quantile


def simulated(arm: Arm, what: Session, draw: np.random.Generator) -> tuple[ArmProblem, Array]:
    """A problem and the true deviations of the DH parameters (links, 4)."""
    model = ArmModel(arm)
    bounds = np.array([0.005, np.radians(2.0)] * 2)
    deviation = what.size * bounds * draw.uniform(-1.0, 1.0, model.nominal_dh.shape)
    true_tool = model.nominal_tool_m
    if what.kind == "tool":
        true_tool = true_tool + draw.uniform(-0.02, 0.02, 3)
    positions, frame, frames = _references(arm, what, draw)
    fixed = _redundant(model, what, positions, frame, frames)
    deviation[np.isin(np.reshape(dh_names(len(deviation)), deviation.shape), fixed)] = 0.0
    true_dh = model.nominal_dh + deviation
    wanted = np.array([frames[f].to_base(p[None])[0] for f, p in zip(frame, positions, strict=True)])
    q = _seated(model, true_dh, true_tool, wanted)
    noise = draw.normal(0.0, NOISE_m, wanted.shape)
    if what.kind == "boards":  # seating error; the reference is the cavity
        q = _seated(model, true_dh, true_tool, wanted + noise, q)
    else:
        positions, frame, frames = model.tips(true_dh, q, true_tool) + noise, 0 * frame, (Frame.base(),)
    observed = Observations(frozen(q), frozen(positions), frame, frames)
    return ArmProblem(model, observed, is_tool_free=what.kind == "tool", fixed=fixed), deviation


def _references(arm: Arm, what: Session, draw: np.random.Generator) -> tuple[Array, NDArray[np.intp], tuple[Frame, ...]]:
    """33 cavities of the level board, 99 of three tilts, more: the rest somewhere in the workspace (on boards: again)."""
    table = table_of(arm)
    board = np.array(list(board_cavities(table).values()))
    setups = ("normal", "roll", "pitch")[: max(1, min(3, what.points_count // 33))]
    frames = tuple(
        Frame(f"board_{setup}", frozen(board_rotation(table, setup)), frozen(board_origin(table)), is_free=True)
        for setup in setups
    )
    index = np.arange(what.points_count)
    frame, positions = (index // 33) % len(setups), board[index % 33].copy()
    if what.kind != "boards":
        free = index >= 33 * len(setups)
        positions[free] += draw.uniform([-0.2, -0.3, 0.0], [0.1, 0.3, 0.3], (int(free.sum()), 3))
    return positions, frame, frames


def _redundant(model: ArmModel, what: Session, positions: Array, frame: NDArray[np.intp], frames: tuple[Frame, ...]) -> list[str]:
    """DH parameters that the points do not determine besides the others: the last pivots of a QR decomposition."""
    from scipy.linalg import qr

    tips = np.array([frames[f].to_base(p[None])[0] for f, p in zip(frame, positions, strict=True)])
    q = _seated(model, model.nominal_dh, model.nominal_tool_m, tips)
    seen = (positions, frame, frames) if what.kind == "boards" else (tips, 0 * frame, (Frame.base(),))
    problem = ArmProblem(model, Observations(frozen(q), frozen(seen[0]), *seen[1:]), is_tool_free=what.kind == "tool")
    columns = problem.sensitivity(np.zeros(len(problem.parameters))).reshape(-1, len(problem.parameters))
    known = determinability(columns.reshape(-1, 3, columns.shape[1]), problem.parameters)
    bounded = [k for k, p in enumerate(problem.parameters) if p.has_bound]
    rest = [k for k in range(len(problem.parameters)) if k not in bounded]
    own = known.basis[np.ix_(np.array(bounded), np.flatnonzero(np.abs(known.basis[rest]).max(axis=0, initial=0.0) == 0.0))]
    _, _, order = qr(own.T, pivoting=True)
    return [problem.parameters[bounded[k]].name for k in order[own.shape[1] :]]


def _seated(model: ArmModel, dh: Array, tool_m: Array, tips_m: Array, start: Array | None = None) -> Array:
    """Joint angles (m, n) that put the tip there, by Newton's steps."""
    q = np.tile([0.0, -1.0, 0.0], (len(tips_m), 1)) if start is None else start.copy()
    for _ in range(30):
        slopes = model.slopes(dh, q, tool_m)
        by_joint = slopes.by_dh[:, :, list(model.theta_places)]
        step = np.einsum("mnk,mk->mn", np.linalg.pinv(by_joint), tips_m - slopes.tips)
        q += step * np.minimum(1.0, 0.4 / np.maximum(1e-12, np.abs(step).max(axis=1, keepdims=True)))
        if np.abs(step).max() < 1e-10:
            break
    return q


def studied(what: Session, sessions_count: int, seed: int = 0, runs: Executor | None = None) -> dict[str, Tally]:
    """Tallies by parameter name, over simulated sessions, each with random numbers of its own."""
    found: dict[str, Tally] = {}
    of_each = dict((runs or InProcess()).results(scored_session, (what, seed), range(sessions_count)))
    for number in range(sessions_count):
        for name, estimate, truth, quantile in of_each[number]:
            found.setdefault(name, Tally()).add(estimate, truth, quantile)
    return found


def scored_session(asked: tuple[Session, int], number: int) -> list[tuple[str, Estimate, float, float]]:
    """A session as a task of a study: parameter, its estimate, its true value, and the quantile of its interval."""
    what, seed = asked
    problem, deviation = simulated(load_arm("right"), what, task_rng(seed, number))
    return list(_scored(problem, deviation, what))


def _scored(problem: ArmProblem, deviation: Array, what: Session) -> Iterator[tuple[str, Estimate, float, float]]:
    objective: Objective = objective_named(what.objective)
    if isinstance(objective, Huber):
        robust = minimise(problem, objective_named("e2"), starts_count=1)
        objective = objective.settled_on(problem.residuals(robust.x))
    x = minimise(problem, objective, starts_count=1).x
    result = uncertainty(problem.parameters, objective, x, problem.residuals(x), Sensitivity.at(problem, x))
    quantile = result.noise.quantile()
    true = dict(zip(dh_names(len(deviation)), deviation.ravel().tolist(), strict=True))
    for estimate in result.estimates:
        if estimate.parameter.name in true and estimate.undetermined_share < OWN_SHARE:
            yield estimate.parameter.name, estimate, true[estimate.parameter.name], quantile


def _row(what: Session, found: dict[str, Tally]) -> str:
    count = sum(t.count for t in found.values())
    if not count:
        return f"{what}: nothing is determined by itself"
    inner = count - sum(t.resting for t in found.values())
    by_sd = sum(t.by_sd for t in found.values()) / max(1, inner)
    by_interval = [t.by_interval / t.count for t in found.values()]
    overall = sum(t.by_interval for t in found.values()) / count
    spread = float(np.std([s for t in found.values() for s in t.scores]))
    return (
        f"{what.kind:7s} {what.points_count:4d} {what.objective:6s} {what.size:4.2f} {len(found):3d} {count:6d}"
        f"  {100 * by_sd:6.1f}  {100 * overall:6.1f}  {100 * min(by_interval):6.1f} {100 * max(by_interval):6.1f}"
        f"  {spread:6.3f}  {100 * (1 - inner / count):5.1f}"
    )


def main() -> None:
    """Print one row per sort of session."""
    given = argparse.ArgumentParser(description=__doc__)
    given.add_argument("--sessions", type=int, default=400)
    given.add_argument("--kinds", nargs="*", default=list(KINDS))
    given.add_argument("--points", nargs="*", type=int, default=[33, 99, 300])
    given.add_argument("--objectives", nargs="*", default=["e2", "lsq", "huber", "e1"])
    given.add_argument("--sizes", nargs="*", type=float, default=[0.5, 1.0])
    add_options(given)
    wanted = given.parse_args()
    print("unknown points obj.   size par. scores  sd +-t  interval    min    max  sd of score  at bound [%]")
    with executor(wanted.sessions, wanted.workers, wanted.cluster) as runs:
        for kind, count, objective, size in itertools.product(wanted.kinds, wanted.points, wanted.objectives, wanted.sizes):
            what = Session(kind, count, objective, size)
            print(_row(what, studied(what, wanted.sessions, runs=runs)), flush=True)


if __name__ == "__main__":
    main()
