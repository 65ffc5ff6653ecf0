"""From a log to what is missing in the model: the time-series half of the gap workflow."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Collection, Sequence

import numpy as np

from calib.arrays import Array
from calib.gap.effects.catalogue import known_laws, role_of
from calib.gap.effects.frame import FRAME
from calib.gap.finding import GEOMETRY, EffectName, GapFinding, OpenQuestion, Unknown
from calib.gap.log import Log
from calib.gap.model_update import as_totals, updated_arm
from calib.gap.residuals.rows import ResidualRows, without_motion
from calib.gap.residuals.scene import SeriesScene
from calib.gap.series.answer import (
    SeriesVerdict,
    judged,
    nameable_effects,
    named_effects,
    seen_by_sensors,
    what_is_left,
)
from calib.gap.series.beyond import ripples
from calib.gap.series.drawing.laws import drawn_laws
from calib.gap.series.file import in_best_forms, laws_of, read_back
from calib.gap.series.iterations import fitted
from calib.gap.series.outcome import DynamicOutcome, doubts, floors_si, gap, grown, in_rad, in_si, left_out
from calib.gap.series.plausible import plausible
from calib.gap.series.split import RowSplit, split
from calib.gap.series.validation import validated
from calib.gap.signals.motion import motion_gaps
from calib.gap.signals.physics import Physics
from calib.gap.signals.recording import RunSet, prepare
from calib.gap.signals.terms import Law
from control.model.arm import Arm
from control.progress import Advance
from control.progress import silent as quiet

IN_KINEMATICS = (GEOMETRY, FRAME)  # what the file has of them is no law of its own


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
    parts, scene = split(recording, rows.table), SeriesScene(rows, known)
    fit = fitted(scene, known, parts, candidates, progress)
    progress("the gap on runs used for nothing else", 0.95)
    parts = parts.only(scene.kept)
    fit, harming = validated(fit, parts.reporting)
    verdict = judged(fit, parts, harming)
    finding, before, after, model = _finding(arm, log, recording, rows, known, verdict, parts)
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
        drawn_laws(verdict.fit, [one.name for one in finding.effects]),
    )


def _rows(physics: Physics, recording: RunSet, known: Sequence[Law]) -> tuple[ResidualRows, tuple[Law, ...]]:
    """Rows, and what the file has, so that what is found adds up to its total."""
    rows = ResidualRows(physics, known)
    model = tuple(in_best_forms(rows, known, split(recording, rows.table).deciding))
    return (rows if model == tuple(known) else ResidualRows(physics, model)), model


def _finding(
    arm: Arm,
    log: Log,
    recording: RunSet,
    rows: ResidualRows,
    known: Sequence[Law],
    verdict: SeriesVerdict,
    parts: RowSplit,
) -> tuple[GapFinding, Array, Array, tuple[Law, ...]]:
    """What was decided, with the gap that the file leaves on the runs that were used for nothing else; what the arm and the file
    leave of all rows, and the file's laws with what is taken off as the sensors' own.
    """
    reporting, table = parts.reporting, rows.table
    before = rows.residual(known)
    found = GapFinding(
        arm=arm.name,
        data=log.sources,
        noise_floor=floors_si(table, arm),
        gap_before=gap(before, table, reporting),
        gap_after=math.nan,
        before_si=in_si(before, table, reporting, arm),
        after_si={},
        effects=named_effects(verdict),
        ambiguous=verdict.ambiguous,
        unknown=verdict.unknown,
        nameable=nameable_effects(verdict.fit),
        next_experiment=next_experiment(recording, verdict.ambiguous, verdict.unknown),
        remainder=verdict.remainder,
        open_questions=open_questions(recording, verdict),
        gap_explained=gap(
            what_is_left(verdict.fit, verdict.kept) if verdict.kept else before, table, reporting
        ),
    )
    told = laws_of(rows, read_back(updated_arm(arm, as_totals(arm, found))), parts.deciding)
    told |= {name: law for name, law in verdict.laws.items() if name.effect in IN_KINEMATICS}
    laws, staged = {law.name: law for law in known}, []
    sensors = [one.law(size) for one, size in verdict.corrected if one.law is not None]
    sensed = seen_by_sensors(verdict, len(before))
    after = rows.residual([*laws.values(), *sensors]) + sensed if verdict.corrected else before
    for one in found.effects:
        laws.pop(one.name, None)
        laws |= {name: law for name, law in told.items() if name == one.name}
        after = rows.residual([*laws.values(), *sensors]) + sensed
        staged.append(dataclasses.replace(one, gap_after=gap(after, table, reporting)))
    moved = motion_gaps(rows.physics, known, tuple(laws.values()), parts.report_runs)
    found = dataclasses.replace(
        found,
        noise_floor={**found.noise_floor, **in_rad(moved, "floor_rad")},
        gap_after=gap(after, table, reporting),
        before_si={**found.before_si, **in_rad(moved, "before_rad")},
        after_si={**in_si(after, table, reporting, arm), **in_rad(moved, "after_rad")},
        effects=tuple(staged),
    )
    return found, before, after, (*laws.values(), *sensors)


def _rising(advance: Advance) -> Advance:
    """Progress that does not go back where a search begins again."""
    most = 0.0

    def progress(what: str, share: float) -> None:
        nonlocal most
        most = max(most, share)
        advance(what, most)

    return progress


# What to record next, to settle what a verdict on time series leaves open.
def next_experiment(
    recording: RunSet, sets: Sequence[Sequence[EffectName]], unknown: Unknown | None
) -> str | None:
    """What to record where something is open."""
    if sets:
        return _to_separate(recording, sets[0])
    if unknown is not None:
        advice = _advice(recording, unknown.where.startswith("the tip"))
        return f"To see more of the residual ({unknown.where}), record {advice}."
    return None


def open_questions(recording: RunSet, verdict: SeriesVerdict) -> tuple[OpenQuestion, ...]:
    """One for each set and each remainder."""
    sets = [
        OpenQuestion(f"Which of {', '.join(map(str, names))} is it?", _to_separate(recording, names))
        for names in verdict.ambiguous
    ]
    rest = [
        OpenQuestion(
            f"What causes the residual in {one.where}?",
            f"Record {_advice(recording, one.where.startswith('the tip'))}.",
        )
        for one in verdict.remainder
    ]
    return (*sets, *rest)


def _to_separate(recording: RunSet, names: Sequence[EffectName]) -> str:
    is_of_tip = any(role_of(name.effect) == "angle" for name in names)
    return f"To separate {', '.join(map(str, names))}, record {_advice(recording, is_of_tip)}."


def _advice(recording: RunSet, is_of_tip: bool = True) -> str:
    """What these runs lack; a camera only where it would see what is asked."""
    if is_of_tip and not recording.has_tip:
        return "the same runs with the camera on the tip"
    if not recording.has_current:
        return "the same runs with the motor currents"
    loads = {round(float(np.median(run.payload_kg)), 3) for run in recording.runs}
    if len(loads) < 2:
        return "the same runs with a known payload at the tip"
    return "slow ramps and reversals at several speeds, each twice, with and without payload"
