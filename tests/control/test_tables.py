"""Rows of tables: whatever the file is, it is read in bounded memory or refused with its name."""

from __future__ import annotations

import gzip
import os
import tracemalloc
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from control.errors import ArmError
from control.files import TOML_MOST_characters, parsed_toml
from control.motion.waypoints import WAYPOINTS_MOST, read_waypoints
from control.tables import (
    CELL_MOST_lines,
    ColumnGroup,
    LINE_MOST_bytes,
    Rows,
    TableColumn,
    TableContent,
    TableFormat,
    documented,
    opened_rows,
    read_table,
)

ROOM_bytes = 24 << 20  # of a reader at its limits: a line, its text and its cells


def rows_of(path: Path, most: int = 1000) -> list[tuple[int, list[str]]]:
    with opened_rows(path, ArmError, most) as rows:
        return [(rows.line_num, row) for row in rows]


def refusal(path: Path, most: int = 10**9) -> str:
    """Why a file is refused; the memory that it took is within ROOM_bytes."""

    def spent(rows: Rows) -> None:
        for _ in rows:
            pass

    tracemalloc.start()
    try:
        with pytest.raises(ArmError) as error, opened_rows(path, ArmError, most) as rows:
            spent(rows)
        assert tracemalloc.get_traced_memory()[1] < ROOM_bytes
    finally:
        tracemalloc.stop()
    return str(error.value)


def packed(path: Path, parts: Iterable[bytes]) -> Path:
    with gzip.open(path, "wb", compresslevel=1) as file:
        for part in parts:
            file.write(part)
    return path


@pytest.mark.parametrize("name", ["a.csv", "a.csv.gz"])
@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
def test_rows_come_with_their_lines_whatever_ends_a_line(name: str, end: str, tmp_path: Path) -> None:
    text = f'a,b{end}1,"x, y"{end}{end}2,"two{end}lines"{end}3,é'.encode("utf-8-sig")
    path = tmp_path / name
    path.write_bytes(gzip.compress(text) if name.endswith("gz") else text)
    rows = rows_of(path)
    assert [row for _, row in rows if row] == [["a", "b"], ["1", "x, y"], ["2", f"two{end}lines"], ["3", "é"]]
    assert [line for line, row in rows if row] == [1, 2, 5, 6]


def test_a_small_packed_file_with_a_line_of_gigabytes_is_refused_in_the_memory_of_a_line(tmp_path: Path) -> None:
    path = packed(tmp_path / "log.csv.gz", [b"run,t_s\n1,", *(b"0" * (1 << 20),) * 200])
    assert path.stat().st_size < 1 << 20
    assert "line 2 has more than 1 MB" in refusal(path)


def test_a_sparse_file_is_refused_at_its_first_line(tmp_path: Path) -> None:
    path = tmp_path / "points.csv"
    with path.open("wb") as file:
        os.truncate(file.fileno(), 10 << 30)
    assert "line 1 has more than 1 MB" in refusal(path)


def test_a_packed_file_of_equal_rows_is_refused_for_what_it_unpacks_to(tmp_path: Path) -> None:
    path = packed(tmp_path / "log.csv.gz", [(b"0" * 8191 + b"\n") * 128] * 80)
    assert "more than 64 MB of text" in refusal(path)


def test_an_open_quote_and_too_many_rows_are_refused(tmp_path: Path) -> None:
    quoted, long = tmp_path / "quoted.csv", tmp_path / "long.csv"
    quoted.write_text('a\n"' + 'x","\n' * 1000)
    assert f"goes on over {CELL_MOST_lines} lines" in refusal(quoted)
    long.write_text("a\n" + "1\n" * 11)
    assert "more than 10 rows" in refusal(long, most=10)
    assert len(rows_of(long, most=11)) == 12
    at_the_limit = tmp_path / "line.csv"
    at_the_limit.write_text("1," * (LINE_MOST_bytes // 2 - 1) + "1\n1\n")
    assert len(rows_of(at_the_limit)) == 2


def test_more_way_points_than_can_be_planned_and_too_much_toml_are_refused_at_once(tmp_path: Path) -> None:
    path = tmp_path / "path.csv"
    path.write_text("x_m,y_m,z_m\n" + "0.3,0.1,0.3\n" * (WAYPOINTS_MOST + 1))
    with pytest.raises(ArmError, match=f"path.csv: more than {WAYPOINTS_MOST} way-points"):
        read_waypoints(path)
    with pytest.raises(ValueError, match=r"1.3 MB, expected at most 1 MB of TOML"):
        parsed_toml("k = 1\n" * (TOML_MOST_characters // 5))


FORM = TableFormat(
    "sample",
    (
        TableColumn("name", "what it is", is_required=True, is_name=True),
        TableColumn("q{}_rad", "angles", is_required=True),
        TableColumn("count", "how many", is_whole=True, lower=0.0, mistaken_for=("thousands", 1e3)),
        *(TableColumn(name, "where", upper=10.0, mistaken_for=("millimetres", 1e-3)) for name in ("x_m", "y_m")),
        TableColumn("mass_kg", may_be_empty=False),
    ),
    groups=(ColumnGroup(("x_m", "y_m")), ColumnGroup(("mass_kg",), beside=("x_m", "y_m"), since="it has a mass")),
    unwarned="remark",
)


def content(tmp_path: Path, text: str, form: TableFormat = FORM, joints: int | None = None) -> TableContent:
    path = tmp_path / "table.csv"
    path.write_text(text, encoding="utf-8")
    return read_table(path, form, ArmError, joints)


def test_a_declared_table_comes_by_its_columns_in_any_order_with_the_lines_of_its_rows(tmp_path: Path) -> None:
    table = content(tmp_path, "\nq2_rad, name ,q1_rad,remark,other\n2,a,1,x,y\n, ,\n\n4, b ,3,x,y\n")
    assert (len(table), table.joint_count) == (2, 2)
    assert table.words("name") == ["a", "b"]
    assert table.joints("q{}_rad").tolist() == [[1.0, 2.0], [3.0, 4.0]]
    assert np.isnan(table.numbers("x_m", "y_m")).all()
    assert "x_m" not in table
    assert table.place(1).endswith("table.csv, line 6")
    assert [warning.split(": ")[-1] for warning in table.warnings] == ["other"]


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "line 1: required column name is missing: the file is empty"),
        ("name,q1_deg\n", "line 1: required column q1_rad is missing, got q1_deg: write radians (column q1_rad)"),
        ("name;q1_rad;x_m\n", "line 1: the columns are separated by semicolons, expected commas"),
        ("name,q1_rad,name\n", "line 1: column name appears twice"),
        ("0.3,0,0.3\n", "line 1: expected a header with the names of the columns (`name`, `q1_rad` … `qn_rad`), got numbers"),
        ("name,q1_rad,q3_rad\n", "line 1: required column q2_rad is missing, got name, q1_rad, q3_rad"),
        ("name,q1_rad,x_m\n", "line 1: column y_m is missing beside x_m"),
        ("name,q1_rad,mass_kg\n", "line 1: columns x_m, y_m are missing beside mass_kg"),
        ("name,q1_rad\n", "table.csv: a header and no samples: expected one line per sample"),
        ("name,q1_rad\na\n", "line 2: 1 values, line 1 names 2"),
        ("name,q1_rad\n,1\n", "line 2, column name: got an empty cell, expected a name"),
        ("name,q1_rad\na,\n", "line 2, column q1_rad: got an empty cell, expected a finite number"),
        ("name,q1_rad\na,inf\n", 'line 2, column q1_rad: got "inf", expected a finite number'),
        ("name,q1_rad\n" + 300 * "a,1\n" + "a,b\n", 'line 302, column q1_rad: got "b", expected a finite number'),
        ("name,q1_rad,count\na,1,1.5\n", 'line 2, column count: got "1.5", expected a whole number'),
        ("name,q1_rad,count\na,1,-1\n", 'line 2, column count: got "-1", expected a whole number'),
        ("name,q1_rad,x_m,y_m\na,1,200,0\n", 'got "200", expected a finite number (millimetres? then write 0.2)'),
        ("name,q1_rad,x_m,y_m\na,1,,\na,1,0,\n", "line 3, column y_m: got an empty cell, expected a number, since"),
        ("name,q1_rad,x_m,y_m,mass_kg\na,1,,,3\n", "line 2, column x_m: got an empty cell, expected a number, since it has"),
    ],
)
def test_a_wrong_table_is_one_error_with_line_column_and_what_was_expected(tmp_path: Path, text: str, says: str) -> None:
    with pytest.raises(ArmError) as caught:
        content(tmp_path, text)
    assert says in str(caught.value)


def test_what_becomes_of_other_columns_and_of_uneven_lines_is_declared(tmp_path: Path) -> None:
    text = "name,q1_rad,remark\na,1,x\n"
    assert content(tmp_path, text, replace(FORM, unknown="kept")).words("remark") == ["x"]
    with pytest.raises(ArmError, match=r'expected columns name, q1_rad, .*, got "remark"'):
        content(tmp_path, text, replace(FORM, unknown="refused"))
    padded = content(tmp_path, "name,q1_rad,count\na,1\nb,2,3,4\n", replace(FORM, is_padded=True))
    assert padded.number("count").tolist()[1] == 3.0


def test_a_declaration_is_a_table_of_the_documents() -> None:
    assert documented(FORM).splitlines() == [
        "| column | required | meaning |",
        "| --- | --- | --- |",
        "| `name` | yes | what it is |",
        "| `q1_rad` … `qn_rad` | yes | angles |",
        "| `count` | | how many |",
        "| `x_m`, `y_m` | | where |",
        "| `mass_kg` | | |",
    ]
