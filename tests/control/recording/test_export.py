"""A recording as log.csv.gz and MCAP: the columns of the formats, runs from zero, the recording's numbers, no overwriting."""

from __future__ import annotations

import csv
import gzip
import json
import math
from pathlib import Path
from typing import Any

import pytest

from console.main import main
from control.recording.export import export, to_csv, to_mcap
from control.recording.reading import RecordError, Recording
from control.recording.record import FileSink, Layout
from control.safety.modes import Mode
from hil_mocks.scenario import CameraTable
from tests.cell import FRICTION, RIGHT, holding_cell, run_numbers, scenario
from tests.recordings import write_recording

UPRIGHT = RIGHT.rest.q_rad if RIGHT.rest else (0.0, 0.0, 0.0)
STARTED_s = 1_700_000_000.5


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two moves, and guiding by hand, of an upright arm."""
    path = tmp_path_factory.mktemp("log") / "run.armlog"
    sink = FileSink(path, Layout.of(3).header({"arm": "right", "started_unix_s": STARTED_s, "period_s": 0.002}))
    with holding_cell(scenario(UPRIGHT, effect=FRICTION, camera=CameraTable(rate_Hz=100.0)), sink=sink) as cell:
        cell.client.move_joints((0.1, 0.15, 0.75))
        cell.client.ask("payload", mass_kg=0.25)
        cell.client.move_joints((0.0, 0.15, 0.75))
        x, y, z = cell.rig.tip_m()
        cell.rig.hand.seat((x, y, z))
        cell.client.guide()
        cell.run(0.05)
    sink.close()
    return path


def rows_of(path: Path) -> list[dict[str, str]]:
    with gzip.open(path, "rt", newline="") as file:
        return list(csv.DictReader(file))


@pytest.fixture
def rows(recording: Path, tmp_path: Path) -> list[dict[str, str]]:
    to_csv(Recording.open(recording), tmp_path / "log.csv.gz")
    return rows_of(tmp_path / "log.csv.gz")


def test_the_columns_are_those_of_log_csv_in_si_units(rows: list[dict[str, str]]) -> None:
    names = list(rows[0])
    assert names[:2] == ["run", "t_s"]
    for kind in ("q{}_rad", "q{}_set_rad", "i{}_A", "u{}_V"):
        assert {kind.format(joint) for joint in (1, 2, 3)} <= set(names)
    assert {"payload_kg", "x_m", "y_m", "z_m"} <= set(names)


def test_only_runs_are_exported_and_each_begins_at_zero(rows: list[dict[str, str]], recording: Path) -> None:
    opened = Recording.open(recording)
    run_at = opened.layout.names.index("run")
    assert run_numbers(rows) == ["1", "2", "3"]
    assert len(rows) == sum(row[run_at] >= 1 for row in opened.rows()) < sum(1 for _ in opened.rows())
    for run in ("1", "2", "3"):
        times = [float(row["t_s"]) for row in rows if row["run"] == run]
        assert times[0] == 0.0
        assert times == sorted(times)
        assert times[10] == pytest.approx(0.02, abs=1e-6)


def test_open_circuits_and_absent_camera_frames_are_empty_cells(rows: list[dict[str, str]]) -> None:
    guiding = str(list(Mode).index(Mode.GUIDING))
    assert {row["u2_V"] == "" for row in rows if row["mode"] == guiding} == {True}
    assert {row["u2_V"] == "" for row in rows if row["mode"] != guiding} == {False}
    seen = [row for row in rows if row["x_m"]]
    assert len(seen) == pytest.approx(len(rows) / 5, rel=0.1)  # 100 Hz of 500
    assert all(row["y_m"] and row["z_m"] for row in seen)
    assert not any("nan" in cell.lower() for row in rows for cell in row.values())


def test_the_payload_stands_in_each_row(rows: list[dict[str, str]]) -> None:
    assert {row["payload_kg"] for row in rows if row["run"] == "1"} >= {"0"}
    assert {row["payload_kg"] for row in rows if row["run"] == "2"} == {"0.25"}


def test_the_numbers_are_those_of_the_recording(rows: list[dict[str, str]], recording: Path) -> None:
    opened = Recording.open(recording)
    named = [dict(zip(opened.layout.names, row, strict=True)) for row in opened.rows()]
    runs = [row for row in named if row["run"] >= 1]
    for got, expected in zip(rows, runs, strict=True):
        for name in ("q1_rad", "q3_set_rad", "i2_A", "cycle"):
            assert float(got[name]) == pytest.approx(expected[name], rel=1e-8, abs=1e-12)


def test_the_same_recording_gives_the_same_bytes(recording: Path, tmp_path: Path) -> None:
    for name in ("a", "b"):
        export(recording, tmp_path / name)
    for file in ("log.csv.gz", "log.mcap"):
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes()


@pytest.mark.parametrize("every", [2, 7])
def test_every_kth_cycle_of_each_run_is_kept(recording: Path, tmp_path: Path, every: int) -> None:
    to_csv(Recording.open(recording), tmp_path / "all.csv.gz")
    to_csv(Recording.open(recording), tmp_path / "some.csv.gz", every)
    whole = rows_of(tmp_path / "all.csv.gz")
    expected = [row for run in "123" for row in [r for r in whole if r["run"] == run][::every]]
    assert rows_of(tmp_path / "some.csv.gz") == expected


def messages(path: Path) -> dict[str, list[tuple[int, Any]]]:
    """What mcap's own reader finds: topic -> (time, message)."""
    from mcap.reader import make_reader

    found: dict[str, list[tuple[int, Any]]] = {}
    with path.open("rb") as file:
        for _, channel, message in make_reader(file).iter_messages():
            found.setdefault(channel.topic, []).append((message.log_time, json.loads(message.data)))
    return found


def test_mcap_holds_the_same_numbers_at_their_times(recording: Path, tmp_path: Path) -> None:
    opened = Recording.open(recording)
    cycles = to_mcap(opened, tmp_path / "log.mcap")
    lines = messages(tmp_path / "log.mcap")
    named = [dict(zip(opened.layout.names, row, strict=True)) for row in opened.rows()]
    assert cycles == len(named) == len(lines["/joints"]) == len(lines["/drives"])
    for (time_ns, joints), row in zip(lines["/joints"], named, strict=True):
        for name in ("q1_rad", "q2_rad", "q3_rad", "speed1_rad_s", "speed3_rad_s", "count2"):
            assert joints[name] == row[name]
        assert time_ns == pytest.approx(1e9 * (STARTED_s + row["t_s"] - named[0]["t_s"]), abs=2000)
    seen = [row for row in named if not math.isnan(row["x_m"])]
    assert [tip["z_m"] for _, tip in lines["/camera"]] == [row["z_m"] for row in seen]


def test_nothing_is_overwritten(recording: Path, tmp_path: Path) -> None:
    export(recording, tmp_path)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    with pytest.raises(RecordError, match="already exists: choose another folder"):
        export(recording, tmp_path)
    (tmp_path / "log.csv.gz").unlink()
    with pytest.raises(RecordError, match=r"log\.mcap already exists"):
        export(recording, tmp_path)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == {"log.mcap": before["log.mcap"]}


def test_an_interrupted_export_leaves_nothing_that_looks_complete(recording: Path, tmp_path: Path) -> None:
    def interrupted(done: float) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        export(recording, tmp_path, report=interrupted)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("every", [0, -3])
def test_every_0th_cycle_is_refused(recording: Path, tmp_path: Path, every: int) -> None:
    with pytest.raises(RecordError, match="expected a cycle count"):
        export(recording, tmp_path, every)
    assert list(tmp_path.iterdir()) == []


def test_a_table_without_a_row_is_explained(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    still = write_recording(tmp_path / "still.armlog", 9)  # the first motion begins with the tenth cycle
    assert main(["export", str(still), "--out", str(tmp_path / "x")]) == 0
    printed = capsys.readouterr()
    assert "log.csv.gz: 0 cycles" in printed.out
    assert "log.csv.gz is empty: it begins with the first motion, and nothing moved" in printed.err
    assert "log.mcap is" not in printed.err


def test_the_command_says_what_it_wrote(recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["export", str(recording), "--out", str(tmp_path / "x"), "--every", "10"]) == 0
    said = capsys.readouterr().out
    assert "log.csv.gz: " in said
    assert "log.csv.gz holds the motions alone, log.mcap what came before the first one, too" in said
    assert main(["export", str(recording), "--out", str(tmp_path / "x")]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert main(["export", str(tmp_path / "none.armlog"), "--out", str(tmp_path / "y")]) == 2
    assert "no such recording" in capsys.readouterr().err
