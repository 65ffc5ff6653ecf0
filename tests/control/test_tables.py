"""Rows of tables: whatever the file is, it is read in bounded memory or refused with its name."""

from __future__ import annotations

import gzip
import os
import tracemalloc
from collections.abc import Iterable
from pathlib import Path

import pytest

from control.errors import ArmError
from control.files import TOML_MOST_characters, parsed_toml
from control.motion.waypoints import WAYPOINTS_MOST, read_waypoints
from control.tables import CELL_MOST_lines, LINE_MOST_bytes, Rows, opened_rows

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
    found = rows_of(path)
    assert [row for _, row in found if row] == [
        ["a", "b"],
        ["1", "x, y"],
        ["2", f"two{end}lines"],
        ["3", "é"],
    ]
    assert [line for line, row in found if row] == [1, 2, 5, 6]


def test_a_small_packed_file_with_a_line_of_gigabytes_is_refused_in_the_memory_of_a_line(
    tmp_path: Path,
) -> None:
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
    with pytest.raises(ArmError, match=f"path.csv: more than {WAYPOINTS_MOST} rows"):
        read_waypoints(path)
    with pytest.raises(ValueError, match=r"1.3 MB, expected at most 1 MB of TOML"):
        parsed_toml("k = 1\n" * (TOML_MOST_characters // 5))
