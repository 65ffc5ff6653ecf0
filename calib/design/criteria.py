"""The value of a pose: the gain in information by one of seven criteria.

With G = J C, C = M^-1 and A = 1 + J C J' of a pose's three rows J, the matrix determinant lemma and the Woodbury
identity give the effect of adding it without another inverse: log det M rises by log det A, C falls by G' A^-1 G.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from calib.arrays import Array
from calib.design.information import Experiment
from calib.errors import CalibrationError

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
    own = lever[listed][:, :, : experiment.rank] @ experiment.visible
    before = experiment.visible.T @ covariance[: experiment.rank, : experiment.rank] @ experiment.visible
    fall = own.transpose(0, 2, 1) @ np.linalg.solve(_growth(lever[listed], rows[listed]), own)
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
