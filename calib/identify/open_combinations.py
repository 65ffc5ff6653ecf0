"""Describes what points leave undetermined: which parameters move together, and what compensates them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calib.arm_problem.parameters import Parameter
from calib.arrays import Array

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
            by_compensation.setdefault((_is_of_a_body(group.names[0]), group.taken_up_by), []).extend(
                group.names
            )
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
            near = [j for j in unseen if abs(projector[k, j]) > _coupled(projector, k, j)]
            unseen = [j for j in unseen if j not in near]
            reached.extend(near)
        groups.append(sorted(group))
    return groups


def _coupled(projector: Array, k: int, j: int) -> float:
    return float(NOTICEABLE * np.sqrt(projector[k, k] * projector[j, j]))


def _describe(
    group: list[int], held: Array, taken_up: Array, parameters: tuple[Parameter, ...]
) -> Undetermined:
    """One group with a sentence about it."""
    names = tuple(parameters[k].name for k in group)
    own = held[group] @ held[group].T
    freedoms = max(1, round(float(np.trace(own))))
    made_up = np.abs(taken_up @ held[group].T).max(axis=1)
    by = _bodies([p.name for p, size in zip(parameters, made_up, strict=True) if size > MADE_UP_FOR])
    if freedoms == len(group):
        return Undetermined(names, freedoms, _alone(list(names), by), by)
    trade = _trade(_simplest_row(own, freedoms), group, parameters)
    return Undetermined(names, freedoms, _together(names, freedoms, trade, by), by)


def _bodies(names: list[str]) -> tuple[str, ...]:
    """Names of the bodies: tool_x to "tool", board_front_rx to "board_front"."""
    return tuple(dict.fromkeys(name.rsplit("_", 1)[0] for name in names))


def _alone(names: list[str], by: tuple[str, ...]) -> str:
    """Individually undetermined parameters."""
    if all(_is_of_a_body(name) for name in names):
        return (
            f"{_listed(names)} {_has(names)} no effect on these points, which lie on one line; no result"
            " depends on it"
        )
    stay = "it stays at nominal" if len(names) == 1 else "they stay at nominal"
    if not by:
        return f"{_listed(names)} {_has(names)} no effect on these points; {stay}"
    cannot = "cannot be told apart from"
    return f"{_listed(names)} {cannot} {_where(by)}, also identified; {stay}"


def _together(names: tuple[str, ...], freedoms: int, trade: str, by: tuple[str, ...]) -> str:
    """Parameters of which only combinations are determined."""
    left = len(names) - freedoms
    if all(_is_of_a_body(name) for name in names):
        return (
            f"{_listed(names)}: {left} of these {len(names)} rotations {'is' if left == 1 else 'are'} determined, as the"
            " points lie on one line; no result depends on the rest"
        )
    aside = f" once {_where(by)} {'follows' if len(by) == 1 and by[0] == 'tool' else 'follow'}" if by else ""
    return (
        f"{_listed(names)} move together: these points determine {left} of their {len(names)} combinations"
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
        bodies.append(
            "the poses of the boards" if len(boards) > 1 else f"the pose of {boards[0].replace('_', ' ', 1)}"
        )
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
        _change(parameters[k], share / largest)
        for k, share in zip(group, row, strict=True)
        if abs(share) > NOTICEABLE * largest
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
    if len(names) > LISTED_LIMIT:
        return f"{', '.join(names[:LISTED_LIMIT])} and {len(names) - LISTED_LIMIT} more"
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"
