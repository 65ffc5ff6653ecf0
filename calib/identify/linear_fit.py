"""The problem linearised around a solution, to compare points without a solver."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from calib.arm_problem.link_bending import link_frames
from calib.arm_problem.parallel_axes import frame_behind, parallel_joints
from calib.arm_problem.posed import position_weights
from calib.arm_problem.problem import ArmProblem
from calib.arrays import Array
from calib.identify.determinability import Sensitivity, determinability
from calib.identify.identification import AT_BOUND
from control.model.arm import Arm

Mask = npt.NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class LinearFit:
    """Residuals r + A y of points, r (m, 3) [m], A (m, 3, rank); y are the determined combinations.

    A'A over all points is the identity. `weights` (m, 3, 3): what r and A were multiplied by; None: nothing.
    """

    residuals: Array
    columns: Array
    weights: Array | None = None

    @classmethod
    def around(cls, problem: ArmProblem, x: Array, extra: Array | None = None) -> LinearFit:
        """Linearise at unknowns x (k,); parameters at their bounds stay there. `extra` (m, 3, e): columns of more unknowns.

        Points with covariances are weighted by them.
        """
        residuals, jacobian = problem.residuals_and_jacobian(x)
        limits = np.array([parameter.limit for parameter in problem.parameters])
        free = np.flatnonzero(np.abs(x) < AT_BOUND * limits)
        known = determinability(Sensitivity.at(problem, x).compact[:, :, free], tuple(problem.parameters[k] for k in free))
        columns = jacobian[:, :, free] @ known.basis
        weights = position_weights(problem, problem.solution(x).frames)
        if weights is not None:
            residuals, columns = np.einsum("mij,mj->mi", weights, residuals), weights @ columns
            extra = None if extra is None else weights @ extra
        return replace(cls.of(residuals, columns, extra), weights=weights)

    @classmethod
    def of(cls, residuals: Array, columns: Array, extra: Array | None = None) -> LinearFit:
        """Normalise columns (m, 3, r) and make them independent."""
        whole = columns if extra is None else np.concatenate((columns, extra), axis=2)
        rows = whole.reshape(-1, whole.shape[2])
        rows = rows / np.maximum(np.linalg.norm(rows, axis=0), 1e-300)
        basis, singular, _ = np.linalg.svd(rows, full_matrices=False)
        basis = basis[:, singular > 1e-6 * singular.max(initial=0.0)]
        independent = np.ascontiguousarray(basis).reshape(*whole.shape[:2], -1)
        return cls(residuals, independent)

    def weighted(self, columns: Array) -> Array:
        """Columns (m, 3, e) multiplied as the residuals are."""
        return columns if self.weights is None else np.asarray(self.weights @ columns)

    def unweighted(self, row: int, vector: Array) -> Array:
        """A weighted residual (3,) of a row as a length again."""
        return vector if self.weights is None else np.asarray(np.linalg.solve(self.weights[row], vector))

    @property
    def rank(self) -> int:
        """Number of combinations."""
        return int(self.columns.shape[2])

    def __len__(self) -> int:
        """How many points."""
        return len(self.residuals)

    def fitted(self, used: Mask) -> Array:
        """Residuals (m, 3) of all points after least squares over those of `used` (m,)."""
        gram = self._gram(used)
        gram[np.diag_indices_from(gram)] += 1e-12 * max(1e-300, float(np.trace(gram)))
        pull = self.columns[used].reshape(-1, self.rank).T @ self.residuals[used].ravel()
        step = np.linalg.solve(gram, -pull)
        return np.asarray(self.residuals + (self.columns.reshape(-1, self.rank) @ step).reshape(-1, 3))

    def leverage(self, used: Mask) -> Array:
        """A_i (A'A)^-1 A_i' of each point (m, 3, 3), A'A over the points of `used` (m,)."""
        inverse = np.linalg.pinv(self._gram(used), rcond=1e-12, hermitian=True)
        return np.asarray(self.columns @ inverse @ self.columns.transpose(0, 2, 1))

    def _gram(self, used: Mask) -> Array:
        """A'A over the points of `used`."""
        if 2 * int(used.sum()) > len(used):
            rest = self.columns[~used].reshape(-1, self.rank)
            return np.asarray(np.eye(self.rank) - rest.T @ rest)
        rows = self.columns[used].reshape(-1, self.rank)
        return np.asarray(rows.T @ rows)


# Detects parallel axes that are tilted against each other in the way that no parameter of their DH rows holds.


CHANCE = 1e-6  # probability of a false alarm
ROWS_LIMIT = 3000  # this many suffice
EXPLAINED_SHARE = 0.05  # of the squared residuals: a smaller tilt is not worth a word


def tilted_axes(arm: Arm, problem: ArmProblem, x: Array) -> list[str]:
    """A sentence for every pair of axes whose tilt would explain a share of the squared residuals."""
    thinned = problem.of_rows(slice(None, None, -(-len(problem) // ROWS_LIMIT)))
    solution = thinned.solution(x)
    frames = link_frames(thinned.model, solution.dh, thinned.observed.q_rad, solution.tool_m)
    fit, warnings = LinearFit.around(thinned, x), []
    for joint in parallel_joints(arm):
        frame = frame_behind(arm, joint)
        moved = np.cross(frames.axes[:, frame, :, 1], frames.tip_m - frames.origin_m[:, frame])
        tilt_rad, share, chance = _gained(fit, fit.weighted(moved[:, :, None]))
        if share > EXPLAINED_SHARE and chance < CHANCE:
            warnings.append(
                f"the axes of joints {joint} and {joint + 1} may not be parallel: a tilt of {1e3 * abs(tilt_rad):.2f} mrad, which"
                f" their DH rows cannot hold, explains {100.0 * share:.0f} % of the squared residuals; `armwright gap` tells it"
                " from other causes, and writes it to arm.toml"
            )
    return warnings


def _gained(fit: LinearFit, column: Array) -> tuple[float, float, float]:
    """Size of one more unknown, the share of the squares that it explains, and the probability that noise does as much."""
    from scipy.special import fdtrc

    known = fit.columns.reshape(-1, fit.rank)
    wanted, regressor = -fit.residuals.ravel(), column.ravel()
    wanted, regressor = (one - known @ (known.T @ one) for one in (wanted, regressor))
    square, freedom = float(regressor @ regressor), len(wanted) - fit.rank - 1
    before = float(wanted @ wanted)
    if freedom < 1 or before <= 0.0 or square < 1e-12 * float(column.ravel() @ column.ravel()):
        return 0.0, 0.0, 1.0
    size = float(regressor @ wanted) / square
    gain = size**2 * square
    return size, gain / before, float(fdtrc(1, freedom, gain * freedom / max(before - gain, 1e-300)))
