"""Registration of a calibration board from three or more of its cavities or markers measured by a camera.

`register` works on arrays, `register_boards` on the rows of a markers.csv. Frames: measured positions are in the arm's base
frame, board positions in the board's own; base = rotation @ board + origin_m.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from calib.arrays import Array, frozen, norms
from calib.boards.markers import Markers, read_markers
from calib.boards.outlying_markers import FEWEST_TO_NAME, outlying
from calib.boards.rigid import best_motion, pose_jacobian, squares_m2
from calib.errors import RegistrationError

__all__ = ["Markers", "Registration", "read_markers", "register", "register_boards"]

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
            raise RegistrationError(
                f"setup {setup}: the board has no marker {name}; it has {_few(list(cavities))}"
            )
    board_m = np.array([np.asarray(cavities[name], dtype=float) for name in seen])
    try:
        found = register(board_m, np.array(list(seen.values())), tuple(seen))
    except RegistrationError as error:
        raise RegistrationError(f"setup {setup}: {error}") from None
    if found.normal[2] < 0.0:
        raise RegistrationError(
            f"setup {setup}: the markers put the board upside down (normal {_spelled(found.normal)}):"
            " check that names count counter-clockwise"
        )
    return found


def _require_shape(board_m: Array, seen_m: Array, names: Sequence[str]) -> None:
    if board_m.shape != seen_m.shape or board_m.ndim != 2 or board_m.shape[1] != 3:
        raise RegistrationError(
            f"markers on the board {board_m.shape} and seen {seen_m.shape}: expected (k, 3) twice"
        )
    if len(names) != len(board_m) or len(set(names)) != len(names):
        raise RegistrationError(
            f"{len(board_m)} markers: expected a different name for each, got {_few(names)}"
        )
    if len(board_m) < FEWEST:
        raise RegistrationError(
            f"{len(board_m)} markers ({_few(names)}): a board's pose needs three or more that are not collinear"
        )


def _require_finite(board_m: Array, seen_m: Array, names: Sequence[str]) -> None:
    for where, positions in (("on the board", board_m), ("seen", seen_m)):
        bad = np.flatnonzero(~np.isfinite(positions).all(axis=1))
        if len(bad):
            raise RegistrationError(
                f"marker {names[int(bad[0])]} {where}: {_spelled(positions[int(bad[0])])} is not a position"
            )


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
    raise RegistrationError(
        f"the markers seen do not have the board's shape: {_worst_pair(board_m, seen_m, names)}"
    )


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
        return (
            "three markers: a wrong one is detected only if it changes their distances, and cannot be identified",
        )
    if count < FEWEST_TO_NAME:
        return (
            "four markers: a wrong one is detected by the residuals but not identified; five can identify it",
        )
    if left_out:
        return (
            f"{left_out} of {count} markers disagree with the others and are not used; measure them again",
        )
    return ()


def _few(names: Sequence[str], most: int = 12) -> str:
    return ", ".join(names[:most]) + (", ..." if len(names) > most else "") or "none"


def _spelled(vector: Array) -> str:
    return "(" + ", ".join(f"{value:.4g}" for value in vector) + ")"
