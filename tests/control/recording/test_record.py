"""Recordings: every row comes back, a torn tail is dropped, a damaged header is one clear error, a full pipe says so."""

from __future__ import annotations

import json
import os
import struct
import subprocess
import sys
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from control.recording.record import MAGIC, FileSink, Layout, PipeSink, Recorder, RecordError, Recording

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
    assert (
        len(layout.names) == len(set(layout.names)) == len(layout.packing.unpack(bytes(layout.packing.size)))
    )
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


def test_a_recording_that_is_cut_anywhere_is_read_as_far_as_it_goes_or_refused_in_a_sentence(
    tmp_path: Path,
) -> None:
    whole = write(tmp_path / "a.armlog", 3).read_bytes()
    for length in range(len(whole)):
        path = tmp_path / "cut.armlog"
        path.write_bytes(whole[:length])
        if length < len(whole) - 3 * LAYOUT.packing.size:
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
        b"", b"hello", MAGIC, MAGIC + b"\x01\x00\x00\x00", MAGIC + struct.pack("<I", 2**31) + b"{}",
        MAGIC + struct.pack("<I", 2) + b"[]", MAGIC + struct.pack("<I", 4) + b"\xff\xfe\xfd\xfc",
        header(names="absent"), header(packing="absent"), header(joint_count="absent"), header(packing="<dz"),
        header(packing="<", names=[]), header(names=5), header(packing=5), header(names=["t_s"]),
    ],
    ids=lambda start: repr(start[:24]),
)  # fmt: skip
def test_a_damaged_start_is_one_sentence_that_names_the_file(tmp_path: Path, start: bytes) -> None:
    path = tmp_path / "bad.armlog"
    path.write_bytes(start)
    with pytest.raises(RecordError, match=r"bad\.armlog: (not an armwright recording|the header)"):
        list(Recording.open(path).rows())


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
    assert [LAYOUT.packing.unpack(kept) for kept in recorder.last_rows()] == [
        row(number) for number in range(3, 8)
    ]
    recorder.close()


def test_a_full_pipe_loses_whole_rows_says_so_and_never_waits() -> None:
    read_fd, write_fd = os.pipe()
    recorder = Recorder(LAYOUT, PipeSink(write_fd, b""))
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
    recorder = Recorder(LAYOUT, PipeSink(write_fd, b""))
    os.close(read_fd)
    recorder.write(row(0))
    assert recorder.lost_rows == 1
    recorder.close()


def test_the_writer_has_all_that_was_sent_when_its_pipe_ends(tmp_path: Path) -> None:
    path = tmp_path / "a.armlog"
    sent = LAYOUT.header({}) + b"".join(LAYOUT.packing.pack(*row(number)) for number in range(300))
    subprocess.run(
        [sys.executable, "-m", "control.recording.writer", str(path)], input=sent, check=True, timeout=120
    )
    assert path.read_bytes() == sent
