"""log.csv is read as the format says, and what is wrong with it is named with its line and column."""

from __future__ import annotations

import gzip
from pathlib import Path

import numpy as np
import pytest

from calib.gap.log import LogFileError, joined_logs, read_log

HEADER = "run,t_s,payload_kg,q1_set_rad,q2_set_rad,q1_rad,q2_rad,i1_A,i2_A,u1_V,u2_V,x_m,y_m,z_m,temperature"


def written(path: Path, rows: list[str], header: str = HEADER) -> Path:
    path.write_text("\n".join([header, *rows]) + "\n", encoding="utf-8")
    return path


def rows_of(run: int, payload: float = 0.0, shift: float = 0.0) -> list[str]:
    return [
        f"{run},{k * 0.002:.3f},{payload},{k * 0.001 + shift:.6f},0,{k * 0.001},0,0.1,0.2,1,2,0.5,0,0.1,21" for k in range(20)
    ]


def test_runs_columns_and_unknown_columns_are_kept(tmp_path: Path) -> None:
    log, warnings = read_log(written(tmp_path / "log.csv", [*rows_of(1), *rows_of(2, 0.5)]))
    assert [run.name for run in log.runs] == ["1", "2"]
    assert log.joint_count == 2
    assert log.runs[1].payload == 0.5
    np.testing.assert_allclose(log.runs[0].t_s, np.arange(20) * 0.002)
    assert log.runs[0].extra["temperature"] == ("21",) * 20
    assert "temperature" in warnings[0]
    assert not log.runs[0].q_rad.flags.writeable


def test_runs_with_the_same_set_points_and_payload_are_repeats(tmp_path: Path) -> None:
    rows = [*rows_of(1), *rows_of(2, 0.5), *rows_of(3), *rows_of(4, shift=0.01)]
    log, _ = read_log(written(tmp_path / "log.csv", rows))
    assert log.repeats() == ((0, 2), (1,), (3,))


def test_an_empty_voltage_is_a_driver_that_is_off_and_an_empty_tip_one_not_seen(tmp_path: Path) -> None:
    row = "1,{t},0,0,0,0,0,0.1,0.2,,,,,,20"
    log, _ = read_log(written(tmp_path / "log.csv", [row.format(t=k) for k in range(3)]))
    assert np.isnan(log.runs[0].voltage_V).all()
    assert np.isnan(log.runs[0].tip_m).all()


def test_a_gzipped_log_reads_the_same(tmp_path: Path) -> None:
    plain = written(tmp_path / "log.csv", rows_of(1))
    packed = tmp_path / "log.csv.gz"
    packed.write_bytes(gzip.compress(plain.read_bytes()))
    np.testing.assert_array_equal(read_log(plain)[0].runs[0].q_rad, read_log(packed)[0].runs[0].q_rad)


def test_files_are_joined_in_their_order(tmp_path: Path) -> None:
    one, _ = read_log(written(tmp_path / "a.csv", rows_of(1)))
    two, _ = read_log(written(tmp_path / "b.csv", rows_of(2)))
    assert [run.name for run in joined_logs((one, two)).runs] == ["1", "2"]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda rows: [rows[0], rows[0]], 'line 3, column t_s: got "0", expected a time after 0'),
        (lambda rows: [rows[0].replace("0.1,0.2", "0.1,x")], 'line 2, column i2_A: got "x", expected a finite number'),
        (lambda rows: [rows[0] + ",1"], "line 2: 16 values, line 1 names 15"),
        (
            lambda rows: [rows[0].replace(",0.5,0,0.1,21", ",0.5,,0.1,21")],
            "line 2, column y_m: got an empty cell, expected a number, since the rest of x_m to z_m is given",
        ),
        (lambda rows: [rows[0].replace("1,0.000,0.0", "1,0.000,-1")], 'column payload_kg: got "-1", expected a mass not below 0'),
        (lambda rows: [rows[0], "2" + rows[1][1:], rows[2]], 'line 4, column run: got "1", expected each run in one piece'),
        (lambda rows: ["," + rows[0].split(",", 1)[1]], "column run: got an empty cell, expected a name or number"),
        (lambda rows: [], "a header and no samples"),
    ],
)
def test_a_bad_row_is_named_with_its_line(tmp_path: Path, change: object, said: str) -> None:
    path = written(tmp_path / "log.csv", change(rows_of(1)))  # type: ignore[operator]
    with pytest.raises(LogFileError, match=r".*") as error:
        read_log(path)
    assert said in str(error.value)


@pytest.mark.parametrize(
    ("header", "said"),
    [
        ("run,t_s,q1_rad,q1_rad", "column q1_rad appears twice"),
        ("run,q1_rad", "required column t_s is missing"),
        ("run,t_s,q1_rad,q3_rad", "required column q2_rad is missing"),
        ("run,t_s,q1_rad,q2_rad,i1_A", "column i2_A is missing beside i1_A"),
        ("run,t_s,q1_rad,u1_V,u2_V", "column u2_V belongs to no joint"),
        ("run,t_s,q1_rad,x_m", "column y_m is missing beside x_m"),
    ],
)
def test_a_bad_header_is_named(tmp_path: Path, header: str, said: str) -> None:
    with pytest.raises(LogFileError) as error:
        read_log(written(tmp_path / "log.csv", [], header))
    assert said in str(error.value)


def test_another_arms_joint_count_is_refused(tmp_path: Path) -> None:
    with pytest.raises(LogFileError, match="joint angles of 2 joints, expected 3"):
        read_log(written(tmp_path / "log.csv", rows_of(1)), joint_count=3)


def test_a_file_that_is_not_there_is_said(tmp_path: Path) -> None:
    with pytest.raises(LogFileError, match="cannot be read"):
        read_log(tmp_path / "none.csv")
