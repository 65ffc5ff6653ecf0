"""Way-point files: strict, with hints for the usual mistakes, and every error names file and line."""

import pytest

from control.errors import PathError, WaypointFileError
from control.model.description import load_arm
from control.motion.plan import plan_path
from control.motion.waypoints import read_waypoints


def _file(tmp_path, text):
    path = tmp_path / "path.csv"
    path.write_text(text, encoding="utf-8")
    return path


def test_points_speeds_and_lines_are_read(tmp_path):
    path = _file(tmp_path, "x_m,y_m,z_m,speed_m_s\n0.5,0,0.1,0.2\n\n0.6, 0.1 ,1e-1,0\n")
    waypoints = read_waypoints(path)
    assert waypoints.points == ((0.5, 0.0, 0.1), (0.6, 0.1, 0.1))
    assert waypoints.speeds_m_s == (0.2, 0.0)
    assert waypoints.places == (f"{path}, line 2", f"{path}, line 4")
    assert waypoints.name(2) == f"way-point 2 ({path}, line 4)"


def test_a_path_that_cannot_be_timed_names_the_line(tmp_path):
    path = _file(tmp_path, "x_m,y_m,z_m\n0.5,0,0.1\n\n0.5,0,0.1\n0.5,0.1,0.1\n")
    with pytest.raises(PathError, match=r"path.csv, line 4: way-points 1 and 2 are the same point") as error:
        plan_path(load_arm("right"), read_waypoints(path))
    assert error.value.waypoint == 2


def test_columns_may_come_in_any_order_and_without_speeds(tmp_path):
    waypoints = read_waypoints(_file(tmp_path, "z_m,x_m,y_m\n3,1,2\n6,4,5\n"))
    assert waypoints.points == ((1.0, 2.0, 3.0), (4.0, 5.0, 6.0))
    assert waypoints.speeds_m_s is None


@pytest.mark.parametrize(
    ("text", "pattern"),
    [
        ("", "column x_m is missing: the file is empty"),
        ("x_m,y_m,z_m\n", "a header and no way-points: expected one line per way-point"),
        ("x_m,y_m,z_m\n1,2,3\n", "at least two way-points, got 1"),
        ("x_m,y_m\n1,2\n1,2\n", "csv, line 1: required column z_m is missing, got x_m, y_m"),
        ("x_m,y_m,z_m,color\n", 'csv, line 1: expected columns .* got "color"'),
        ("x_mm,y_mm,z_mm\n", r"column x_m is missing, got x_mm: write metres"),
        ("x_m,y_m,z_m,x_m\n", "column x_m appears twice"),
        ("0.5,0.1,0.2\n0.5,0.1,0.2\n", r"csv, line 1: expected a header .* \(`x_m`, `y_m`, `z_m`\), got numbers"),
        ("x_m,y_m,z_m\n1,2\n1,2,3\n", "csv, line 2: 2 values, line 1 names 3"),
        ("x_m,y_m,z_m\n1,2,3\n1,2,three\n", 'csv, line 3, column z_m: got "three", expected a number from -10 to 10 m'),
        ("x_m,y_m,z_m\n1,2,3\n1,2,\n", "csv, line 3, column z_m: got an empty cell, expected a number"),
        ("x_m,y_m,z_m\n1,2,3\n1,2,nan\n", 'csv, line 3, column z_m: got "nan", expected a number'),
        ("x_m,y_m,z_m\n500,2,3\n1,2,3\n", r'csv, line 2, column x_m: got "500", .*10 m \(millimetres\? then write 0.5\)'),
        ("x_m,y_m,z_m\n1,2,3\n1,-90,3\n", r'csv, line 3, column y_m: got "-90", .* \(millimetres\? then write -0.09\)'),
        (
            "x_m,y_m,z_m,speed_m_s\n1,2,3,150\n1,2,4,1\n",
            r'csv, line 2, column speed_m_s: got "150", .* \(mm/s\? then write 0.15\)',
        ),
        (
            "x_m,y_m,z_m,speed_m_s\n1,2,3,-1\n1,2,4,1\n",
            'csv, line 2, column speed_m_s: got "-1", expected a number from 0 to 10 m/s$',
        ),
    ],
)
def test_every_mistake_is_one_error_with_file_line_and_remedy(tmp_path, text, pattern):
    with pytest.raises(WaypointFileError, match=pattern) as caught:
        read_waypoints(_file(tmp_path, text))
    assert "path.csv" in str(caught.value)


def test_a_file_that_is_not_there_or_no_text_is_refused(tmp_path):
    with pytest.raises(WaypointFileError, match="No such file"):
        read_waypoints(tmp_path / "none.csv")
    (tmp_path / "binary.csv").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(WaypointFileError, match="not UTF-8"):
        read_waypoints(tmp_path / "binary.csv")


def test_numbers_at_the_bounds_of_what_is_plausible_pass(tmp_path):
    waypoints = read_waypoints(_file(tmp_path, "x_m,y_m,z_m,speed_m_s\n10,-10,0,10\n0,0,0,0\n"))
    assert waypoints.points[0] == (10.0, -10.0, 0.0)
