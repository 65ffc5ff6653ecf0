"""Recordings as LeRobot's data sets: each motion an episode at a steady rate, without gaps, as learning wants it."""

from __future__ import annotations

import importlib
import json
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from console.visualisation.series import Array, Series
from control.errors import ArmError
from control.files import make_whole_folder, write_whole
from control.kinematics.kinematics import ForwardKinematics
from control.model.arm import Arm
from control.model.description import arm_text

MOTION_MODES: Final = ("MOVING", "JOGGING", "STOPPING", "PAUSED")  # set-points that somebody asked for


@dataclass(frozen=True, slots=True)
class Episode:
    """One motion, m samples of n joints, all finite.

    joint_rad, joint_set_rad, current_A (m, n); tip_m (m, 3) in the base frame by the model, of joint_rad. `source`: recording
    and run.
    """

    arm: Arm
    source: str
    joint_rad: Array
    joint_set_rad: Array
    current_A: Array
    tip_m: Array

    def __len__(self) -> int:
        """Number of samples."""
        return len(self.joint_rad)


def episodes_of(series: Series, rate_Hz: int) -> Iterator[Episode]:
    """Every run with a motion, from its begin to its end; where values are missing, the last ones are held.

    ArmError if the arm is unknown, or the recording is slower than `rate_Hz`.
    """
    if series.arm is None:
        raise ArmError(f"{series.name}: its arm is unknown: give it with --arm")
    if len(series) > 1 and rate_Hz * series.period_s > 1.0 + 1e-6:
        raise ArmError(f"{series.name}: --fps: expected at most the recorded {1.0 / series.period_s:.6g} Hz, got {rate_Hz}")
    kinematics = ForwardKinematics(series.arm)
    groups = (series.joint_rad, series.joint_set_rad, series.current_A)
    is_whole = np.logical_and.reduce([np.isfinite(group).all(axis=1) for group in groups])
    is_moving = _is_moving(series)
    for number in np.unique(series.run[is_moving & is_whole]):
        of_run = series.run == number
        first, last = np.flatnonzero(of_run & is_moving)[[0, -1]]
        span = (np.arange(len(series)) >= first) & (np.arange(len(series)) <= last)
        rows = _held(series.t_s, np.flatnonzero(of_run & is_whole & span), 1.0 / rate_Hz)
        joint_rad = series.joint_rad[rows]
        yield Episode(
            series.arm,
            f"{series.name}, run {series.runs[number]}",
            joint_rad,
            series.joint_set_rad[rows],
            series.current_A[rows],
            kinematics.tips(joint_rad),
        )


def _is_moving(series: Series) -> NDArray[np.bool_]:
    """Samples (m,) in a motion; where no modes were recorded, all."""
    moving = [number for number, name in enumerate(series.modes) if name in MOTION_MODES]
    return np.isin(series.mode, moving) | (series.mode < 0)


def _held(t_s: Array, rows: NDArray[np.int64], period_s: float) -> NDArray[np.int64]:
    """For times `period_s` apart, from that of the first row: the last of the rows until then."""
    times_s = t_s[rows]
    steps = int((times_s[-1] - times_s[0]) / period_s + 1e-6) + 1
    wanted_s = times_s[0] + period_s * np.arange(steps)
    # a cycle begins some microseconds early or late: half a cycle decides which one is meant
    slack_s = 0.5 * float(np.median(np.diff(times_s))) if len(rows) > 1 else 0.0
    found: NDArray[np.int64] = rows[np.searchsorted(times_s, wanted_s + slack_s, side="right") - 1]
    return found


# Writes episodes as a LeRobot dataset, version 3.0 of its format. An extra: pyarrow is 55 MB.
#
#     meta/info.json                              features with type, shape, names; rate; totals; where files are
#     meta/stats.json                             of each feature over all frames: min, max, mean, std, count, quantiles
#     meta/tasks.parquet                          task_index by task, with the task as pandas' index
#     meta/episodes/chunk-000/file-000.parquet    of each episode: length, frames from and to, its file, its statistics
#     data/chunk-000/file-000.parquet             the frames, one file an episode here
#     meta/armwright.json                         ours: where each episode comes from, and the arm.toml
#
# Source: github.com/huggingface/lerobot, version 0.4.4, lerobot.datasets (CODEBASE_VERSION v3.0).


VERSION: Final = "v3.0"
FILES_PER_CHUNK: Final = 1000  # these three: LeRobot's defaults
DATA_FILE_MB, VIDEO_FILE_MB = 100, 200
FILE: Final = "chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
QUANTILES: Final = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}
Frames = dict[str, NDArray[Any]]  # feature: (m,) or (m, k)
Statistics = dict[str, dict[str, list[float]]]


def write_dataset(episodes: Iterable[Episode], rate_Hz: int, task: str, out: Path) -> tuple[int, int]:
    """Write the dataset into the new folder `out`, whole or not at all; returns the numbers of episodes and frames.

    ArmError if pyarrow is not installed, `out` exists, there is no episode, or they are of several arms. NotWritten.
    """
    arrow = _arrow()
    if out.exists():
        raise ArmError(f"{out} exists already and is never overwritten: choose another --out")
    runs = list(episodes)
    if not runs:
        raise ArmError("the recordings hold no motion: an episode is a run in which the arm moved")
    for episode in runs:
        if (episode.arm.name, episode.arm.joint_count) != (runs[0].arm.name, runs[0].arm.joint_count):
            raise ArmError(
                f"expected one arm, got {runs[0].arm.name} ({runs[0].source}) and {episode.arm.name} ({episode.source}): make a"
                " dataset of each, or give the arm of all with --arm"
            )
    make_whole_folder(out, lambda folder: _write(arrow, folder, runs, rate_Hz, task))
    return len(runs), sum(map(len, runs))


def _write(arrow: Any, out: Path, episodes: Sequence[Episode], rate_Hz: int, task: str) -> None:
    arm = episodes[0].arm
    features, made, rows = features_of(arm.joint_count), _frames(episodes, rate_Hz), []
    for number, frames in enumerate(made):
        place = {"chunk_index": number // FILES_PER_CHUNK, "file_index": number % FILES_PER_CHUNK}
        _table(arrow, _columns(arrow, frames, features), out / "data" / FILE.format(**place))
        rows.append(_about_episode(frames, task, place))
    _table(
        arrow,
        {name: arrow.array([row[name] for row in rows]) for name in rows[0]},
        out / "meta" / "episodes" / FILE.format(chunk_index=0, file_index=0),
    )
    _write_tasks(arrow, task, out / "meta" / "tasks.parquet")
    whole = {name: np.concatenate([frames[name] for frames in made]) for name in features}
    sources = [episode.source for episode in episodes]
    about = {"sources": sources, "arm_toml": arm_text(arm)}
    info = info_of(features, len(episodes), sum(map(len, episodes)), rate_Hz, arm.name)
    for name, content in (("info", info), ("stats", statistics(whole)), ("armwright", about)):
        write_whole(out / "meta" / f"{name}.json", json.dumps(content, indent=2, ensure_ascii=False) + "\n")


def features_of(joint_count: int) -> dict[str, dict[str, Any]]:
    """Type, shape and names of every column. Angles in rad, currents in A, the tip in m in the base frame."""

    def vector(*names: str) -> dict[str, Any]:
        return {"dtype": "float32", "shape": [len(names)], "names": list(names)}

    def of_joints(form: str) -> dict[str, Any]:
        return vector(*(form.format(joint) for joint in range(1, joint_count + 1)))

    whole = {"dtype": "int64", "shape": [1], "names": None}
    return {
        "observation.state": of_joints("joint{}_rad"),
        "observation.current": of_joints("i{}_A"),
        "observation.tip": vector("x_m", "y_m", "z_m"),
        "action": of_joints("joint{}_set_rad"),
        "timestamp": {"dtype": "float32", "shape": [1], "names": None},
        **dict.fromkeys(("frame_index", "episode_index", "index", "task_index"), whole),
    }


def info_of(features: dict[str, dict[str, Any]], episodes: int, frames: int, rate_Hz: int, arm: str) -> dict[str, Any]:
    """The content of meta/info.json; there are no videos, and one task."""
    return {
        "codebase_version": VERSION,
        "robot_type": arm,
        "total_episodes": episodes,
        "total_frames": frames,
        "total_tasks": 1,
        "chunks_size": FILES_PER_CHUNK,
        "data_files_size_in_mb": DATA_FILE_MB,
        "video_files_size_in_mb": VIDEO_FILE_MB,
        "fps": rate_Hz,
        "splits": {"train": f"0:{episodes}"},
        "data_path": f"data/{FILE}",
        "video_path": None,
        "features": features,
    }


def _frames(episodes: Sequence[Episode], rate_Hz: int) -> list[Frames]:
    """The columns of each episode; `index` counts on over all episodes."""
    made: list[Frames] = []
    begin = 0
    for number, episode in enumerate(episodes):
        steps = np.arange(len(episode))
        made.append(
            {
                "observation.state": episode.joint_rad.astype(np.float32),
                "observation.current": episode.current_A.astype(np.float32),
                "observation.tip": episode.tip_m.astype(np.float32),
                "action": episode.joint_set_rad.astype(np.float32),
                "timestamp": (steps / rate_Hz).astype(np.float32),
                "frame_index": steps,
                "episode_index": np.full(len(steps), number),
                "index": begin + steps,
                "task_index": np.zeros(len(steps), dtype=np.int64),
            }
        )
        begin += len(episode)
    return made


def statistics(frames: Frames) -> Statistics:
    """LeRobot's statistics of each feature over the frames."""
    by_feature: Statistics = {}
    for name, values in frames.items():
        columns = values.reshape(len(values), -1).astype(np.float64)
        by_feature[name] = {
            "min": columns.min(axis=0).tolist(),
            "max": columns.max(axis=0).tolist(),
            "mean": columns.mean(axis=0).tolist(),
            "std": columns.std(axis=0).tolist(),
            "count": [len(columns)],
            **{key: np.quantile(columns, share, axis=0).tolist() for key, share in QUANTILES.items()},
        }
    return by_feature


def _about_episode(frames: Frames, task: str, place: dict[str, int]) -> dict[str, Any]:
    begin, length = int(frames["index"][0]), len(frames["index"])
    return {
        "episode_index": int(frames["episode_index"][0]),
        "tasks": [task],
        "length": length,
        "dataset_from_index": begin,
        "dataset_to_index": begin + length,
        **{f"data/{key}": value for key, value in place.items()},
        "meta/episodes/chunk_index": 0,
        "meta/episodes/file_index": 0,
        **{f"stats/{name}/{key}": values for name, found in statistics(frames).items() for key, values in found.items()},
    }


def _columns(arrow: Any, frames: Frames, features: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """Arrow's columns: numbers, or lists of fixed length."""
    types = {"float32": arrow.float32(), "int64": arrow.int64()}
    columns = {}
    for name, feature in features.items():
        flat = arrow.array(frames[name].ravel(), type=types[feature["dtype"]])
        size = feature["shape"][0]
        columns[name] = flat if size == 1 else arrow.FixedSizeListArray.from_arrays(flat, size)
    return columns


def _write_tasks(arrow: Any, task: str, path: Path) -> None:
    """The table that pandas writes of a frame with the tasks as its index; LeRobot reads it with pandas."""
    names = {"task_index": ("int64", "int64"), "task": ("unicode", "object")}
    columns = [
        {"name": name, "field_name": name, "pandas_type": kind, "numpy_type": of, "metadata": None}
        for name, (kind, of) in names.items()
    ]
    index = [{"name": None, "field_name": None, "pandas_type": "unicode", "numpy_type": "object", "metadata": None}]
    about = {"index_columns": ["task"], "column_indexes": index, "columns": columns, "pandas_version": "2.0.0"}
    _table(arrow, {"task_index": arrow.array([0]), "task": arrow.array([task])}, path, {"pandas": json.dumps(about)})


def _table(arrow: Any, columns: dict[str, Any], path: Path, metadata: dict[str, str] | None = None) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    importlib.import_module("pyarrow.parquet").write_table(arrow.table(columns).replace_schema_metadata(metadata), path)


def _arrow() -> Any:
    try:
        return importlib.import_module("pyarrow")
    except ImportError as error:
        raise ArmError(
            "--lerobot: pyarrow is not installed (55 MB, so it is an extra): in the clone, .venv/bin/pip install -e '.[lerobot]'"
        ) from error
