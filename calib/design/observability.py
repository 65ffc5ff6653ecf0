"""Observability indices: how well a set of poses determines the parameters; larger is better.

They are functions of the singular values s1 >= ... >= sr of the identification Jacobian of m poses:

    O1 = (s1 s2 ... sr)^(1/r) / sqrt(m)    Borm and Menq, Int. J. Robotics Research 10 (1991): all of them together
    O2 = sr / s1                           Driels and Pathre, J. Robotic Systems 7 (1990): one over the condition number
    O3 = sr                                Nahvi, Hollerbach and Hayward, IEEE ICRA 1994: the least certain combination
    O4 = sr^2 / s1                         Nahvi and Hollerbach, IEEE ICRA 1996: the noise amplification index
    O5 = 1 / (1/s1 + ... + 1/sr)           Sun and Hollerbach, IEEE ICRA 2008: the mean of all uncertainties

Here the Jacobian is in scaled unknowns (a parameter divided by its bound) and in standard deviations of the noise: the
indices have no unit. 1/sr is the standard deviation of the least certain combination, as a share of the bound. Only
combinations that some pose of the arm could determine count (`calib.design.information`); one of those that these poses
do not determine makes all five zero.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib.arrays import Array

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
