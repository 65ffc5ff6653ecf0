"""Poses of calibration boards: markers.csv, registration by a rigid motion, outliers, boards.json.

In: markers measured by a camera or tracker. Out: where the board stands in each setup, with what is
uncertain.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import numpy as np

from calib.arrays import Array, frozen, norms
from calib.errors import PointsFileError, RegistrationError
from calib.points.points import COVARIANCE, IMPORT, ORIENTATION, TIP
from calib.results import DECIMALS, Provenance, array_in, read_json, write_json
from control.tables import TableColumn, TableFormat, read_table

FORMAT = "boards/1"
SD_KEYS = ("x_m", "y_m", "z_m", "rx_rad", "ry_rad", "rz_rad")
ROTATION_TOLERANCE = 1e-6  # of rotation @ rotation.T - 1


@dataclass(frozen=True, slots=True)
class BoardPose:
    """A board's frame in the base frame: rotation (3, 3) base_R_board, origin_m (3,)."""

    rotation: Array
    origin_m: Array

    def to_base(self, board_m: Array) -> Array:
        """Points of the board (k, 3) in the base frame."""
        return np.asarray(board_m @ self.rotation.T + self.origin_m)


def write_boards(path: Path, arm: str, registrations: Mapping[str, Registration], made: Provenance) -> None:
    """Write the poses with residuals and standard deviations."""
    boards = {
        setup: {
            "origin_m": registration.origin_m.round(DECIMALS),
            "rotation": registration.rotation.round(DECIMALS),
            "sd": dict(zip(SD_KEYS, registration.sd.round(DECIMALS), strict=True)),
            "noise_m": round(registration.noise_m, DECIMALS),
            "residual_m": dict(zip(registration.names, registration.residual_m.round(DECIMALS), strict=True)),
            "outliers": registration.outliers,
            "notes": registration.notes,
        }
        for setup, registration in registrations.items()
    }
    write_json(path, made.heading(FORMAT, arm=arm) | {"boards": boards})


def read_boards(path: Path) -> dict[str, BoardPose]:
    """The poses by setup. RegistrationError names file and key."""
    boards = read_json(path, FORMAT, RegistrationError).get("boards")
    if not isinstance(boards, dict) or not boards:
        raise RegistrationError(f"{path}, boards: expected one entry per setup, got {boards!r}")
    return {setup: _pose(path, setup, entry) for setup, entry in boards.items()}


def _pose(path: Path, setup: str, entry: object) -> BoardPose:
    where = f"{path}, boards.{setup}"
    if not isinstance(entry, dict):
        raise RegistrationError(f"{where}: expected origin_m and rotation, got {entry!r}")
    origin = array_in(f"{where}.origin_m", entry.get("origin_m"), (3,), RegistrationError)
    rotation = array_in(f"{where}.rotation", entry.get("rotation"), (3, 3), RegistrationError)
    is_rotation = np.allclose(rotation @ rotation.T, np.eye(3), rtol=0.0, atol=ROTATION_TOLERANCE)
    if not is_rotation or np.linalg.det(rotation) < 0.0:
        raise RegistrationError(f"{where}.rotation: expected the rows of a rotation, got {rotation.tolist()}")
    return BoardPose(rotation, origin)


# markers.csv: positions of a board's markers, or of the tip in the board's cavities, measured by a camera.
#
# Required columns: setup, marker, x_m, y_m, z_m (base frame). Several rows of one marker are repeats. Other
# columns are ignored with a warning. Comma-separated, .csv or .csv.gz.


MARKERS = TableFormat(
    "marker",
    (
        TableColumn("setup", "placement of the board", is_required=True, is_name=True),
        TableColumn("marker", "a cavity by name; rows of one marker are averaged", is_required=True, is_name=True),
        *(TableColumn(name, "measured position in the base frame", is_required=True) for name in TIP),
    ),
    unwarned="|".join((*ORIENTATION, *COVARIANCE)),
    separated=IMPORT,
)


@dataclass(frozen=True, slots=True)
class Markers:
    """m measurements: setup and marker names, seen_m (m, 3) in the base frame; warnings of the reader."""

    setup: tuple[str, ...]
    marker: tuple[str, ...]
    seen_m: Array
    warnings: tuple[str, ...] = ()

    def __len__(self) -> int:
        """Number of measurements."""
        return len(self.setup)

    def means_m(self, setup: str) -> dict[str, Array]:
        """Mean position (3,) of each marker in a setup, in order of their first measurement."""
        rows: dict[str, list[int]] = {}
        for row, (stood, name) in enumerate(zip(self.setup, self.marker, strict=True)):
            if stood == setup:
                rows.setdefault(name, []).append(row)
        return {name: self.seen_m[chosen].mean(axis=0) for name, chosen in rows.items()}


def read_markers(path: Path) -> Markers:
    """Read the measurements of a file. PointsFileError names file, line and column."""
    table = read_table(path, MARKERS, PointsFileError)
    return Markers(tuple(table.words("setup")), tuple(table.words("marker")), frozen(table.numbers(*TIP)), table.warnings)


def markers_text(markers: Markers) -> str:
    """The file's text."""
    lines = io.StringIO()
    writer = csv.writer(lines, lineterminator="\n")
    writer.writerow([column.name for column in MARKERS.columns])
    for setup, marker, seen in zip(markers.setup, markers.marker, markers.seen_m, strict=True):
        writer.writerow([setup, marker, *(f"{value:.7f}" for value in seen)])
    return lines.getvalue()


# Rigid motion between two sets of points: the least-squares rotation and translation, one set or many at
# once.
#
# Arun, Huang and Blostein 1987 (singular value decomposition), with Umeyama's 1991 correction: a rotation,
# never a reflection.


@dataclass(frozen=True, slots=True)
class RigidMotion:
    """Seen = rotation @ board + shift_m, for one set or a stack of sets: rotation (..., 3, 3), shift_m (..., 3)."""

    rotation: Array
    shift_m: Array

    def of(self, board_m: Array) -> Array:
        """Board points (k, 3) moved: (..., k, 3)."""
        moved = board_m @ np.swapaxes(self.rotation, -1, -2) + self.shift_m[..., None, :]
        return np.asarray(moved)


def best_motion(board_m: Array, seen_m: Array, may_mirror: bool = False) -> RigidMotion:
    """The motion with the least sum of squared distances; board_m and seen_m (..., k, 3).

    With `may_mirror` a reflection is used if it fits better.
    """
    board_centre = board_m.mean(axis=-2, keepdims=True)
    seen_centre = seen_m.mean(axis=-2, keepdims=True)
    moments = np.swapaxes(seen_m - seen_centre, -1, -2) @ (board_m - board_centre)
    u, _, vt = np.linalg.svd(moments)
    if not may_mirror:
        turned = np.array(u)
        turned[..., :, 2] *= np.sign(np.linalg.det(u @ vt))[..., None]
        u = turned
    rotation = np.asarray(u @ vt)
    shift = seen_centre - board_centre @ np.swapaxes(rotation, -1, -2)
    return RigidMotion(rotation, shift[..., 0, :])


def squares_m2(motion: RigidMotion, board_m: Array, seen_m: Array) -> Array:
    """Squared distance of every point: (..., k)."""
    return np.asarray(np.sum((seen_m - motion.of(board_m)) ** 2, axis=-1))


def pose_jacobian(rotated_m: Array) -> Array:
    """Derivative of points by a motion's shift and small turn: rotated_m (k, 3) to (k, 3, 6).

    rotated_m are the points relative to the centre of the turn, in the frame of the shift.
    """
    x, y, z = rotated_m.T
    jacobian = np.zeros((len(rotated_m), 3, 6))
    jacobian[:, :, :3] = np.eye(3)
    jacobian[:, 0, 4], jacobian[:, 0, 5] = z, -y
    jacobian[:, 1, 3], jacobian[:, 1, 5] = -z, x
    jacobian[:, 2, 3], jacobian[:, 2, 4] = y, -x
    return jacobian


# Outliers of a rigid registration: markers that are not at their place on the board.
#
# For j = 0, 1, 2, ... the k - j best agreeing markers are searched (least trimmed squares: Rousseeuw 1984),
# and an F test decides whether leaving one more out is significant; the largest j that passes counts, so
# that several outliers do not mask each other (generalised extreme studentised deviate test: Rosner 1983).


FEWEST_TO_NAME = 5  # with four, leaving one out leaves three, which nearly always fit
FALSE_ALARM = 0.01  # probability that a registration without an outlier names one
RESOLUTION_m = 1e-6  # smaller residuals are ignored, so that a set without noise has no outliers
LARGEST_SHARE = 3  # at most every third marker may be wrong; else the whole set is
TRIPLES = 2000  # starts of the search
REFINED = 20  # number of best starts to refine
POSE_UNKNOWNS = 6


def outlying(board_m: Array, seen_m: Array) -> tuple[int, ...]:
    """Rows of the outliers among markers board_m (k, 3) and seen_m (k, 3); none if k is below five."""
    k = len(board_m)
    if k < FEWEST_TO_NAME:
        return ()
    motions = _starts(board_m, seen_m)
    agreeing = [_agreeing(motions, board_m, seen_m, k - j) for j in range(min(k // LARGEST_SHARE, k - 4) + 1)]
    squares = [_sum_of_squares(board_m, seen_m, rows) for rows in agreeing]
    passed = [j for j in range(1, len(agreeing)) if _is_more_than_chance(squares[j - 1], squares[j], k - j)]
    return tuple(sorted(set(range(k)) - set(agreeing[max(passed)]))) if passed else ()


def _starts(board_m: Array, seen_m: Array) -> RigidMotion:
    """The motions of many triples of markers."""
    triples = np.array(list(combinations(range(len(board_m)), 3)))
    if len(triples) > TRIPLES:
        triples = np.random.default_rng(0).choice(triples, TRIPLES, replace=False)
    return best_motion(board_m[triples], seen_m[triples])


def _agreeing(motions: RigidMotion, board_m: Array, seen_m: Array, count: int) -> tuple[int, ...]:
    """The `count` markers with the least sum of squares under one motion."""
    squares = np.sort(squares_m2(motions, board_m, seen_m), axis=-1)
    promising = np.argsort(squares[:, :count].sum(axis=-1))[:REFINED]
    candidates = {_refined(RigidMotion(motions.rotation[i], motions.shift_m[i]), board_m, seen_m, count) for i in promising}
    return min(sorted(candidates), key=lambda rows: _sum_of_squares(board_m, seen_m, rows))


def _refined(motion: RigidMotion, board_m: Array, seen_m: Array, count: int) -> tuple[int, ...]:
    """Fit the best markers and select again, until the selection is stable."""
    rows: tuple[int, ...] = ()
    for _ in range(10):
        best = np.argsort(squares_m2(motion, board_m, seen_m), kind="stable")[:count]
        chosen = tuple(sorted(int(i) for i in best))
        if chosen == rows:
            break
        rows = chosen
        motion = best_motion(board_m[list(rows)], seen_m[list(rows)])
    return rows


def _sum_of_squares(board_m: Array, seen_m: Array, rows: tuple[int, ...]) -> float:
    board, seen = board_m[list(rows)], seen_m[list(rows)]
    return float(squares_m2(best_motion(board, seen), board, seen).sum())


def _is_more_than_chance(before_m2: float, after_m2: float, count: int) -> bool:
    """Whether leaving out one of left + 1 markers reduces the sum of squares significantly."""
    from scipy.special import fdtrc

    freedom = 3 * count - POSE_UNKNOWNS
    variance_m2 = max(after_m2 / freedom, RESOLUTION_m**2)
    ratio = (before_m2 - after_m2) / 3.0 / variance_m2
    return float(fdtrc(3, freedom, max(0.0, ratio))) < FALSE_ALARM / (count + 1)


# Registration of a calibration board from three or more of its cavities or markers measured by a camera.
#
# `register` works on arrays, `register_boards` on the rows of a markers.csv. Frames: measured positions are
# in the arm's base frame, board positions in the board's own; base = rotation @ board + origin_m.

FEWEST = 3
LINE_TOLERANCE = 0.02  # spread across the best line, as a share of that along it
MISFIT = 0.1  # largest root mean square residual, as a share of the markers' spread
Cavities = Mapping[str, Sequence[float] | Array]


@dataclass(frozen=True, slots=True)
class Registration:
    """A board's pose in the base frame and its uncertainty.

    rotation (3, 3): base_R_board; origin_m (3,) of the board's frame; residual_m (k, 3) seen minus board, also of the
    outliers, which the pose does not use. noise_m: standard deviation per axis of the markers that were used.
    covariance (6, 6) of x, y, z [m] of the origin and of small turns about the base axes through it [rad].
    """

    names: tuple[str, ...]
    rotation: Array
    origin_m: Array
    residual_m: Array
    outliers: tuple[str, ...]
    noise_m: float
    covariance: Array
    notes: tuple[str, ...] = ()

    @property
    def sd(self) -> Array:
        """Standard deviations (6,): x, y, z in m, turns about x, y, z in rad."""
        return frozen(np.sqrt(np.diag(self.covariance)))

    @property
    def normal(self) -> Array:
        """The board's normal in the base frame, (3,)."""
        return frozen(self.rotation[:, 2])

    def to_base(self, board_m: Array) -> Array:
        """Points of the board (k, 3) in the base frame."""
        return np.asarray(board_m @ self.rotation.T + self.origin_m)


def register(board_m: Array, seen_m: Array, names: Sequence[str] | None = None) -> Registration:
    """Least-squares pose of the board from markers board_m (k, 3) seen at seen_m (k, 3), outliers left out.

    Outliers are searched among five markers or more. RegistrationError if the markers determine no pose: fewer
    than three, collinear, not finite, or wrongly named.
    """
    board, seen = np.asarray(board_m, dtype=float), np.asarray(seen_m, dtype=float)
    called = tuple(names) if names is not None else tuple(str(k + 1) for k in range(len(board)))
    _require_shape(board, seen, called)
    _require_finite(board, seen, called)
    _require_area(board, called)
    left_out = outlying(board, seen)
    used = [k for k in range(len(board)) if k not in left_out]
    _require_area(board[used], [called[k] for k in used])
    _require_match(board[used], seen[used], [called[k] for k in used])
    motion = best_motion(board[used], seen[used])
    variance_m2 = float(squares_m2(motion, board[used], seen[used]).sum()) / (3 * len(used) - 6)
    turned = pose_jacobian(board[used] @ motion.rotation.T).reshape(-1, 6)
    return Registration(
        called,
        frozen(motion.rotation),
        frozen(motion.shift_m),
        frozen(seen - motion.of(board)),
        tuple(called[k] for k in left_out),
        float(np.sqrt(variance_m2)),
        frozen(variance_m2 * np.linalg.inv(turned.T @ turned)),
        _notes(len(board), len(left_out)),
    )


def register_boards(markers: Markers, cavities: Cavities) -> dict[str, Registration]:
    """The pose of the board in each setup of `markers`, by setup; repeats of a marker are averaged.

    `cavities` are the markers' positions in the board's frame. RegistrationError names setup and marker.
    """
    return {setup: _register_setup(markers, cavities, setup) for setup in dict.fromkeys(markers.setup)}


def _register_setup(markers: Markers, cavities: Cavities, setup: str) -> Registration:
    seen = markers.means_m(setup)
    for name in seen:
        if name not in cavities:
            raise RegistrationError(f"setup {setup}: the board has no marker {name}; it has {_few(list(cavities))}")
    board_m = np.array([np.asarray(cavities[name], dtype=float) for name in seen])
    try:
        registration = register(board_m, np.array(list(seen.values())), tuple(seen))
    except RegistrationError as error:
        raise RegistrationError(f"setup {setup}: {error}") from None
    if registration.normal[2] < 0.0:
        raise RegistrationError(
            f"setup {setup}: the markers put the board upside down (normal {_spelled(registration.normal)}):"
            " check that names count counter-clockwise"
        )
    return registration


def _require_shape(board_m: Array, seen_m: Array, names: Sequence[str]) -> None:
    if board_m.shape != seen_m.shape or board_m.ndim != 2 or board_m.shape[1] != 3:
        raise RegistrationError(f"markers on the board {board_m.shape} and seen {seen_m.shape}: expected (k, 3) twice")
    if len(names) != len(board_m) or len(set(names)) != len(names):
        raise RegistrationError(f"{len(board_m)} markers: expected a different name for each, got {_few(names)}")
    if len(board_m) < FEWEST:
        raise RegistrationError(
            f"{len(board_m)} markers ({_few(names)}): a board's pose needs three or more that are not collinear"
        )


def _require_finite(board_m: Array, seen_m: Array, names: Sequence[str]) -> None:
    for where, positions in (("on the board", board_m), ("seen", seen_m)):
        bad = np.flatnonzero(~np.isfinite(positions).all(axis=1))
        if len(bad):
            raise RegistrationError(f"marker {names[int(bad[0])]} {where}: {_spelled(positions[int(bad[0])])} is not a position")


def _require_area(board_m: Array, names: Sequence[str]) -> None:
    if len(board_m) < FEWEST:
        raise RegistrationError(f"only {_few(names)} agree with each other: the board's pose needs three")
    spread = np.linalg.svd(board_m - board_m.mean(axis=0), compute_uv=False)
    if spread[1] <= LINE_TOLERANCE * spread[0]:
        raise RegistrationError(
            f"markers {_few(names)} are collinear on the board: its rotation about that line is undetermined;"
            " add one off the line"
        )


def _require_match(board_m: Array, seen_m: Array, names: Sequence[str]) -> None:
    """Check that the measured markers have the board's shape, and not that of its mirror image."""
    spread_m2 = float(np.sum((board_m - board_m.mean(axis=0)) ** 2))
    turned = float(squares_m2(best_motion(board_m, seen_m), board_m, seen_m).sum())
    if turned <= MISFIT**2 * spread_m2:
        return
    mirrored = float(squares_m2(best_motion(board_m, seen_m, True), board_m, seen_m).sum())
    if mirrored <= MISFIT**2 * spread_m2:
        raise RegistrationError(
            "the markers seen are the board's mirror image: a coordinate has the wrong sign, or names are swapped"
        )
    raise RegistrationError(f"the markers seen do not have the board's shape: {_worst_pair(board_m, seen_m, names)}")


def _worst_pair(board_m: Array, seen_m: Array, names: Sequence[str]) -> str:
    def distances_m(pair: tuple[int, int]) -> tuple[float, float]:
        i, j = pair
        return float(norms(board_m[[i]] - board_m[[j]])[0]), float(norms(seen_m[[i]] - seen_m[[j]])[0])

    pair = max(combinations(range(len(names)), 2), key=lambda p: abs(np.subtract(*distances_m(p))))
    on_board_m, seen_m_apart = distances_m(pair)
    return (
        f"{names[pair[0]]} and {names[pair[1]]} are {on_board_m:.4f} m apart on the board and measured {seen_m_apart:.4f} m"
        " apart; check for swapped names, and that positions are in metres"
    )


def _notes(count: int, left_out: int) -> tuple[str, ...]:
    if count == FEWEST:
        return ("three markers: a wrong one is detected only if it changes their distances, and cannot be identified",)
    if count < FEWEST_TO_NAME:
        return ("four markers: a wrong one is detected by the residuals but not identified; five can identify it",)
    if left_out:
        return (f"{left_out} of {count} markers disagree with the others and are not used; measure them again",)
    return ()


def _few(names: Sequence[str], most: int = 12) -> str:
    return ", ".join(names[:most]) + (", ..." if len(names) > most else "") or "none"


def _spelled(vector: Array) -> str:
    return "(" + ", ".join(f"{value:.4g}" for value in vector) + ")"
