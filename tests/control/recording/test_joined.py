"""Recordings of two arms of a cell as one table."""

from __future__ import annotations

import csv
import gzip
import json
import os
from pathlib import Path

import numpy as np
import pytest

from console.main import main
from console.visualisation.reading import read_log
from control.model.description import load_arm
from control.recording.cell_folder import join, new_folder, recordings_in
from control.recording.reading import RecordError, Recording
from control.recording.writer import Policy, remove_oldest
from tests.recordings import BOOTED_s, PERIOD_s, write_recording

AT_REST = {"orientation": (1.0, 0.0, 0.0, 0.0)}
CELL = {"name": "pair", "bases": {"left": {"origin_m": (0, 0.25, 0), **AT_REST}, "right": {"origin_m": (0, -0.25, 0), **AT_REST}}}


def both(folder: Path, **of_right: object) -> Path:
    """Left: cycles 0 to 19 without 7. Right: cycles 3 to 22."""
    left = {k: {"cycle": k + (k >= 7)} for k in range(19)}
    left = {k: {**row, "t_s": BOOTED_s + PERIOD_s * row["cycle"]} for k, row in left.items()}
    right = {k: {"cycle": k + 3, "t_s": BOOTED_s + PERIOD_s * (k + 3)} for k in range(20)}
    write_recording(folder / "a-right.armlog", 20, changes=right, **{"arm": "right", "cell": CELL, **of_right})
    write_recording(folder / "b-left.armlog", 19, changes=left, arm="left", cell=CELL)
    return folder


def test_rows_of_one_cycle_stand_in_one_row_with_the_arms_names_before_the_columns(tmp_path: Path) -> None:
    assert join(recordings_in(both(tmp_path)), tmp_path / "cell.csv.gz") == 16
    with gzip.open(tmp_path / "cell.csv.gz", "rt") as file:
        rows = list(csv.DictReader(file))
    assert [int(row["cycle"]) for row in rows] == [3, 4, 5, 6, *range(8, 20)]
    first = rows[0]
    assert float(first["t_s"]) == pytest.approx(BOOTED_s + 3 * PERIOD_s)
    # By formula, the right arm's first row is that of its cycle 0.
    assert float(first["right.q2_rad"]) == pytest.approx(-0.002)
    assert float(first["left.q2_rad"]) != pytest.approx(-0.002)
    assert "right.mode" in first


def test_one_mcap_file_has_the_arms_names_before_topics_and_frames_on_one_clock(tmp_path: Path) -> None:
    from mcap.reader import make_reader

    assert main(["export", str(both(tmp_path)), "--out", str(tmp_path / "out")]) == 0
    times: dict[str, list[float]] = {}
    frames, parents = set(), {}
    with (tmp_path / "out" / "cell.mcap").open("rb") as file:
        reader = make_reader(file)
        for _, channel, message in reader.iter_messages():
            content = json.loads(message.data)
            if channel.topic.endswith("/loop"):
                times.setdefault(channel.topic, []).append(message.log_time * 1e-9 - content["t_s"])
            for one in content.get("transforms", ()):
                parents[one["child_frame_id"]] = one["parent_frame_id"], one["translation"]["y"]
            frames |= {one["frame_id"] for one in content.get("entities", ())}
        attached = {one.name for one in reader.iter_attachments()}
    assert {*times} == {"/left/loop", "/right/loop"}
    assert np.ptp([offset for of_arm in times.values() for offset in of_arm]) < 1e-6
    assert parents["left/base"] == ("cell", 0.25)
    assert parents["right/base"] == ("cell", -0.25)
    assert parents["right/measured/link1"][0] == "right/base"
    assert all(frame.split("/")[0] in ("left", "right") for frame in frames)
    assert attached == {"left.arm.toml", "right.arm.toml"}


def test_a_recording_whose_first_file_was_removed_begins_with_its_next(tmp_path: Path) -> None:
    for file in both(tmp_path).glob("b-left*"):
        file.rename(tmp_path / "b-left.part3.armlog")
    assert [one.header["arm"] for one in recordings_in(tmp_path)] == ["left", "right"]


def test_every_second_row_is_half_of_them(tmp_path: Path) -> None:
    assert join(recordings_in(both(tmp_path)), tmp_path / "cell.csv", every=2) == 8


@pytest.mark.parametrize(
    ("of_right", "said"),
    [
        ({"arm": "left"}, "expected another arm, got 'left' again"),
        ({"cell": {"name": "trio"}}, "expected arms of one cell, got those of pair, trio"),
    ],
)
def test_recordings_that_do_not_belong_together_are_refused(tmp_path: Path, of_right: dict[str, object], said: str) -> None:
    with pytest.raises(RecordError, match=said):
        recordings_in(both(tmp_path, **of_right))


def test_recordings_of_other_runs_and_of_an_arm_alone_are_refused(tmp_path: Path) -> None:
    left = recordings_in(both(tmp_path))[0]
    (tmp_path / "other").mkdir()
    later = write_recording(tmp_path / "other" / "later.armlog", 5, changes={0: {"cycle": 4, "t_s": 9.0}}, arm="right", cell=CELL)
    with pytest.raises(RecordError, match=r"cycle 4 was at 9\.000 s, and that of .* they are not of one run"):
        join([left, Recording.open(later)], tmp_path / "cell.csv")
    write_recording(tmp_path / "other" / "alone.armlog", 5)
    with pytest.raises(RecordError, match="got that of arm 'right' alone; give the file"):
        recordings_in(tmp_path / "other")
    (tmp_path / "none").mkdir()
    with pytest.raises(RecordError, match="a folder without recordings"):
        recordings_in(tmp_path / "none")


def test_the_oldest_files_of_an_arm_go_first_in_all_runs_of_its_cell(tmp_path: Path) -> None:
    def run(name: str, arms: tuple[str, ...]) -> list[Path]:
        folder = new_folder(tmp_path, "pair", name)
        files = [folder / f"{arm}-{name}.armlog" for arm in arms]
        for file in files:
            file.write_bytes(bytes(100))
            os.utime(file, ns=(0, int(name[-1])))
        return files

    (old,) = run("20261123-000001", ("left",))
    _, beside = run("20261123-000002", ("left", "right"))
    now, _ = run("20261123-000003", ("left", "right"))
    remove_oldest(now, Policy(rotate_bytes=100, keep_bytes=200), lambda text: None)
    assert not old.parent.exists()
    assert beside.exists()
    assert now.exists()


def test_the_series_of_a_cell_has_the_joints_of_all_arms_at_the_cycles_that_all_have(tmp_path: Path) -> None:
    series = read_log(both(tmp_path))
    assert len(series) == 16
    assert series.joint_count == 6
    assert [series.joint_name(joint) for joint in (1, 4)] == ["left 1", "right 1"]
    assert series.cell is not None
    assert series.cell.placed("right").origin_m == (0, -0.25, 0)
    np.testing.assert_allclose(np.diff(series.t_s), PERIOD_s * np.diff([3, 4, 5, 6, *range(8, 20)]), atol=1e-6)
    with pytest.raises(RecordError, match="--arm: not for"):
        read_log(tmp_path, load_arm("right"))
