"""Files are written whole or not at all; a disk that takes no more is one sentence that names the file."""

from __future__ import annotations

import contextlib
import os
import resource
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from control.files import (
    APART,
    KeptLines,
    NotWritten,
    append_whole,
    changing,
    make_whole,
    make_whole_folder,
    open_to_append,
    read_text,
    require_writable,
    write_whole,
)
from control.model.description import load_arm, save_arm


@contextlib.contextmanager
def files_up_to(size: int) -> Iterator[None]:
    """The kernel's own limit: a write that would pass it comes back short, the next fails."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def test_a_file_for_which_there_is_no_room_stays_as_it_was_and_nothing_is_left_beside_it(tmp_path: Path) -> None:
    file = tmp_path / "report.html"
    write_whole(file, "the old one")
    with files_up_to(5), pytest.raises(NotWritten, match=r"report\.html: not written: File too large"):
        write_whole(file, "the new one")
    assert file.read_text("utf-8") == "the old one"
    assert [path.name for path in tmp_path.iterdir()] == ["report.html"]


def test_the_folder_of_a_file_is_made_with_it(tmp_path: Path) -> None:
    write_whole(tmp_path / "not" / "there" / "a", "1")
    assert (tmp_path / "not" / "there" / "a").read_text() == "1"


def test_text_is_utf_8_whatever_the_locale_says(tmp_path: Path) -> None:
    write_whole(tmp_path / "Prüfung.txt", "3 °C ± 1 µm")
    assert (tmp_path / "Prüfung.txt").read_bytes() == "3 °C ± 1 µm".encode()


def test_text_of_a_windows_editor_is_read_as_the_same_text(tmp_path: Path) -> None:
    (tmp_path / "a.toml").write_bytes(b'\xef\xbb\xbfname = "a"\r\nlines = 2\r\n')
    assert read_text(tmp_path / "a.toml") == 'name = "a"\nlines = 2\n'


def test_a_writer_that_is_interrupted_leaves_no_file(tmp_path: Path) -> None:
    def interrupted(beside: Path) -> None:
        beside.write_text("half", "utf-8")
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        make_whole(tmp_path / "a.png", interrupted)
    assert not list(tmp_path.iterdir())


def test_the_file_beside_keeps_the_ending_and_a_name_that_the_system_takes(tmp_path: Path) -> None:
    for name in ("a.csv.gz", "x" * 250 + ".png"):
        assert make_whole(tmp_path / name, lambda beside: (beside.write_bytes(b"-"), beside.suffix)[1]) == Path(name).suffix


def test_a_new_file_never_takes_the_place_of_another(tmp_path: Path) -> None:
    write_whole(tmp_path / "a", "1", is_new=True)
    with pytest.raises(FileExistsError):
        write_whole(tmp_path / "a", "2", is_new=True)


def test_a_record_that_does_not_fit_is_not_there_in_part(tmp_path: Path) -> None:
    path = tmp_path / "points.csv"
    with path.open("a+b", buffering=0) as file:
        append_whole(file.fileno(), path, b"first\n")
        with files_up_to(9), pytest.raises(NotWritten, match=r"points\.csv"):
            append_whole(file.fileno(), path, b"second\n")
        append_whole(file.fileno(), path, b"third\n")
    assert path.read_bytes() == b"first\nthird\n"


@pytest.mark.parametrize("is_replaced", [False, True])
def test_a_record_is_not_written_where_nobody_would_find_it(tmp_path: Path, is_replaced: bool) -> None:
    path = tmp_path / "points.csv"
    with path.open("a+b", buffering=0) as file:
        append_whole(file.fileno(), path, b"first\n")
        path.rename(tmp_path / "aside")
        if is_replaced:
            path.write_bytes(b"another\n")
        with pytest.raises(NotWritten, match=r"points\.csv: not written: it was removed or replaced"):
            append_whole(file.fileno(), path, b"second\n")
    assert (tmp_path / "aside").read_bytes() == b"first\n"


def test_an_arm_that_finds_no_room_is_no_half_arm(tmp_path: Path) -> None:
    with files_up_to(100), pytest.raises(NotWritten, match=r"arm\.toml"):
        save_arm(load_arm("right"), tmp_path / "arm.toml")
    assert not list(tmp_path.iterdir())


def test_a_folder_that_finds_no_room_is_no_half_folder(tmp_path: Path) -> None:
    def write(folder: Path) -> None:
        (folder / "small").write_bytes(b"1")
        (folder / "large").write_bytes(bytes(200))

    with files_up_to(100), pytest.raises(NotWritten, match="new"):
        make_whole_folder(tmp_path / "new", write)
    assert not list(tmp_path.iterdir())
    make_whole_folder(tmp_path / "new", write)
    assert sorted(path.name for path in (tmp_path / "new").iterdir()) == ["large", "small"]


def test_what_a_killed_program_left_goes_and_what_a_running_one_writes_stays(tmp_path: Path) -> None:
    (tmp_path / f"{APART}killed").mkdir(mode=0o700)
    (tmp_path / f"{APART}killed" / "half").write_bytes(b"1")

    def write(apart: Path) -> None:
        write_whole(tmp_path / "b", "of another program meanwhile")
        apart.write_bytes(b"whole")

    make_whole(tmp_path / "a", write)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a", "b"]
    assert (tmp_path / "a").read_bytes() == b"whole"


@pytest.fixture
def precious(tmp_path: Path) -> Path:
    """A file to which somebody wants another's program to write."""
    (tmp_path / "home").mkdir()
    (tmp_path / "home" / "precious").write_bytes(b"precious")
    return tmp_path / "home" / "precious"


def test_a_folder_that_is_put_in_the_place_of_ours_gets_nothing(tmp_path: Path, precious: Path) -> None:
    shared = tmp_path / "shared"
    shared.mkdir()

    def write(apart: Path) -> None:
        (ours,) = shared.iterdir()
        ours.rename(shared / "aside")
        ours.mkdir()
        (ours / "places.toml").symlink_to(precious)
        apart.write_bytes(b"a place")

    make_whole(shared / "places.toml", write)
    assert precious.read_bytes() == b"precious"
    assert (shared / "places.toml").read_bytes() == b"a place"
    assert not (shared / "places.toml").is_symlink()


def test_a_file_is_appended_through_links_of_ours_only(tmp_path: Path, precious: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    link = tmp_path / "history.jsonl"
    link.symlink_to(precious)
    with open_to_append(link) as file:
        assert file.write(b"!") == 1
    monkeypatch.setattr(os, "geteuid", lambda: os.getuid() + 1)
    with pytest.raises(NotWritten, match=r"history\.jsonl: not written"):
        open_to_append(link)
    assert precious.read_bytes() == b"precious!"


@pytest.mark.parametrize("has_links", [True, False])
def test_a_new_file_gives_way_to_one_that_came_while_it_was_written(
    tmp_path: Path, has_links: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    def no_links(*_: object, **__: object) -> None:
        raise PermissionError(1, "Operation not permitted")

    def write(apart: Path) -> None:
        apart.write_bytes(b"mine")
        (tmp_path / "arm.toml").write_bytes(b"theirs")

    if not has_links:  # FAT
        monkeypatch.setattr(os, "link", no_links)
    with pytest.raises(FileExistsError, match=r"arm\.toml"):
        make_whole(tmp_path / "arm.toml", write, is_new=True)
    assert [path.name for path in tmp_path.iterdir()] == ["arm.toml"]
    assert (tmp_path / "arm.toml").read_bytes() == b"theirs"
    write_whole(tmp_path / "another.toml", "mine", is_new=True)
    assert (tmp_path / "another.toml").read_bytes() == b"mine"


ADDS = """
import sys
from pathlib import Path
from control.files import changing, read_text, write_whole
file, who = Path(sys.argv[1]), sys.argv[2]
for number in range(40):
    with changing(file):
        write_whole(file, read_text(file) + f"{who}{number}\\n")
"""


def test_of_programs_that_change_a_file_at_once_none_loses_what_another_has_written(tmp_path: Path) -> None:
    file = tmp_path / "places"
    programs = [subprocess.Popen([sys.executable, "-c", ADDS, os.fspath(file), who]) for who in "abc"]
    assert [program.wait() for program in programs] == [0, 0, 0]
    assert sorted(file.read_text("utf-8").split()) == sorted(f"{who}{k}" for who in "abc" for k in range(40))
    assert [path.name for path in tmp_path.iterdir()] == ["places"]


def test_a_file_that_is_not_changed_after_all_is_not_made(tmp_path: Path) -> None:
    with contextlib.suppress(ValueError), changing(tmp_path / "places"):
        raise ValueError
    assert not list(tmp_path.iterdir())


def test_trying_a_place_leaves_no_trace(tmp_path: Path) -> None:
    require_writable(tmp_path / "not" / "yet" / "there")
    require_writable(tmp_path)
    with files_up_to(100), pytest.raises(NotWritten, match="there"):
        require_writable(tmp_path / "there")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("place", ["file/folder", "file"])
def test_a_place_that_is_none_is_refused(tmp_path: Path, place: str) -> None:
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(NotWritten, match=os.fspath(tmp_path)):
        require_writable(tmp_path / place)


def kept(path: Path, *lines: str, header: str = "a,b") -> list[bytes]:
    """The lines that were there, after appending others."""
    with contextlib.closing(KeptLines(path, ValueError, header)) as file:
        file.append(*lines)
        return file.lines


def test_lines_are_kept_and_an_end_torn_at_any_byte_is_dropped(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    assert kept(path, "1,2", "3,4") == []
    content, whole = path.read_bytes(), len(b"a,b\n1,2\n")
    for end in range(whole, len(content)):
        path.write_bytes(content[:end])
        with contextlib.closing(KeptLines(path, ValueError, "a,b")) as file:
            assert (file.lines, file.torn) == ([b"1,2"], content[whole:end])
        assert path.read_bytes() == content[:whole]
    kept(path, "7,8")
    assert path.read_bytes() == b"a,b\n1,2\n7,8\n"


def test_a_file_of_other_columns_or_in_use_is_refused_and_stays_as_it_is(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    path.write_bytes(b"a,c\n1,2\n3,")
    with pytest.raises(ValueError, match="line 1: recorded otherwise: expected column b, got c"):
        kept(path)
    assert path.read_bytes() == b"a,c\n1,2\n3,"
    with contextlib.closing(KeptLines(path, ValueError)) as file:
        with pytest.raises(ValueError, match="another program is recording into it"):
            kept(path)
        file.replace("5,6")
        file.append("7,8")
        with pytest.raises(ValueError, match="another program is recording into it"):
            kept(path)
    assert path.read_bytes() == b"5,6\n7,8\n"
