"""Rows in frames: all come back to the stored resolution, any cut or damage costs only what it hits, and a fifth is enough."""

from __future__ import annotations

import math
import os
import struct
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from control.recording.frame_decoder import FrameDecoder
from control.recording.frames import (
    HEAD,
    ROWS_MOST,
    STREAM_ROWS,
    FrameEncoder,
    columns_of,
    content_of,
    frames_in,
    in_frames,
    stored_columns,
)
from control.recording.reading import RecordError, Recording, RowReader
from control.recording.record import MAGIC_OF_FRAMES, Layout
from control.recording.writer import PartFile, Policy, RecordingParts, begin
from tests.recordings import PERIOD_s, row_of

LAYOUT = Layout.of(3)
RAD_PER_COUNT = (3e-5, 3e-5, -2e-5)
NAME = "right-20260101-120000.armlog"
EXACT = st.floats(width=32, allow_nan=True, allow_infinity=True)
VALUES = {
    "d": st.one_of(st.floats(-10.0, 10.0), st.just(math.nan), st.floats()),
    "f": st.one_of(st.floats(-50.0, 50.0, width=32), st.just(math.nan), EXACT),
    "i": st.integers(-(2**31), 2**31 - 1),
    "I": st.integers(0, 2**32 - 1),
    "H": st.integers(0, 2**16 - 1),
    "B": st.integers(0, 255),
}
SMALL_LAYOUT = Layout.of(1, has_joint_side=True)
ROWS = st.lists(st.tuples(*(VALUES[code] for code in SMALL_LAYOUT.codes)), min_size=1, max_size=12)


def packed(first: int, count: int, seed: int = 5) -> bytes:
    """Rows of an arm in motion, with the noise of its counts, currents, voltages and times."""
    noise = np.random.default_rng([seed, first])
    rows = []
    for k in range(first, first + count):
        row = row_of(k + 20, 3, late_s=abs(noise.normal(0, 4e-5)), busy_s=2e-4 + abs(noise.normal(0, 3e-5)))
        row["t_s"] += row["late_s"]
        for j, scale in enumerate(RAD_PER_COUNT, start=1):
            row[f"count{j}"] = round(row[f"q{j}_rad"] / scale)
            row |= {
                f"q{j}_rad": row[f"count{j}"] * scale,
                f"counted{j}_s": round(k * PERIOD_s + 3.0, 6),
                f"speed{j}_rad_s": noise.normal(0.3, 0.01),
                f"u{j}_V": noise.normal(2.0, 0.02),
                f"i{j}_A": round(noise.normal(0.5, 0.03), 3),
                f"supply{j}_V": round(noise.normal(24.0, 0.01), 3),
            }
        rows.append(LAYOUT.packing.pack(*(row.get(name, 0) for name in LAYOUT.names)))
    return b"".join(rows)


def begun(folder: Path) -> Path:
    begin(folder / NAME, LAYOUT.about(arm="right", period_s=PERIOD_s, **LAYOUT.framed(RAD_PER_COUNT)))
    return folder / NAME


def written(folder: Path, count: int, rows_a_frame: int = 10) -> tuple[Path, bytes]:
    path, rows = begun(folder), packed(0, count)
    part = PartFile(path)
    for at in range(0, len(rows), rows_a_frame * LAYOUT.packing.size):
        part.append(rows[at : at + rows_a_frame * LAYOUT.packing.size])
    part.close()
    return path, rows


def stored(rows: bytes) -> bytes:
    """What the frames of these rows say."""
    columns = stored_columns(LAYOUT.names, LAYOUT.codes, RAD_PER_COUNT)
    coded = FrameEncoder(columns, LAYOUT.packing)
    frames = b"".join(coded.frame(part) for part in in_frames(rows, LAYOUT.packing.size))
    return FrameDecoder(columns, LAYOUT.names, LAYOUT.packing).rows(frames)[0]


@settings(deadline=None, max_examples=50)
@given(st.lists(ROWS, min_size=1, max_size=4))
def test_any_values_come_back_to_their_resolution_and_counts_to_the_bit(frames: list[list[tuple[float, ...]]]) -> None:
    columns = stored_columns(SMALL_LAYOUT.names, SMALL_LAYOUT.codes, (1e-4,))
    encoder = FrameEncoder(columns, SMALL_LAYOUT.packing)
    content = b"".join(encoder.frame(b"".join(SMALL_LAYOUT.packing.pack(*row) for row in rows)) for rows in frames)
    back, used = FrameDecoder(columns, SMALL_LAYOUT.names, SMALL_LAYOUT.packing).rows(content)
    assert used == len(content)
    wanted = [row for rows in frames for row in rows]
    for row, got in zip(wanted, SMALL_LAYOUT.packing.iter_unpack(back), strict=True):
        for column, value, is_now in zip(columns, row, got, strict=True):
            if math.isfinite(value) and column.per_unit > 1:
                assert abs(is_now - value) <= 0.501 / column.per_unit + 1e-7 * abs(value)
            else:
                assert struct.pack("<d", is_now) == struct.pack("<d", value) or is_now == value


def test_a_column_of_a_later_version_is_kept_to_the_bit() -> None:
    columns = stored_columns(("new_s", "newer_s", "many"), "dfh")
    packing = struct.Struct("<dfh")
    rows = b"".join(
        packing.pack(value, value, number) for number, value in enumerate([0.1, -1e300 * 0.0, math.inf, math.nan, -0.3, 1e-30])
    )
    back, _ = FrameDecoder(columns, ("new_s", "newer_s", "many"), packing).rows(FrameEncoder(columns, packing).frame(rows))
    assert back == rows


def test_a_recording_is_a_fifth_of_its_packed_rows_or_less_in_motion(tmp_path: Path) -> None:
    path, rows = written(tmp_path, 2500)
    assert path.stat().st_size - Recording.open(path).offset < 0.2 * len(rows)


def test_a_file_cut_anywhere_gives_the_rows_before_the_cut(tmp_path: Path) -> None:
    path, rows = written(tmp_path, 40)
    whole, offset, size = path.read_bytes(), Recording.open(path).offset, LAYOUT.packing.size
    ends = [offset, *(offset + end for end, _, _ in frames_in(whole[offset:]))]
    cut, expected = tmp_path / "cut.armlog", stored(rows)
    for length in sorted({*range(offset, len(whole), 23), *ends, *(end - 1 for end in ends[1:])}):
        cut.write_bytes(whole[:length])
        due = 10 * (sum(end <= length for end in ends) - 1)
        opened = Recording.open(cut)
        assert opened.row_count == due
        assert opened.packed() == expected[: due * size]
    for length in range(0, offset, 40):
        cut.write_bytes(whole[:length])
        with pytest.raises(RecordError, match=r"cut\.armlog: "):
            Recording.open(cut)


def test_a_damaged_frame_costs_its_stream_and_no_row_is_wrong(tmp_path: Path) -> None:
    path, rows = written(tmp_path, STREAM_ROWS + 300, rows_a_frame=ROWS_MOST)
    whole, offset, size = bytearray(path.read_bytes()), Recording.open(path).offset, LAYOUT.packing.size
    right = Recording.open(path).packed()
    assert len(right) == len(rows)
    second = next(end for end, start, _ in frames_in(bytes(whole[offset:])) if HEAD.unpack(start)[1] & 0x8000 and end > 9999)
    noise = np.random.default_rng(3)
    for _ in range(12):
        at = offset + HEAD.size + int(noise.integers(second - 9000))
        damaged = bytearray(whole)
        damaged[at] ^= 1 << int(noise.integers(8))
        path.write_bytes(damaged)
        back = Recording.open(path).packed()
        kept = {right[k : k + size] for k in range(0, len(right), size)}
        assert all(back[k : k + size] in kept for k in range(0, len(back), size))
        assert right.endswith(back[-300 * size :])


def test_a_full_disk_keeps_whole_frames_and_recording_resumes_in_the_same_file(tmp_path: Path) -> None:
    left, now_s = [1 << 30], [0.0]

    def pwrite(fd: int, content: bytes, at: int) -> int:
        if left[0] <= 0:
            raise OSError(28, os.strerror(28))
        done = os.pwrite(fd, content[: left[0]], at)
        left[0] -= done
        return done

    path, size = begun(tmp_path), LAYOUT.packing.size
    parts = RecordingParts(path, Policy(1 << 30), lambda text: None, pwrite, lambda: now_s[0])
    parts.append(packed(0, 10))
    left[0] = 150  # less than a frame
    parts.append(packed(10, 10))
    assert (parts.state().is_on, parts.state().lost_rows) == (False, 10)
    left[0], now_s[0] = 1 << 30, 2.0
    parts.append(packed(20, 10))
    parts.close()
    opened = Recording.open(path)
    assert opened.extent() == (20, path.stat().st_size)
    cycle = LAYOUT.names.index("cycle")
    assert [row[cycle] for row in opened.rows()] == [*range(20, 30), *range(40, 50)]
    assert len(opened.packed()) == 20 * size


def test_a_growing_file_is_read_frame_by_frame_whatever_has_arrived(tmp_path: Path) -> None:
    path, rows = written(tmp_path, 40)
    whole = path.read_bytes()
    opened = Recording.open(path)
    path.write_bytes(whole[: opened.offset])
    reader, read = RowReader(opened), b""
    for at in range(opened.offset, len(whole) + 97, 97):
        path.write_bytes(whole[:at])
        read += reader.new()
    assert read == stored(rows)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("per_unit", -1),
        ("per_unit", 10**16),
        ("order", 0),
        ("order", 4),
        ("beside", 10**6),
        ("beside", 0),
        ("factor", math.inf),
        ("factor", math.nan),
        ("order", "x"),
        ("per_unit", None),
    ],
)
def test_a_header_that_describes_no_columns_is_refused(tmp_path: Path, key: str, value: object) -> None:
    about = LAYOUT.framed(RAD_PER_COUNT)
    about["frames"][key][0] = value
    begin(tmp_path / NAME, LAYOUT.about(**about))
    with pytest.raises(RecordError, match=r"right-.*: the header of this recording is damaged"):
        Recording.open(tmp_path / NAME)


def test_columns_are_what_the_header_says_they_are() -> None:
    columns = stored_columns(LAYOUT.names, LAYOUT.codes, RAD_PER_COUNT)
    assert columns_of(content_of(columns), LAYOUT.codes) == columns


@settings(deadline=None, max_examples=60)
@given(st.binary(max_size=400), st.integers(0, 3))
def test_no_bytes_break_the_reader_of_frames(tail: bytes, good_frames: int) -> None:
    columns = stored_columns(LAYOUT.names, LAYOUT.codes, RAD_PER_COUNT)
    encoder = FrameEncoder(columns, LAYOUT.packing)
    content = b"".join(encoder.frame(packed(10 * k, 10)) for k in range(good_frames)) + tail
    back, used = FrameDecoder(columns, LAYOUT.names, LAYOUT.packing).rows(content)
    assert len(back) == 10 * good_frames * LAYOUT.packing.size
    assert used <= len(content)


def test_earlier_versions_refuse_the_new_file_by_its_first_bytes(tmp_path: Path) -> None:
    assert begun(tmp_path).read_bytes().startswith(MAGIC_OF_FRAMES)
    assert not MAGIC_OF_FRAMES.startswith(b"ARMLOG1")
