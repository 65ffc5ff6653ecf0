"""Covariances of measured poses as columns of a file: upper triangles, of the position and of the orientation's error.

The orientation's error is the rotation vector e with R_measured = exp([e]) R_true, in the axes of the measuring frame.
"""

from __future__ import annotations

import numpy as np

from calib.arrays import Array

_PAIRS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
POSITION = tuple(f"cov_{'xyz'[i]}{'xyz'[j]}_m2" for i, j in _PAIRS)
TURN = tuple(f"cov_r{'xyz'[i]}r{'xyz'[j]}_rad2" for i, j in _PAIRS)
COVARIANCE = (*POSITION, *TURN)


def triangles(matrices: Array) -> Array:
    """Upper triangles (..., 6) of symmetric matrices (..., 3, 3)."""
    return np.stack([matrices[..., i, j] for i, j in _PAIRS], axis=-1)


def matrices_of(triangle: Array) -> Array:
    """Symmetric matrices (..., 3, 3) of upper triangles (..., 6)."""
    found = np.empty((*triangle.shape[:-1], 3, 3))
    for k, (i, j) in enumerate(_PAIRS):
        found[..., i, j] = found[..., j, i] = triangle[..., k]
    return found


def is_covariance(triangle: Array) -> bool:
    """Whether an upper triangle (6,) is of a positive definite matrix."""
    try:
        np.linalg.cholesky(matrices_of(triangle))
    except np.linalg.LinAlgError:
        return False
    return True
