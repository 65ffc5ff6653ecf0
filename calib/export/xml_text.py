"""XML output: numbers that read back exactly, and safe names and comments."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from collections.abc import Iterable

from control.model.arm import Arm

# Not allowed in XML 1.0 even escaped: controls, lone surrogates, the last two of the first plane.
_FORBIDDEN = re.compile("[\x00-\x08\x0b\x0c\x0e-\x1f\ud800-\udfff\ufffe\uffff]")


def numbers(values: Iterable[float]) -> str:
    """Format numbers so that they read back exactly."""
    return " ".join(repr(float(value)) for value in values)


def safe(text: str) -> str:
    """A name for XML: invalid characters become underscores, line breaks spaces."""
    return _FORBIDDEN.sub("_", " ".join(text.split())) or "arm"


def document(root: ET.Element, comment: str) -> str:
    """The whole file, indented, with a leading comment."""
    ET.indent(root)
    text = re.sub(r"-(?=-)", "- ", safe(comment)).rstrip("-")
    return (
        f'<?xml version="1.0" encoding="utf-8"?>\n<!-- {text} -->\n{ET.tostring(root, encoding="unicode")}\n'
    )


def about(arm: Arm) -> str:
    """The origin of the arm, for the leading comment."""
    text = f"armwright: arm {arm.name}, {arm.dh_convention} DH, SI units and radians"
    made = arm.calibration
    if made is None:
        return f"{text}; not calibrated"
    inputs = ", ".join(f"{name} (SHA-256 {digest})" for name, digest in made.inputs.items())
    return f"{text}; calibrated from {made.source} on {made.date}, {made.objective}, {made.program_version}, with {inputs}"
