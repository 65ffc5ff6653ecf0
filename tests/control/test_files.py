"""Files are written whole or not at all; a disk that takes no more is one sentence that names the file."""

from __future__ import annotations

import contextlib
import os
import resource
from collections.abc import Iterator
from pathlib import Path

import pytest

from control.files import (
    NotWritten,
    append_whole,
    make_whole,
    make_whole_folder,
    require_writable,
    write_new,
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


def test_a_file_for_which_there_is_no_room_stays_as_it_was_and_nothing_is_left_beside_it(
    tmp_path: Path,
) -> None:
    file = tmp_path / "report.html"
    write_whole(file, "the old one")
    with files_up_to(5), pytest.raises(NotWritten, match=r"report\.html: not written: File too large"):
        write_whole(file, "the new one")
    assert file.read_text("utf-8") == "the old one"
    assert [path.name for path in tmp_path.iterdir()] == ["report.html"]


def test_text_is_utf_8_whatever_the_locale_says(tmp_path: Path) -> None:
    write_whole(tmp_path / "Prüfung.txt", "3 °C ± 1 µm")
    assert (tmp_path / "Prüfung.txt").read_bytes() == "3 °C ± 1 µm".encode()


def test_a_writer_that_is_interrupted_leaves_no_file(tmp_path: Path) -> None:
    def interrupted(beside: Path) -> None:
        beside.write_text("half", "utf-8")
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        make_whole(tmp_path / "a.png", interrupted)
    assert not list(tmp_path.iterdir())


def test_the_file_beside_keeps_the_ending_and_a_name_that_the_system_takes(tmp_path: Path) -> None:
    for name in ("a.csv.gz", "x" * 250 + ".png"):
        assert (
            make_whole(tmp_path / name, lambda beside: (beside.write_bytes(b"-"), beside.suffix)[1])
            == Path(name).suffix
        )


def test_a_new_file_never_takes_the_place_of_another(tmp_path: Path) -> None:
    write_new(tmp_path / "a", "1")
    with pytest.raises(FileExistsError):
        write_new(tmp_path / "a", "2")


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

    (tmp_path / ".partial-new" / "of a program that was killed").mkdir(parents=True)
    with files_up_to(100), pytest.raises(NotWritten, match="new"):
        make_whole_folder(tmp_path / "new", write)
    assert not list(tmp_path.iterdir())
    make_whole_folder(tmp_path / "new", write)
    assert sorted(path.name for path in (tmp_path / "new").iterdir()) == ["large", "small"]


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
