"""report.html of the gap workflow: the answer, the gap as the model grew, what could be named, what is left where."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from calib.gap.finding import GapFinding
from calib.gap.static.find import StaticGap
from calib.gap.static.nameable import NAMEABLE_sd, is_nameable
from calib.gap.static.pictures import joint_picture, recordings_picture
from calib.gap.words import in_words, listed, parameters_text
from calib.page import Section, page, paragraph, table, tiles, verdict


def gap_page(found: GapFinding, static: StaticGap | None, date: str, program_version: str) -> str:
    """The whole page."""
    return page("The gap", found.arm, f"{date} · {program_version}", _parts(found, static))


def _parts(found: GapFinding, static: StaticGap | None) -> Iterator[Section | str]:
    yield verdict(in_words(found))
    yield tiles(_tiles(found))
    yield _effects(found)
    if static is not None:
        yield from _static(static)
    yield _nameable(found)


def _tiles(found: GapFinding) -> Iterator[tuple[str, str, str]]:
    yield "before", f"{found.gap_before:.2f}", "times the noise before, on recordings kept apart"
    yield "after", f"{found.gap_after:.2f}", "times the noise after"
    for channel, value in found.after_si.items():
        before = found.before_si.get(channel, float("nan"))
        yield "", f"{value:.3g}", f"{channel} after ({before:.3g} before), root mean square"


def _effects(found: GapFinding) -> Section:
    rows = [
        (str(effect.name), ("text", _shortened(parameters_text(effect))), f"{effect.gap_after:.3f}")
        for effect in found.effects
    ]
    if not rows:
        return Section("Added to the model", paragraph("Nothing."))
    return Section("Added to the model, in this order", table(("effect", "parameters", "gap after"), rows))


def _shortened(text: str) -> str:
    parts = text.split(", ")
    return text if len(parts) <= 4 else f"{', '.join(parts[:4])} and {len(parts) - 4} more (gap.json)"


def _static(gap: StaticGap) -> Iterator[Section]:
    kept = int(gap.split.report.sum())
    how = (
        f"{gap.split.recordings_count} recordings; {kept} of {len(gap.points)} poses were kept apart for the report."
        if gap.split.is_divided
        else "Too few recordings to keep one apart: the gap is that of the poses which were fitted."
    )
    yield Section(
        "Static poses, by recording",
        paragraph(
            f"Noise of one axis of the tip: {1e3 * gap.floor.tip_m:.3f} mm, from {gap.floor.source}. {how}"
        )
        + recordings_picture(gap),
    )
    for joint in _joints(gap):
        yield Section(f"Along joint {joint}", joint_picture(gap, joint))


def _joints(gap: StaticGap) -> Sequence[int]:
    """The joints that something was found on; the one with most left otherwise."""
    named = [3 if one.name.effect == "belt_coupling" else one.name.joint for one in gap.finding.effects]
    found = [joint for joint in dict.fromkeys(named) if joint is not None]
    if gap.finding.unknown is not None:
        found += [
            j for j in range(1, gap.points.joint_count + 1) if f"joint {j}:" in gap.finding.unknown.where
        ]
    return list(dict.fromkeys(found)) or [int(np.argmax(np.ptp(gap.points.q_rad, axis=0))) + 1]


def _nameable(found: GapFinding) -> Section:
    rows = [
        (
            str(one.name),
            f"{one.detectability:.1f}",
            ("text", listed(one.confusable_with) if one.confusable_with else ""),
            ("text", "yes" if is_nameable(one) else "no"),
        )
        for one in found.nameable
    ]
    header = ("effect", "detectability [sd]", ("text", "not to be told from"), ("text", "would be named"))
    return Section(
        "What this data could name at all",
        paragraph(
            "How far an effect of usual size would stand out beside the geometry, before any residual is looked at; it takes"
            f" {NAMEABLE_sd:.1f} standard deviations to be named."
        )
        + table(header, rows),
    )
