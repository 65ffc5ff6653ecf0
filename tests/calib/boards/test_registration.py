"""Where a board stands, from markers: the pose is recovered, wrong markers are named, and what cannot be told is said."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from benchmarks.calibration.chains import board_points
from calib.boards import Markers, markers_text, read_boards, read_markers, register, register_boards, write_boards
from calib.errors import PointsFileError, RegistrationError
from calib.results import made_today

BOARD = board_points() - np.array([0.5, 0.0, 0.0])
NAMES = tuple(str(k + 1) for k in range(33))
FIVE = [0, 5, 11, 17, 30]


def turned(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """A rotation by up to half a radian about any axis, and an origin."""
    axis = rng.normal(size=3)
    axis /= np.linalg.norm(axis)
    angle = rng.uniform(-0.5, 0.5)
    k = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    return np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * k @ k, rng.uniform(-1, 1, 3)


@pytest.mark.parametrize("rows", [[0, 8, 16], FIVE, list(range(33))])
def test_an_exact_board_is_found_exactly(rows: list[int]) -> None:
    rotation, origin = turned(np.random.default_rng(1))
    registration = register(BOARD[rows], BOARD[rows] @ rotation.T + origin)
    np.testing.assert_allclose(registration.rotation, rotation, atol=1e-12)
    np.testing.assert_allclose(registration.origin_m, origin, atol=1e-12)
    assert np.linalg.det(registration.rotation) == pytest.approx(1.0)
    assert registration.outliers == ()
    np.testing.assert_allclose(registration.to_base(BOARD[rows]) + registration.residual_m, BOARD[rows] @ rotation.T + origin)


def test_standard_deviations_are_those_of_repeated_registrations() -> None:
    rng = np.random.default_rng(2)
    rotation, origin = turned(rng)
    errors, claimed, noises = [], [], []
    for _ in range(200):
        registration = register(BOARD[FIVE], BOARD[FIVE] @ rotation.T + origin + rng.normal(0, 2e-4, (5, 3)))
        if registration.outliers:
            continue
        turn = registration.rotation @ rotation.T
        turns = 0.5 * np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
        errors.append(np.concatenate((registration.origin_m - origin, turns)))
        claimed.append(registration.covariance)
        noises.append(registration.noise_m**2)
    assert np.mean(noises) == pytest.approx(4e-8, rel=0.1)  # 200 times 9 degrees of freedom: 3.3 %
    spread = np.cov(np.array(errors).T, bias=True)
    np.testing.assert_allclose(np.sqrt(np.diag(spread)), np.sqrt(np.diag(np.mean(claimed, axis=0))), rtol=0.15)


@pytest.mark.parametrize(
    ("rows", "wrong"),
    [(FIVE, [2]), (list(range(0, 24, 4)), [1]), (list(range(0, 24, 3)), [1, 2]), (list(range(33)), [3, 4, 5, 20])],
)
def test_wrong_markers_are_named_also_when_there_are_several(rows: list[int], wrong: list[int]) -> None:
    for seed in range(5):
        rng = np.random.default_rng(seed)
        rotation, origin = turned(rng)
        seen = BOARD[rows] @ rotation.T + origin + rng.normal(0, 1.4e-4, (len(rows), 3))
        seen[wrong] += rng.choice([-1, 1], (len(wrong), 3)) * 0.008
        registration = register(BOARD[rows], seen, [NAMES[k] for k in rows])
        assert registration.outliers == tuple(NAMES[rows[k]] for k in wrong), seed
        np.testing.assert_allclose(registration.origin_m, origin, atol=1e-3)
        assert min(np.linalg.norm(registration.residual_m[wrong], axis=1)) > 5e-3


@pytest.mark.parametrize("rows", [FIVE, list(range(0, 24, 3))])
def test_among_good_markers_hardly_ever_one_is_called_wrong(rows: list[int]) -> None:
    rng = np.random.default_rng(3)
    alarms = sum(bool(register(BOARD[rows], BOARD[rows] + rng.normal(0, 1.4e-4, (len(rows), 3))).outliers) for _ in range(120))
    assert alarms <= 5  # 1 % is meant; 6 of 120 at 1 % has a probability of 0.1 %


def test_two_swapped_names_among_many_are_named() -> None:
    seen = np.array(BOARD)
    seen[[7, 8]] = seen[[8, 7]]
    seen += np.random.default_rng(4).normal(0, 1.4e-4, seen.shape)
    assert register(BOARD, seen, NAMES).outliers == ("8", "9")


def test_with_three_or_four_markers_it_is_said_what_cannot_be_told() -> None:
    rng = np.random.default_rng(5)
    for count, word in ((3, "three"), (4, "four")):
        rows = FIVE[:count]
        registration = register(BOARD[rows], BOARD[rows] + rng.normal(0, 1e-4, (count, 3)))
        assert registration.outliers == ()
        assert registration.notes[0].startswith(word)


@pytest.mark.parametrize(
    ("rows", "change", "said"),
    [
        ([0, 1], None, "2 markers .* three or more"),
        ([24, 26, 28, 32], None, "collinear"),
        ([0, 8, 16, 3], lambda s: s * np.array([1.0, 1.0, np.nan]), "marker 1 seen: .* not a position"),
        ([0, 8, 16, 3], lambda s: s[[1, 0, 2, 3]], "swapped names"),
        ([0, 8, 16], lambda s: 1000.0 * s, "in metres"),
    ],
)
def test_markers_that_determine_no_pose_are_refused_with_the_reason(rows: list[int], change, said: str) -> None:
    seen = BOARD[rows]
    with pytest.raises(RegistrationError, match=said):
        register(BOARD[rows], change(seen) if change else seen, [NAMES[k] for k in rows])


def test_a_mirror_image_is_refused() -> None:
    solid = np.vstack((BOARD[[0, 8, 16]], [[0.0, 0.0, 0.1]]))
    with pytest.raises(RegistrationError, match="mirror image"):
        register(solid, solid * np.array([1.0, 1.0, -1.0]))
    flat = Markers(("normal",) * 3, ("1", "2", "3"), BOARD[[0, 8, 16]])
    cavities = dict(zip("123", BOARD[[0, 16, 8]], strict=True))  # numbered the other way round
    with pytest.raises(RegistrationError, match=r"setup normal: .* upside down"):
        register_boards(flat, cavities)


def test_every_setup_has_its_own_pose_and_repeats_are_averaged(tmp_path: Path) -> None:
    rng = np.random.default_rng(6)
    poses = {setup: turned(rng) for setup in ("normal", "roll")}
    rows = [(s, NAMES[k], BOARD[k] @ r.T + o + e) for s, (r, o) in poses.items() for k in FIVE for e in (1e-4, -1e-4)]
    markers = Markers(tuple(r[0] for r in rows), tuple(r[1] for r in rows), np.array([r[2] for r in rows]))
    (tmp_path / "markers.csv").write_text(markers_text(markers))
    back = read_markers(tmp_path / "markers.csv")
    assert len(back) == 20
    boards = register_boards(back, dict(zip(NAMES, BOARD, strict=True)))
    assert list(boards) == ["normal", "roll"]
    for setup, (rotation, origin) in poses.items():
        assert len(boards[setup].names) == 5
        np.testing.assert_allclose(boards[setup].rotation, rotation, atol=2e-6)  # 7 decimals in the file
        np.testing.assert_allclose(boards[setup].origin_m, origin, atol=2e-7)
    with pytest.raises(RegistrationError, match="setup normal: the board has no marker 6; it has 1"):
        register_boards(back, {"1": BOARD[0]})


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("setup,marker,x_m,y_m\n", "line 1: required column z_m is missing"),
        ("setup,marker,x_m,y_m,z_m\n", "a header and no markers"),
        ("setup,marker,x_m,y_m,z_m\nnormal,1,0,0,nan\n", 'line 2, column z_m: got "nan", expected a finite number'),
        ("setup,marker,x_m,y_m,z_m\nnormal,,0,0,0\n", "line 2, column marker: got an empty cell, expected a name"),
        ("setup,marker,x_m,y_m,z_m\nnormal,1,0,0\n", "line 2: 4 values, line 1 names 5"),
        ("setup,marker,x_m,y_m,z_m,x_m\n", "column x_m appears twice"),
    ],
)
def test_a_markers_file_that_is_wrong_is_named_with_line_and_column(tmp_path: Path, text: str, said: str) -> None:
    path = tmp_path / "markers.csv"
    path.write_text(text)
    with pytest.raises(PointsFileError) as caught:
        read_markers(path)
    assert str(path) in str(caught.value)
    assert said in str(caught.value)


def test_unknown_columns_of_markers_are_ignored_with_a_warning(tmp_path: Path) -> None:
    path = tmp_path / "markers.csv"
    path.write_text("setup,marker,t_s,x_m,y_m,z_m\nnormal,1,3,0.1,0.2,0.3\n")
    markers = read_markers(path)
    np.testing.assert_allclose(markers.seen_m, [[0.1, 0.2, 0.3]])
    assert markers.warnings == (f"{path}: unknown columns ignored: t_s",)


def test_boards_written_come_back_and_a_wrong_file_is_named(tmp_path: Path) -> None:
    rotation, origin = turned(np.random.default_rng(8))
    registration = register(BOARD[FIVE], BOARD[FIVE] @ rotation.T + origin, [NAMES[k] for k in FIVE])
    path = tmp_path / "boards.json"
    write_boards(path, "right", {"roll": registration}, made_today())
    back = read_boards(path)["roll"]
    np.testing.assert_allclose(back.to_base(BOARD), registration.to_base(BOARD), atol=1e-11)
    entry = json.loads(path.read_text())["boards"]["roll"]
    assert set(entry) == {"origin_m", "rotation", "sd", "noise_m", "residual_m", "outliers", "notes"}
    assert list(entry["residual_m"]) == [NAMES[k] for k in FIVE]
    for wrong, said in (("boards/1", "boards/2"), (str(entry["rotation"][0][0])[:6], "9.999")):
        (tmp_path / "wrong.json").write_text(path.read_text().replace(wrong, said))
        with pytest.raises(RegistrationError, match=r"wrong\.json, "):
            read_boards(tmp_path / "wrong.json")
