"""Folders for results: never overwritten, and checked before anything moves."""

from collections.abc import Sequence
from pathlib import Path

from control import files
from control.errors import ArmError


def free_folder(wanted: Path) -> Path:
    """`wanted`, or the first of `wanted-2`, `wanted-3`, ... that is not used. ArmError for a file.

    For places that nobody named, and demos; a folder that somebody named is never another one.
    """
    folder, number = wanted, 1
    if wanted.exists() and not wanted.is_dir():
        raise ArmError(f"--out {wanted}: expected a folder, new or old, got a file: choose another place")
    while folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        number += 1
        folder = wanted.with_name(f"{wanted.name}-{number}")
    if folder.exists():
        folder.rmdir()
    return folder


def require_writable(folder: Path, option: str = "--out") -> None:
    """ArmError if `folder` is not writable: checked before an arm moves, so that no results are lost."""
    try:
        files.require_writable(folder)
    except files.NotWritten as error:
        raise ArmError(f"{option} {error}") from error


def require_empty(folder: Path) -> None:
    """ArmError if something is in `folder`, or it is not writable."""
    if folder.is_dir() and any(folder.iterdir()):
        raise ArmError(f"--out {folder}: is not empty, and nothing is overwritten: choose another folder")
    require_writable(folder)


def require_new(folder: Path, results: Sequence[str]) -> None:
    """ArmError if `folder` has one of the results already, or is not writable."""
    for name in results:
        if (folder / name).exists():
            raise ArmError(f"{folder / name} exists already and is never overwritten: choose another --out")
    require_writable(folder)
