"""What fuzzers throw at readers: the files and lines that the product reads, by the name that the file has there."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable
from pathlib import Path
from unittest.mock import patch

from calib.arm_import import read_arm
from calib.boards import read_boards, read_markers
from calib.capture.tracks import read_c3d, read_vicon_csv
from calib.closed_chain.pair_problem import read_contacts
from calib.distances import has_readings, readings_of
from calib.gap.log import read_log
from calib.history import read_history
from calib.iso9283.recorded import read_rectangle, read_runs
from calib.points.points import points_for, read_points
from calib.session.folder import JOURNAL, POINTS, SessionFolder
from calib.session.moves import read_free_poses
from calib.session.plan import SessionPlan, board_targets
from calib.studies import ChunkStore
from calib.tolerances.making import parse_tolerances, tolerances_text
from calib.vision.intrinsics import read_camera
from calib.vision.targets import read_picture, read_tags
from console.lines import Grammar, parse_lines
from console.places import read_places
from console.specs.table import COMMANDS
from console.user_config import default_arm
from console.visualisation.reading import read_series
from control.model.cell import load_cell
from control.model.description import load_arm
from control.motion.waypoints import read_waypoints
from control.recording.reading import Recording
from hil_mocks.scenario import load_scenario
from procedures.bringup.procedure import Journal
from procedures.gap_recording import RunFile
from procedures.session_operator import BadCommand, parse_command

RIGHT = load_arm("right")
PLAN = SessionPlan("right", "00", 3, board_targets(["normal"], ["1", "2"]))
CHUNK = 3


def _recording(path: Path) -> object:
    opened = Recording.open(path)
    return opened.row_count, sum(1 for _ in opened.rows())


def _session(path: Path) -> object:
    path.rename(path.parent / "session.json")
    with SessionFolder(path.parent) as folder:
        return folder.state


def _in_session(name: str) -> Callable[[Path], object]:
    """A file of a session that was begun, which is resumed."""

    def read(path: Path) -> object:
        folder = path.parent / "session"
        folder.mkdir()
        SessionFolder(folder, PLAN).close()
        path.rename(folder / name)
        with SessionFolder(folder) as resumed:
            return resumed.state, resumed.points()

    return read


def _tolerances(path: Path) -> object:
    return parse_tolerances(tolerances_text(str(path)), str(path), RIGHT)


def _contacts(path: Path) -> object:
    return read_contacts(path, (load_arm("left"), RIGHT))


def _lengths(path: Path) -> object:
    points, _ = points_for(RIGHT, [path])
    return has_readings(points), readings_of(RIGHT, points, path)


def _chunk(path: Path) -> object:
    store = ChunkStore(path.parent / "study", {"of": "this"})
    path.rename(path.parent / "study" / f"{CHUNK:06}.npz")
    return store.read(CHUNK)


def _study(path: Path) -> object:
    return ChunkStore(path.parent, {"of": "this"})


def _config(path: Path) -> object:
    folder = path.parent / "armwright"
    folder.mkdir()
    path.rename(folder / "config.toml")
    with patch.dict(os.environ, {"XDG_CONFIG_HOME": str(path.parent)}):
        os.environ.pop("ARMWRIGHT_ARM", None)
        return default_arm()


FILES: dict[str, Callable[[Path], object]] = {
    "arm.toml": load_arm,
    "points.csv": read_points,
    "log.csv": read_log,
    "markers.csv": read_markers,
    "path.csv": read_waypoints,
    "boards.json": read_boards,
    "session.json": _session,
    "run.armlog": _recording,
    "programme.json": read_rectangle,
    "places.toml": read_places,
    "scenario.toml": load_scenario,
    "tolerances.toml": _tolerances,
    "capture.csv": read_vicon_csv,
    "capture.c3d": read_c3d,
    "cell.toml": load_cell,
    "contacts.csv": _contacts,
    "camera.json": read_camera,
    "tags.csv": read_tags,
    "arm.urdf": lambda path: read_arm(path, "urdf"),
    "arm.xml": lambda path: read_arm(path, "mjcf"),
    "history.jsonl": lambda path: read_history(path, "right"),
    "poses.csv": lambda path: read_free_poses(path, 3),
    "journal.jsonl": _in_session(JOURNAL),
    "recorded.csv": _in_session(POINTS),
    "lengths.csv": _lengths,
    "runs.csv": lambda path: read_runs(path, RIGHT),
    "series": read_series,
    "run.mcap": read_series,
    "picture": read_picture,
    "chunk.npz": _chunk,
    "study.json": _study,
    "config.toml": _config,
    "bringup.json": lambda path: Journal(path, RIGHT),
    "run.csv": lambda path: RunFile.read(path, 3),
}


def operator_lines(content: bytes) -> None:
    """Lines of a script, or typed at the console."""
    parse_lines(content.decode("utf-8", "replace").splitlines(), Grammar(COMMANDS, {}))


def session_line(content: bytes) -> None:
    """A line typed in a session."""
    with contextlib.suppress(BadCommand):
        parse_command(content.decode("utf-8", "replace"))


LINES: dict[str, Callable[[bytes], None]] = {"script": operator_lines, "session line": session_line}
