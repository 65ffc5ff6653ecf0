"""The array types of this package and how an array becomes read-only."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]


def frozen(values: npt.ArrayLike) -> Array:
    """A read-only float copy, for frozen dataclasses."""
    copy = np.array(values, dtype=np.float64)
    copy.flags.writeable = False
    return copy


def norms(vectors: Array) -> Array:
    """Euclidean length of each row: (m, 3) to (m,)."""
    return np.asarray(np.sqrt(np.einsum("ij,ij->i", vectors, vectors)))
