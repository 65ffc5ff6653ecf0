"""The whole calibration of two arms in contact: where they stand, their parameters, contacts left out, which contacts to take."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calib.arm_problem.arm_model import ArmModel
from calib.arm_problem.observations import Frame, rotation_of
from calib.arrays import Array, frozen, norms
from calib.boards import best_motion
from calib.closed_chain.pair_problem import BASE, Contacts, PairPlan, PairProblem, names_of
from calib.design.information import Experiment, Group, criterion_of, select
from calib.errors import UnusablePointsError
from calib.identify.determinability import Determinability, Sensitivity, determinability, open_in_words
from calib.identify.identification import Estimate, uncertainty
from calib.identify.objective import Huber, SumOfDistances
from calib.identify.solver import Minimum, minimise
from calib.results import Provenance, entries, write_json
from control.kinematics.rotation import quaternion_of, quaternions
from control.model.arm import Arm
from control.model.cell import Cell, Placed
from control.model.description import save_arm
from control.plain_text import Advance, aligned, first_of, silent

CONTACTS_LEAST = 6
FOLDS = 5
STARTS = 16  # orientations from which the second base is searched where only distances are known
STEPS = 40
FAR_OFF_m = 0.1  # mean error of nominal arms beyond which the file is of others
SEED = 0
ONE_SEARCH = 0  # no further starts
PLACING_m = 0.005  # nominal arms: a contact that is farther off counts less


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


def calibrate_pair(arms: tuple[Arm, Arm], contacts: Contacts, plan: PairPlan, advance: Advance = silent) -> PairFound:
    """Identify both arms. UnusablePointsError if the contacts are too few, or are not of these arms."""
    if len(contacts) < CONTACTS_LEAST:
        raise UnusablePointsError(
            f"{len(contacts)} contacts: {CONTACTS_LEAST} are needed to know where the arms stand, and more to calibrate them"
        )
    advance("where the arms stand", 0.0)
    placed = placed_by(arms, contacts)
    before = placed.errors_m(np.zeros(6))
    if float(np.median(before)) > FAR_OFF_m:
        raise UnusablePointsError(
            f"with nominal arms the contacts stay open by {1e3 * float(np.median(before)):.0f} mm (median) wherever the second"
            " arm stands: expected the joints of the first arm, then of the second, in rad, and distance_m in m"
        )
    advance("identifying", 0.1)
    problem, best = _identified(arms, contacts, placed.base, plan)
    x = best.x
    estimation = uncertainty(problem.parameters, best.objective, x, problem.residuals(x), Sensitivity.at(problem, x), best.prior)
    calibrated, base = problem.solution(x)
    held = _held_out(arms, contacts, plan, advance)
    return PairFound(
        calibrated,
        base,
        estimation.estimates,
        estimation.known,
        frozen(before),
        frozen(problem.errors_m(x)),
        *held,
        bool((contacts.distance_m > 0.0).any()),
        contacts.name,
        int(np.where(contacts.distance_m > 0.0, 1, 3).sum()) + 3 * len(problem.joins),
        frozen(problem.angles_rad(x)),
    )


def choose_contacts(problem: PairProblem, count: int, noise_m: float) -> list[int]:
    """Rows of the `count` contacts that say most about both arms together (D-optimal), the most valuable first."""
    x = np.zeros(len(problem.parameters))
    known = determinability(problem.sensitivity(x), problem.parameters)
    rows = problem.of_contacts(x)[1] @ known.basis / noise_m
    rank = known.rank
    experiment = Experiment((), frozen(known.basis), frozen(np.eye(rank)), frozen(rows), frozen(np.zeros((1, 3, rank))), False)
    everything = np.arange(len(problem.contacts))
    return select(experiment, criterion_of("D"), np.zeros(0, dtype=np.intp), [Group("contacts", everything, count)])


def _identified(arms: tuple[Arm, Arm], contacts: Contacts, base: Frame, plan: PairPlan) -> tuple[PairProblem, Minimum]:
    """The problem and its minimum near the nominal arms.

    One search: where the scale is open, noise drives parameters to their bounds, and more starts find only more of the same.
    """
    problem = PairProblem(arms, contacts, base, plan)
    wanted = plan.objective
    if isinstance(wanted, Huber):
        robust = minimise(problem, SumOfDistances(), ONE_SEARCH)
        wanted = wanted.settled_on(problem.residuals(robust.x))
    return problem, minimise(problem, wanted, ONE_SEARCH, equal="by noise")


def placed_by(arms: tuple[Arm, Arm], contacts: Contacts) -> PairProblem:
    """The problem of the second base alone, nominal arms, at its solution."""
    names = names_of(arms)
    start = Frame(f"{names[1]}_{BASE}", *_started(arms, contacts))
    geometry = [p.name for p in PairProblem(arms, contacts, start).parameters if f"_{BASE}_" not in p.name]
    problem = PairProblem(arms, contacts, start, PairPlan(fixed=geometry))
    x = minimise(problem, Huber(PLACING_m), ONE_SEARCH).x  # nominal arms: some contacts may be far off
    return PairProblem(arms, contacts, problem.solution(x)[1], problem.plan)


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


def _held_out(arms: tuple[Arm, Arm], contacts: Contacts, plan: PairPlan, advance: Advance) -> tuple[Array, Array]:
    """Errors of every contact by arms from the others, nominal and calibrated; empty if the others are too few."""
    m = len(contacts)
    before, after = np.zeros(m), np.zeros(m)
    if m - m // FOLDS - 1 < CONTACTS_LEAST:
        return np.zeros(0), np.zeros(0)
    for fold in range(FOLDS):
        advance("leaving contacts out", 0.3 + 0.7 * fold / FOLDS)
        out = np.arange(fold, m, FOLDS)
        rest = contacts.chosen(np.setdiff1d(np.arange(m), out))
        placed = placed_by(arms, rest)
        problem, best = _identified(arms, rest, placed.base, plan)
        before[out] = contact_errors_m(arms, placed.base, contacts.chosen(out))
        after[out] = contact_errors_m(*problem.solution(best.x), contacts.chosen(out))
    return frozen(before), frozen(after)


def contact_errors_m(arms: tuple[Arm, Arm], base: Frame, contacts: Contacts) -> Array:
    """How far contacts are from closing (m,) by given arms, the second base at `base` in the first's."""
    problem = PairProblem(arms, contacts, base)
    return problem.errors_m(np.zeros(len(problem.parameters)))


FORMAT = "pair/1"
SCALE = (
    "Contacts in one place leave the scale of both arms open: it stays at nominal. Contacts at a known distance (distance_m)"
    " determine it."
)
NO_EFFECT = 0.98  # share of a parameter that the contacts leave open, from which on its value means nothing


def pair_text(nominal: tuple[Arm, Arm], pair: PairFound) -> str:
    """Errors of contacts left out first, then what is determined, then both arms and where they stand."""
    lines = []
    if len(pair.held_after_m):
        lines.append(
            f"On contacts not used (every 5th left out in turn), the mean error went from {_mm(pair.held_before_m)} to"
            f" {_mm(pair.held_after_m)} mm (largest {1e3 * float(pair.held_after_m.max()):.3f})."
        )
    else:
        lines.append("Too few contacts to leave some out: how good the result is elsewhere is unknown.")
    lines += [
        f"{len(pair.after_m)} contacts: mean error {_mm(pair.before_m)} mm with nominal arms, {_mm(pair.after_m)} mm after, at"
        " the contacts of the fit.",
        *_joined(pair.angles_rad),
        f"They determine {pair.known.rank} of {len(pair.estimates)} parameters (condition number"
        f" {pair.known.condition_number:.0f}).",
        *(f"{sentence}." for sentence in (*remarks(pair), *open_in_words(pair.known.undetermined))),
        *([] if pair.has_distance else [SCALE]),
        "",
        aligned([("parameter", "unit", "", "nominal", "identified", "sd"), *map(_row, _own(pair))], left=3),
        "",
        _stand(names_of(nominal), pair.base),
    ]
    return "\n".join(lines) + "\n"


def _mm(errors_m: Array) -> str:
    return f"{1e3 * float(errors_m.mean()):.3f}"


def _joined(angles_rad: Array) -> list[str]:
    """How well the orientation between joined tools fits."""
    if not len(angles_rad):
        return []
    return [f"Joined tools: {len(angles_rad)} contacts, orientation within {1e3 * _rms(angles_rad):.3f} mrad (rms) after."]


def _rms(angles_rad: Array) -> float:
    return float(np.sqrt(np.mean(np.sum(angles_rad**2, axis=1))))


def _own(pair: PairFound) -> list[Estimate]:
    """The parameters of the arms and their tools, without those of where the bases stand."""
    return [one for one in pair.estimates if one.parameter.has_bound or "_tool_" in one.parameter.name]


def _row(estimate: Estimate) -> tuple[str, ...]:
    unit, factor, digits = ("deg", math.degrees(1.0), 4) if estimate.parameter.unit == "rad" else ("mm", 1e3, 3)
    values = (f"{factor * estimate.parameter.nominal:.{digits}f}", f"{factor * estimate.value:z.{digits}f}")
    if estimate.undetermined_share > NO_EFFECT:
        return (estimate.parameter.name, unit, "no effect here", *values, "")
    spread = "" if math.isnan(estimate.sd) else f"{factor * estimate.sd:.{digits}f}"
    remark = "at its bound" if estimate.is_at_bound else "" if estimate.is_determined else "not determined alone"
    return (estimate.parameter.name, unit, remark, *values, spread)


def _stand(names: tuple[str, str], base: Frame) -> str:
    w, x, y, z = quaternions(base.rotation[None])[0].tolist()
    origin = ", ".join(f"{value:.6f}" for value in base.origin_m)
    return (
        f"Base of {names[1]} in the base frame of {names[0]} (as in cell.toml):\n"
        f"origin_m = [{origin}]\norientation = [{w:.9f}, {x:.9f}, {y:.9f}, {z:.9f}]"
    )


def calibrated_cell(cell: Cell, arms: tuple[Arm, Arm], base: Frame) -> Cell:
    """The cell with calibrated arms of the same names, the second at `base` in the first's base frame."""
    first_arm, second_arm = arms
    first = dataclasses.replace(cell.placed(first_arm.name), arm=first_arm)
    rows = np.array(first.rotation) @ base.rotation
    second = Placed(second_arm, first.in_cell(base.origin_m.tolist()), quaternion_of(rows.tolist()))
    made = {first_arm.name: first, second_arm.name: second}
    return dataclasses.replace(cell, arms=tuple(made.get(placed.name, placed) for placed in cell.arms))


def write_pair(out: Path, nominal: tuple[Arm, Arm], pair: PairFound, objective: str, made: Provenance) -> list[Path]:
    """Write NAME.toml of both arms and pair.json; return the files."""
    files = [out / f"{name}.toml" for name in (*names_of(nominal), "pair")]
    files[-1] = files[-1].with_suffix(".json")
    for file, arm, calibrated in zip(files[:-1], nominal, pair.arms, strict=True):
        save_arm(dataclasses.replace(calibrated, calibration=made.of_arm(arm, objective)), file)
    write_json(files[-1], made.heading(FORMAT) | pair_json(nominal, pair))
    return files


def pair_json(nominal: tuple[Arm, Arm], pair: PairFound) -> dict[str, object]:
    """The result for other programs."""
    return {
        "arms": names_of(nominal),
        "contacts": len(pair.after_m),
        "mean_error_m": {"before": pair.before_m.mean(), "after": pair.after_m.mean()},
        "held_out": {
            "mean_before_m": pair.held_before_m.mean(),
            "mean_after_m": pair.held_after_m.mean(),
            "max_after_m": pair.held_after_m.max(),
        }
        if len(pair.held_after_m)
        else None,
        "rank": pair.known.rank,
        "condition_number": pair.known.condition_number,
        "parameters": {
            estimate.parameter.name: entries(estimate.parameter, "unit", "nominal")
            | entries(estimate, "value", "sd", "is_determined", "is_at_bound")
            for estimate in _own(pair)
        },
        "second_base": {"origin_m": pair.base.origin_m, "orientation": quaternions(pair.base.rotation[None])[0]},
        "undetermined": [{"names": group.names, "freedoms": group.freedoms_count} for group in pair.known.undetermined],
        "joined_angle_rms_rad": _rms(pair.angles_rad) if len(pair.angles_rad) else None,
        "remarks": list(remarks(pair)),
        "in_words": open_in_words(pair.known.undetermined),
    }


EXPLAINED = 0.5  # of the error of contacts left out: a calibration that leaves more has not understood them
CONTRADICTED = 6.0  # times the median error of contacts left out
LEAST_m = 5e-4  # below it a contact is as good as hands and backlash allow
NAMED = 6  # contacts, and parameters
SPARE = 1.5  # rows of three numbers over the numbers that they determine


def remarks(pair: PairFound) -> Iterator[str]:
    """Sentences, the gravest first; none for a result without reproach."""
    before, after = pair.held_before_m, pair.held_after_m
    is_enough = pair.numbers_count >= SPARE * pair.known.rank
    if len(after):
        left_m, nominal_m = float(np.median(after)), float(np.median(before))  # some contacts may be none
        if left_m > max(EXPLAINED * nominal_m, LEAST_m):
            yield (
                f"This does not explain the contacts: left out, half of them stay open by {1e3 * left_m:.2f} mm or more, with"
                f" nominal arms by {1e3 * nominal_m:.2f} mm. Check distance_m (in m), the order of the joints, and that both tips"
                " touched"
            )
        wrong = np.flatnonzero(after > max(CONTRADICTED * float(np.median(after)), LEAST_m))
        if len(wrong) and is_enough:
            worst = wrong[np.argsort(-after[wrong])]
            named = first_of([f"{pair.names[row]} ({1e3 * after[row]:.2f} mm)" for row in worst], NAMED)
            yield f"Contradicted by the others: {named}. Look at them; remove what was not a contact"
    at_bound = [one.parameter.name for one in pair.estimates if one.is_at_bound]
    if at_bound:
        yield (
            f"At their bounds: {first_of(at_bound, NAMED)}. If parts may be that far off, give a larger --bound;"
            " else look for a wrong contact"
        )
    if not is_enough:
        yield (
            f"{pair.numbers_count} numbers determine {pair.known.rank} parameters: the errors at the contacts of the fit say"
            " nothing, and more contacts are needed"
        )
