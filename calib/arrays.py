"""The array types of this package and how an array becomes read-only."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]


def frozen(values: npt.ArrayLike) -> Array:
    """A read-only float copy, for frozen dataclasses."""
    copy = np.array(values, dtype=np.float64)
    copy.flags.writeable = False
    return copy


def rms(values: Array) -> float:
    """Root mean square; NaN of nothing."""
    return float(np.sqrt(np.mean(values**2))) if values.size else math.nan


def norms(vectors: Array) -> Array:
    """Euclidean length of each row: (m, 3) to (m,)."""
    return np.asarray(np.sqrt(np.einsum("ij,ij->i", vectors, vectors)))


# OpenBLAS uses threads for products with more than 2^18 multiplications. They gain little on matrices this
# slim, and if the other processors are busy, the product waits for them.
SERIAL = 200_000


def slim_product(left: Array, right: Array) -> Array:
    """The product left @ right.T of (a, n) and (b, n), piece by piece."""
    a, n = left.shape
    b = len(right)
    size = max(1, SERIAL // (a * b))
    if n <= size:
        return np.asarray(left @ right.T)
    pieces = n // size
    body = pieces * size
    parts = left[:, :body].reshape(a, pieces, size).swapaxes(0, 1) @ right[:, :body].reshape(b, pieces, size).transpose(1, 2, 0)
    return np.asarray(parts.sum(axis=0) + left[:, body:] @ right[:, body:].T)
