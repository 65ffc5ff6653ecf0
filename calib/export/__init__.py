"""Export of an arm to URDF, MJCF or plain JSON. docs/export.md describes the contents.

Joint angles of the exported model are the arm's own, without offsets. The tip is a separate frame.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Final

from calib.errors import CalibrationError
from calib.export.formats import mjcf_text, plain_text, urdf_text
from calib.export.frames import losses
from control.files import write_whole
from control.model.arm import Arm

__all__ = ["FORMS", "export", "export_text", "write_new"]

FORMS: Final[Mapping[str, Callable[[Arm], str]]] = {"urdf": urdf_text, "mjcf": mjcf_text, "json": plain_text}


def export(arm: Arm, form: str, path: Path) -> tuple[str, ...]:
    """Write the arm to a new file; return one sentence for everything that the format cannot represent.

    Raises:
        CalibrationError: unknown format, or the file exists.
        NotWritten: the disk is full, or the place is not ours.
    """
    write_new(path, export_text(arm, form))
    return losses(arm, form)


def write_new(path: Path, text: str) -> None:
    """Write a new file and its folder. CalibrationError if it exists, NotWritten."""
    try:
        write_whole(path, text, is_new=True)
    except FileExistsError:
        raise CalibrationError(f"{path}: already exists and is not overwritten; name another file") from None


def export_text(arm: Arm, form: str) -> str:
    """The file's text; CalibrationError for an unknown format."""
    if form not in FORMS:
        raise CalibrationError(f'export form: expected one of {", ".join(FORMS)}, got "{form}"')
    return FORMS[form](arm)
