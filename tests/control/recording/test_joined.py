"""Recordings of two arms of a cell as one table."""

from __future__ import annotations

import csv
import gzip
from pathlib import Path

import pytest

from control.recording.joined import join
from control.recording.reading import RecordError
from tests.recordings import BOOTED_s, PERIOD_s, write_recording

CELL = {"name": "pair"}


def both(folder: Path, **of_right: object) -> list[Path]:
    """Left: cycles 0 to 19 without 7. Right: cycles 3 to 22."""
    left = {k: {"cycle": k + (k >= 7)} for k in range(19)}
    left = {k: {**row, "t_s": BOOTED_s + PERIOD_s * row["cycle"]} for k, row in left.items()}
    right = {k: {"cycle": k + 3, "t_s": BOOTED_s + PERIOD_s * (k + 3)} for k in range(20)}
    return [
        write_recording(folder / "l.armlog", 19, changes=left, arm="left", cell=CELL),
        write_recording(folder / "r.armlog", 20, changes=right, **{"arm": "right", "cell": CELL, **of_right}),
    ]


def test_rows_of_one_cycle_stand_in_one_row_with_the_arms_names_before_the_columns(tmp_path: Path) -> None:
    assert join(both(tmp_path), tmp_path / "cell.csv.gz") == 16
    with gzip.open(tmp_path / "cell.csv.gz", "rt") as file:
        rows = list(csv.DictReader(file))
    assert [int(row["cycle"]) for row in rows] == [3, 4, 5, 6, *range(8, 20)]
    first = rows[0]
    assert float(first["t_s"]) == pytest.approx(BOOTED_s + 3 * PERIOD_s)
    # By formula, the right arm's first row is that of its cycle 0.
    assert float(first["right.q2_rad"]) == pytest.approx(-0.002)
    assert float(first["left.q2_rad"]) != pytest.approx(-0.002)
    assert "right.mode" in first


def test_every_second_row_is_half_of_them(tmp_path: Path) -> None:
    assert join(both(tmp_path), tmp_path / "cell.csv", every=2) == 8


@pytest.mark.parametrize(
    ("of_right", "said"),
    [
        ({"arm": "left"}, "expected another arm, got 'left' again"),
        ({"cell": {"name": "trio"}}, "expected arms of one cell, got those of pair, trio"),
    ],
)
def test_recordings_that_do_not_belong_together_are_refused(
    tmp_path: Path, of_right: dict[str, object], said: str
) -> None:
    with pytest.raises(RecordError, match=said):
        join(both(tmp_path, **of_right), tmp_path / "cell.csv")


def test_recordings_of_other_runs_and_of_an_arm_alone_are_refused(tmp_path: Path) -> None:
    left, right = both(tmp_path)
    later = write_recording(
        tmp_path / "later.armlog", 5, changes={0: {"cycle": 4, "t_s": 9.0}}, arm="right", cell=CELL
    )
    with pytest.raises(RecordError, match=r"cycle 4 was at 9\.000 s, and that of .* they are not of one run"):
        join([left, later], tmp_path / "cell.csv")
    alone = write_recording(tmp_path / "alone.armlog", 5)
    with pytest.raises(
        RecordError, match="expected the recording of an arm of a cell, got that of arm 'right' alone"
    ):
        join([right, alone], tmp_path / "cell.csv")
