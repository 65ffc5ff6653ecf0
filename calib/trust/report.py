"""report.html of an error map."""

from __future__ import annotations

from collections.abc import Sequence

from calib.report.page import Section, bullets, page, pair, paragraph, table, verdict
from calib.trust.iso9283 import PoseFigures, pose_rows
from calib.trust.pictures import causes_picture, map_picture, payload_picture, space_picture
from calib.trust.task import Reliability
from calib.trust.trust import Trust
from calib.trust.words import POSE_HEAD, cause_rows, sentences, task_sentences

ABOUT = (
    "Colours: the distance from where the arm's file puts the tip that one visit keeps in 95 % of cases, from either direction"
    " of approach. It counts what is expected and not corrected, what the points do not determine, and what scatters."
)


def trust_report(
    trust: Trust,
    tasks: Sequence[Reliability],
    poses: Sequence[PoseFigures],
    date: str,
    program_version: str,
) -> str:
    """The page."""
    parts: list[Section | str] = [verdict(sentences(trust))]
    if tasks:
        parts.append(Section("Tasks", bullets(line for one in tasks for line in task_sentences(one))))
    if poses:
        parts.append(Section("ISO 9283: pose accuracy and repeatability", table(POSE_HEAD, pose_rows(poses))))
    parts += [
        Section("The error over the workspace", paragraph(ABOUT) + map_picture(trust)),
        Section("In space, and by payload", pair(space_picture(trust), payload_picture(trust))),
        Section(
            "What costs most",
            table(("if this were known exactly", "left [mm]", "expected [mm]"), cause_rows(trust))
            + causes_picture(trust),
        ),
    ]
    if trust.warnings:
        parts.append(Section("Warnings", bullets(trust.warnings)))
    return page("How far the arm can be trusted", trust.arm.name, f"{date} · {program_version}", parts)
