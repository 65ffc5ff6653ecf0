"""Residuals and their analytic Jacobian in scaled unknowns.

An unknown x is a deviation divided by its bound, so that the box is -1 .. 1 for millimetres and radians
alike: in SI units a solver stops far from the optimum, because a radian moves the tip half a metre and a
metre moves it one.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import Protocol

import numpy as np

from calib.arrays import Array, frozen
from calib.identify.parameters import Bounds, Parameter, dh_parameters


class TipModel(Protocol):
    """Forward kinematics of many poses at once; control.model.kinematics provides it."""

    def tips(self, dh: Array, q: Array) -> Array:
        """Tip positions (m, 3) [m] in the base frame, from dh (links, 4) and joint angles q (m, n) [rad]."""

    def tips_and_dh_jacobian(self, dh: Array, q: Array) -> tuple[Array, Array]:
        """Tips (m, 3) and their derivatives (m, 3, 4 links) with respect to dh.ravel()."""


class Problem(Protocol):
    """What the solver needs to know: unknowns x (k,) in -1 .. 1, and residuals measured minus modelled [m].

    A problem with more unknowns (tool, table frames, gears) is another class of this form.
    """

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """The k unknowns, in the order of x."""

    def residuals(self, x: Array) -> Array:
        """(m, 3) [m]."""

    def residuals_and_jacobian(self, x: Array) -> tuple[Array, Array]:
        """(m, 3) [m] and the derivative of the residuals (m, 3, k) [m per bound]."""


class DhProblem:
    """Tips measured in the base frame against DH deviations, SpringerPlus 5:1771, eq. (4)."""

    def __init__(
        self,
        model: TipModel,
        nominal_dh: Array,
        q_rad: Array,
        tip_m: Array,
        bounds: Bounds | None = None,
        fixed: Collection[str] = (),
    ) -> None:
        """Nominal (links, 4), q_rad (m, n), tip_m (m, 3); `fixed` names parameters that keep their value."""
        self._model = model
        self._nominal_dh = frozen(nominal_dh)
        self._q_rad = frozen(q_rad)
        self._tip_m = frozen(tip_m)
        self.parameters, places = dh_parameters(self._nominal_dh, bounds or Bounds(), fixed)
        self._places = np.array(places)
        self._scale = np.array([parameter.bound for parameter in self.parameters])

    @property
    def dh_scale(self) -> Array:
        """Bounds of the free parameters, (k,): a deviation is x times this."""
        return self._scale

    def dh(self, x: Array) -> Array:
        """The DH table (links, 4) at scaled unknowns x."""
        flat = self._nominal_dh.ravel().copy()
        flat[self._places] += x * self._scale
        return flat.reshape(self._nominal_dh.shape)

    def residuals(self, x: Array) -> Array:
        """Measured minus modelled tip, (m, 3)."""
        return self._tip_m - self._model.tips(self.dh(x), self._q_rad)

    def residuals_and_jacobian(self, x: Array) -> tuple[Array, Array]:
        """Residuals (m, 3) and their derivative with respect to x, (m, 3, k)."""
        tips, jacobian = self._model.tips_and_dh_jacobian(self.dh(x), self._q_rad)
        return self._tip_m - tips, -jacobian[:, :, self._places] * self._scale
