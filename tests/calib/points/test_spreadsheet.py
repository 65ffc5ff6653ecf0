"""Tables of other programs: what header and cells tell is taken, what they do not tell is asked."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calib.errors import PointsFileError
from calib.points.points import Points
from calib.points.spreadsheet import Unclear, read_sheet, understood
from control.model.arm import Arm
from control.model.description import load_arm

RIGHT = load_arm("right")


def with_names(arm: Arm, names: list[str]) -> Arm:
    """The arm with names of its joints."""
    left = iter(names)
    return replace(
        arm, links=tuple(replace(link, joint_name=next(left)) if link.joint == "revolute" else link for link in arm.links)
    )


NO_ANGLES = ("mrad", "[mdeg]", "deg/s", "[rad / s]", "°/s")
NO_LENGTHS = ("[µm]", "\N{GREEK SMALL LETTER MU}m", "km", "mm/s")
GERMAN = "Stelle;Achse 1 [°];Achse 2 [°];Achse 3 [°];X [mm];Y [mm];Z [mm];Prüfer\n"


def points_of(path: Path, text: str, encoding: str = "utf-8", **given: str) -> Points:
    path.write_text(text, encoding=encoding)
    columns = {name: theirs for name, theirs in given.items() if name not in ("angles", "lengths")}
    return understood(read_sheet(path), RIGHT, columns, given.get("angles"), given.get("lengths")).points


def test_semicolons_decimal_commas_latin_1_degrees_and_millimetres_are_read(tmp_path: Path) -> None:
    text = GERMAN + "a;180,0;-90;0,5;1,5;250;-1e2;Böhm\na;0;0;0;0;0;0;\n"
    points = points_of(tmp_path / "t.csv", text, "latin-1")
    np.testing.assert_allclose(points.q_rad[0], np.radians([180.0, -90.0, 0.5]))
    np.testing.assert_allclose(points.tip_m[0], [1.5e-3, 0.25, -0.1])
    assert (points.point, points.repeat) == (("a", "a"), (1, 2))


def test_titles_above_the_header_are_passed_and_lines_are_counted_as_in_the_file(tmp_path: Path) -> None:
    titles = "Messprotokoll;;;;;;;\nDatum: 12.11.2026;;;;;;;\n\n"
    row = "a;180,0;-90;0,5;1,5;250;-1e2;\n"
    assert points_of(tmp_path / "t.csv", titles + GERMAN + row).point == ("a",)
    with pytest.raises(PointsFileError, match="line 7, column Achse 1"):
        points_of(tmp_path / "t.csv", titles + GERMAN + row + ";;;;;;;\n" + row.replace("180,0", "?"))


def test_commas_points_radians_and_names_with_units_are_read(tmp_path: Path) -> None:
    points = points_of(tmp_path / "t.csv", "q1_rad,q2_rad,q3_rad,tip x (m),tip y (m),tip z (m)\n1,2,3,0.1,0.2,0.3\n")
    np.testing.assert_allclose(points.q_rad, [[1.0, 2.0, 3.0]])
    np.testing.assert_allclose(points.tip_m, [[0.1, 0.2, 0.3]])


@pytest.mark.parametrize(
    "names",
    [
        "Winkel Achse 1 [°];Winkel Achse 2 [°];Winkel Achse 3 [°];Länge X (mm);Länge Y (mm);Höhe Z (mm)",
        "joint angle 1 deg;joint angle 2 deg;joint angle 3 deg;X mm;Y mm;Z mm;Force X;Force Y;Force Z",
        "q[1] deg;q[2] deg;q[3] deg;measured_x_mm;measured_y_mm;measured_z_mm;max mm",
        "base.pos deg;upper_arm.pos deg;forearm.pos deg;TCP.X mm;TCP.Y mm;TCP.Z mm",
    ],
)
def test_a_column_may_have_other_words_around_its_name_and_joints_the_arm_s_names(names: str, tmp_path: Path) -> None:
    arm = with_names(RIGHT, ["base", "upper_arm", "forearm"])
    (tmp_path / "t.csv").write_text(f"{names}\n{';'.join(map(str, range(1, 2 + names.count(';'))))}\n", encoding="utf-8")
    points = understood(read_sheet(tmp_path / "t.csv"), arm, {}, None, None).points
    np.testing.assert_allclose(points.q_rad[0], np.radians([1.0, 2.0, 3.0]))
    np.testing.assert_allclose(points.tip_m[0], [4e-3, 5e-3, 6e-3])


@pytest.mark.parametrize(
    ("header", "asks", "choices"),
    [
        *((f"q1 {unit};q2 {unit};q3 {unit};x mm;y mm;z mm", f"the unit of q1 {unit}", ("rad", "deg")) for unit in NO_ANGLES),
        *((f"q1 deg;q2 deg;q3 deg;x {unit};y {unit};z {unit}", f"the unit of x {unit}", ("m", "mm")) for unit in NO_LENGTHS),
        ("q1;q2;q3;x [mm];y [mm];z [mm]", "the unit of q1, q2, q3: answer with --angles", ("rad", "deg")),
        ("q1 deg;q2 deg;q3 deg;x;y;z", "the unit of x, y, z: answer with --lengths", ("m", "cm", "mm", "in")),
        ("q1 deg;q2 rad;q3 deg;x mm;y mm;z mm", "the unit of q1 deg, q2 rad, q3 deg", ("rad", "deg")),
        ("a deg;q2 deg;q3 deg;x mm;y mm;z mm", "which column is q1_rad: answer with --columns q1_rad=", ("a deg",)),
        ("q1 deg;q2 deg;q3 deg;x mm;y mm;z mm;x mm soll", "which column is x_m", ("x mm", "x mm soll")),
        ("q1 deg;q2 deg;q3 deg;set x mm;is x mm;y mm;z mm", "which column is x_m", ("set x mm", "is x mm")),
    ],
)
def test_what_a_header_does_not_tell_is_asked_with_what_it_may_be(
    header: str, asks: str, choices: tuple[str, ...], tmp_path: Path
) -> None:
    with pytest.raises(Unclear) as unclear:
        points_of(tmp_path / "t.csv", header + "\n" + ";".join("1" * (header.count(";") + 1)) + "\n")
    assert asks in str(unclear.value)
    assert set(choices) <= set(unclear.value.choices)


def test_a_unit_of_angles_that_cannot_be_is_asked_for_whoever_says_it(tmp_path: Path) -> None:
    said: dict[str, str]
    text = "q1 rad;q2 rad;q3 rad;x mm;y mm;z mm\n81;2;3;4;5;6\n"
    for said in ({}, {"angles": "rad"}):
        with pytest.raises(Unclear, match=r"read as rad: q1_rad reaches 81, more than three turns.*answer with --angles"):
            points_of(tmp_path / "t.csv", text, **said)
    assert points_of(tmp_path / "t.csv", text, angles="deg").q_rad[0, 0] == pytest.approx(np.radians(81))


def test_answers_are_taken_and_wrong_ones_refused(tmp_path: Path) -> None:
    text = "A\tq2\tq3\tx\ty\tz\n90\t0\t0\t1\t0\t0\n"
    points = points_of(tmp_path / "t.csv", text, q1_rad="A", angles="deg", lengths="cm")
    np.testing.assert_allclose((points.q_rad[0, 0], points.tip_m[0, 0]), (np.pi / 2, 0.01))
    with pytest.raises(PointsFileError, match='no column "B" for q1_rad; it has A, q2'):
        points_of(tmp_path / "t.csv", text, q1_rad="B")
    with pytest.raises(PointsFileError, match='line 2, column q2: got "zero", expected a number'):
        points_of(tmp_path / "t.csv", text.replace("\t0", "\tzero", 1), q1_rad="A", angles="deg", lengths="m")


ENGLISH = "q1 deg;q2 deg;q3 deg;x mm;y mm;z mm;point;repeat\n"


@pytest.mark.parametrize(
    ("row", "said"),
    [
        ("1,5;2;3;1.400;50;300;a;1", 'column x mm: got "1.400", expected a number with a decimal comma'),
        *(
            (f"1;2;3;{cell};50;300;a;1", f'column x mm: got "{cell}", expected a number')
            for cell in ("nan", "inf", "1e999", "4_0", "\u0664", "", "-")
        ),
        ("1;2;3;4;5;6;a;1.5", "column repeat: got 1.5, expected whole numbers"),
        ("1;2;3;4;5;6;a;nan", 'column repeat: got "nan", expected a number'),
        ("1;2;3;4;5;6;;1", "line 2, column point: got an empty cell, expected a name"),
        (f"1;2;3;4;5;{'6' * 200_000};a;1", "no table"),
    ],
)
def test_what_is_no_value_is_refused(row: str, said: str, tmp_path: Path) -> None:
    with pytest.raises(PointsFileError, match=said):
        points_of(tmp_path / "t.csv", f"{ENGLISH}{row}\n")


def test_an_answer_about_no_column_of_ours_is_refused(tmp_path: Path) -> None:
    with pytest.raises(PointsFileError, match="--columns tipx: expected one of q1_rad"):
        points_of(tmp_path / "t.csv", f"{ENGLISH}1;2;3;4;5;6;a;1\n", tipx="x mm")


def test_rows_with_the_same_angles_are_repeats_of_one_point_whatever_their_running_number(tmp_path: Path) -> None:
    text = GERMAN.replace("Stelle", "Punkt") + "1;1;2;3;4;5;6;\n2;7;8;9;4;5;6;\n3;1;2;3;4;5;7;\n"
    points = points_of(tmp_path / "t.csv", text)
    assert (points.point, points.repeat) == (("1", "2", "1"), (1, 1, 2))
    said = understood(read_sheet(tmp_path / "t.csv"), RIGHT, {}, None, None).in_words
    assert said[-1] == "rows with the angles of an earlier one: 1, taken as repeats of its point"


def test_a_unit_that_contradicts_the_header_is_noted(tmp_path: Path) -> None:
    (tmp_path / "t.csv").write_text(GERMAN + "a;1;2;3;4;5;6;\n", encoding="utf-8")
    sheet = read_sheet(tmp_path / "t.csv")
    assert (
        understood(sheet, RIGHT, {}, "rad", "mm").in_words[-1]
        == '--angles rad, although the header says deg ("Achse 1 [°]"): is that right?'
    )
    assert len(understood(sheet, RIGHT, {}, "deg", "mm").in_words) == 3
