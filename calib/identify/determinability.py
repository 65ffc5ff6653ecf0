"""What the data determine: rank and conditioning of the scaled Jacobian; in words, what they leave open."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib.arrays import Array, frozen
from calib.identify.parameters import Parameter

# A combination is determined if moving it by its bound moves the tips by more than this share of what the
# best determined one does. Between the two sorts there is a gap: on the reference board 9e-4 (last
# determined) against 3e-6 (first that is not).
RANK_TOLERANCE = 1e-4
NOTICEABLE = 0.02  # share of a parameter, or coupling of two, that is worth naming


@dataclass(frozen=True, slots=True)
class Undetermined:
    """Parameters that the data leave open together; `freedoms_count` combinations of them stay at nominal."""

    names: tuple[str, ...]
    freedoms_count: int
    words: str


@dataclass(frozen=True, slots=True)
class Determinability:
    """Singular values of the scaled Jacobian [m per bound] and what follows from them.

    `basis` (k, rank): determined combinations of scaled parameters; `undetermined_share` (k,): 0 for a
    parameter that the data determine, 1 for one without any effect.
    """

    rank: int
    condition_number: float
    singular_values: Array
    basis: Array
    undetermined_share: Array
    undetermined: tuple[Undetermined, ...]

    def covariance(self, variance_m2: float) -> Array:
        """Covariance of the scaled parameters inside the determined subspace, (k, k)."""
        scaled = self.basis / self.singular_values[: self.rank]
        return np.asarray(variance_m2 * scaled @ scaled.T)


def determinability(jacobian: Array, parameters: tuple[Parameter, ...]) -> Determinability:
    """From the scaled Jacobian (m, 3, k) of the residuals."""
    rows = jacobian.reshape(-1, jacobian.shape[2])
    singular, right = _singular(rows)
    rank = int(np.sum(singular > RANK_TOLERANCE * _yardstick(rows, parameters)))
    null = right[rank:].T
    open_share = np.sqrt(np.einsum("ij,ij->i", null, null))
    return Determinability(
        rank=rank,
        condition_number=float(singular[0] / singular[rank - 1]) if rank else float("inf"),
        singular_values=frozen(singular),
        basis=frozen(right[:rank].T),
        undetermined_share=frozen(open_share),
        undetermined=_groups(null @ null.T, parameters),
    )


def null_space(jacobian: Array, parameters: tuple[Parameter, ...], tolerance: float) -> Array:
    """Combinations of unknowns (k, k - rank) that the scaled Jacobian (m, 3, k) does not see."""
    rows = jacobian.reshape(-1, jacobian.shape[2])
    singular, right = _singular(rows)
    return np.asarray(right[int(np.sum(singular > tolerance * _yardstick(rows, parameters))) :].T)


def _yardstick(rows: Array, parameters: tuple[Parameter, ...]) -> float:
    """What the best determined combination of bounded parameters does to the tips [m per bound]."""
    bounded = [k for k, parameter in enumerate(parameters) if parameter.has_bound]
    return float(np.linalg.norm(rows[:, bounded or ...], 2))


def _singular(rows: Array) -> tuple[Array, Array]:
    """Singular values (k,) and right vectors (k, k); QR first, or many points would need a large U."""
    triangle = np.linalg.qr(rows, mode="r") if len(rows) > rows.shape[1] else rows
    _, values, right = np.linalg.svd(triangle, full_matrices=True)
    singular = np.zeros(rows.shape[1])
    singular[: len(values)] = values
    return singular, right


def _groups(projector: Array, parameters: tuple[Parameter, ...]) -> tuple[Undetermined, ...]:
    """Sets of parameters that the null space couples: connected components of its projector (k, k)."""
    unseen = [k for k in range(len(parameters)) if projector[k, k] > NOTICEABLE**2]
    groups = []
    while unseen:
        group, reached = [], [unseen.pop(0)]
        while reached:
            k = reached.pop()
            group.append(k)
            near = [
                j
                for j in unseen
                if abs(projector[k, j]) > NOTICEABLE * np.sqrt(projector[k, k] * projector[j, j])
            ]
            unseen = [j for j in unseen if j not in near]
            reached.extend(near)
        groups.append(_describe(sorted(group), projector, parameters))
    return tuple(groups)


def _describe(group: list[int], projector: Array, parameters: tuple[Parameter, ...]) -> Undetermined:
    """One group with a sentence about it."""
    names = tuple(parameters[k].name for k in group)
    freedoms = max(1, round(float(np.trace(projector[np.ix_(group, group)]))))
    if len(group) == 1:
        return Undetermined(names, 1, f"{names[0]} has no effect on these points; it stays at nominal")
    if freedoms == len(group):
        return Undetermined(
            names,
            freedoms,
            f"{_listed(names)} have no effect of their own on these points; they stay at nominal",
        )
    examples = "; ".join(
        _trade(row, group, parameters) for row in _sparse_rows(projector[np.ix_(group, group)], freedoms)
    )
    left = len(group) - freedoms
    return Undetermined(
        names,
        freedoms,
        f"{_listed(names)} move together: these points determine {left} of their {len(group)} combinations. "
        f"No tip moves when {examples}. Of all that fit, the values nearest to nominal are given",
    )


def _sparse_rows(projector: Array, freedoms: int) -> Array:
    """A null space basis (freedoms, parameters), with as few parameters in a row as elimination gives."""
    _, vectors = np.linalg.eigh(projector)
    rows = vectors[:, -freedoms:].T.copy()
    for i in range(freedoms):
        pivot = int(np.argmax(np.abs(rows[i])))
        rows[i] /= rows[i, pivot]
        others = [j for j in range(freedoms) if j != i]
        rows[others] -= np.outer(rows[others, pivot], rows[i])
    return rows


def _trade(row: Array, group: list[int], parameters: tuple[Parameter, ...]) -> str:
    """As `d2 +1.00 mm with d3 -1.00 mm`: a change that moves no tip."""
    parts = [
        _change(parameters[k], share / float(np.max(np.abs(row))))
        for k, share in zip(group, row, strict=True)
        if abs(share) > NOTICEABLE * float(np.max(np.abs(row)))
    ]
    return " with ".join(parts)


def _change(parameter: Parameter, share: float) -> str:
    """A fifth of the bound, times share, in mm or degrees."""
    change = 0.2 * share * parameter.bound
    if parameter.unit == "m":
        return f"{parameter.name} {1e3 * change:+.2f} mm"
    return f"{parameter.name} {np.degrees(change):+.3f} deg"


def _listed(names: tuple[str, ...]) -> str:
    """a, b and c."""
    return f"{', '.join(names[:-1])} and {names[-1]}"
