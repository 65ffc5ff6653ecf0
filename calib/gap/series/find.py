"""From a log to what is missing in the model: the time-series half of the gap workflow."""

from __future__ import annotations

from collections.abc import Collection, Sequence

import numpy as np

from calib.arrays import Array
from calib.gap.effects.catalogue import known_laws, other_forms
from calib.gap.finding import GapFinding
from calib.gap.log import Log
from calib.gap.residuals.rows import Rows, without_motion
from calib.gap.residuals.scene import Scene
from calib.gap.series.advice import next_experiment, open_questions
from calib.gap.series.answer import Verdict, judged, nameable_effects, stages, what_is_left
from calib.gap.series.beyond import ripples
from calib.gap.series.drawing.laws import drawn_laws
from calib.gap.series.fit import Fit
from calib.gap.series.iterations import fitted
from calib.gap.series.outcome import DynamicOutcome, doubts, floors_si, gap, grown, in_rad, in_si, left_out
from calib.gap.series.plausible import plausible
from calib.gap.series.split import Split, split
from calib.gap.series.validation import validated
from calib.gap.signals.motion import motion_gaps
from calib.gap.signals.physics import Physics
from calib.gap.signals.recording import Recording, prepare
from calib.gap.signals.terms import Term as Law
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
    progress = _rising(advance or quiet)
    progress("reading the runs", 0.0)
    recording = plausible(arm, prepare(arm, log))
    rows, known = _rows(Physics(arm, recording), recording, known_laws(arm))
    warnings = [*recording.warnings, *without_motion(rows.table)]
    warnings += map(str, ripples(recording, rows.physics.gear_ratios))
    parts, scene = split(recording, rows.table), Scene(rows, known)
    fit = fitted(scene, known, parts, candidates, progress)
    progress("the gap on runs used for nothing else", 0.95)
    parts = parts.only(scene.kept)
    fit, harming = validated(fit, parts.reporting)
    verdict = judged(fit, parts.reporting, harming)
    fit, before = verdict.fit, rows.residual(known)
    model = (*known, *(law for key, law in fit.laws().items() if key in verdict.kept))
    after, written = before, before  # where nothing is added to the model
    if verdict.kept:
        after, written = what_is_left(fit, verdict.kept), rows.residual(model)
    finding = _finding(arm, log, recording, fit, verdict, parts, (before, after, written))
    progress("done", 1.0)
    warnings += [*doubts(before, rows.table), *left_out(scene.kept, rows.table)]
    warnings += [*verdict.warnings, *grown(finding)]
    return DynamicOutcome(
        finding,
        tuple(warnings),
        rows.table,
        before,
        after,
        parts,
        tuple(run.name for run in recording.runs),
        rows.physics,
        model,
        drawn_laws(fit, [one.name for one in finding.effects]),
    )


def _rows(physics: Physics, recording: Recording, known: Sequence[Law]) -> tuple[Rows, tuple[Law, ...]]:
    """Rows, and what the file has, each law in the form that leaves least of the rows that decide: what is found then adds up to
    its total.
    """
    rows, model = Rows(physics, known), list(known)
    deciding = split(recording, rows.table).deciding
    for place, law in enumerate(known):
        kept = model.copy()
        least = float(np.linalg.norm(rows.residual(kept)[deciding])) if other_forms(law) else 0.0
        for other in other_forms(law):
            kept[place] = other
            if (left := float(np.linalg.norm(rows.residual(kept)[deciding]))) < least:
                least, model[place] = left, other
    return (rows if model == list(known) else Rows(physics, model)), tuple(model)


def _finding(
    arm: Arm, log: Log, recording: Recording, fit: Fit, verdict: Verdict, parts: Split, sizes: tuple[Array, Array, Array]
) -> GapFinding:  # fmt: skip
    """What was decided, with the gap on the runs that were used for nothing else; `sizes`: rows before, after, and with
    the laws alone.
    """
    before, after, written = sizes
    rows, known, reporting = fit.around.scene.rows, fit.around.known, parts.reporting
    moved = motion_gaps(rows.physics, known, (*known, *verdict.laws.values()), parts.report_runs)
    return GapFinding(
        arm=arm.name,
        data=log.sources,
        noise_floor={**floors_si(rows.table, arm), **in_rad(moved, "floor_rad")},
        gap_before=gap(before, rows.table, reporting),
        gap_after=gap(after, rows.table, reporting),
        before_si={**in_si(before, rows.table, reporting, arm), **in_rad(moved, "before_rad")},
        after_si={**in_si(after, rows.table, reporting, arm), **in_rad(moved, "after_rad")},
        effects=stages(fit, verdict, reporting),
        ambiguous=verdict.ambiguous,
        unknown=verdict.unknown,
        nameable=nameable_effects(fit),
        next_experiment=next_experiment(recording, verdict.ambiguous, verdict.unknown),
        remainder=verdict.remainder,
        open_questions=open_questions(recording, verdict),
        gap_as_written=gap(written, rows.table, reporting),
    )


def _rising(advance: Advance) -> Advance:
    """Progress that does not go back where a search begins again."""
    most = 0.0

    def progress(what: str, share: float) -> None:
        nonlocal most
        most = max(most, share)
        advance(what, most)

    return progress
