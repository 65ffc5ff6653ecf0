"""The arm of a recording, from its header."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from pathlib import Path

from control.errors import ArmError
from control.model.arm import Arm
from control.model.description import load_arm, parse_arm
from control.recording.reading import Recording


def recorded_arm(recording: Recording) -> Arm | None:
    """The recorded arm, else the file named in the header, else the supplied arm of that name.

    None if there is none of these, or only one with another number of joints.
    """
    for arm in _candidates(recording):
        if arm.joint_count == recording.layout.joint_count:
            return arm
    return None


def _candidates(recording: Recording) -> Iterator[Arm]:
    header, file = recording.header, Path(str(recording.header.get("arm_file", "")))
    try:
        if isinstance(text := header.get("arm_toml"), str):
            yield dataclasses.replace(parse_arm(text, file), path=file)
    except ArmError:
        pass  # written by another version: the file may still be readable
    for name in (file, header.get("arm")):
        try:
            if name and str(name) != ".":
                yield load_arm(str(name))
        except ArmError:
            continue
