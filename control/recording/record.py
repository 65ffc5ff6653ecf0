r"""Recording format: a JSON header and one fixed-size binary row per cycle, robust against a killed process; an arm's columns.

File: `ARMLOG2\n`, u32 header length, JSON header, then frames of rows (control.recording.frames); little endian.
`ARMLOG1\n`: packed rows instead, as on the stepped clock and by earlier versions.
Both are only ever appended to, so a killed writer can truncate only the last frame or row, which the reader drops.

Header: names, packing (columns of a row, and their format for `struct`), frames (per_unit, order, beside, factor of each);
joint_count; modes, tools, gripper_states, digital (names by number); arm, arm_file, arm_toml (name, path and full text);
program (version), started_unix_s (time of day at t_s = 0), period_s; cell (of a cell's arm: name, arm, and the bases of all
arms: origin_m, orientation).

In real time the rows go through a pipe to a writer process (`control.recording.writer`): the loop never waits for a
disk, and when the loop dies the writer still drains the pipe. It continues in another file when one has grown large
(`next_part`). On the stepped clock, the rows go directly to the file.
"""

import json
import math
import os
import socket
import struct
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, BinaryIO, Protocol

from control.dynamics.joint_side import has_joint_side
from control.end_effector import GripState
from control.files import NotWritten
from control.model.arm import Arm
from control.model.cell import Cell
from control.recording.frames import content_of, stored_columns
from control.recording.recorder_state import RecorderState
from control.safety.modes import Mode

MAGIC, MAGIC_OF_FRAMES = b"ARMLOG1\n", b"ARMLOG2\n"
ROWS_A_REPORT = 256  # reports are read once in this many rows
REPORT_bytes = 1 << 14
MODES_BEFORE_THEY_WERE_RECORDED = ("OFF", "BRAKED", "HOLDING", "MOVING", "HOMING", "GUIDING", "STOPPING", "FAULT")
SCALAR_FIELDS = (
    ("t_s", "d"),
    ("cycle", "I"),
    ("run", "I"),
    ("mode", "B"),
    ("missed", "I"),
    ("late_s", "f"),
    ("busy_s", "f"),
    ("page_faults", "H"),
    ("switches", "H"),
    ("age_s", "f"),
    ("payload_kg", "f"),
    ("x_m", "d"),
    ("y_m", "d"),
    ("z_m", "d"),
)
JOINT_FIELDS = (
    ("q{}_rad", "d"),
    ("q{}_set_rad", "d"),
    ("speed{}_rad_s", "f"),
    ("speed{}_set_rad_s", "f"),
    ("count{}", "i"),
    ("u{}_V", "f"),
    ("i{}_A", "f"),
    ("supply{}_V", "f"),
    ("temperature{}_C", "f"),
    ("statusword{}", "B"),
    ("drive_faults{}", "B"),
    ("flags{}", "B"),
    ("counted{}_s", "d"),
)

LATER_FIELDS = ("page_faults", "switches", "age_s")  # not in recordings of earlier versions, as counted{}_s
COUNT_MOST = 0xFFFF  # of page faults and switches in a cycle
JOINT_SIDE_FIELDS = (("joint{}_rad", "d"), ("joint{}_set_rad", "d"))  # where they are not the encoders' angles


@dataclass(frozen=True, slots=True)
class Layout:
    """Names and packing of one row for an arm of `joint_count` joints."""

    joint_count: int
    names: tuple[str, ...]
    packing: struct.Struct

    @classmethod
    def of(cls, joint_count: int, has_joint_side: bool = False, more: Sequence[tuple[str, str]] = ()) -> "Layout":
        """The layout that this version writes; with joint angles beside encoder angles if the arm distinguishes them.

        `more`: name and code of columns at the end of each row (control.recording.record).
        """
        fields, of_joint = (list(SCALAR_FIELDS), (*JOINT_FIELDS, *(JOINT_SIDE_FIELDS if has_joint_side else ())))
        for joint in range(1, joint_count + 1):
            fields += [(name.format(joint), code) for name, code in of_joint]
        fields += more
        return cls(joint_count, tuple(n for n, _ in fields), struct.Struct("<" + "".join(c for _, c in fields)))

    def fitting(self, values: Sequence[float]) -> list[float]:
        """The values as a row can hold them: what fits no column becomes NaN, or 0 where the column is of whole numbers."""
        return [
            value if _fits(code, value) else (math.nan if code in "fd" else 0)
            for code, value in zip(self.codes, values, strict=True)
        ]

    def header(self, about: dict[str, Any]) -> bytes:
        """The header, as it precedes the rows."""
        return header_bytes(self.about(**about))

    @property
    def codes(self) -> str:
        """The packing's code of each column."""
        return self.packing.format.removeprefix("<")

    def framed(self, rad_per_count: Sequence[float]) -> dict[str, Any]:
        """What `about` gets for a recording in frames; `rad_per_count` of each joint's encoder."""
        return {"frames": content_of(stored_columns(self.names, self.codes, rad_per_count))}

    def about(self, **more: Any) -> dict[str, Any]:
        """The header as a JSON object."""
        return {
            "names": self.names,
            "packing": self.packing.format,
            "joint_count": self.joint_count,
            "modes": [mode.name for mode in Mode],
            **more,
        }


def _fits(code: str, value: float) -> bool:
    try:
        struct.pack("<" + code, value)
    except (struct.error, OverflowError, ValueError):
        return False
    return True


def header_bytes(header: Mapping[str, Any]) -> bytes:
    """Encode a header as it precedes the rows."""
    text = json.dumps(header).encode()
    return (MAGIC_OF_FRAMES if "frames" in header else MAGIC) + struct.pack("<I", len(text)) + text


class RowSink(Protocol):
    """Destination of packed rows. `write` must not block; it returns False if the row was not accepted."""

    def write(self, row: bytes) -> bool: ...

    def state(self) -> RecorderState: ...

    def close(self) -> None: ...


class FileSink:
    """Writes rows directly to a buffered file: for the stepped clock, where blocking does not matter."""

    def __init__(self, path: Path, header: bytes) -> None:
        self._file: BinaryIO = path.open("xb")
        self._state = RecorderState(True, str(path))
        self.write(header)

    def write(self, row: bytes) -> bool:
        """Append the row. NotWritten where there is no room for it."""
        try:
            self._file.write(row)
        except OSError as error:
            raise NotWritten.of(error, Path(self._state.file)) from error
        return True

    def state(self) -> RecorderState:
        """The state of the recording; rows are recorded as long as nothing raises."""
        return self._state

    def close(self) -> None:
        """Flush and close. NotWritten where there is no room for the last rows."""
        try:
            self._file.close()
        except OSError as error:
            raise NotWritten.of(error, Path(self._state.file)) from error


class PipeSink:
    """Writes rows to a non-blocking pipe; a full or broken pipe loses the row and reports it, and the loop continues.

    `reports` is the non-blocking datagram socket on which the writer reports its state.
    """

    def __init__(self, fd: int, reports: socket.socket | None = None, first: str = "") -> None:
        os.set_blocking(fd, False)
        self._fd, self._reports = fd, reports
        self._state = RecorderState(True, first)
        self._row = 0

    def write(self, row: bytes) -> bool:
        """Append the row; rows are shorter than PIPE_BUF, so the kernel takes a row whole or not at all."""
        self._row += 1
        if self._row % ROWS_A_REPORT == 0:
            self._listen()
        try:
            os.write(self._fd, row)
        except BlockingIOError:
            return False
        except BrokenPipeError:
            if self._state.is_on:
                reason = "the process that writes the file has ended"
                self._state = replace(self._state, is_on=False, reason=reason, since_unix_s=time.time())
            return False
        return True

    def state(self) -> RecorderState:
        """The last state that the writer reported."""
        self._listen()
        return self._state

    def close(self) -> None:
        """Close the pipe: the writer drains it and ends."""
        os.close(self._fd)
        if self._reports is not None:
            self._reports.close()

    def _listen(self) -> None:
        """Read all pending reports, so that there is always room for the next; the last one is used."""
        while self._reports is not None:
            try:
                message = self._reports.recv(REPORT_bytes)
            except OSError:  # none pending
                return
            if not message:
                return
            self._state = RecorderState.of(json.loads(message))


class NoSink:
    """Discards rows."""

    def write(self, row: bytes) -> bool:
        """Discard the row."""
        return True

    def state(self) -> RecorderState:
        """There is no recording."""
        return RecorderState(False)

    def close(self) -> None:
        """Nothing to close."""


class Recorder:
    """Packs rows, keeps the last ones for fault reports, and counts the rows that the sink did not accept."""

    def __init__(self, layout: Layout, sink: RowSink, saved_rows: int = 250) -> None:
        self.layout = layout
        self._refused = self._refused_before = 0
        self._sink = sink
        self._kept: list[bytes] = [b""] * saved_rows
        self._next = 0
        self._pack = layout.packing.pack

    def write(self, values: Sequence[float]) -> None:
        """Record one cycle; `values` in the order of `layout.names`."""
        try:
            row = self._pack(*values)
        except (struct.error, OverflowError, ValueError):  # a board said what fits no column
            row = self._pack(*self.layout.fitting(values))
        self._kept[self._next] = row
        self._next = (self._next + 1) % len(self._kept)
        if not self._sink.write(row):
            self._refused += 1

    def state(self) -> RecorderState:
        """The state of the recording; lost rows include those that never reached the writer."""
        return self._sink.state().plus_lost(self._refused)

    def problem(self) -> str:
        """Why rows are not recorded now, as text; empty while they are. For rows that were lost: since the last call."""
        refused, self._refused_before = self._refused - self._refused_before, self._refused
        return self._sink.state().reason or (f"{refused} cycles were lost: the disk is too slow" if refused else "")

    @property
    def lost_rows(self) -> int:
        """Number of rows that are not in any file."""
        return self.state().lost_rows

    def last_rows(self) -> tuple[bytes, ...]:
        """The latest rows, oldest first."""
        return tuple(row for row in self._kept[self._next :] + self._kept[: self._next] if row)

    def close(self) -> None:
        """Close the sink."""
        self._sink.close()


TOOL_FIELD = ("tool", "B")  # index into the header's `tools`
GRIPPER_FIELDS = (("gripper_m", "f"), ("gripper_goal_m", "f"), ("gripper_A", "f"), ("gripper_state", "B"))
DIGITAL_FIELD = ("digital", "I")  # bits, in the order of the header's `digital`
LEAD_FIELD = ("lead{}_rad", "f")  # motor minus joint, where both have an encoder; NaN while no new pair came
END_FIELDS = (TOOL_FIELD, *GRIPPER_FIELDS, DIGITAL_FIELD)  # all that there may be


def layout_of(arm: Arm) -> Layout:
    """The columns for an arm: joint angles where they differ from the encoders', and what is at its end."""
    of_leads = [d.joint for d in arm.drives if d.motor_counts_per_rev is not None]
    more = [(LEAD_FIELD[0].format(joint), LEAD_FIELD[1]) for joint in of_leads]
    more += [TOOL_FIELD] if arm.spare_tools else []
    more += GRIPPER_FIELDS if arm.gripper is not None else ()
    more += [DIGITAL_FIELD] if arm.digital else []
    return Layout.of(arm.joint_count, has_joint_side(arm), more)


def about_columns(arm: Arm) -> dict[str, Any]:
    """What the header of the arm's recording says for these columns."""
    about: dict[str, Any] = {}
    if arm.spare_tools:
        about["tools"] = [tool.name for tool in arm.tools]
    if arm.gripper is not None:
        about["gripper_states"] = [state.name for state in GripState]
    if arm.digital:
        about["digital"] = [pin.name for pin in arm.digital]
    return about


def about_cell(cell: Cell, arm: str) -> dict[str, Any]:
    """What the header of an arm's recording says of the cell that it is in: all bases; nothing of an arm alone."""
    if len(cell.arms) == 1:
        return {}
    bases = {placed.name: {"origin_m": placed.origin_m, "orientation": placed.orientation} for placed in cell.arms}
    return {"cell": {"name": cell.name, "arm": arm, "bases": bases}}
