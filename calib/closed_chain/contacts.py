"""contacts.csv: joint angles of two arms whose tips are in one place, or a known distance apart.

A points.csv whose q1_rad ... are the joints of the first arm, then those of the second, without measured tips.
distance_m: between the tips, as of two balls that touch or a ball bar; 0 or empty: both are in one place.
joined: the name of a rigid join of both tools: both are in one place, and their orientation to each other is the same wherever
the name is; empty: they only touch.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from calib.arm_problem.joint_effects import known_corrections
from calib.arrays import Array, frozen
from calib.errors import PointsFileError, UnusablePointsError
from calib.points.points import Points, make_points
from calib.points.reading import beyond, read_points
from calib.points.writer import DISTANCE, Key
from control.model.arm import Arm
from control.tables import TableColumn, TableFormat

JOINED = "joined"
DISTANCE_MOST_m = 5.0
TURNS_LIMIT_rad = 6 * math.pi
BESIDE = TableFormat(
    "point",
    (
        TableColumn(
            DISTANCE,
            "between the tips; empty: 0",
            lower=0.0,
            upper=DISTANCE_MOST_m,
            expected=f"a distance from 0 to {DISTANCE_MOST_m:g} m",
        ),
        TableColumn(JOINED, "name of a rigid join of both tools; empty: they touch", is_name=True),
    ),
)
"""Columns of contacts that points.csv has beside its own."""


@dataclass(frozen=True, slots=True)
class Contacts:
    """m contacts: joint angles (m, n1) and (m, n2) with each arm's known static effects, distances between the tips (m,).

    `joined`: the name of a join of both tools, which also keeps the orientation between them; "" where they only touch.
    """

    name: tuple[str, ...]
    setup: tuple[str, ...]
    first_rad: Array
    second_rad: Array
    distance_m: Array
    joined: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Without names, no tools are joined."""
        if not self.joined:
            object.__setattr__(self, "joined", ("",) * len(self.name))

    def __len__(self) -> int:
        """How many."""
        return len(self.name)

    @property
    def keys(self) -> tuple[Key, ...]:
        """Setup, point and repeat of each: contacts of a file are named by all three, planned ones by the point."""
        found = []
        for name, setup in zip(self.name, self.setup, strict=True):
            rest = name.removeprefix(f"{setup}:")
            point, _, repeat = rest.rpartition(":")
            found.append((setup, name, 1) if rest == name else (setup, point, int(repeat)))
        return tuple(found)

    def chosen(self, rows: npt.ArrayLike) -> Contacts:
        """Some of them, by index."""
        keep = np.arange(len(self))[np.asarray(rows)]
        return Contacts(
            tuple(self.name[k] for k in keep),
            tuple(self.setup[k] for k in keep),
            frozen(self.first_rad[keep]),
            frozen(self.second_rad[keep]),
            frozen(self.distance_m[keep]),
            tuple(self.joined[k] for k in keep),
        )


def read_contacts(path: Path, arms: tuple[Arm, Arm]) -> tuple[Contacts, tuple[str, ...]]:
    """The contacts of a file, and warnings. PointsFileError or UnusablePointsError names file, line and column."""
    first, second = arms
    n = first.joint_count
    try:
        points, warnings = read_points(path, n + second.joint_count, BESIDE)
    except PointsFileError as error:
        raise PointsFileError(
            f"{error} (contacts: the {n} joints of {first.name}, then the {second.joint_count} of {second.name})"
        ) from None
    if np.isfinite(points.tip_m).any():
        raise UnusablePointsError(
            f"{path}: contacts have no measured tips: remove x_m, y_m, z_m, or calibrate each arm by itself"
        )
    if np.abs(points.q_rad).max() > TURNS_LIMIT_rad:
        raise UnusablePointsError(f"{path}: the joint angles look like degrees: expected radians")
    table = beyond(points, path, BESIDE, PointsFileError)
    distance_m, joined = np.nan_to_num(table.number(DISTANCE)), tuple(table.words(JOINED))
    for row, name in enumerate(joined):
        if name and distance_m[row] > 0.0:
            raise PointsFileError(
                f"{table.place(row)}, column {JOINED}: joined tools {name!r} are in one place: expected {DISTANCE} 0 or"
                f" empty, got {distance_m[row]:g}"
            )
    names = zip(points.setup, points.point, points.repeat, strict=True)
    return Contacts(
        tuple(f"{setup}:{point}:{repeat}" for setup, point, repeat in names),
        points.setup,
        frozen(_joint_rad(first, points, slice(0, n))),
        frozen(_joint_rad(second, points, slice(n, None))),
        frozen(distance_m),
        joined,
    ), warnings


def contact_points(
    setup: Sequence[str],
    name: Sequence[str],
    q_rad: Array,
    distance_m: Sequence[float],
    direction: Array | None = None,
) -> Points:
    """Contacts as the points of a file: q_rad (m, n1 + n2) as the encoders say, direction likewise."""
    extra = {DISTANCE: tuple(f"{distance:g}" for distance in distance_m)}
    nowhere = np.full((len(name), 3), np.nan)
    return make_points(setup, name, [1] * len(name), q_rad, nowhere, direction, extra=extra)


def _joint_rad(arm: Arm, points: Points, columns: slice) -> Array:
    """Joint angles of one arm, with its known static effects."""
    q, m = points.q_rad[:, columns], len(points)
    own = make_points(
        points.setup, points.point, points.repeat, q, np.full((m, 3), np.nan), points.direction[:, columns]
    )
    return np.asarray(q + known_corrections(arm, own))
