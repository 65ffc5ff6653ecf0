"""The whole calibration of two arms in contact: where they stand, their parameters, contacts left out, which contacts to take."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field

import numpy as np

from calib.arm_problem.arm_model import ArmModel
from calib.arm_problem.frames import Frame, rotation_of
from calib.arm_problem.parameters import Bounds
from calib.arrays import Array, frozen, norms
from calib.boards import best_motion
from calib.closed_chain.contacts import Contacts
from calib.closed_chain.pair_problem import BASE, PairProblem, names_of
from calib.design.information import Experiment, criterion_of
from calib.design.planning import Group, select
from calib.errors import UnusablePointsError
from calib.identify.determinability import Determinability, determinability
from calib.identify.estimates import Estimate, uncertainty
from calib.identify.objective import Huber, Objective, SumOfDistances
from calib.identify.sensitivity import Sensitivity
from calib.identify.solver import Minimum, minimise
from control.model.arm import Arm
from control.progress import Advance, silent

CONTACTS_LEAST = 6
FOLDS = 5
STARTS = 16  # orientations from which the second base is searched where only distances are known
STEPS = 40
FAR_OFF_m = 0.1  # mean error of nominal arms beyond which the file is of others
SEED = 0
ONE_SEARCH = 0  # no further starts
PLACING_m = 0.005  # nominal arms: a contact that is farther off counts less


@dataclass(frozen=True, slots=True)
class PairPlan:
    """What to identify: `fixed` parameters by name such as left_theta4, arms whose tip is identified too; by which objective."""

    bounds: Bounds = field(default_factory=Bounds)
    fixed: Collection[str] = ()
    free_tools: Collection[str] = ()
    objective: Objective = field(default_factory=Huber)


@dataclass(frozen=True, slots=True)
class PairFound:
    """Both arms, the second base in the first's, and errors [m]: how far contacts are from closing.

    before_m (m,): nominal arms, the base where they fit best; after_m (m,): of the fit. held_before_m, held_after_m (m,): each
    contact predicted by the others; empty with too few. `names` of the contacts (m,); `numbers_count`: three a contact in one
    place, one at a distance. angles_rad (r, 3): how far the orientation between joined tools is from that of their join.
    """

    arms: tuple[Arm, Arm]
    base: Frame
    estimates: tuple[Estimate, ...]
    known: Determinability
    before_m: Array
    after_m: Array
    held_before_m: Array
    held_after_m: Array
    has_distance: bool
    names: tuple[str, ...]
    numbers_count: int
    angles_rad: Array


def calibrate_pair(
    arms: tuple[Arm, Arm], contacts: Contacts, plan: PairPlan, advance: Advance = silent
) -> PairFound:
    """Identify both arms. UnusablePointsError if the contacts are too few, or are not of these arms."""
    if len(contacts) < CONTACTS_LEAST:
        raise UnusablePointsError(
            f"{len(contacts)} contacts: {CONTACTS_LEAST} are needed to know where the arms stand, and more to calibrate them"
        )
    advance("where the arms stand", 0.0)
    placed = _placed(arms, contacts)
    before = placed.errors_m(np.zeros(6))
    if float(np.median(before)) > FAR_OFF_m:
        raise UnusablePointsError(
            f"with nominal arms the contacts stay open by {1e3 * float(np.median(before)):.0f} mm (median) wherever the second"
            " arm stands: expected the joints of the first arm, then of the second, in rad, and distance_m in m"
        )
    advance("identifying", 0.1)
    problem, best = _identified(arms, contacts, placed.base, plan)
    x = best.x
    found = uncertainty(
        problem.parameters, best.objective, x, problem.residuals(x), Sensitivity.at(problem, x)
    )
    calibrated, base = problem.solution(x)
    held = _held_out(arms, contacts, plan, advance)
    advance("done", 1.0)
    return PairFound(
        calibrated,
        base,
        found.estimates,
        found.known,
        frozen(before),
        frozen(problem.errors_m(x)),
        *held,
        bool((contacts.distance_m > 0.0).any()),
        contacts.name,
        int(np.where(contacts.distance_m > 0.0, 1, 3).sum()) + 3 * len(problem.joins),
        frozen(problem.angles_rad(x)),
    )


def choose_contacts(
    arms: tuple[Arm, Arm],
    contacts: Contacts,
    plan: PairPlan,
    count: int,
    noise_m: float,
    base: Frame | None = None,
) -> list[int]:
    """Rows of the `count` contacts that say most about both arms together (D-optimal), the most valuable first.

    `base`: where the second arm stands; None: where the contacts fit best.
    """
    problem = PairProblem(
        arms,
        contacts,
        base or _placed(arms, contacts).base,
        bounds=plan.bounds,
        fixed=plan.fixed,
        free_tools=plan.free_tools,
    )
    x = np.zeros(len(problem.parameters))
    known = determinability(problem.sensitivity(x), problem.parameters)
    rows = problem.of_contacts(x)[1] @ known.basis / noise_m
    rank = known.rank
    experiment = Experiment(
        (), frozen(known.basis), frozen(np.eye(rank)), frozen(rows), frozen(np.zeros((1, 3, rank))), False
    )
    everything = np.arange(len(contacts))
    return select(
        experiment, criterion_of("D"), np.zeros(0, dtype=np.intp), [Group("contacts", everything, count)]
    )


def _identified(
    arms: tuple[Arm, Arm], contacts: Contacts, base: Frame, plan: PairPlan
) -> tuple[PairProblem, Minimum]:
    """The problem and its minimum near the nominal arms.

    One search: where the scale is open, noise drives parameters to their bounds, and more starts find only more of the same.
    """
    problem = PairProblem(
        arms, contacts, base, bounds=plan.bounds, fixed=plan.fixed, free_tools=plan.free_tools
    )
    wanted = plan.objective
    if isinstance(wanted, Huber):
        robust = minimise(problem, SumOfDistances(), ONE_SEARCH)
        wanted = wanted.settled_on(problem.residuals(robust.x))
    return problem, minimise(problem, wanted, ONE_SEARCH, equal="by noise")


def _placed(arms: tuple[Arm, Arm], contacts: Contacts) -> PairProblem:
    """The problem of the second base alone, nominal arms, at its solution."""
    names = names_of(arms)
    start = Frame(f"{names[1]}_{BASE}", *_started(arms, contacts))
    fixed = [p.name for p in PairProblem(arms, contacts, start).parameters if f"_{BASE}_" not in p.name]
    problem = PairProblem(arms, contacts, start, fixed=fixed)
    x = minimise(problem, Huber(PLACING_m), ONE_SEARCH).x  # nominal arms: some contacts may be far off
    return PairProblem(arms, contacts, problem.solution(x)[1], fixed=fixed)


def _started(arms: tuple[Arm, Arm], contacts: Contacts) -> tuple[Array, Array]:
    """Rotation and origin of the second base in the first, by nominal arms.

    Contacts in one place give it in closed form. With distances, the second tip is put on the line to the first at the right
    distance, and the base where it fits best, in turns, from several orientations.
    """
    ours = ArmModel(arms[0]).tips(arms[0].dh, contacts.first_rad)
    theirs = ArmModel(arms[1]).tips(arms[1].dh, contacts.second_rad)
    near = contacts.distance_m == 0.0
    if near.sum() >= CONTACTS_LEAST:
        motion = best_motion(theirs[near], ours[near])
        return frozen(motion.rotation), frozen(motion.shift_m)
    rng, best, least = np.random.default_rng(SEED), best_motion(theirs, ours), np.inf
    for _ in range(STARTS):
        turn = rotation_of(rng.uniform(-np.pi, np.pi) * _unit(rng))
        placed = theirs @ turn.T
        placed += ours.mean(axis=0) - placed.mean(axis=0) + contacts.distance_m.mean() * _unit(rng)
        for _ in range(STEPS):
            way = placed - ours
            wanted = ours + contacts.distance_m[:, None] * way / np.maximum(norms(way), 1e-9)[:, None]
            motion = best_motion(theirs, wanted)
            placed = motion.of(theirs)
        total = float(np.sum((norms(placed - ours) - contacts.distance_m) ** 2))
        if total < least:
            best, least = motion, total
    return frozen(best.rotation), frozen(best.shift_m)


def _unit(rng: np.random.Generator) -> Array:
    vector = rng.normal(size=3)
    return np.asarray(vector / np.linalg.norm(vector))


def _held_out(
    arms: tuple[Arm, Arm], contacts: Contacts, plan: PairPlan, advance: Advance
) -> tuple[Array, Array]:
    """Errors of every contact by arms from the others, nominal and calibrated; empty if the others are too few."""
    m = len(contacts)
    before, after = np.zeros(m), np.zeros(m)
    if m - m // FOLDS - 1 < CONTACTS_LEAST:
        return np.zeros(0), np.zeros(0)
    for fold in range(FOLDS):
        advance("leaving contacts out", 0.3 + 0.7 * fold / FOLDS)
        out = np.arange(fold, m, FOLDS)
        rest = contacts.chosen(np.setdiff1d(np.arange(m), out))
        placed = _placed(arms, rest)
        problem, best = _identified(arms, rest, placed.base, plan)
        before[out] = contact_errors_m(arms, placed.base, contacts.chosen(out))
        after[out] = contact_errors_m(*problem.solution(best.x), contacts.chosen(out))
    return frozen(before), frozen(after)


def contact_errors_m(arms: tuple[Arm, Arm], base: Frame, contacts: Contacts) -> Array:
    """How far contacts are from closing (m,) by given arms, the second base at `base` in the first's."""
    problem = PairProblem(arms, contacts, base)
    return problem.errors_m(np.zeros(len(problem.parameters)))
