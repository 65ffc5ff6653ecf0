"""What a pose is worth: information on the parameters, the uncertainty after measuring some, criteria and
indices of observability; and the most valuable poses, selected by exchange.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from calib.arm_problem.arm_model import Parameter, dh_names
from calib.arm_problem.assembly import Choice, problem_of
from calib.arm_problem.observations import cross_matrix
from calib.arm_problem.posed import TARGET_NAMES, PosedProblem
from calib.arm_problem.problem import TOOL_NAMES, ArmProblem
from calib.arrays import Array, frozen
from calib.design.candidates import Mask, Rows
from calib.errors import CalibrationError
from calib.identify.determinability import RANK_TOLERANCE
from calib.points.points import Points
from control.kinematics.kinematics import ForwardKinematics
from control.kinematics.rotation import quaternions
from control.model.arm import Arm

# Information of each pose on the parameters, and the uncertainty after measuring some of them.
#
# Linear theory at the nominal arm: a pose with Jacobian J (3, k), in scaled unknowns and standard
# deviations of the noise, adds J'J to the information M. M begins with 1 per unknown, a weak prior: each
# deviation is somewhere within its bound. Unknown poses of boards and base are also identified, but are
# nuisance parameters: only the information left for the arm after eliminating them counts (the Schur
# complement; Ds-optimality, Atkinson and Donev, Optimum Experimental Designs, 1992).


@dataclass(frozen=True, slots=True)
class Experiment:
    """Information of all recorded and candidate poses; arrays are read-only.

    `rows` (p, 3, r + s), with orientations (p, 6, r + s): derivatives of the tips by r combinations of the arm's scaled
    parameters and s unknowns of boards and base, in standard deviations of the noise. `basis` (k, r) are the combinations:
    those that move a tip anywhere in the workspace, or in some pose. `visible` (r, v): those of them that the poses can
    determine together. `workspace` (w, 3, r) [m]: derivatives of tips over the workspace by the combinations; if nothing
    relates the base to a known place (`is_tied`), without rigid motions.
    """

    parameters: tuple[Parameter, ...]
    basis: Array
    visible: Array
    rows: Array
    workspace: Array
    is_tied: bool

    @property
    def rank(self) -> int:
        """The number of combinations, r."""
        return int(self.basis.shape[1])

    @property
    def places_count(self) -> int:
        """Unknowns of boards and base, s."""
        return int(self.rows.shape[2]) - self.rank

    @property
    def workspace_weight(self) -> Array:
        """Mean of J'J over the workspace, (r, r) [m^2]: its trace with a covariance is the tip's mean square error."""
        return np.asarray(np.einsum("wik,wil->kl", self.workspace, self.workspace) / len(self.workspace))

    def information(self, chosen: Rows | list[int]) -> Array:
        """M (r + s, r + s) of the poses chosen, and the prior."""
        flat = self.rows[chosen].reshape(-1, self.rows.shape[2])
        return np.asarray(np.eye(self.rows.shape[2]) + flat.T @ flat)


@dataclass(frozen=True, slots=True)
class Uncertainty:
    """Uncertainty after some poses.

    log_det: natural logarithm by which the parameters' uncertain volume has shrunk, squared. tip_m: root mean square
    of the tip's predicted error over the workspace, in space; tip_worst_m: the same at the worst pose there.
    least_known: the parameter whose standard deviation is the largest share of its bound, with that deviation in its
    unit.
    """

    points_count: int
    log_det: float
    indices: Indices
    tip_m: float
    tip_worst_m: float
    least_known: str
    least_known_sd: float
    least_known_unit: str
    rank: int


def experiment_of(arm: Arm, poses: Points, workspace_q: Array, noise_m: float, choice: Choice) -> Experiment:
    """All poses (taken and candidates) of an arm as information; `choice` as for the identification.

    With its `orientation_noise_rad` the orientation of every measured tip is measured, too.
    """
    problem = problem_of(arm, poses, choice)
    parameters, rows = _rows(arm, poses, problem, noise_m, choice)
    is_place = _is_place(problem, parameters)
    tied = ~np.array([frame.is_free for frame in problem.observed.frames])[problem.observed.frame]
    parameters = tuple(p for p, place in zip(parameters, is_place, strict=True) if not place)
    workspace = _workspace_rows(problem, parameters, workspace_q, bool(tied.any()))
    shown, scale = _arm_information(rows, is_place), np.array([p.has_bound for p in parameters])
    everything = shown + np.einsum("wik,wil->kl", workspace, workspace) / noise_m**2
    basis = _seen(everything, float(np.linalg.norm(everything[np.ix_(scale, scale)], 2)))
    visible = _seen(basis.T @ shown @ basis, float(np.linalg.norm(shown[np.ix_(scale, scale)], 2)))
    return Experiment(
        parameters=parameters,
        basis=frozen(basis),
        visible=frozen(visible),
        rows=frozen(np.concatenate((rows[:, :, ~is_place] @ basis, rows[:, :, is_place]), axis=2)),
        workspace=frozen(workspace @ basis),
        is_tied=bool(tied.any()),
    )


def uncertainty_of(experiment: Experiment, chosen: Rows | list[int]) -> Uncertainty:
    """Uncertainty after the chosen poses."""
    r = experiment.rank
    information = experiment.information(chosen)
    covariance = np.asarray(np.linalg.inv(information), dtype=np.float64)[:r, :r]
    squares = np.einsum("wik,kl,wil->w", experiment.workspace, covariance, experiment.workspace)
    shown = _without_places(information - np.eye(len(information)), r)
    values = np.linalg.eigvalsh(experiment.visible.T @ shown @ experiment.visible)
    singular = np.sqrt(np.where(values > RANK_TOLERANCE**2 * _yardstick(experiment, shown), values, 0.0))
    name, sd, unit = _least_known(experiment, covariance)
    return Uncertainty(
        points_count=len(chosen),
        log_det=0.0 - float(np.linalg.slogdet(covariance)[1]),
        indices=indices_of(singular, len(chosen)),
        tip_m=float(np.sqrt(np.mean(squares))),
        tip_worst_m=float(np.sqrt(np.max(squares))),
        least_known=name,
        least_known_sd=sd,
        least_known_unit=unit,
        rank=int(np.sum(singular > 0.0)),
    )


def _rows(arm: Arm, poses: Points, problem: ArmProblem, noise_m: float, choice: Choice) -> tuple[tuple[Parameter, ...], Array]:
    """The unknowns, and each pose's derivatives over their noise: (m, 3, k), with orientations (m, 6, k)."""
    if choice.orientation_noise_rad is None:
        _, jacobian = problem.residuals_and_jacobian(np.zeros(len(problem.parameters)))
        return problem.parameters, np.array(jacobian) / noise_m
    seen = np.isfinite(poses.tip_m).all(axis=1)
    turned = np.full((len(poses), 4), np.nan)
    turned[seen] = quaternions(ForwardKinematics(arm).link_transforms(poses.q_rad[seen])[:, -1, :3, :3])
    whole = PosedProblem(problem_of(arm, dataclasses.replace(poses, orientation=turned), choice))
    _, jacobian = whole.residuals_and_jacobian(np.zeros(len(whole.parameters)))
    m, k = len(poses), len(whole.parameters)
    rows = np.zeros((m, 6, k))
    rows[:, :3] = jacobian[:m] / noise_m
    rows[whole.rows, 3:] = jacobian[m:] / (whole.lever_m * choice.orientation_noise_rad)
    return whole.parameters, rows


def _is_place(problem: ArmProblem, parameters: tuple[Parameter, ...]) -> Mask:
    """Mask of unknowns for poses of boards, the base or the measured target."""
    places = {name for frame in problem.free_frames for name in frame.parameter_names} | set(TARGET_NAMES)
    return np.array([parameter.name in places for parameter in parameters])


def _arm_information(rows: Array, is_place: Mask) -> Array:
    """Information on the arm's parameters from all poses, with board poses eliminated."""
    ordered = np.concatenate((rows[:, :, ~is_place], rows[:, :, is_place]), axis=2).reshape(-1, rows.shape[2])
    return _without_places(ordered.T @ ordered, int((~is_place).sum()))


def _without_places(information: Array, r: int) -> Array:
    """Schur complement of everything beyond the first r unknowns, including the prior."""
    own, mixed, places = information[:r, :r], information[:r, r:], information[r:, r:]
    return np.asarray(own - mixed @ np.linalg.solve(places + np.eye(len(places)), mixed.T))


def _seen(information: Array, yardstick: float) -> Array:
    """Orthonormal combinations that the information determines; as in calib.identify.determinability."""
    values, vectors = np.linalg.eigh(information)
    return np.asarray(vectors[:, values > RANK_TOLERANCE**2 * yardstick])


def _yardstick(experiment: Experiment, shown: Array) -> float:
    """Information on the best determined combination of bounded parameters; at least that of the prior."""
    bounded = experiment.basis[[parameter.has_bound for parameter in experiment.parameters]]
    return max(1.0, float(np.linalg.norm(bounded @ shown @ bounded.T, 2)))


def _workspace_rows(problem: ArmProblem, parameters: tuple[Parameter, ...], q_rad: Array, is_tied: bool) -> Array:
    """Derivatives of tips (w, 3, k) [m per scaled unknown] by the arm's parameters at poses (w, n)."""
    model, tool_m = problem.model, problem.solution(np.zeros(len(problem.parameters))).tool_m
    slopes = model.slopes(model.nominal_dh, q_rad, tool_m)
    columns = np.concatenate((slopes.by_dh, slopes.by_tool), axis=2)
    places = {name: k for k, name in enumerate((*dh_names(len(model.nominal_dh)), *TOOL_NAMES))}
    places_of_arm = [places[parameter.name] for parameter in parameters]
    rows = columns[:, :, places_of_arm] * [parameter.scale for parameter in parameters]
    return rows if is_tied else _without_moves(rows, slopes.tips)


def _without_moves(rows: Array, tips_m: Array) -> Array:
    """The derivatives without the part that a rigid motion of the whole workspace explains."""
    centred = tips_m - tips_m.mean(axis=0)
    moves = np.array([np.hstack((np.eye(3), cross_matrix(tip))) for tip in centred]).reshape(-1, 6)
    flat = rows.reshape(-1, rows.shape[2])
    fitted, *_ = np.linalg.lstsq(moves, flat)
    return np.asarray((flat - moves @ fitted).reshape(rows.shape))


def _least_known(experiment: Experiment, covariance: Array) -> tuple[str, float, str]:
    """Name, standard deviation and unit of the least certain parameter, relative to its bound."""
    sd = np.sqrt(np.einsum("kr,rs,ks->k", experiment.basis, covariance, experiment.basis))
    k = int(np.argmax(sd))
    parameter = experiment.parameters[k]
    return parameter.name, float(sd[k] * parameter.scale), parameter.unit


# The value of a pose: the gain in information by one of seven criteria.
#
# With G = J C, C = M^-1 and A = 1 + J C J' of a pose's three rows J, the matrix determinant lemma and the
# Woodbury identity give the effect of adding it without another inverse: log det M rises by log det A, C
# falls by G' A^-1 G.


CRITERIA = ("D", "O1", "O2", "O3", "O4", "O5", "tip")
SHORTLIST = 600  # shortlist for O2 to O5, each of which needs an eigenvalue problem per candidate
Criterion = Callable[[Experiment, Array, Array], Array]  # (experiment, M, rows (c, 3, k)) -> scores (c,)


def criterion_of(name: str) -> Criterion:
    """Function that scores the addition of each pose (larger is better); CalibrationError for an unknown name.

    D: log det of the information on the arm; O1 of a given number of poses is a function of it, and selects the same.
    tip: minus the tip's mean square error over the workspace (I- or V-optimality). O2 to O5: the index afterwards.
    """
    if name in ("D", "O1"):
        return _log_det
    if name == "tip":
        return _tip
    if name in _INDEX:
        return lambda experiment, information, rows: _index(experiment, information, rows, _INDEX[name])
    raise CalibrationError(f'criterion: expected one of {", ".join(CRITERIA)}, got "{name}"')


def _log_det(experiment: Experiment, information: Array, rows: Array) -> Array:
    """Gain of log det of the arm's information: that of everything minus that of the board poses."""
    r = experiment.rank
    gain = _log_det_of_update(information, rows)
    if rows.shape[2] > r:
        gain -= _log_det_of_update(information[r:, r:], rows[:, :, r:])
    return gain


def _log_det_of_update(information: Array, rows: Array) -> Array:
    """Log det A of each pose, by the determinant lemma."""
    return np.asarray(np.linalg.slogdet(_growth(rows @ np.linalg.inv(information), rows))[1])


def _growth(lever: Array, rows: Array) -> Array:
    """A = 1 + J C J' of each pose, (c, 3, 3), from G = J C."""
    return np.asarray(np.eye(rows.shape[1]) + lever @ rows.transpose(0, 2, 1))


def _tip(experiment: Experiment, information: Array, rows: Array) -> Array:
    """Reduction of the tip's mean square error over the workspace [m^2]."""
    lever = rows @ np.linalg.inv(information)
    own = lever[:, :, : experiment.rank]
    fall = own @ experiment.workspace_weight @ own.transpose(0, 2, 1)
    return np.asarray(np.trace(np.linalg.solve(_growth(lever, rows), fall), axis1=1, axis2=2))


def _index(experiment: Experiment, information: Array, rows: Array, index: Callable[[Array], Array]) -> Array:
    """An observability index after each pose; minus infinity for those off the shortlist."""
    covariance = np.linalg.inv(information)
    lever = rows @ covariance
    worth = np.einsum("cik,cik->c", lever, lever)
    listed = np.argsort(-worth, kind="stable")[:SHORTLIST]
    visible = lever[listed][:, :, : experiment.rank] @ experiment.visible
    before = experiment.visible.T @ covariance[: experiment.rank, : experiment.rank] @ experiment.visible
    fall = visible.transpose(0, 2, 1) @ np.linalg.solve(_growth(lever[listed], rows[listed]), visible)
    variances = np.maximum(np.linalg.eigvalsh(before - fall), 1e-300)
    scores = np.full(len(rows), -np.inf)
    scores[listed] = index(1.0 / np.sqrt(variances))
    return scores


# singular values (c, v), largest first, to an index (c,)
_INDEX: dict[str, Callable[[Array], Array]] = {
    "O2": lambda s: s[:, -1] / s[:, 0],
    "O3": lambda s: s[:, -1],
    "O4": lambda s: s[:, -1] ** 2 / s[:, 0],
    "O5": lambda s: 1.0 / np.sum(1.0 / s, axis=1),
}


# Observability indices: how well a set of poses determines the parameters; larger is better.
#
# They are functions of the singular values s1 >= ... >= sr of the identification Jacobian of m poses:
#
#     O1 = (s1 s2 ... sr)^(1/r) / sqrt(m)    Borm and Menq, Int. J. Robotics Research 10 (1991): all of them together
#     O2 = sr / s1                           Driels and Pathre, J. Robotic Systems 7 (1990): one over the condition number
#     O3 = sr                                Nahvi, Hollerbach and Hayward, IEEE ICRA 1994: the least certain combination
#     O4 = sr^2 / s1                         Nahvi and Hollerbach, IEEE ICRA 1996: the noise amplification index
#     O5 = 1 / (1/s1 + ... + 1/sr)           Sun and Hollerbach, IEEE ICRA 2008: the mean of all uncertainties
#
# Here the Jacobian is in scaled unknowns (a parameter divided by its bound) and in standard deviations of
# the noise: the indices have no unit. 1/sr is the standard deviation of the least certain combination, as a
# share of the bound. Only combinations that some pose of the arm could determine count
# (`calib.design.information`); one of those that these poses do not determine makes all five zero.


NAMES = ("O1", "O2", "O3", "O4", "O5")


@dataclass(frozen=True, slots=True)
class Indices:
    """O1 to O5, without unit."""

    o1: float
    o2: float
    o3: float
    o4: float
    o5: float

    def as_dict(self) -> dict[str, float]:
        """By name, O1 to O5."""
        return dict(zip(NAMES, (self.o1, self.o2, self.o3, self.o4, self.o5), strict=True))


def indices_of(singular_values: Array, poses_count: int) -> Indices:
    """The five indices of singular values (r,) of the Jacobian of that many poses; zeros without any pose."""
    s = np.sort(np.asarray(singular_values, dtype=np.float64))[::-1]
    if not len(s) or poses_count < 1 or s[-1] <= 0.0:
        return Indices(0.0, 0.0, 0.0, 0.0, 0.0)
    return Indices(
        o1=float(np.exp(np.mean(np.log(s))) / np.sqrt(poses_count)),
        o2=float(s[-1] / s[0]),
        o3=float(s[-1]),
        o4=float(s[-1] ** 2 / s[0]),
        o5=float(1.0 / np.sum(1.0 / s)),
    )


# Selection of poses: greedy, then exchanges until none helps.
#
# Fedorov, Theory of Optimal Experiments, 1972; Mitchell, Technometrics 16 (1974) 203 (DETMAX, of which this
# is the case without excursions: remove one, add the best one).


SWEEPS_LIMIT = 20
BETTER = 1e-9  # an exchange must gain more than this share


@dataclass(frozen=True, slots=True)
class Group:
    """Select `count` of these poses (rows of the experiment); `name` is for the error if there are too few."""

    name: str
    rows: Rows
    count: int


def select(
    experiment: Experiment, criterion: Criterion, recorded: Rows, groups: Sequence[Group], start: Sequence[int] | None = None
) -> list[int]:
    """Rows of the best poses to add to those recorded, with the count of each group.

    In order of value: each is the best of the chosen ones to add to the previous ones. `start`: a choice to
    start the exchanges with, instead of the greedy one. CalibrationError if a group has too few.
    """
    for group in groups:
        if group.count > len(group.rows):
            raise CalibrationError(
                f"{group.count} {group.name} were requested, but only {len(group.rows)} are available: request fewer"
            )
    if start is None:
        chosen = _greedy(experiment, criterion, recorded, groups)
    else:
        chosen = [(row, next(k for k, group in enumerate(groups) if row in group.rows)) for row in start]
    _exchange(experiment, criterion, recorded, groups, chosen)
    rows = np.array([row for row, _ in chosen], dtype=np.intp)
    ordered = _greedy(experiment, criterion, recorded, [Group("poses", rows, len(rows))])
    return [row for row, _ in ordered]


def _greedy(experiment: Experiment, criterion: Criterion, recorded: Rows, groups: Sequence[Group]) -> list[tuple[int, int]]:
    """(row, group) of each choice: the best of all groups that are not complete yet."""
    information = experiment.information(recorded)
    rest = [np.array(group.rows) for group in groups]
    open_count = [group.count for group in groups]
    chosen: list[tuple[int, int]] = []
    while any(open_count):
        places = [(k, rows) for k, rows in enumerate(rest) if open_count[k]]
        rows = np.concatenate([rows for _, rows in places])
        owner = np.concatenate([np.full(len(rows), k) for k, rows in places])
        best = int(np.argmax(criterion(experiment, information, experiment.rows[rows])))
        row, group = int(rows[best]), int(owner[best])
        chosen.append((row, group))
        open_count[group] -= 1
        rest = [rows[rows != row] for rows in rest]
        information = information + np.asarray(experiment.rows[row].T @ experiment.rows[row])
    return chosen


def _exchange(
    experiment: Experiment, criterion: Criterion, recorded: Rows, groups: Sequence[Group], chosen: list[tuple[int, int]]
) -> None:
    """Replace each choice by the best of its group, again and again, until nothing changes."""
    for _ in range(SWEEPS_LIMIT):
        is_changed = False
        for place, (row, group) in enumerate(chosen):
            others = [other for other, _ in chosen if other != row]
            information = experiment.information(np.array([*recorded, *others], dtype=np.intp))
            rows = groups[group].rows[~np.isin(groups[group].rows, others)]
            scores = criterion(experiment, information, experiment.rows[rows])
            best, own = int(np.argmax(scores)), float(scores[np.flatnonzero(rows == row)[0]])
            if scores[best] > own + BETTER * abs(own):
                chosen[place] = (int(rows[best]), group)
                is_changed = True
        if not is_changed:
            return
