"""Recordings: every row comes back, a torn tail is dropped, a damaged header is one clear error, a full pipe says so."""

from __future__ import annotations

import contextlib
import json
import math
import os
import re
import resource
import socket
import struct
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from control.files import NotWritten
from control.recording.reading import RecordError, Recording
from control.recording.record import MAGIC, FileSink, Layout, NoSink, PipeSink, Recorder
from control.recording.recorder_state import RecorderState
from control.recording.writer import begin

LAYOUT = Layout.of(2)


def row(number: int) -> tuple[float, ...]:
    """Values that every field can hold exactly."""
    return tuple(float(number % 128) if code in "df" else number % 128 for code in LAYOUT.packing.format[1:])


def write(path: Path, rows: int) -> Path:
    sink = FileSink(path, LAYOUT.header({"arm": "test"}))
    recorder = Recorder(LAYOUT, sink)
    for number in range(rows):
        recorder.write(row(number))
    recorder.close()
    return path


@pytest.mark.parametrize("joints", [1, 3, 7])
def test_a_row_of_any_number_of_joints_has_a_name_for_each_value(joints: int) -> None:
    layout = Layout.of(joints)
    assert len(layout.names) == len(set(layout.names)) == len(layout.packing.unpack(bytes(layout.packing.size)))
    assert layout.packing.size < 4096  # PIPE_BUF: a row goes into the pipe whole or not at all


def test_what_was_written_is_read(tmp_path: Path) -> None:
    recording = Recording.open(write(tmp_path / "a.armlog", 5000))
    assert (recording.layout.names, recording.layout.joint_count) == (LAYOUT.names, 2)
    assert recording.header["arm"] == "test"
    assert list(recording.rows()) == [row(number) for number in range(5000)]


@pytest.mark.parametrize("torn", [1, 7, LAYOUT.packing.size - 1])
def test_a_torn_last_row_is_dropped_and_all_others_are_there(tmp_path: Path, torn: int) -> None:
    path = write(tmp_path / "a.armlog", 20)
    with path.open("r+b") as file:
        file.truncate(path.stat().st_size - torn)
    assert list(Recording.open(path).rows()) == [row(number) for number in range(19)]


def test_a_recording_that_is_cut_anywhere_is_read_as_far_as_it_goes_or_refused_in_a_sentence(tmp_path: Path) -> None:
    path = write(tmp_path / "cut.armlog", 3)
    whole = path.stat().st_size
    for length in reversed(range(whole)):
        os.truncate(path, length)
        if length < whole - 3 * LAYOUT.packing.size:
            with pytest.raises(RecordError, match=r"cut\.armlog: "):
                Recording.open(path)
        else:
            rows = list(Recording.open(path).rows())
            assert rows == [row(number) for number in range(len(rows))]


def header(**changes: object) -> bytes:
    about = {"names": list(LAYOUT.names), "packing": LAYOUT.packing.format, "joint_count": 2, **changes}
    text = json.dumps({key: value for key, value in about.items() if value != "absent"}).encode()
    return MAGIC + struct.pack("<I", len(text)) + text


@pytest.mark.parametrize(
    "start",
    [
        b"",
        b"hello",
        MAGIC,
        MAGIC + b"\x01\x00\x00\x00",
        MAGIC + struct.pack("<I", 2**31) + b"{}",
        MAGIC + struct.pack("<I", 2) + b"[]",
        MAGIC + struct.pack("<I", 4) + b"\xff\xfe\xfd\xfc",
        header(names="absent"),
        header(packing="absent"),
        header(joint_count="absent"),
        header(packing="<dz"),
        header(packing="<", names=[]),
        header(joint_count=3),
        header(joint_count=10**9),
        header(joint_count=True),
        header(started_unix_s="yesterday"),
        header(names=["other", *LAYOUT.names[1:]]),
        header(names=5),
        header(packing=5),
        header(names=["t_s"]),
    ],
    ids=lambda start: repr(start[:24]),
)
def test_a_damaged_start_is_one_sentence_that_names_the_file(tmp_path: Path, start: bytes) -> None:
    path = tmp_path / "bad.armlog"
    path.write_bytes(start)
    with pytest.raises(RecordError, match=r"bad\.armlog: (not an armwright recording|the header)") as refused:
        list(Recording.open(path).rows())
    assert "b'" not in str(refused.value)  # no bytes as Python prints them


@settings(deadline=None)
@given(st.binary(max_size=300))
def test_no_bytes_at_all_break_the_reader(tail: bytes) -> None:
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "x.armlog"
        path.write_bytes(header() + tail)
        assert len(list(Recording.open(path).rows())) == len(tail) // LAYOUT.packing.size


def test_a_recording_is_never_overwritten(tmp_path: Path) -> None:
    path = write(tmp_path / "a.armlog", 2)
    with pytest.raises(FileExistsError):
        write(path, 1)


def test_the_last_rows_are_kept_in_order(tmp_path: Path) -> None:
    recorder = Recorder(LAYOUT, FileSink(tmp_path / "a.armlog", b""), saved_rows=5)
    assert recorder.last_rows() == ()
    for number in range(8):
        recorder.write(row(number))
    assert [LAYOUT.packing.unpack(kept) for kept in recorder.last_rows()] == [row(number) for number in range(3, 8)]
    recorder.close()


def test_a_value_that_fits_no_column_ends_neither_the_row_nor_the_loop() -> None:
    recorder = Recorder(LAYOUT, NoSink())
    values = [1.0] * len(LAYOUT.names)
    q, count = LAYOUT.names.index("q1_rad"), LAYOUT.names.index("count1")
    narrow = LAYOUT.codes.index("f")
    values[count], values[narrow] = 2**40, 1e300
    recorder.write(values)
    (row,) = recorder.last_rows()
    kept = LAYOUT.packing.unpack(row)
    assert (kept[q], kept[count]) == (1.0, 0)
    assert math.isnan(kept[narrow])


def test_a_full_pipe_loses_whole_rows_says_so_and_never_waits() -> None:
    read_fd, write_fd = os.pipe()
    recorder = Recorder(LAYOUT, PipeSink(write_fd))
    for number in range(2000):
        recorder.write(row(number))
    assert recorder.lost_rows > 0
    recorder.close()
    received = b""
    while chunk := os.read(read_fd, 1 << 20):
        received += chunk
    os.close(read_fd)
    assert len(received) == (2000 - recorder.lost_rows) * LAYOUT.packing.size


def test_a_dead_writer_loses_rows_and_stops_nothing() -> None:
    read_fd, write_fd = os.pipe()
    recorder = Recorder(LAYOUT, PipeSink(write_fd))
    os.close(read_fd)
    recorder.write(row(0))
    assert recorder.lost_rows == 1
    assert recorder.state().reason == "the process that writes the file has ended"
    recorder.close()


def started_writer(path: Path, sizes: tuple[int, int] = (1 << 30, 0)) -> subprocess.Popen[bytes]:
    begin(path, LAYOUT.about(arm="test", period_s=0.002))
    command = [sys.executable, "-m", "control.recording.writer", str(path), *map(str, sizes)]
    return subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE)


def test_the_writer_has_all_that_was_sent_when_its_pipe_ends_but_for_a_torn_row(tmp_path: Path) -> None:
    path = tmp_path / "a.armlog"
    sent = b"".join(LAYOUT.packing.pack(*row(number)) for number in range(300))
    _, said = started_writer(path).communicate(sent + sent[:7], timeout=120)
    assert said == b""
    assert path.read_bytes()[Recording.open(path).offset :] == sent


def told_until(writer: subprocess.Popen[bytes], is_so: Callable[[RecorderState], bool], rows: int = 1) -> RecorderState:
    """Send some rows and hear a report, until one is so."""
    assert writer.stdin is not None
    assert writer.stdout is not None
    for number in range(1000):
        writer.stdin.write(LAYOUT.packing.pack(*row(number)) * rows)
        writer.stdin.flush()
        state = RecorderState.of(json.loads(writer.stdout.readline()))
        if is_so(state):
            return state
    pytest.fail("the writer never told so")


def test_a_writer_whose_file_may_grow_no_more_says_so_and_goes_on_when_it_may(tmp_path: Path) -> None:
    """The limit is a real one of the kernel: writes come back short, then fail."""
    writer = started_writer(tmp_path / "a.armlog")
    whole = Recording.open(tmp_path / "a.armlog").offset + 2 * LAYOUT.packing.size
    children = Path(f"/proc/{writer.pid}/task/{writer.pid}/children")
    assert told_until(writer, lambda state: state.is_on).is_on  # it has forked
    limited = int(children.read_text())
    resource.prlimit(limited, resource.RLIMIT_FSIZE, (whole + 5, resource.RLIM_INFINITY))
    stopped = told_until(writer, lambda state: not state.is_on)
    assert stopped.reason == "File too large"
    assert (tmp_path / "a.armlog").stat().st_size == whole
    resource.prlimit(limited, resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
    resumed = told_until(writer, lambda state: state.is_on)
    assert resumed.lost_rows >= 1
    _, said = writer.communicate(timeout=120)
    first, second = said.decode().splitlines()
    time = r"\d\d:\d\d:\d\d  "  # as before every event of `serve`
    assert re.match(time + rf"{re.escape(str(tmp_path))}/a.armlog: recording stopped: File too large", first)
    assert re.match(time + rf"{re.escape(str(tmp_path))}/a.armlog: recording resumed", second)
    assert len(list(Recording.open(tmp_path / "a.armlog").rows())) >= 3


def test_a_disk_that_is_really_full_stops_the_recording_until_there_is_room(tmp_path: Path) -> None:
    disk = tmp_path / "disk"
    disk.mkdir()
    mounted = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=16m", "tmpfs", str(disk)], check=False, capture_output=True)
    if mounted.returncode:
        pytest.skip(f"this user cannot mount: {mounted.stderr.decode().strip()}")
    try:
        writer = started_writer(disk / "a.armlog")
        ballast = disk / "ballast"
        with contextlib.suppress(OSError), ballast.open("wb", buffering=0) as file:
            while True:
                file.write(bytes(1 << 12))
        page = resource.getpagesize() // LAYOUT.packing.size + 1  # rows: what is left of the last page takes some
        stopped = told_until(writer, lambda state: not state.is_on, page)
        assert stopped.reason == "No space left on device"
        ballast.unlink()
        assert told_until(writer, lambda state: state.is_on).lost_rows >= 1
        writer.communicate(timeout=120)
        assert len(list(Recording.open(disk / "a.armlog").rows())) >= 1
    finally:
        subprocess.run(["umount", str(disk)], check=True)


def test_the_loop_hears_the_newest_report_however_long_it_has_not_listened() -> None:
    read_fd, write_fd = os.pipe()
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    ours.setblocking(False)
    recorder = Recorder(LAYOUT, PipeSink(write_fd, ours, "a.armlog"))
    assert (recorder.state().is_on, recorder.state().file) == (True, "a.armlog")
    for lost in range(5):
        theirs.send(json.dumps(RecorderState(False, "a.armlog", "full", lost_rows=lost).content()).encode())
    assert (recorder.state().reason, recorder.lost_rows) == ("full", 4)
    theirs.close()
    assert recorder.state().reason == "full"
    recorder.close()
    os.close(read_fd)


def test_a_recording_without_room_is_named(tmp_path: Path) -> None:
    path = tmp_path / "a.armlog"
    sink = FileSink(path, b"")
    sink.close()
    with Path("/dev/full").open("wb", buffering=0) as full:
        sink._file = full
        with pytest.raises(NotWritten, match=r"a\.armlog: not written: No space left on device"):
            sink.write(b"row")
