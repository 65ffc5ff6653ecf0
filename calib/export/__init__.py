"""Export of an arm to URDF, MJCF or plain JSON. docs/export.md describes the contents.

Joint angles of the exported model are the arm's own, without offsets. The tip is a separate frame. Such programs know rigid trees
only: the links are those of the rigid arm that is nearest to the file's with its effects (`nearest`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Final

from calib.errors import CalibrationError
from calib.export.formats import mjcf_text, plain_text, urdf_text
from calib.export.rigid import losses, nearest_rigid
from control.files import write_whole
from control.model.arm import Arm

__all__ = ["FORMS", "export", "export_text", "exported", "write_new"]

# Of the rigid arm, and of the file's.
FORMS: Final[Mapping[str, Callable[[Arm, Arm], str]]] = {
    "urdf": lambda rigid, _: urdf_text(rigid),
    "mjcf": lambda rigid, _: mjcf_text(rigid),
    "json": plain_text,
}


def export(arm: Arm, form: str, path: Path, is_served: bool = False) -> tuple[str, ...]:
    """Write the arm to a new file; return one sentence for everything that the format cannot represent.

    `is_served`: for a program that moves the arm through `serve`, which corrects the effects.

    Raises:
        CalibrationError: unknown format, or the file exists.
        NotWritten: the disk is full, or the place is not ours.
    """
    text, sentences = (export_text(arm, form), losses(arm, form)) if is_served else exported(arm, form)
    write_new(path, text)
    return sentences


def write_new(path: Path, text: str) -> None:
    """Write a new file and its folder. CalibrationError if it exists, NotWritten."""
    try:
        write_whole(path, text, is_new=True)
    except FileExistsError:
        raise CalibrationError(f"{path}: already exists and is not overwritten; name another file") from None


def export_text(arm: Arm, form: str) -> str:
    """The text with the file's own links, for angles behind the effects, as `serve` has them; CalibrationError as `exported`."""
    return _text(arm, arm, form)


def exported(arm: Arm, form: str) -> tuple[str, tuple[str, ...]]:
    """The text for angles of the encoders, and what it cannot represent; CalibrationError for an unknown format."""
    rigid = nearest_rigid(arm)
    return _text(rigid.arm, arm, form), (*losses(arm, form), *rigid.notes)


def _text(rigid: Arm, arm: Arm, form: str) -> str:
    if form not in FORMS:
        raise CalibrationError(f'export form: expected one of {", ".join(FORMS)}, got "{form}"')
    return FORMS[form](rigid, arm)
