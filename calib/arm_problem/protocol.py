"""What a solver asks of a problem: residuals and their derivatives in scaled unknowns."""

from __future__ import annotations

from typing import Protocol

from calib.arm_problem.parameters import Parameter
from calib.arrays import Array

ALL = slice(None)


class Expanded(Protocol):
    """Residuals around one x, to second order."""

    @property
    def residuals(self) -> Array:
        """(m, 3) [m]."""

    def sums(self, pull: Array, bend: Array | None) -> tuple[Array, Array]:
        """Sums of pull . d residual / dx (k,) and of (d residual / dx)' bend (d residual / dx) (k, k)."""

    def curvature(self, pull: Array) -> Array:
        """Sum of pull . d2 residual / dx2, (k, k)."""


class Problem(Protocol):
    """The problem for the solver: unknowns x (k,) within +-limits, and residuals reference minus modelled [m].

    The Jacobian (m, 3, k) is a view of a contiguous (k, 3, m) array: jacobian.transpose(2, 1, 0) costs nothing.
    """

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """The k unknowns, in the order of x."""

    def __len__(self) -> int:
        """Number of poses, m."""

    def residuals(self, x: Array, rows: slice = ALL) -> Array:
        """(m, 3) [m], of all poses or a slice of them."""

    def residuals_and_jacobian(self, x: Array, rows: slice = ALL) -> tuple[Array, Array]:
        """(m, 3) [m] and the derivative of the residuals (m, 3, k) [m per scaled unknown]."""

    def expanded(self, x: Array, rows: slice = ALL) -> Expanded:
        """The residuals, and sums of their derivatives for Newton's steps."""

    def sensitivity(self, x: Array, rows: slice = ALL) -> Array:
        """(m, 3, k), of all poses or a slice of them: the Jacobian for zero residuals, which shows what the points determine."""
