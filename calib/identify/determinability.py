"""What the data determine: rank and conditioning of the scaled sensitivity, and the undetermined combinations.

Unknowns without a nominal value (tool, boards, base frame: no bound) are projected out first. The rest shows
how well the points determine the parameters with a nominal value, for any tool and boards. A
combination of these that tool or boards can compensate stays at nominal.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
import numpy.typing as npt

from calib.arm_problem.arm_model import Parameter
from calib.arm_problem.expansion import Problem
from calib.arrays import Array, Mask, frozen
from control.plain_text import first_of, listed

# Describes what points leave undetermined: which parameters move together, and what compensates them.

NOTICEABLE = 0.02  # smallest share of a parameter, or coupling of two, to report
MADE_UP_FOR = 1e-4  # a free unknown with a smaller (scaled) change does not count as compensating
LISTED_LIMIT = 8  # most names in one sentence


@dataclass(frozen=True, slots=True)
class Undetermined:
    """Parameters that the data leave open together; `freedoms_count` combinations of them stay at nominal.

    `taken_up_by`: the unbounded unknowns that compensate any change of them; empty if no tip moves at all.
    """

    names: tuple[str, ...]
    freedoms_count: int
    words: str
    taken_up_by: tuple[str, ...] = ()


def described(held: Array, taken_up: Array, parameters: tuple[Parameter, ...]) -> tuple[Undetermined, ...]:
    """Sets of parameters that the open combinations `held` (k, open) couple, each with a sentence.

    `taken_up` (k, open): compensating change of unbounded unknowns for each. Sets are the connected components of
    the projector held @ held.T.
    """
    projector = held @ held.T
    return tuple(_describe(group, held, taken_up, parameters) for group in _components(projector))


def open_in_words(groups: Sequence[Undetermined]) -> tuple[str, ...]:
    """One sentence per kind; single parameters with the same compensation share one."""
    by_compensation: dict[tuple[bool, tuple[str, ...]], list[str]] = {}
    for group in groups:
        if len(group.names) == group.freedoms_count:
            by_compensation.setdefault((_is_of_a_body(group.names[0]), group.taken_up_by), []).extend(group.names)
    singles = [_alone(names, by) for (_, by), names in by_compensation.items()]
    return (*singles, *(group.words for group in groups if len(group.names) != group.freedoms_count))


def _components(projector: Array) -> list[list[int]]:
    """Connected components of the projector (k, k)."""
    unseen = [k for k in range(len(projector)) if projector[k, k] > NOTICEABLE**2]
    groups = []
    while unseen:
        group, reached = [], [unseen.pop(0)]
        while reached:
            k = reached.pop()
            group.append(k)
            near = [j for j in unseen if abs(projector[k, j]) > NOTICEABLE * np.sqrt(projector[k, k] * projector[j, j])]
            unseen = [j for j in unseen if j not in near]
            reached.extend(near)
        groups.append(sorted(group))
    return groups


def _describe(group: list[int], held: Array, taken_up: Array, parameters: tuple[Parameter, ...]) -> Undetermined:
    """One group with a sentence about it."""
    names = tuple(parameters[k].name for k in group)
    projection = held[group] @ held[group].T
    freedoms = max(1, round(float(np.trace(projection))))
    made_up = np.abs(taken_up @ held[group].T).max(axis=1)
    by = _bodies([p.name for p, size in zip(parameters, made_up, strict=True) if size > MADE_UP_FOR])
    if freedoms == len(group):
        return Undetermined(names, freedoms, _alone(list(names), by), by)
    trade = _trade(_simplest_row(projection, freedoms), group, parameters)
    return Undetermined(names, freedoms, _together(names, freedoms, trade, by), by)


def _bodies(names: list[str]) -> tuple[str, ...]:
    """Names of the bodies: tool_x to "tool", board_front_rx to "board_front"."""
    return tuple(dict.fromkeys(name.rsplit("_", 1)[0] for name in names))


def _alone(names: list[str], by: tuple[str, ...]) -> str:
    """Individually undetermined parameters."""
    if all(_is_of_a_body(name) for name in names):
        return f"{_listed(names)} {_has(names)} no effect on these points, which lie on one line; no result depends on it"
    stay = "it stays at nominal" if len(names) == 1 else "they stay at nominal"
    if not by:
        return f"{_listed(names)} {_has(names)} no effect on these points; {stay}"
    cannot = "cannot be told apart from"
    return f"{_listed(names)} {cannot} {_where(by)}, also identified; {stay}"


def _together(names: tuple[str, ...], freedoms: int, trade: str, by: tuple[str, ...]) -> str:
    """Parameters of which only combinations are determined."""
    rank = len(names) - freedoms
    if all(_is_of_a_body(name) for name in names):
        return (
            f"{_listed(names)}: {rank} of these {len(names)} rotations {'is' if rank == 1 else 'are'} determined, as the"
            " points lie on one line; no result depends on the rest"
        )
    aside = f" once {_where(by)} {'follows' if len(by) == 1 and by[0] == 'tool' else 'follow'}" if by else ""
    return (
        f"{_listed(names)} move together: these points determine {rank} of their {len(names)} combinations"
        f" (no tip moves{aside} when {trade}); the values given are the solution nearest to nominal"
    )


def _is_of_a_body(name: str) -> bool:
    return name.endswith(("_x", "_y", "_z", "_rx", "_ry", "_rz"))


def _where(by: tuple[str, ...]) -> str:
    """The compensating bodies, in brief."""
    bodies = ["the tool"] if "tool" in by else []
    if "base" in by:
        bodies.append("the pose of the base frame")
    devices = [name for name in by if name.startswith(("wire_", "gauge_"))]
    if devices:
        bodies.append(f"the place of {_listed([name.replace('_', ' ', 1) for name in devices])}")
    boards = [name for name in by if name not in ("tool", "base", *devices)]
    if boards:
        bodies.append("the poses of the boards" if len(boards) > 1 else f"the pose of {boards[0].replace('_', ' ', 1)}")
    return _listed(bodies)


def _has(names: Sequence[str]) -> str:
    return "has" if len(names) == 1 else "have"


def _simplest_row(projector: Array, freedoms: int) -> Array:
    """The row with the fewest parameters of a basis of the open combinations, as elimination gives it."""
    _, vectors = np.linalg.eigh(projector)
    rows = vectors[:, -freedoms:].T.copy()
    for i in range(freedoms):
        pivot = int(np.argmax(np.abs(rows[i])))
        rows[i] /= rows[i, pivot]
        others = [j for j in range(freedoms) if j != i]
        rows[others] -= np.outer(rows[others, pivot], rows[i])
    large = np.abs(rows) > NOTICEABLE * np.abs(rows).max(axis=1, keepdims=True)
    return np.asarray(rows[int(np.argmin(large.sum(axis=1)))])


def _trade(row: Array, group: list[int], parameters: tuple[Parameter, ...]) -> str:
    """A change that moves no tip, such as `d2 +1.00 mm with d3 -1.00 mm`."""
    largest = float(np.max(np.abs(row)))
    return " with ".join(
        _change(parameters[k], share / largest) for k, share in zip(group, row, strict=True) if abs(share) > NOTICEABLE * largest
    )


def _change(parameter: Parameter, share: float) -> str:
    """A fifth of the scale, times share, in mm, degrees or the parameter's own unit."""
    change = 0.2 * share * parameter.scale
    if parameter.unit == "m":
        return f"{parameter.name} {1e3 * change:+.2f} mm"
    if parameter.unit == "rad":
        return f"{parameter.name} {math.degrees(change):+.3f} deg"
    return f"{parameter.name} {change:+.3g} {parameter.unit}"


def _listed(names: Sequence[str]) -> str:
    """a, b and c."""
    return listed(names) if len(names) <= LISTED_LIMIT else first_of(names, LISTED_LIMIT)


BLOCK: Final = 20_000  # poses: 8 MB for 16 unknowns


class Sensitivity:
    """The sensitivity (m, 3, k) of m poses."""

    def __init__(self, block: Callable[[slice], Array], count: int) -> None:
        """`block` gives the part (b, 3, k) of a slice of the `count` poses."""
        self._block, self._count = block, count

    @classmethod
    def at(cls, problem: Problem, x: Array) -> Sensitivity:
        """Of a problem at unknowns x (k,)."""
        return cls(lambda rows: problem.sensitivity(x, rows), len(problem))

    @classmethod
    def of(cls, whole: Array) -> Sensitivity:
        """Of an array (m, 3, k)."""
        return cls(lambda rows: whole[rows], len(whole))

    def blocks(self) -> Iterator[tuple[slice, Array]]:
        """Slices of the poses, and their parts."""
        for start in range(0, self._count, BLOCK):
            rows = slice(start, min(start + BLOCK, self._count))
            yield rows, self._block(rows)

    def chosen(self, rows: Mask) -> Array:
        """The rows of a mask (m, 3) of coordinates, (chosen, k)."""
        return np.concatenate([part[rows[block]] for block, part in self.blocks()])

    def pulled(self, pull: Array) -> Array:
        """Sum of pull (m, 3) times the sensitivity, (k,)."""
        return np.asarray(sum(np.einsum("ij,ijk->k", pull[rows], part) for rows, part in self.blocks()))

    @cached_property
    def compact(self) -> Array:
        """Another sensitivity (n, 1, k) of few rows with the same products of its columns: R of QR, block after block."""
        root: Array | None = None
        for _, part in self.blocks():
            rows = part.reshape(-1, part.shape[2])
            root = triangle(rows if root is None else np.concatenate((root, rows)))
        whole = np.zeros((0, 0)) if root is None else root
        return whole[:, None, :]


def triangle(rows: Array) -> Array:
    """R of rows (n, k), (k, k); the rows themselves if there are no more."""
    return np.asarray(np.linalg.qr(rows, mode="r")) if len(rows) > rows.shape[1] else rows


# A combination is determined if a change by its bound moves the tips by more than this share of what the
# strongest one does. There is a gap between the two: on the reference board 9e-4 (last determined)
# against 3e-6 (first that is not).
RANK_TOLERANCE = 1e-4


@dataclass(frozen=True, slots=True)
class Determinability:
    """Rank of all k unknowns; condition number of the bounded ones, others projected out.

    `basis` (k, rank): every change of the scaled unknowns that the data determine, as basis @ y; `spread`
    (k, rank): basis @ R^-1 with R'R = (J basis)'(J basis), so that spread @ spread.T times the noise variance is
    the covariance; `undetermined_share` (k,): 0 for an unknown that the data determine, 1 for one that they do not.
    """

    rank: int
    condition_number: float
    basis: Array
    spread: Array
    undetermined_share: Array
    undetermined: tuple[Undetermined, ...]

    def covariance(self, variance_m2: float) -> Array:
        """Covariance of the scaled unknowns (k, k); undetermined combinations count as known, at nominal."""
        return np.asarray(variance_m2 * self.spread @ self.spread.T)


def determinability(sensitivity: Array, parameters: tuple[Parameter, ...]) -> Determinability:
    """From the scaled sensitivity (m, 3, k) of ArmProblem."""
    parts = _Parts.of(sensitivity, parameters)
    held = parts.held(RANK_TOLERANCE)
    basis = parts.basis(RANK_TOLERANCE)
    seen = parts.singular[: basis.shape[1] - parts.free_basis.shape[1]]
    return Determinability(
        rank=basis.shape[1],
        condition_number=float(seen[0] / seen[-1]) if len(seen) else float("inf"),
        basis=frozen(basis),
        spread=frozen(_spread(parts.rows, basis)),
        undetermined_share=frozen(np.sqrt(np.einsum("ij,ij->i", held, held))),
        undetermined=described(held, parts.take_up(held), parameters),
    )


def null_space(sensitivity: Array, parameters: tuple[Parameter, ...], tolerance: float, least_m: float = 0.0) -> Array:
    """Orthonormal combinations of unknowns (k, k - rank) that the points leave undetermined and that stay at nominal.

    Separately for bounded and unbounded ones; with these combinations at zero, the points determine the rest. `least_m`:
    undetermined are also those whose bound moves all tips together by less (root of the sum of squares).
    """
    parts = _Parts.of(sensitivity, parameters)
    return parts.held(max(tolerance, least_m / parts.yardstick if parts.yardstick > 0.0 else 0.0))


@dataclass(frozen=True, slots=True)
class _Parts:
    """Bounded and free columns, and the bounded ones with the free ones projected out."""

    rows: Array
    bounded: npt.NDArray[np.intp]
    free: npt.NDArray[np.intp]
    free_basis: Array
    free_open: Array
    singular: Array
    right: Array
    yardstick: float

    @classmethod
    def of(cls, sensitivity: Array, parameters: tuple[Parameter, ...]) -> _Parts:
        """The parts of the sensitivity (m, 3, k); if no parameter has a bound, all count as bounded."""
        rows = triangle(sensitivity.reshape(-1, sensitivity.shape[2]))
        has_bound = np.array([parameter.has_bound for parameter in parameters])
        if not has_bound.any():
            has_bound[:] = True
        bounded, free = np.flatnonzero(has_bound), np.flatnonzero(~has_bound)
        basis, strength, right = _decomposed(rows[:, free])
        rank = int(np.sum(strength > RANK_TOLERANCE * strength.max(initial=0.0)))
        own = rows[:, bounded] - basis[:, :rank] @ (basis[:, :rank].T @ rows[:, bounded])
        _, singular, own_right = _decomposed(own)
        yardstick = float(np.linalg.norm(rows[:, bounded], 2))
        return cls(rows, bounded, free, right[:rank].T, right[rank:].T, singular, own_right, yardstick)

    def rank(self, tolerance: float) -> int:
        """Of the bounded columns."""
        return int(np.sum(self.singular > tolerance * self.yardstick))

    def held(self, tolerance: float) -> Array:
        """(k, open): first the open combinations of bounded unknowns, then those of free ones."""
        return self._placed(self.right[self.rank(tolerance) :].T, self.free_open)

    def basis(self, tolerance: float) -> Array:
        """(k, rank): what is orthogonal to `held`."""
        return self._placed(self.right[: self.rank(tolerance)].T, self.free_basis)

    def take_up(self, held: Array) -> Array:
        """Change of the free unknowns that compensates each open combination of bounded ones, (k, open), scaled."""
        answer = np.zeros_like(held)
        if len(self.free):
            moved = self.rows[:, self.bounded] @ held[self.bounded]
            solved, *_ = np.linalg.lstsq(self.rows[:, self.free] @ self.free_basis, -moved, rcond=None)
            answer[self.free] = self.free_basis @ solved
        return answer

    def _placed(self, of_bounded: Array, of_free: Array) -> Array:
        whole = np.zeros((self.rows.shape[1], of_bounded.shape[1] + of_free.shape[1]))
        whole[self.bounded, : of_bounded.shape[1]] = of_bounded
        whole[self.free, of_bounded.shape[1] :] = of_free
        return whole


def _decomposed(rows: Array) -> tuple[Array, Array, Array]:
    """Left vectors, singular values (k,) and right vectors (k, k)."""
    left_vectors, values, right = np.linalg.svd(rows, full_matrices=True)
    singular = np.zeros(rows.shape[1])
    singular[: len(values)] = values
    return left_vectors, singular, right


def _spread(rows: Array, basis: Array) -> Array:
    """The matrix basis @ R^-1; columns are scaled first, since those of free unknowns are a hundred times longer."""
    seen = rows @ basis
    lengths = np.linalg.norm(seen, axis=0)
    triangle = np.asarray(np.linalg.qr(seen / lengths, mode="r"))
    return np.asarray(np.linalg.solve(triangle.T, (basis / lengths).T).T)
