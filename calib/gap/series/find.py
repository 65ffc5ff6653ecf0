"""From a log to what is missing in the model: the time-series half of the gap workflow."""

from __future__ import annotations

from collections.abc import Collection

from calib.arrays import Array
from calib.gap.finding import GapFinding
from calib.gap.log import Log
from calib.gap.residuals.rows import Rows, without_motion
from calib.gap.series.answer import (
    Judged,
    judged,
    nameable_effects,
    next_experiment,
    open_questions,
    silent,
    stages,
    what_is_left,
)
from calib.gap.series.drawing.laws import drawn_laws
from calib.gap.series.look import Look, looked
from calib.gap.series.outcome import DynamicOutcome, doubts, floors_si, gap, grown, in_rad, in_si, left_out
from calib.gap.series.plausible import plausible
from calib.gap.series.scene import Scene
from calib.gap.series.split import Split, split
from calib.gap.series.standing import borne_out
from calib.gap.signals import forms
from calib.gap.signals.motion import motion_gaps
from calib.gap.signals.physics import Physics
from calib.gap.signals.recording import Recording, prepare
from control.model.arm import Arm
from control.progress import Advance
from control.progress import silent as quiet


def find(
    arm: Arm, log: Log, advance: Advance | None = None, candidates: Collection[str] | None = None
) -> GapFinding:
    """What is hidden in a log of this arm; `candidates`: only these effects of the list, by name.

    Raises UnusableLogError where no answer is possible (another arm's log, degrees, runs that are too short).
    """
    return examine(arm, log, advance, candidates).finding


def examine(
    arm: Arm, log: Log, advance: Advance | None = None, candidates: Collection[str] | None = None
) -> DynamicOutcome:
    """`find`, with what a report shows beside the finding."""
    told = _rising(advance or quiet)
    told("reading the runs", 0.0)
    recording = plausible(arm, prepare(arm, log))
    known = forms.known_terms(arm)
    rows = Rows(Physics(arm, recording), known)
    unmoved = without_motion(rows.table)
    parts = split(recording, rows.table)
    scene = Scene(rows, known)
    look = looked(scene, known, parts, candidates, told)
    told("the gap on runs used for nothing else", 0.95)
    parts = parts.only(scene.kept)
    look, harming = borne_out(look, parts.reporting)
    told_of = judged(look, parts.reporting, harming)
    look = told_of.look
    before = rows.residual(known)
    after = what_is_left(look, told_of.kept) if told_of.kept else before  # nothing is added to the model
    finding = _finding(arm, log, recording, look, told_of, parts, (before, after))
    told("done", 1.0)
    said = (
        *unmoved,
        *doubts(before, rows.table),
        *left_out(scene.kept, rows.table),
        *told_of.warnings,
        *grown(finding),
    )
    names = tuple(run.name for run in recording.runs)
    model = (*known, *(law for key, law in look.laws().items() if key in told_of.kept))
    return DynamicOutcome(
        finding,
        (*recording.warnings, *said),
        rows.table,
        before,
        after,
        parts,
        names,
        rows.physics,
        model,
        drawn_laws(look, [one.name for one in finding.effects]),
    )


def _finding(
    arm: Arm, log: Log, recording: Recording, look: Look, told_of: Judged, parts: Split, sizes: tuple[Array, Array]
) -> GapFinding:  # fmt: skip
    """What was decided, with the gap on the runs that were used for nothing else; `sizes`: rows before and after."""
    before, after = sizes
    rows, known, reporting = look.around.scene.rows, look.around.known, parts.reporting
    moved = motion_gaps(rows.physics, known, (*known, *told_of.laws.values()), parts.report_runs)
    unknown = told_of.unknown or silent(look, what_is_left(look, told_of.kept), reporting, told_of.harming)
    return GapFinding(
        arm=arm.name,
        data=log.sources,
        noise_floor={**floors_si(rows.table, arm), **in_rad(moved, "floor_rad")},
        gap_before=gap(before, rows.table, reporting),
        gap_after=gap(after, rows.table, reporting),
        before_si={**in_si(before, rows.table, reporting, arm), **in_rad(moved, "before_rad")},
        after_si={**in_si(after, rows.table, reporting, arm), **in_rad(moved, "after_rad")},
        effects=stages(look, told_of, reporting),
        ambiguous=told_of.ambiguous,
        unknown=unknown,
        nameable=nameable_effects(look),
        next_experiment=next_experiment(recording, told_of.ambiguous, unknown),
        remainder=told_of.remainder,
        open_questions=open_questions(recording, told_of),
    )


def _rising(advance: Advance) -> Advance:
    """Progress that does not go back where a search begins again."""
    most = 0.0

    def told(what: str, share: float) -> None:
        nonlocal most
        most = max(most, share)
        advance(what, most)

    return told
