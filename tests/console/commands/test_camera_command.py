"""`armwright camera`: from rendered pictures to points that a calibration takes; wrong input."""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path

import numpy as np
import pytest

from calib.points.points import make_points, read_points
from calib.points.writer import write_points
from calib.vision.targets import png_of
from console.main import main
from tests.calib.vision.scenes import BOARD, drawn_pose, picture

OF_BOARD = ["--board", "5x7", "--square", "30mm"]


@pytest.fixture(scope="module")
def pictures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six pictures of a board, called like poses."""
    folder, rng = tmp_path_factory.mktemp("pictures"), np.random.default_rng(0)
    for k in range(6):
        seen = picture(BOARD, drawn_pose(rng, near=0.3, far=0.45), rng).astype(np.uint8)
        (folder / f"free_p{k}_1.png").write_bytes(png_of(seen))
    return folder


def test_pictures_become_a_lens_and_points(pictures: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    lens, out = tmp_path / "lens", tmp_path / "out"
    assert main(["camera", "calibrate", *OF_BOARD, "--images", str(pictures), "--out", str(lens)]) == 0
    said = capsys.readouterr().out
    assert "6 pictures" in said
    assert "To do: 6 pictures show the board: take at least 15." in said
    found = json.loads((lens / "camera.json").read_text())
    assert abs(found["lens"]["fx"] - 560.0) < 5.0 * found["sd"]["fx"]
    points = make_points(["free"] * 5, [f"p{k}" for k in range(5)], [1] * 5, np.zeros((5, 3)), np.full((5, 3), np.nan))
    write_points(tmp_path / "angles.csv", points)
    run = ["camera", "poses", *OF_BOARD, "--camera", str(lens / "camera.json"), "--images", str(pictures)]
    assert main([*run, "--points", str(tmp_path / "angles.csv"), "--out", str(out)]) == 0
    printed = capsys.readouterr()
    assert "6 of 6 pictures give a pose" in printed.out
    assert "belong to no pose of the points: free_p5_1" in printed.err
    made, warnings = read_points(out / "points.csv", 3)
    assert (len(made), warnings) == (5, ())
    assert np.isfinite(made.covariance).all()
    assert made.in_camera_frame
    assert main([*run, "--out", str(out)]) == 2
    assert "markers.csv exists already and is never overwritten" in capsys.readouterr().err


def test_a_print_has_its_true_size(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["camera", "board", *OF_BOARD, "--out", str(tmp_path)]) == 0
    assert "150.0 x 210.0 mm" in capsys.readouterr().out
    page = (tmp_path / "board.pdf").read_bytes()
    size = re.search(rb"/MediaBox \[ 0 0 ([0-9.]+) ([0-9.]+) \]", page)
    assert size is not None
    assert [float(part) * 25.4 / 72.0 for part in size.groups()] == pytest.approx([170.0, 230.0], abs=0.01)


@pytest.mark.parametrize(
    ("line", "says"),
    [
        (["calibrate", "--images", "."], "expected one target: --board 5x7 --square 30mm"),
        (["calibrate", *OF_BOARD, "--tag", "3", "--images", "."], "got --board and --tag"),
        (["calibrate", "--board", "5by7", "--images", "."], "--board: expected columns x rows of squares, such as 5x7"),
        (["calibrate", "--board", "5x7", "--images", "."], "give the edge of a square as measured on the print"),
        (["calibrate", "--board", "5x7", "--square", "30", "--images", "."], "--square: expected a number with one of the units"),
        (["calibrate", "--tag", "3", "--size", "5cm", "--images", "."], "expected a ChArUco board"),
        (["calibrate", *OF_BOARD], "--images: expected 1 folder(s), one for each camera, got 0"),
        (["calibrate", *OF_BOARD, "--images", "/no/such"], "expected a folder with pictures"),
        (["poses", *OF_BOARD, "--images", "."], "expected --camera camera.json"),
        (["poses", "--tag", "3", "--images", "."], "give the edge of its black square with --size"),
        (["poses", *OF_BOARD, "--camera", "/no/camera.json", "--images", "."], "cannot be read"),
    ],
)
def test_wrong_input_is_one_line_with_the_remedy(
    line: list[str], says: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["camera", *line, "--out", str(tmp_path / "out")]) == 2
    told = capsys.readouterr().err
    assert says in told
    assert told.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_without_opencv_the_remedy_is_said(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "cv2", None)
    assert main(["camera", "board", *OF_BOARD, "--out", str(tmp_path)]) == 2
    assert "pip install 'armwright[camera]'" in capsys.readouterr().err
