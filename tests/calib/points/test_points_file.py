"""points.csv: what is written comes back, and what is wrong is named with file, line and column."""

import dataclasses
import gzip
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from calib.errors import PointsFileError, SessionError
from calib.points.points import make_points, read_points
from calib.points.writer import PointsWriter, Record, write_points

GOOD = "setup,point,repeat,q1_rad,q2_rad,x_m,y_m,z_m\nnormal,1,1,0.1,0.2,0.5,0,0\nroll,2,1,0.3,0.4,,,\n"


def file_with(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "points.csv"
    path.write_text(text)
    return path


def some_points(m: int = 7, n: int = 3):
    rng = np.random.default_rng(5)
    tip = rng.normal(0.0, 0.3, (m, 3))
    tip[2] = np.nan
    return make_points(
        [f"s{k % 2}" for k in range(m)],
        [f"p,{k}" for k in range(m)],
        range(1, m + 1),
        rng.normal(0.0, 1.0, (m, n)),
        tip,
        rng.integers(-1, 2, (m, n)).astype(float),
        rng.normal(0.0, 1.0, (m, n)),
        np.arange(m) * 8.0,
        np.full(m, 0.5),
        {"remark": tuple(f"r{k}" for k in range(m))},
    )


@pytest.mark.parametrize("name", ["points.csv", "points.csv.gz"])
@pytest.mark.parametrize("n", [1, 3, 7])
def test_written_points_come_back(tmp_path: Path, name: str, n: int) -> None:
    points = some_points(n=n)
    write_points(tmp_path / name, points)
    back, warnings = read_points(tmp_path / name)
    assert (back.setup, back.point, back.repeat) == (points.setup, points.point, points.repeat)
    for field in ("q_rad", "tip_m", "direction", "current_A", "t_s", "payload_kg"):
        np.testing.assert_allclose(getattr(back, field), getattr(points, field), atol=1e-6, err_msg=field)
    assert dict(back.extra) == dict(points.extra)
    assert warnings == (f"{tmp_path / name}: unknown columns ignored: remark",)


def test_only_required_columns_are_needed(tmp_path: Path) -> None:
    points, warnings = read_points(file_with(tmp_path, "setup,point,repeat,q1_rad\nfree,a,1,0.5\n"))
    assert warnings == ()
    assert points.joint_count == 1
    assert np.isnan(points.tip_m).all()
    assert np.isnan(points.current_A).all()
    assert not points.direction.any()


def test_arrays_are_read_only(tmp_path: Path) -> None:
    points, _ = read_points(file_with(tmp_path, GOOD))
    for field in ("q_rad", "tip_m", "direction", "current_A", "t_s", "payload_kg"):
        with pytest.raises(ValueError, match="read-only"):
            getattr(points, field)[0] = 1.0


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (GOOD.replace("setup,", "set,"), "line 1: required column setup is missing"),
        (GOOD.replace("q2_rad", "q3_rad"), "line 1: required column q2_rad is missing"),
        (GOOD.replace("q1_rad,q2_rad", "a,b"), "line 1: required column q1_rad is missing"),
        (GOOD.replace("x_m,y_m", "x_m,y"), "line 1: column y_m is missing beside x_m"),
        (GOOD.replace("q2_rad", "q1_rad"), "line 1: column q1_rad appears twice"),
        (GOOD.replace("0.4", "four"), 'line 3, column q2_rad: got "four", expected a finite number'),
        (GOOD.replace("0.4", "nan"), 'line 3, column q2_rad: got "nan", expected a finite number'),
        (GOOD.replace("0.4", ""), "line 3, column q2_rad: got an empty cell, expected a finite number"),
        (GOOD.replace("0.5", "inf"), 'line 2, column x_m: got "inf", expected a finite number'),
        (GOOD.replace("0.4", "1e300"), 'line 3, column q2_rad: got "1e300", expected a finite number'),
        (GOOD.replace(",0,0\n", ",,0\n"), "line 2, column y_m: got an empty cell"),
        (GOOD.replace("1,1,0.1", "1,1.5,0.1"), 'line 2, column repeat: got "1.5", expected a whole number'),
        (GOOD.replace("0.3,0.4,", "0.3,"), "line 3: 7 values, line 1 names 8"),
        (GOOD.replace("roll,", ","), "line 3, column setup: got an empty cell, expected a name"),
        ("setup,point,repeat,q1_rad,dir1\na,1,1,0,2\n", 'line 2, column dir1: got "2", expected -1, 0 or 1'),
        ("setup,point,repeat,q1_rad,i2_A\na,1,1,0,2\n", "line 1: column i2_A belongs to no joint"),
        ("setup,point,repeat,q1_rad\n", "a header and no points"),
        ("", "line 1: required column setup is missing"),
    ],
)
def test_a_bad_file_is_one_message_with_file_line_and_column(tmp_path: Path, text: str, says: str) -> None:
    path = file_with(tmp_path, text)
    with pytest.raises(PointsFileError) as caught:
        read_points(path)
    assert str(caught.value).startswith(str(path))
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("name", "content", "remedy"),
    [
        ("run.armlog", b"ARMLOG2\n\xff", "`armwright export` makes a log.csv.gz of it"),
        ("points.csv", GOOD.encode("utf-16"), "save it in UTF-8; `armwright import-points` reads other encodings"),
    ],
)
def test_what_is_no_text_is_refused_with_what_to_do(tmp_path: Path, name: str, content: bytes, remedy: str) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(PointsFileError, match=f"{name}: byte [0-9]+ is not UTF-8 text: .*; {remedy}"):
        read_points(tmp_path / name)


def test_another_joint_count_than_expected_is_refused(tmp_path: Path) -> None:
    with pytest.raises(PointsFileError, match="joint angles of 2 joints, expected 3"):
        read_points(file_with(tmp_path, GOOD), joint_count=3)
    with pytest.raises(PointsFileError, match="joint angles of 2 joints, expected 1"):
        read_points(file_with(tmp_path, GOOD), joint_count=1)


@pytest.mark.parametrize(
    "content", [gzip.compress(GOOD.encode(), mtime=0)[:-9], b"not gzip", b"\xff\xfe\x00"], ids=["cut off", "no gzip", "binary"]
)
def test_a_damaged_file_is_one_message(tmp_path: Path, content: bytes) -> None:
    for name in ("points.csv.gz", "points.csv"):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(PointsFileError, match=name):
            read_points(tmp_path / name)
    with pytest.raises(PointsFileError, match="cannot be read"):
        read_points(tmp_path / "absent.csv")


def record(point: int, tip: tuple[float, float, float] | None = (0.5, 0.0, 0.0)) -> Record:
    return Record("normal", str(point), 1, (0.1, point * 0.01), (1e-5, 2e-5), (1, -1), (0.2, 1.4), 8.0 * point, 0.0, tip)


def test_an_interrupted_session_goes_on_where_it_was(tmp_path: Path) -> None:
    path = tmp_path / "points.csv"
    with PointsWriter(path, 2) as writer:
        writer.append(record(1))
        writer.append(record(2, None))
    with PointsWriter(path, 2) as writer:
        assert writer.warnings == ()
        assert writer.recorded == {("normal", "1", 1), ("normal", "2", 1)}
        with pytest.raises(SessionError, match="recorded already"):
            writer.append(record(2))
        writer.append(record(3))
    points, warnings = read_points(path, 2)
    assert warnings == ()
    assert points.point == ("1", "2", "3")
    assert np.isnan(points.tip_m).any(axis=1).tolist() == [False, True, False]
    assert points.direction[0].tolist() == [1.0, -1.0]


def test_times_go_on_where_a_file_is_continued_by_a_runtime_whose_clock_began_anew(tmp_path: Path) -> None:
    path = tmp_path / "points.csv"
    for times_s in ((100.0, 130.0), (5.0, 25.0), (90.0, 95.0)):
        with PointsWriter(path, 2) as writer:
            for t_s in times_s:
                number = len(writer.recorded) + 1
                writer.append(dataclasses.replace(record(number), t_s=t_s))
    steps_s = np.diff(read_points(path, 2)[0].t_s)
    np.testing.assert_allclose(steps_s[[0, 2, 4]], [30.0, 20.0, 5.0])
    assert ((steps_s[[1, 3]] >= 0.0) & (steps_s[[1, 3]] < 60.0)).all(), "the pause between"


def test_a_line_torn_at_any_byte_is_dropped_with_a_warning(tmp_path: Path) -> None:
    path = tmp_path / "points.csv"
    with PointsWriter(path, 2) as writer:
        writer.append(record(1))
        whole = path.stat().st_size
        writer.append(record(2))
    content = path.read_bytes()
    for end in range(whole + 1, len(content)):
        path.write_bytes(content[:end])
        with PointsWriter(path, 2) as writer:
            assert writer.recorded == {("normal", "1", 1)}
            assert "dropped" in writer.warnings[0]
        assert path.read_bytes() == content[:whole]


def test_a_torn_header_is_written_again(tmp_path: Path) -> None:
    path = file_with(tmp_path, "setup,poi")
    with PointsWriter(path, 2) as writer:
        assert "dropped" in writer.warnings[0]
        writer.append(record(1))
    assert len(read_points(path)[0]) == 1


def test_what_was_acknowledged_survives_kill_9(tmp_path: Path) -> None:
    """The child says each point after append has returned, then is killed while it writes the next ones."""
    path = tmp_path / "points.csv"
    code = (
        "import itertools, sys; from pathlib import Path; from calib.points.writer import PointsWriter, Record\n"
        "writer = PointsWriter(Path(sys.argv[1]), 1)\n"
        "for k in itertools.count():\n"
        "    writer.append(Record('n', str(k), 1, (0.1,), (0.0,), (1,), (0.5,), 1.0, 0.0, None)); print(k, flush=True)\n"
    )
    with subprocess.Popen([sys.executable, "-c", code, str(path)], stdout=subprocess.PIPE, text=True) as child:
        assert child.stdout is not None
        said = [child.stdout.readline() for _ in range(20)]
        os.kill(child.pid, signal.SIGKILL)
        said += child.stdout.readlines()
    with PointsWriter(path, 1) as writer:
        assert {int(key[1]) for key in writer.recorded} >= {int(line) for line in said if line.endswith("\n")}


def test_a_file_of_another_arm_is_not_continued(tmp_path: Path) -> None:
    with PointsWriter(tmp_path / "points.csv", 3):
        pass
    with pytest.raises(SessionError, match="expected column dir1, got q3_rad"):
        PointsWriter(tmp_path / "points.csv", 2)
    with pytest.raises(SessionError, match="writes plain"):
        PointsWriter(tmp_path / "points.csv.gz", 2)
