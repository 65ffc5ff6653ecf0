"""Identifies many made arms at once, as `calibrate` does for one: bounded deviations, full kinematics, every pose.

The most probable deviations given the measured tips, with the identification's bounds as a uniform prior's variance. All arms of
a study have the same poses, so that one factored normal matrix at arm.toml's values serves them all (the simplified Newton
method); the tips of each step are exact.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from calib.arm_problem.parameters import ANGLE_BOUND_rad, LENGTH_BOUND_m
from calib.arrays import Array
from calib.tolerances.making import MadeArms
from calib.tolerances.terms import MadePoses
from calib.trust.posterior import UNIFORM

NOISE_LEAST_m: Final = 1e-6  # below it, rounding decides what poses do not determine
SAMPLE: Final = 2000  # arms that say how large an effect may be
LOOSE: Final = 3.0  # an effect's prior is this many times as wide as its tolerance
DONE_m: Final = 1e-8  # a step that moves no tip by more
STEPS_MOST: Final = 12


class Identification:
    """Finds the parameters at `places` of z from tips at `poses`; the others stay as arm.toml says."""

    def __init__(self, made: MadeArms, poses: MadePoses, places: list[int], noise_m: float) -> None:
        """`noise_m`: standard deviation of one axis of a measured tip."""
        self._poses, self._places, self._start = poses, places, made.file_z
        scale = _prior(made)[places]
        by_place = poses.slopes(made.file_z)[:, :, places] * scale  # (3, m, places)
        squares = max(noise_m, NOISE_LEAST_m) ** 2
        normal = np.einsum("imk,iml->kl", by_place, by_place) + squares * np.eye(len(places))
        inverse = np.linalg.inv(normal)
        self._gain = np.einsum("kl,iml->ikm", inverse, by_place)
        self._pull, self._scale = inverse * squares, scale
        self._largest_m = float(np.abs(by_place).sum(axis=2).max())  # of a tip by a step of 1 in every place

    def found(self, tips_m: Array) -> Array:
        """Z (arms, k) from measured tips (3, arms, m)."""
        z = np.tile(self._start, (tips_m.shape[1], 1))
        x = np.zeros((len(z), len(self._places)))  # deviations over their prior
        for _ in range(STEPS_MOST):
            left = tips_m - self._poses.tips(z)
            # einsum, not BLAS: the same bits on any number of threads
            step = np.einsum("iam,ikm->ak", left, self._gain) - np.einsum("al,kl->ak", x, self._pull)
            x += step
            z[:, self._places] = self._start[self._places] + x * self._scale
            if np.abs(step).max() * self._largest_m < DONE_m:
                break
        return z


def _prior(made: MadeArms) -> Array:
    """Standard deviation of each parameter before anything is measured, (k,)."""
    geometry = np.tile([LENGTH_BOUND_m, ANGLE_BOUND_rad], 2 * len(made.arm.links))
    tool = np.full(3, LENGTH_BOUND_m)
    off = made.drawn(np.random.default_rng(0), SAMPLE) - made.file_z
    effects = LOOSE * np.sqrt(np.mean(off[:, len(geometry) + 3 :] ** 2, axis=0))
    bounds = np.sqrt(UNIFORM) * np.concatenate((geometry, tool))
    return np.concatenate((bounds, effects))
