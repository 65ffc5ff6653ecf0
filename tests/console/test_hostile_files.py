"""Files that nobody should have written: each reader answers with one of our errors, at once and in little memory."""

from __future__ import annotations

import dataclasses
import os
import resource
import struct
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from calib.boards import read_boards, read_markers
from calib.errors import PointsFileError, SessionError
from calib.gap.log import read_log
from calib.iso9283.recorded import read_rectangle
from calib.points import points
from calib.points.points import read_points
from calib.session.folder import SessionFolder
from console.places import read_places
from control.files import read_text
from control.model.description import load_arm
from control.motion.waypoints import read_waypoints
from control.recording.reading import RecordError, Recording
from control.recording.record import MAGIC, Layout
from firmware_iface.errors import ArmwrightError
from tests.calib.session.session_killer import KEYS, PLAN, record

MEMORY_bytes = 300 << 20  # on top of what is used already
DEEP = "[" * 100_000 + "]" * 100_000


def session(file: Path) -> object:
    file.rename(file.parent / "session.json")
    return SessionFolder(file.parent)


READERS: dict[str, Callable[[Path], object]] = {
    "arm.toml": load_arm,
    "points.csv": read_points,
    "log.csv": read_log,
    "markers.csv": read_markers,
    "path.csv": read_waypoints,
    "boards.json": read_boards,
    "session.json": session,
    "run.armlog": Recording.open,
    "programme.json": read_rectangle,
    "places.toml": read_places,
}
HOSTILE = {
    "nested": DEEP.encode(),
    "nested table": b"a = " + DEEP.encode(),
    "binary": bytes(range(256)) * 50,
    "empty": b"",
    "one long line": b"x" * (1 << 22),
    "long field": b"setup,point,repeat\n" + b"y" * (1 << 20) + b",1,1\n",
    "quote that never ends": b'setup,point,repeat,q1_rad\n"' + b"z\n" * 200_000,
    "nothing but commas": b"," * 300_000,
    "armlog that lies": MAGIC + struct.pack("<I", 0xFFFFFFFF) + b"{}",
    "armlog of padding": MAGIC + struct.pack("<I", 58) + b'{"packing": "<1999999999x", "names": [], "joint_count": 1}',
    "numbers without end": b"9" * (1 << 20),
    "deep keys": ("a." * 20_000 + "b = 1").encode(),
}

ALLOWED = {("places.toml", "empty"), ("places.toml", "deep keys")}  # a file without places is one


@contextmanager
def little_memory() -> Iterator[None]:
    before = resource.getrlimit(resource.RLIMIT_AS)
    used = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
    resource.setrlimit(resource.RLIMIT_AS, (used + MEMORY_bytes, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)


@pytest.mark.parametrize("content", HOSTILE, ids=str)
@pytest.mark.parametrize("name", READERS)
def test_whatever_a_file_holds_its_reader_answers_with_one_error(tmp_path: Path, name: str, content: str) -> None:
    file = tmp_path / name
    file.write_bytes(HOSTILE[content])
    begun_s, said = time.process_time(), "nothing"
    try:
        with little_memory():
            READERS[name](file)
    except ArmwrightError as error:
        said = str(error)
    assert said != "nothing" or (name, content) in ALLOWED
    assert len(said) < 2000
    assert time.process_time() - begun_s < 5.0


@pytest.mark.parametrize("name", READERS)
def test_a_pipe_that_nobody_writes_to_is_refused_and_not_waited_for(tmp_path: Path, name: str) -> None:
    os.mkfifo(tmp_path / name)
    with pytest.raises((ArmwrightError, OSError), match="a pipe or a device"):
        READERS[name](tmp_path / name)


def test_a_header_that_names_gigabytes_is_not_read(tmp_path: Path) -> None:
    """A sparse file of 1.9 GB whose header claims all of it."""
    file = tmp_path / "a.armlog"
    with file.open("wb") as made:
        made.write(MAGIC + struct.pack("<I", 1_900_000_000))
        made.truncate(1_900_000_100)
    with little_memory(), pytest.raises(RecordError, match="its length is 1900000000 bytes"):
        Recording.open(file)


def test_a_file_of_gigabytes_is_refused_by_its_size(tmp_path: Path) -> None:
    file = tmp_path / "arm.toml"
    with file.open("wb") as made:
        made.truncate(3_000_000_000)
    with little_memory(), pytest.raises(OSError, match="3000 MB, expected at most 67 MB"):
        read_text(file)
    with pytest.raises(ArmwrightError, match="3000 MB"):
        load_arm(file)


def test_a_time_series_is_not_taken_for_points(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(points, "POINTS", dataclasses.replace(points.POINTS, most_rows=1000))
    file = tmp_path / "points.csv"
    file.write_text("setup,point,repeat,q1_rad\n" + "a,1,1,0.5\n" * 1005)
    with pytest.raises(PointsFileError, match="more than 1000 points"):
        read_points(file)


def test_a_journal_that_is_nested_names_its_line(tmp_path: Path) -> None:
    with SessionFolder(tmp_path, PLAN) as folder:
        folder.record(record(KEYS[0]))
    with (tmp_path / "journal.jsonl").open("a") as journal:
        journal.write(DEEP + "\n")
    with pytest.raises(SessionError, match="not a journal entry"):
        SessionFolder(tmp_path)


def test_a_recording_that_is_sound_is_read(tmp_path: Path) -> None:
    file = tmp_path / "a.armlog"
    file.write_bytes(Layout.of(3).header({"arm": "right"}))
    assert Recording.open(file).row_count == 0
