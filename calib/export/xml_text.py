"""XML as a file has it: numbers that read back exactly, names and comments that no sign in them can break."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from collections.abc import Iterable

from control.model.arm import Arm

# What XML 1.0 cannot hold even escaped: controls, lone surrogates, the last two of the first plane.
_FORBIDDEN = re.compile("[\x00-\x08\x0b\x0c\x0e-\x1f\ud800-\udfff\ufffe\uffff]")


def numbers(values: Iterable[float]) -> str:
    """Numbers that read back exactly."""
    return " ".join(repr(float(value)) for value in values)


def safe(text: str) -> str:
    """A name that XML can hold: what it cannot is an underscore, line breaks are spaces."""
    return _FORBIDDEN.sub("_", " ".join(text.split())) or "arm"


def document(root: ET.Element, comment: str) -> str:
    """The whole file, indented, with a comment ahead."""
    ET.indent(root)
    said = re.sub(r"-(?=-)", "- ", safe(comment)).rstrip("-")
    return (
        f'<?xml version="1.0" encoding="utf-8"?>\n<!-- {said} -->\n{ET.tostring(root, encoding="unicode")}\n'
    )


def about(arm: Arm) -> str:
    """Where the arm comes from, for the comment ahead."""
    said = f"armwright: arm {arm.name}, {arm.dh_convention} DH, SI units and radians"
    made = arm.calibration
    if made is None:
        return f"{said}; not calibrated"
    inputs = ", ".join(f"{name} (SHA-256 {digest})" for name, digest in made.inputs.items())
    return f"{said}; calibrated from {made.source} on {made.date}, {made.objective}, {made.program_version}, with {inputs}"
