"""Reads recordings: their header, and their rows while they grow or after. Every version's files, or a sentence."""

from __future__ import annotations

import dataclasses
import os
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from control.errors import ArmError
from control.files import open_file, parsed_json
from control.model.arm import Arm
from control.model.description import load_arm, parse_arm
from control.recording.frames import HEAD, ROWS, ROWS_MOST, CONTENT_MOST_bytes, StoredColumn, columns_of
from control.recording.record import LATER_FIELDS, MAGIC, MAGIC_OF_FRAMES, MODES_BEFORE_THEY_WERE_RECORDED, Layout

HEADER_MOST_bytes, ROW_MOST_bytes = 1 << 24, 1 << 14  # the text of an arm.toml; 100 joints
PORTION_bytes = 1 << 20  # read at once; some 40,000 rows in frames
Taken = Callable[[bytes], tuple[bytes, int]]


class RecordError(ArmError):
    """A recording that cannot be read."""


def _require_columns(layout: Layout) -> None:
    """ValueError if the columns do not match the joint count. Columns of later versions may be missing."""
    if type(layout.joint_count) is not int or not 1 <= layout.joint_count <= len(layout.names):
        raise ValueError(f"joint_count {layout.joint_count!r} does not match {len(layout.names)} columns")
    later = {*LATER_FIELDS, *(f"counted{joint}_s" for joint in range(1, layout.joint_count + 1))}
    for name in Layout.of(layout.joint_count).names:
        if name not in layout.names and name not in later:
            raise ValueError(f"column {name} of {layout.joint_count} joints is missing")


def _require_numbers(header: dict[str, Any]) -> None:
    for key in ("started_unix_s", "period_s"):
        if not isinstance(header.get(key, 0.0), int | float):
            raise ValueError(f"{key} is not a number: {header[key]!r}")


@dataclass(frozen=True, slots=True)
class Recording:
    """A recording on disk: its header, the offset of its rows, and how their columns are stored if they are in frames."""

    path: Path
    header: dict[str, Any]
    layout: Layout
    offset: int
    columns: tuple[StoredColumn, ...] | None = None

    @classmethod
    def open(cls, path: Path) -> Recording:
        """Read the header. RecordError if the file is not a recording."""
        with open_file(path) as file:
            start = file.read(len(MAGIC) + 4)
            if len(start) < len(MAGIC) + 4 or not start.startswith((MAGIC, MAGIC_OF_FRAMES)):
                raise RecordError(
                    f"{path}: not an armwright recording: expected an .armlog of `armwright serve`, which begins with"
                    f" ARMLOG2 or ARMLOG1, got {'an empty file' if not start else 'other bytes'}"
                )
            (length,) = struct.unpack("<I", start[len(MAGIC) :])
            if length > min(HEADER_MOST_bytes, os.fstat(file.fileno()).st_size - len(start)):
                raise RecordError(f"{path}: the header of this recording is damaged: its length is {length} bytes")
            text = file.read(length)
        try:
            header = parsed_json(text)
            packing = struct.Struct(header["packing"])
            if not 0 < packing.size <= ROW_MOST_bytes:
                raise ValueError(f"a row of {packing.size} bytes")
            layout = Layout(header["joint_count"], tuple(header["names"]), packing)
            packing.pack(*(0 for _ in layout.names))  # as many values as names
            _require_columns(layout)
            _require_numbers(header)
            columns = columns_of(header["frames"], layout.codes) if start.startswith(MAGIC_OF_FRAMES) else None
        except (ValueError, KeyError, TypeError, OverflowError, struct.error) as error:
            raise RecordError(f"{path}: the header of this recording is damaged ({error})") from error
        return cls(path, header, layout, len(MAGIC) + 4 + length, columns)

    @property
    def modes(self) -> tuple[str, ...]:
        """Names of the modes by number, in the version that recorded."""
        return tuple(self.header.get("modes") or MODES_BEFORE_THEY_WERE_RECORDED)

    @property
    def row_count(self) -> int:
        """Number of whole rows in the file; in frames, of those that are not damaged as well as of those that are."""
        return self.extent()[0]

    def extent(self) -> tuple[int, int]:
        """Number of whole rows, and the offset of their end: what follows was torn off, or is still being written."""
        if self.columns is None:
            count = max(0, self.path.stat().st_size - self.offset) // self.layout.packing.size
            return count, self.offset + count * self.layout.packing.size
        return self._extent_of_frames()

    def _extent_of_frames(self) -> tuple[int, int]:
        count, at, size = 0, self.offset, self.path.stat().st_size
        with self.path.open("rb") as file:
            file.seek(at)
            while len(start := file.read(HEAD.size)) == HEAD.size:
                content_bytes, number, _ = HEAD.unpack(start)
                end = at + HEAD.size + content_bytes
                is_frame = content_bytes <= CONTENT_MOST_bytes and 0 < number & ROWS <= ROWS_MOST
                if not is_frame or end > size:
                    break
                count, at = count + (number & ROWS), end
                file.seek(at)
        return count, at

    def packed(self) -> bytes:
        """All whole rows, packed as `layout` says."""
        return b"".join(RowReader(self).portions())

    def rows(self) -> Iterator[tuple[float, ...]]:
        """Rows as tuples in the order of `layout.names`; an incomplete end is dropped."""
        for packed in RowReader(self).portions():
            yield from self.layout.packing.iter_unpack(packed)


class RowReader:
    """Reads the rows of a recording, which may be growing, from its beginning."""

    def __init__(self, recording: Recording) -> None:
        self._path, self._at = recording.path, recording.offset
        self._taken = _frames(recording) if recording.columns is not None else _rows(recording)

    def new(self) -> bytes:
        """The whole rows that were not read yet, packed."""
        return b"".join(self.portions())

    def portions(self) -> Iterator[bytes]:
        """The same in portions, for a file that is larger than the memory."""
        portion_bytes = PORTION_bytes
        with self._path.open("rb") as file:
            while True:
                file.seek(self._at)
                content = file.read(portion_bytes)
                rows, used = self._taken(content)
                self._at += used
                if rows:
                    yield rows
                if not used:
                    if len(content) < portion_bytes or portion_bytes > CONTENT_MOST_bytes:
                        return
                    portion_bytes = CONTENT_MOST_bytes + HEAD.size + 1  # one frame is larger than a portion


def _rows(recording: Recording) -> Taken:
    row_bytes = recording.layout.packing.size

    def taken(content: bytes) -> tuple[bytes, int]:
        whole = len(content) // row_bytes * row_bytes
        return content[:whole], whole

    return taken


def _frames(recording: Recording) -> Taken:
    from control.recording.frame_decoder import FrameDecoder

    layout = recording.layout
    return FrameDecoder(recording.columns or (), layout.names, layout.packing).rows


def recorded_arm(recording: Recording) -> Arm | None:
    """The recorded arm, else the file named in the header, else the supplied arm of that name.

    None if there is none of these, or only one with another number of joints.
    """
    for arm in _candidates(recording):
        if arm.joint_count == recording.layout.joint_count:
            return arm
    return None


def _candidates(recording: Recording) -> Iterator[Arm]:
    header, file = recording.header, Path(str(recording.header.get("arm_file", "")))
    try:
        if isinstance(text := header.get("arm_toml"), str):
            yield dataclasses.replace(parse_arm(text, file), path=file)
    except ArmError:
        pass  # written by another version: the file may still be readable
    for name in (file, header.get("arm")):
        try:
            if name and str(name) != ".":
                yield load_arm(str(name))
        except ArmError:
            continue
