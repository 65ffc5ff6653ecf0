"""A recording survives a full disk, rotates, removes only what it may, and never tears a row."""

from __future__ import annotations

import errno
import math
import os
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from control.recording.reading import Recording
from control.recording.record import Layout
from control.recording.recorder_state import RecorderState, next_part, parts_from
from control.recording.writer import PartFile, Policy, RecordingParts, RETRY_s, begin, remove_oldest

LAYOUT = Layout.of(2)
ROW = LAYOUT.packing.size
NAMES = LAYOUT.names
LARGE = Policy(rotate_bytes=1 << 30)


def row(cycle: int) -> bytes:
    values = [cycle if name == "cycle" else 0 for name in NAMES]
    return LAYOUT.packing.pack(*values)


def rows(first: int, count: int) -> bytes:
    return b"".join(row(cycle) for cycle in range(first, first + count))


def cycles(path: Path) -> list[int]:
    at = NAMES.index("cycle")
    return [int(values[at]) for values in Recording.open(path).rows()]


@dataclass
class Disk:
    """A disk with room for `room` bytes more; a write may come back short, as the kernel's does."""

    room: int = 1 << 30
    error: int = errno.ENOSPC
    said: list[str] = field(default_factory=list)
    now_s: float = 0.0

    def pwrite(self, fd: int, content: bytes, at: int) -> int:
        if self.room <= 0:
            raise OSError(self.error, os.strerror(self.error))
        written = os.pwrite(fd, content[: self.room], at)
        self.room -= written
        return written

    def parts(self, folder: Path, policy: Policy = LARGE, name: str = "right-20260101-120000.armlog") -> RecordingParts:
        begin(folder / name, LAYOUT.about(arm="right", period_s=0.002))
        return RecordingParts(folder / name, policy, self.said.append, self.pwrite, lambda: self.now_s)


@pytest.fixture
def disk() -> Disk:
    return Disk()


@pytest.mark.parametrize("torn", [0, 1, ROW // 2, ROW - 1])
def test_a_full_disk_keeps_whole_rows_and_recording_resumes_in_the_same_file_when_there_is_room(
    tmp_path: Path, disk: Disk, torn: int
) -> None:
    parts = disk.parts(tmp_path)
    disk.room = 3 * ROW + torn
    parts.append(rows(0, 5))
    stopped = parts.state()
    assert (stopped.is_on, stopped.reason, stopped.lost_rows) == (False, "No space left on device", 2)
    assert cycles(Path(stopped.file)) == [0, 1, 2]
    assert Path(stopped.file).stat().st_size == Recording.open(Path(stopped.file)).offset + 3 * ROW
    disk.room = 1 << 30
    parts.append(rows(5, 4))  # too early for another trial
    assert parts.state().lost_rows == 6
    disk.now_s += RETRY_s
    parts.append(rows(9, 2))
    parts.close()
    assert parts.state().is_on
    assert cycles(tmp_path / "right-20260101-120000.armlog") == [0, 1, 2, 9, 10]
    assert [("stopped" in said, "6 rows were lost" in said) for said in disk.said] == [(True, False), (False, True)]
    assert all("right-20260101-120000.armlog" in said for said in disk.said)


def test_a_disk_that_stays_full_is_told_once_however_often_it_is_tried(tmp_path: Path, disk: Disk) -> None:
    parts = disk.parts(tmp_path)
    disk.room = 0
    for cycle in range(20):
        parts.append(row(cycle))
        disk.now_s += RETRY_s
    assert parts.state().lost_rows == 20
    assert len(disk.said) == 1


@pytest.mark.parametrize("error", [errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO])
def test_whatever_the_disk_says_the_reason_is_in_the_state(tmp_path: Path, disk: Disk, error: int) -> None:
    parts = disk.parts(tmp_path)
    disk.room, disk.error = 0, error
    parts.append(row(0))
    assert parts.state().reason == os.strerror(error)


def test_a_recording_rotates_into_files_that_are_readable_each_for_itself(tmp_path: Path, disk: Disk) -> None:
    offset = len(LAYOUT.header({"arm": "right", "period_s": 0.002, "started_unix_s": 1.0}))
    parts = disk.parts(tmp_path, Policy(rotate_bytes=offset + 40 * ROW))
    for first in range(0, 100, 10):
        parts.append(rows(first, 10))
    written = parts.state().written_bytes
    parts.close()
    files = parts_from(tmp_path / "right-20260101-120000.armlog")
    assert [file.name for file in files] == [
        "right-20260101-120000.armlog",
        "right-20260101-120000.part2.armlog",
        "right-20260101-120000.part3.armlog",
    ]
    assert [cycle for file in files for cycle in cycles(file)] == list(range(100))
    assert {Recording.open(file).header["arm"] for file in files} == {"right"}
    assert Recording.open(files[1]).header["started_unix_s"] > 1.0
    assert written == sum(file.stat().st_size for file in files)


def test_a_disk_that_is_full_when_the_next_file_begins_leaves_no_half_of_it(tmp_path: Path, disk: Disk) -> None:
    parts = disk.parts(tmp_path, Policy(rotate_bytes=1))
    parts.append(rows(0, 3))
    disk.room = 7
    parts.append(rows(3, 3))
    assert [path.name for path in tmp_path.iterdir()] == ["right-20260101-120000.armlog"]
    disk.room, disk.now_s = 1 << 30, RETRY_s
    parts.append(rows(6, 3))
    parts.close()
    assert cycles(tmp_path / "right-20260101-120000.part2.armlog") == [6, 7, 8]


def test_a_recording_that_somebody_removes_to_make_room_goes_on_in_the_next_file(tmp_path: Path, disk: Disk) -> None:
    parts = disk.parts(tmp_path)
    parts.append(rows(0, 3))
    (tmp_path / "right-20260101-120000.armlog").unlink()
    parts.append(rows(3, 2))
    parts.close()
    assert cycles(tmp_path / "right-20260101-120000.part2.armlog") == [3, 4]


@pytest.mark.parametrize("is_framed", [False, True])
@pytest.mark.parametrize("left", [0.0, 1e-6, 1e-3, 0.5, 0.9, 1.5])
def test_a_recording_that_another_program_empties_or_cuts_says_so_and_goes_on_in_a_file_that_can_be_read(
    tmp_path: Path, disk: Disk, left: float, is_framed: bool
) -> None:
    about = {"arm": "right", "period_s": 0.002, **(LAYOUT.framed([1e-5] * 2) if is_framed else {})}
    first = tmp_path / "right-20260101-120000.armlog"
    begin(first, LAYOUT.about(**about))
    parts = RecordingParts(first, LARGE, disk.said.append)
    parts.append(rows(0, 1000))
    os.truncate(first, math.ceil(left * first.stat().st_size))  # 1.5: with a hole
    parts.append(rows(1000, 5))
    parts.append(rows(1005, 5))
    state = parts.state()
    parts.close()
    read = [cycles(part) for part in parts_from(first)]
    assert read[0] == list(range(len(read[0])))
    assert read[1:] == [list(range(1000, 1010))]
    assert state.is_on
    assert state.lost_rows == 1010 - sum(map(len, read))
    assert [f", and {state.lost_rows} cycles" in said for said in disk.said] == [left < 1.0]


def test_a_recording_that_is_moved_away_keeps_its_rows_and_goes_on_where_it_is_looked_for(tmp_path: Path, disk: Disk) -> None:
    parts = disk.parts(tmp_path)
    first = tmp_path / "right-20260101-120000.armlog"
    parts.append(rows(0, 3))
    first.rename(tmp_path / "log.1")
    first.write_bytes(b"")  # as logrotate does
    parts.append(rows(3, 2))
    parts.close()
    assert (cycles(tmp_path / "log.1"), cycles(Path(parts.state().file))) == ([0, 1, 2], [3, 4])
    assert (parts.state().lost_rows, first.stat().st_size) == (0, 0)


def named(folder: Path, name: str, size: int, age: int) -> Path:
    path = folder / name
    path.write_bytes(bytes(size))
    os.utime(path, (1e9 - age, 1e9 - age))
    return path


def test_only_the_oldest_finished_recordings_of_this_arm_are_removed_and_it_is_told(tmp_path: Path) -> None:
    oldest = named(tmp_path, "right-20250101-120000.armlog", 100, 30)
    older = named(tmp_path, "right-20250102-120000.part2.armlog", 100, 20)
    newer = named(tmp_path, "right-20250103-120000-2.armlog", 100, 10)
    others = [
        named(tmp_path, name, 100, 99)
        for name in ("left-20240101-120000.armlog", "right-calibrated-20240101-120000.armlog", "right.armlog", "notes.txt")
    ]
    said: list[str] = []
    current = named(tmp_path, "right-20260101-120000.armlog", 50, 0)
    remove_oldest(current, Policy(rotate_bytes=100, keep_bytes=350), said.append)
    assert [path.exists() for path in (oldest, older, newer, current)] == [False, True, True, True]
    assert all(path.exists() for path in others)
    assert len(said) == 1
    assert str(oldest) in said[0]
    assert said[0].endswith("keeps 0.00035 MB")
    remove_oldest(current, Policy(rotate_bytes=100, keep_bytes=0), said.append)
    assert older.exists()


def test_a_recording_that_another_writer_still_has_open_is_not_removed(tmp_path: Path) -> None:
    other = tmp_path / "right-20250101-120000.armlog"
    begin(other, LAYOUT.about(arm="right"))
    writer = PartFile(other)
    current = named(tmp_path, "right-20260101-120000.armlog", 50, 0)
    policy = Policy(rotate_bytes=100, keep_bytes=200)
    remove_oldest(current, policy, lambda text: None)
    assert other.exists()
    writer.close()
    remove_oldest(current, policy, lambda text: None)
    assert not other.exists()


def test_a_recording_that_finds_no_room_for_its_header_names_the_file_and_leaves_none(tmp_path: Path, disk: Disk) -> None:
    disk.room = 5
    with pytest.raises(OSError, match=r"a\.armlog: not written: No space left on device"):
        begin(tmp_path / "a.armlog", LAYOUT.about(), disk.pwrite)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("name", "following"),
    [("a.armlog", "a.part2.armlog"), ("a.part2.armlog", "a.part3.armlog"), ("x.party.armlog", "x.party.part2.armlog")],
)
def test_parts_are_numbered(name: str, following: str) -> None:
    assert next_part(Path(name)) == Path(following)


@pytest.mark.parametrize(("hours", "says"), [(31.2, "31 h"), (0.5, "30 min"), (0.01, "less than 1 min"), (None, "")])
def test_the_time_that_the_disk_lasts_is_never_nought(hours: float | None, says: str) -> None:
    assert RecorderState(True, hours_left=hours).time_left() == says


def test_the_state_survives_being_told_and_says_what_it_takes(tmp_path: Path, disk: Disk) -> None:
    state = disk.parts(tmp_path).state()
    assert RecorderState.of({**state.content(), "of_a_later_version": 1}) == state
    assert state.bytes_per_h == pytest.approx(ROW * 500 * 3600)
    assert state.usage().startswith(f"{1e-6 * state.bytes_per_h:.0f} MB/h, room for ")
