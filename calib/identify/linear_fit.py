"""The problem around one solution, linear: which points agree with which, without a solver."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from calib.arm_problem.problem import ArmProblem
from calib.arrays import Array
from calib.identify.determinability import determinability
from calib.identify.estimates import AT_BOUND

Mask = npt.NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class LinearFit:
    """Residuals r + A y of points, r (m, 3) [m], A (m, 3, rank): y are the combinations that the points determine.

    Over all points A'A is one.
    """

    residuals: Array
    columns: Array

    @classmethod
    def around(cls, problem: ArmProblem, x: Array, extra: Array | None = None) -> LinearFit:
        """At unknowns x (k,); parameters on their bounds stay there. `extra` (m, 3, e): columns of more unknowns."""
        residuals, jacobian = problem.residuals_and_jacobian(x)
        limits = np.array([parameter.limit for parameter in problem.parameters])
        free = np.flatnonzero(np.abs(x) < AT_BOUND * limits)
        known = determinability(
            problem.sensitivity(x)[:, :, free], tuple(problem.parameters[k] for k in free)
        )
        return cls.of(residuals, jacobian[:, :, free] @ known.basis, extra)

    @classmethod
    def of(cls, residuals: Array, columns: Array, extra: Array | None = None) -> LinearFit:
        """Columns (m, 3, r) are brought to one length and made independent."""
        whole = columns if extra is None else np.concatenate((columns, extra), axis=2)
        rows = whole.reshape(-1, whole.shape[2])
        rows = rows / np.maximum(np.linalg.norm(rows, axis=0), 1e-300)
        left, singular, _ = np.linalg.svd(rows, full_matrices=False)
        left = left[:, singular > 1e-6 * singular.max(initial=0.0)]
        independent = np.ascontiguousarray(left).reshape(*whole.shape[:2], -1)
        return cls(residuals, independent)

    @property
    def rank(self) -> int:
        """How many combinations."""
        return int(self.columns.shape[2])

    def __len__(self) -> int:
        """How many points."""
        return len(self.residuals)

    def fitted(self, kept: Mask) -> Array:
        """Residuals (m, 3) of all points after least squares over those of `kept` (m,)."""
        gram = self._gram(kept)
        gram[np.diag_indices_from(gram)] += 1e-12 * max(1e-300, float(np.trace(gram)))
        pull = self.columns[kept].reshape(-1, self.rank).T @ self.residuals[kept].ravel()
        step = np.linalg.solve(gram, -pull)
        return np.asarray(self.residuals + (self.columns.reshape(-1, self.rank) @ step).reshape(-1, 3))

    def leverage(self, kept: Mask) -> Array:
        """A_i (A'A)^-1 A_i' of each point (m, 3, 3), A'A over the points of `kept` (m,)."""
        inverse = np.linalg.pinv(self._gram(kept), rcond=1e-12, hermitian=True)
        return np.asarray(self.columns @ inverse @ self.columns.transpose(0, 2, 1))

    def _gram(self, kept: Mask) -> Array:
        """A'A over the points of `kept`."""
        if 2 * int(kept.sum()) > len(kept):
            rest = self.columns[~kept].reshape(-1, self.rank)
            return np.asarray(np.eye(self.rank) - rest.T @ rest)
        rows = self.columns[kept].reshape(-1, self.rank)
        return np.asarray(rows.T @ rows)
