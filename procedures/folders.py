"""Where results go: no folder that is there is overwritten, and a file that grows loses nothing to a full disk."""

from pathlib import Path


def free_folder(wanted: Path) -> Path:
    """`wanted`, or the first of `wanted-2`, `wanted-3`, ... that is not there."""
    folder, number = wanted, 1
    while folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        number += 1
        folder = wanted.with_name(f"{wanted.name}-{number}")
    if folder.exists():
        folder.rmdir()
    return folder


def write_whole(file: Path, text: str) -> None:
    """The file with this text, or as it was: what is written goes beside it first."""
    beside = file.with_name(f".{file.name}.partial")
    beside.write_text(text, encoding="utf-8")
    beside.replace(file)
