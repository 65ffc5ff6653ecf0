"""A short check of a calibrated arm: is it as it was, does it need a calibration, or is something wrong with
a joint?

In: the points of its calibration, and a few new ones. Expectations say where the tip is measured if nothing
has changed, and how surely; causes (a slipped zero, play, a softer gear) get probabilities by what they would
move; the decision says what to do. The design chooses the few poses that tell the causes apart best.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final, Literal

import numpy as np

from calib.arm_problem.arm_model import ArmModel
from calib.arm_problem.assembly import Choice, problem_of
from calib.arm_problem.observations import cross_matrix
from calib.arrays import Array, Mask
from calib.gap.plan.motions import collision_free_box
from calib.gap.plan.plan import MARGIN_rad, NamedPose, PlanExtent, PlannedVisit, RecordingPlan, plan_of, static_poses
from calib.points.points import FREE, Points, joined, make_points
from calib.results import entries
from calib.trust.discrepancy import Conditions, Discrepancy
from calib.trust.prediction import linearised, loose_play_m2, posterior_of
from control.dynamics.static_pose import resting
from control.errors import MissingModel
from control.model.arm import Arm

# What an arm's earlier points say of new poses: where the tip will be measured if nothing has changed, and
# how surely.


LOAD_LEAST_Nm: Final = 0.01  # a joint that gravity loads by less, such as a vertical one, tells nothing of its give


@dataclass(frozen=True, slots=True)
class ExpectedTips:
    """At m new poses: `left_m` (m, 3), measured minus expected tips; covariance (3 m, 3 m) if nothing has changed.

    scatter_m2 (m, 3, 3): its part that is another in each visit. by_joint (m, 3, n): the tip per angle; by_link (m, 3, 4 links):
    per DH parameter. flank (m, n): the side on which a gear lies, 0 if unclear. load, held (m, n): gravity torque, and what the
    motor holds beyond it, over the largest gravity torque.
    """

    left_m: Array
    covariance: Array
    scatter_m2: Array
    by_joint: Array
    by_link: Array
    tip_m: Array
    flank: Array
    load: Array
    held: Array
    q_rad: Array
    model: ArmModel
    dh: Array
    tool_m: Array

    def turned_m(self, joint: int, angle_rad: float) -> Array:
        """The tip's shift (m, 3) if a joint (0-based) turns by an angle of any size."""
        q = self.q_rad.copy()
        q[:, joint] += angle_rad
        return self.model.tips(self.dh, q, self.tool_m) - self.tip_m

    def __len__(self) -> int:
        """How many poses."""
        return len(self.left_m)

    def chosen(self, rows: list[int]) -> ExpectedTips:
        """Of some poses."""
        flat = (3 * np.array(rows)[:, None] + np.arange(3)).ravel()
        return replace(
            self,
            left_m=self.left_m[rows],
            covariance=self.covariance[np.ix_(flat, flat)],
            scatter_m2=self.scatter_m2[rows],
            by_joint=self.by_joint[rows],
            by_link=self.by_link[rows],
            tip_m=self.tip_m[rows],
            flank=self.flank[rows],
            load=self.load[rows],
            held=self.held[rows],
            q_rad=self.q_rad[rows],
        )


def expectation_of(arm: Arm, earlier: Points, new: Points) -> ExpectedTips:
    """By the posterior of the `earlier` points (`calib.trust.prediction`). UnusablePointsError for a pose without a reference."""
    points = joined((earlier, new))
    problem = problem_of(arm, points, Choice().for_points(arm, points))
    is_new = np.arange(len(points)) >= len(earlier)
    at = Conditions.recorded(arm, points)
    discrepancy = Discrepancy(arm)
    posterior = posterior_of(problem, at, discrepancy, ~is_new)
    design, wanted = linearised(problem, at, discrepancy, posterior.x)
    solved = problem.solution(posterior.x)
    rows = design[is_new]
    flat = rows.reshape(-1, rows.shape[2])
    scatter = loose_play_m2(discrepancy, at, solved, posterior)[is_new] + posterior.noise_m**2 * np.eye(3)
    model = ArmModel(arm)
    slopes = model.slopes(solved.dh, new.q_rad, solved.tool_m)
    flank, load, held = _gears(arm, at, is_new)
    return ExpectedTips(
        left_m=rows @ posterior.mean - wanted[is_new],
        covariance=flat @ posterior.covariance @ flat.T + _blocks(scatter),
        scatter_m2=scatter,
        by_joint=slopes.by_dh[:, :, list(model.theta_places)],
        by_link=np.asarray(slopes.by_dh),
        tip_m=slopes.tips,
        flank=flank,
        load=load,
        held=held,
        q_rad=new.q_rad,
        model=model,
        dh=solved.dh,
        tool_m=solved.tool_m,
    )


def _gears(arm: Arm, at: Conditions, is_new: Mask) -> tuple[Array, Array, Array]:
    """Flanks, gravity torques and held torques at the new poses, (m, n) each."""
    try:
        state = resting(arm, at.q_rad, at.direction, at.current_A, at.payload_kg)
    except MissingModel:
        unknown = np.zeros((int(is_new.sum()), at.q_rad.shape[1]))
        return np.sign(at.direction)[is_new], unknown, unknown
    largest = np.abs(state.gravity_Nm).max(axis=0)
    unit = np.where(largest > LOAD_LEAST_Nm, largest, np.inf)
    return state.flank[is_new], (state.gravity_Nm / unit)[is_new], (state.held_Nm / unit)[is_new]


def _blocks(parts: Array) -> Array:
    """Block-diagonal matrix (3 m, 3 m) of parts (m, 3, 3)."""
    whole = np.zeros((3 * len(parts), 3 * len(parts)))
    for k, part in enumerate(parts):
        whole[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] = part
    return whole


# What may have happened to an arm since its points were taken, and which of it new poses speak for.
#
# Each cause moves the tip along columns X with amplitudes that are normal with an unknown size s; measured
# minus expected tips have the covariance S + s^2 X X', with S of `expectation`. The scale of both is an
# estimate, known as by FREEDOM coordinates, so that the evidence is that of Student's distribution: tips
# that are all somewhat farther off than expected are no change. Sizes are averaged over a grid. "several"
# has the columns of all causes, for what no single one explains. Probabilities follow from these evidences
# and equal odds of "nothing" and "something".


Kind = Literal["nothing", "zero", "play", "load", "link", "frame", "several"]
FREEDOM: Final = 10.0  # what is left of predicted tips was 0.85 to 1.6 times what had been promised (make trust-study)
ANGLES_rad: Final = (3e-4, 1e-3, 3e-3, 1e-2, 3e-2)  # sizes of a joint's change: from below what shows to a slipped tooth
LENGTHS_m: Final = (1e-4, 3e-4, 1e-3, 3e-3, 1e-2)  # of a frame's or a link's
LEVER_m: Final = 0.3  # turns one into the other
STRAIGHT_rad: Final = 1e-3  # up to which the tip's way is straight to a micrometre
CHORDS: Final = 3  # rounds, until the chord is that of the angle


@dataclass(frozen=True, slots=True)
class Cause:
    """A change: kind, joint or link (1-based, 0: none); its columns (m, 3, k) and how far it scatters a visit (m, 3, 3)."""

    kind: Kind
    number: int
    columns: Array
    scatter: Array | None
    sizes: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class Judged:
    """A cause with its probability, its most probable amplitudes (k,), and the tip's shift by them, root mean square [m].

    misfit: chi-squared of what it leaves, over its degrees of freedom.
    """

    cause: Cause
    probability: float
    amplitudes: Array
    shift_m: float
    misfit: float


def causes_of(at: ExpectedTips) -> tuple[Cause, ...]:
    """All causes that poses can show; the first is nothing."""
    return tuple(_causes(at))


def _causes(at: ExpectedTips) -> Iterator[Cause]:
    count = len(at)
    yield Cause("nothing", 0, np.zeros((count, 3, 0)), None, (1.0,))
    for j in range(at.by_joint.shape[2]):
        moves = at.by_joint[:, :, j]
        yield Cause("zero", j + 1, moves[:, :, None], None, ANGLES_rad)
        loose = 0.25 * (at.flank[:, j] == 0.0)[:, None, None] * np.einsum("mi,mk->mik", moves, moves)
        yield Cause("play", j + 1, -0.5 * (at.flank[:, j, None] * moves)[:, :, None], loose, ANGLES_rad)
        if at.load[:, j].any():
            pulls = np.stack((at.load[:, j], at.held[:, j]), axis=1)  # of friction, a part is on the link's side
            yield Cause("load", j + 1, -moves[:, :, None] * pulls[:, None, :], None, ANGLES_rad)
    for link in range(at.by_link.shape[2] // 4):
        d, _, length, alpha = (at.by_link[:, :, 4 * link + k] for k in range(4))
        yield Cause("link", link + 1, np.stack((d, length, alpha / LEVER_m), axis=2), None, LENGTHS_m)
    turns = np.array([-cross_matrix(tip) for tip in at.tip_m]) / LEVER_m
    shifts = np.broadcast_to(np.eye(3), turns.shape)
    yield Cause("frame", 0, np.concatenate((shifts, turns), axis=2), None, LENGTHS_m)


def judged(at: ExpectedTips) -> tuple[Judged, ...]:
    """Every cause, the most probable first."""
    singles = [_along_circle(at, cause) for cause in causes_of(at)]
    causes = [*singles, _several(singles)]
    prior = np.log(np.array([0.5, *np.full(len(causes) - 1, 0.5 / (len(causes) - 1))]))
    tried = [[_tried(at, cause, size) for size in cause.sizes] for cause in causes]
    evidence = np.array([_mean_of([trial.evidence for trial in of_sizes]) for of_sizes in tried]) + prior
    probability = np.exp(evidence - evidence.max())
    probability /= probability.sum()
    judgements = []
    for cause, of_sizes, share in zip(causes, tried, probability, strict=True):
        best = max(of_sizes, key=lambda trial: trial.evidence)
        moved = cause.columns @ best.amplitudes
        shift_m = math.sqrt(float(np.mean(np.sum(moved**2, axis=1))))
        judgements.append(Judged(cause, float(share), best.amplitudes, shift_m, best.misfit))
    return tuple(sorted(judgements, key=lambda one: -one.probability))


def misfit_limit(coordinates: int) -> float:
    """The chi-squared a coordinate that chance and the estimated scale leave in 99 of 100 cases (Fisher's distribution)."""
    from scipy.special import fdtri

    return float(fdtri(coordinates, FREEDOM, 0.99))


def _several(singles: Sequence[Cause]) -> Cause:
    """All causes at once, each with amplitudes of one size: angles in rad, lengths over a lever."""
    columns = [one.columns if one.sizes == ANGLES_rad else one.columns * LEVER_m for one in singles if one.kind != "nothing"]
    return Cause("several", 0, np.concatenate(columns, axis=2), None, ANGLES_rad)


def _along_circle(at: ExpectedTips, cause: Cause) -> Cause:
    """A turned joint moves the tip on a circle: its column as the chord to where it turned, not the tangent."""
    if cause.kind != "zero":
        return cause
    for _ in range(CHORDS):
        best = max((_tried(at, cause, size) for size in cause.sizes), key=lambda one: one.evidence)
        angle_rad = float(best.amplitudes[0])
        if abs(angle_rad) > STRAIGHT_rad:
            chord = at.turned_m(cause.number - 1, angle_rad) / angle_rad
            cause = dataclasses.replace(cause, columns=chord[:, :, None])
    return cause


@dataclass(frozen=True, slots=True)
class _Tried:
    evidence: float
    amplitudes: Array
    misfit: float


def _tried(at: ExpectedTips, cause: Cause, size: float) -> _Tried:
    """The evidence of a cause of one size."""
    y, x = at.left_m.ravel(), cause.columns.reshape(3 * len(at), -1) * size
    noise = at.covariance.copy()
    if cause.scatter is not None:
        for k, part in enumerate(cause.scatter):
            noise[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] += size**2 * part
    root = np.linalg.cholesky(noise + x @ x.T)
    white = np.linalg.solve(root, y)
    amplitudes = size * x.T @ np.linalg.solve(root.T, white)
    left = y - (x / size) @ amplitudes
    misfit = float(left @ np.linalg.solve(noise, left)) / len(y)
    square = 0.5 * (FREEDOM + len(y)) * math.log1p(float(white @ white) / FREEDOM)
    return _Tried(-square - float(np.log(np.diag(root)).sum()), amplitudes, misfit)


def _mean_of(logs: list[float]) -> float:
    """Logarithm of the mean of what these are the logarithms of."""
    top = max(logs)
    return top + math.log(sum(math.exp(one - top) for one in logs) / len(logs))


SURE: Final = 0.9  # probability from which one decision is given
SLIP_rad: Final = 0.008  # of a zero: settling and temperature move it by less, a slipped coupling or a lost tooth by more
BENT_m: Final = 0.003  # of the tip, by one link: more than parts settle
LEFT_MOST: Final = 0.05  # of chi-squared if nothing had changed: a cause that leaves less is one, whatever else there is
CAUSES_NAMED: Final = 3

FINE, RECALIBRATE = "fine", "recalibrate"


@dataclass(frozen=True, slots=True)
class CheckupDecision:
    """`action`: fine, recalibrate, or "inspect joint 2"; its probability; other actions that are left open, with theirs.

    is_one_cause: the first cause explains most; is_all: it explains everything. expected_m: root mean square of what the tips
    may be off by if nothing has changed; left_m: of what was measured.
    """

    action: str
    probability: float
    open: tuple[tuple[str, float], ...]
    causes: tuple[Judged, ...]
    is_one_cause: bool
    is_all: bool
    expected_m: float
    left_m: float
    poses_count: int

    @property
    def is_sure(self) -> bool:
        """Whether one action has most of the probability."""
        return self.probability >= SURE


def decide(at: ExpectedTips) -> CheckupDecision:
    """By poses that were measured."""
    judgements = judged(at)
    single = next(judgement for judgement in judgements if judgement.cause.kind != "several")
    unchanged = next(judgement.misfit for judgement in judgements if judgement.cause.kind == "nothing")
    is_one_cause = judgements[0] is single or single.misfit <= LEFT_MOST * unchanged
    noise_m = math.sqrt(float(np.mean(np.trace(at.scatter_m2, axis1=1, axis2=2))))
    actions: dict[str, float] = {}
    for judgement in judgements:
        is_several = judgement.cause.kind == "several"
        action = action_of(single if is_several and is_one_cause else judgement, noise_m)
        actions[action] = actions.get(action, 0.0) + judgement.probability
    first, *others = sorted(actions.items(), key=lambda item: -item[1])
    return CheckupDecision(
        first[0],
        first[1],
        tuple((action, share) for action, share in others if share >= 1.0 - SURE),
        tuple(judgement for judgement in judgements if judgement.cause.kind != "several")[:CAUSES_NAMED],
        is_one_cause,
        judgements[0] is single and single.misfit <= misfit_limit(3 * len(at)),
        math.sqrt(float(np.trace(at.covariance)) / len(at)),
        math.sqrt(float(np.mean(np.sum(at.left_m**2, axis=1)))),
        len(at),
    )


def action_of(judgement: Judged, noise_m: float) -> str:
    """What a cause calls for. A change that is smaller than a visit's scatter is none."""
    kind, number = judgement.cause.kind, judgement.cause.number
    if kind == "nothing" or judgement.shift_m < noise_m:
        return FINE
    if kind in ("play", "load"):
        return f"inspect joint {number}"
    if kind == "zero" and abs(float(judgement.amplitudes[0])) > SLIP_rad:
        return f"inspect joint {number}"
    if kind == "link" and judgement.shift_m > BENT_m:
        return f"inspect link {number}"
    return RECALIBRATE


def words_of(judgement: Judged) -> str:
    """A cause in words, with its size."""
    kind, number = judgement.cause.kind, judgement.cause.number
    size = f"{1e3 * abs(float(judgement.amplitudes[0])):.2g} mrad" if kind in ("zero", "play", "load") else ""
    shift = f"{1e3 * judgement.shift_m:.2g} mm at the tip"
    texts = {
        "nothing": "nothing has changed",
        "zero": f"the zero of joint {number} has moved by {size}",
        "play": f"the play of joint {number} has changed by {size}",
        "load": f"joint {number} gives way under load by {size} more at its largest load",
        "link": f"link {number} has another shape ({shift})",
        "frame": f"the base or the camera has moved ({shift})",
    }
    return texts[kind]


def sentences(decision: CheckupDecision) -> tuple[str, ...]:
    """The decision in words."""
    return tuple(_sentences(decision))


def _sentences(decision: CheckupDecision) -> Iterator[str]:
    yield (
        f"{decision.poses_count} visits: the tip is {1e3 * decision.left_m:.2g} mm from where it is expected; if nothing has"
        f" changed, {1e3 * decision.expected_m:.2g} mm are usual (root mean square)."
    )
    first = decision.causes[0]
    if not decision.is_one_cause:
        yield f"Recalibrate: no single cause explains it; nearest: {words_of(first)}."
        return
    if decision.is_sure:
        yield f"{decision.action.capitalize()} ({_percent(decision.probability)}): {words_of(first)}."
        if decision.action.startswith("inspect"):
            yield _advice(first)
        if not decision.is_all:
            yield "It does not explain everything: something smaller may have changed as well."
        return
    options = [(decision.action, decision.probability), *decision.open]
    told = " or ".join(f"{action} ({_percent(share)})" for action, share in options)
    yield f"Not sure: {told}. Likely: {_listed(decision.causes)}. Run it again with more --poses."


def _advice(first: Judged) -> str:
    number = first.cause.number
    match first.cause.kind:
        case "zero":
            return f"Look for a slipped coupling, encoder or belt of joint {number}; then home and calibrate."
        case "play":
            return f"Look for wear or a loose fit in the gear of joint {number}; then calibrate, and run `gap`."
        case "load":
            return f"Look for a loose screw, clamp or belt at joint {number}; then calibrate, and run `gap`."
        case _:
            return f"Look whether link {number} is bent or loose; then calibrate."


def _listed(causes: Sequence[Judged]) -> str:
    return "; ".join(f"{words_of(one)} ({_percent(one.probability)})" for one in causes if one.probability >= 0.01)


def _percent(share: float) -> str:
    return "> 99 %" if share > 0.99 else f"{100 * share:.0f} %"


def decision_json(decision: CheckupDecision) -> dict[str, object]:
    """For programs; SI units."""
    return {
        "format": "checkup/1",
        "action": decision.action if decision.is_sure else "not sure",
        "likeliest": decision.action,
        "probability": decision.probability,
        "open": [{"action": action, "probability": share} for action, share in decision.open],
        "causes": [
            {"kind": judgement.cause.kind, "number": judgement.cause.number or None, "shift_rms_m": judgement.shift_m}
            | entries(judgement, "probability", "amplitudes")
            for judgement in decision.causes
        ],
        "visits": decision.poses_count,
        "expected_rms_m": decision.expected_m,
        "left_rms_m": decision.left_m,
        "in_words": sentences(decision),
    }


POSES: Final = 8  # each is visited from two opposite sides
SIZE_rad: Final = 3e-3  # of a change that is to be told: three times what parts of a sound arm do
CANDIDATES: Final = PlanExtent(levels=3, spread=24, outside=8, pulled=2)


def checkup_plan(arm: Arm, earlier: Points, count: int = POSES, speed: float = 1.0) -> RecordingPlan:
    """The poses that determine all causes together best (D-optimal, one after the other), as visits."""
    room = collision_free_box(arm)
    poses = static_poses(arm, room.inset(MARGIN_rad), CANDIDATES)
    sides = _sides(arm.joint_count)
    rows = [(pose, side) for k, pose in enumerate(poses) for side in (sides[k % 2], _against(sides[k % 2]))]
    q = np.array([pose.q_rad for pose, _ in rows])
    direction = np.array([side for _, side in rows], dtype=float)
    names = [f"c{k}" for k in range(len(rows))]
    new = make_points([FREE] * len(rows), names, [1] * len(rows), q, ArmModel(arm).tips(arm.dh, q), direction)
    chosen = _best(expectation_of(arm, earlier, new), count)
    visits = [visit for k in chosen for visit in _visits(*rows[2 * k])]
    return plan_of(arm, room, visits, speed)


def _visits(pose: NamedPose, side: tuple[int, ...]) -> tuple[PlannedVisit, PlannedVisit]:
    ways = (side, _against(side))
    first, second = (
        PlannedVisit(pose.name, repeat, pose.q_rad, way, 0.0, pose.via_rad, FREE) for repeat, way in enumerate(ways, 1)
    )
    return first, second


def _best(at: ExpectedTips, count: int) -> list[int]:
    """Greedy: the pose (two rows) that adds most to the logarithm of the information's determinant."""
    columns = np.concatenate(
        [one.columns * (SIZE_rad if one.kind in ("zero", "play", "load") else 0.3 * SIZE_rad) for one in causes_of(at)], axis=2
    )
    half = len(at) // 2
    parts = [_information(at, columns, [2 * k, 2 * k + 1]) for k in range(half)]
    known = np.eye(columns.shape[2])
    chosen: list[int] = []
    for _ in range(min(count, half)):
        gains = [-np.inf if k in chosen else np.linalg.slogdet(known + parts[k])[1] for k in range(half)]
        chosen.append(int(np.argmax(gains)))
        known = known + parts[chosen[-1]]
    return chosen


def _information(at: ExpectedTips, columns: Array, rows: list[int]) -> Array:
    visits = at.chosen(rows)
    flat = columns[rows].reshape(6, -1)
    return np.asarray(flat.T @ np.linalg.solve(visits.covariance, flat))


def _sides(n: int) -> tuple[tuple[int, ...], tuple[int, ...]]:
    return (1,) * n, tuple(1 if j % 2 == 0 else -1 for j in range(n))


def _against(side: tuple[int, ...]) -> tuple[int, ...]:
    return tuple(-one for one in side)
