"""`armwright export --lerobot`: the layout of LeRobot's datasets, version 3.0, and what the files say."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from console.lerobot_dataset import episodes_of, statistics
from console.main import main
from console.visualisation.reading import read_series
from control.model.description import arm_text, load_arm
from tests.recordings import MODES, write_recording

ARM = load_arm("right")
WITHOUT = "pyarrow (the extra `lerobot`, 55 MB) is not installed"
# of lerobot 0.4.4, lerobot.datasets: what each frame and each episode must have
OF_FRAMES = {"timestamp": "float", "frame_index": "int64", "episode_index": "int64", "index": "int64", "task_index": "int64"}
OF_EPISODES = {
    "episode_index",
    "tasks",
    "length",
    "dataset_from_index",
    "dataset_to_index",
    "data/chunk_index",
    "data/file_index",
    "meta/episodes/chunk_index",
    "meta/episodes/file_index",
}
OF_INFO = {
    "codebase_version",
    "robot_type",
    "total_episodes",
    "total_frames",
    "total_tasks",
    "chunks_size",
    "data_files_size_in_mb",
    "video_files_size_in_mb",
    "fps",
    "splits",
    "data_path",
    "video_path",
    "features",
}


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two motions, 60 and 90 cycles."""
    second = {k: {"run": 2} for k in range(70, 160)}
    folder = tmp_path_factory.mktemp("log")
    return write_recording(folder / "a.armlog", 160, 3, second, arm_toml=arm_text(ARM))


@pytest.fixture
def without_pyarrow(monkeypatch: pytest.MonkeyPatch) -> None:
    """Errors come before pyarrow is used."""
    monkeypatch.setitem(sys.modules, "pyarrow", SimpleNamespace())  # type: ignore[arg-type]


def export(*given: object) -> int:
    return main(["export", *map(str, given)])


def test_the_dataset_has_lerobots_layout_and_the_recordings_values(
    log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    parquet = pytest.importorskip("pyarrow.parquet", reason=WITHOUT)
    out = tmp_path / "new" / "dataset"
    assert export(log, log, "--lerobot", "--task", "draw a square", "--fps", 100, "--out", out) == 0
    assert f"{out}: 4 episodes, 60 frames at 100 Hz" in capsys.readouterr().out
    info = json.loads((out / "meta" / "info.json").read_text("utf-8"))
    assert set(info) == OF_INFO
    assert (info["codebase_version"], info["fps"], info["total_frames"]) == ("v3.0", 100, 60)
    assert info["splits"] == {"train": "0:4"}

    episodes = parquet.read_table(out / "meta" / "episodes" / "chunk-000" / "file-000.parquet").to_pylist()
    assert {name for name in episodes[0] if not name.startswith("stats/")} == OF_EPISODES
    wanted = [*episodes_of(read_series(log), 100)] * 2
    begin = 0
    for number, (about, episode) in enumerate(zip(episodes, wanted, strict=True)):
        file = info["data_path"].format(chunk_index=about["data/chunk_index"], file_index=about["data/file_index"])
        table = parquet.read_table(out / file)
        assert table.column_names == list(info["features"])
        for name, kind in OF_FRAMES.items():
            assert str(table.schema.field(name).type) == kind
        assert str(table.schema.field("action").type) == "fixed_size_list<element: float>[3]"
        frames: dict[str, Any] = {name: np.array(table[name].to_pylist()) for name in table.column_names}
        np.testing.assert_array_equal(frames["action"], episode.joint_set_rad.astype(np.float32))
        np.testing.assert_array_equal(frames["observation.state"], episode.joint_rad.astype(np.float32))
        np.testing.assert_array_equal(frames["observation.tip"], episode.tip_m.astype(np.float32))
        np.testing.assert_allclose(frames["timestamp"], np.arange(len(episode)) / 100, atol=1e-6)
        np.testing.assert_array_equal(frames["index"], begin + frames["frame_index"])
        assert set(frames["episode_index"]) == {about["episode_index"]} == {number}
        assert (about["dataset_from_index"], about["dataset_to_index"]) == (begin, begin + len(episode))
        assert about["stats/action/max"] == pytest.approx(frames["action"].max(axis=0).tolist())
        assert about["tasks"] == ["draw a square"]
        begin += about["length"]


def test_tasks_are_a_table_that_pandas_reads_with_the_task_as_index(log: Path, tmp_path: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet", reason=WITHOUT)
    assert export(log, "--lerobot", "--task", "draw", "--out", tmp_path / "d", "--json") == 0
    tasks = parquet.read_table(tmp_path / "d" / "meta" / "tasks.parquet")
    assert tasks.to_pylist() == [{"task_index": 0, "task": "draw"}]
    assert tasks.schema.pandas_metadata["index_columns"] == ["task"]
    about = json.loads((tmp_path / "d" / "meta" / "armwright.json").read_text("utf-8"))
    assert about["sources"] == ["a.armlog, run 1", "a.armlog, run 2"]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["d"]


def test_statistics_are_of_each_column() -> None:
    random = np.random.default_rng(2)
    values = random.normal([1.0, -2.0], [0.1, 3.0], size=(20000, 2))
    figures = statistics({"action": values, "index": np.arange(20000)})
    assert set(figures["action"]) == {"min", "max", "mean", "std", "count", "q01", "q10", "q50", "q90", "q99"}
    np.testing.assert_allclose(figures["action"]["std"], [0.1, 3.0], rtol=0.02)
    np.testing.assert_allclose(figures["action"]["q90"], [1.0 + 1.2816 * 0.1, -2.0 + 1.2816 * 3.0], rtol=0.02)
    assert figures["index"]["count"] == [20000]
    assert figures["index"]["max"] == [19999.0]


@pytest.mark.usefixtures("without_pyarrow")
@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--lerobot"], "say in words what the arm does"),
        (["--lerobot", "--task", "  "], "say in words what the arm does"),
        (["--lerobot", "--task", "t", "--fps", "0"], "--fps: expected 1 or more samples per second, got 0"),
        (["--lerobot", "--task", "t", "--fps", "600"], "expected at most the recorded 500 Hz, got 600"),
        (["--lerobot", "--task", "t", "--every", "2"], "not together with --every"),
        (["--lerobot", "--task", "t", "--arm", "left6"], "left6"),
        (["--lerobot", "--task", "t", "--out", "."], ". exists already"),
        (["none.armlog", "--lerobot", "--task", "t"], "no such recording"),
        (["--fps", "50"], "give --lerobot too"),
        (["a.armlog"], "expected one recording, got 2"),
    ],
)
def test_a_bad_option_is_one_message_and_writes_nothing(
    log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], options: list[str], said: str
) -> None:
    monkeypatch.chdir(tmp_path)
    files = [one for one in options if one.endswith(".armlog")]
    assert export(log, *files, "--out", "out", *options[len(files) :]) == 2
    assert said in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


@pytest.mark.usefixtures("without_pyarrow")
def test_recordings_without_a_motion_and_of_several_arms_are_one_message(
    log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    held = {k: {"mode": MODES.index("HOLDING")} for k in range(30)}
    still = write_recording(tmp_path / "still.armlog", 30, 3, held, arm_toml=arm_text(ARM))
    second = write_recording(tmp_path / "left.armlog", 30, 3, arm_toml=arm_text(load_arm("left")))
    rest = ["--lerobot", "--task", "t", "--out", tmp_path / "d"]
    assert export(still, *rest) == 2
    assert "the recordings hold no motion" in capsys.readouterr().err
    assert export(log, second, *rest) == 2
    assert "expected one arm, got right (a.armlog, run 1) and left (left.armlog, run 1)" in capsys.readouterr().err
    assert not (tmp_path / "d").exists()


def test_without_pyarrow_its_installation_is_named(
    log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    assert export(log, "--lerobot", "--task", "t", "--out", tmp_path / "d") == 2
    assert ".venv/bin/pip install -e '.[lerobot]'" in capsys.readouterr().err
