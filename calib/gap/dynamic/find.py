"""From a log to what is missing in the model: the dynamic half of the gap workflow."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from calib.arrays import Array
from calib.gap.dynamic.catalogue import candidates as all_candidates
from calib.gap.dynamic.choose import CAMERA_TIME, SAMPLING_TIME, Choice, Step
from calib.gap.dynamic.fit import Fitted
from calib.gap.dynamic.nameable import nameable
from calib.gap.dynamic.plausible import plausible
from calib.gap.dynamic.rows import Cell, Rows, RowTable, without_motion
from calib.gap.dynamic.split import Picked, Split, split
from calib.gap.dynamic.validation import Validated, validate
from calib.gap.dynamic.verdict import Verdict, judge
from calib.gap.finding import GapFinding, Nameable, NamedEffect
from calib.gap.log import Log
from calib.gap.signals import forms
from calib.gap.signals.motion import MotionGap, motion_gaps
from calib.gap.signals.physics import Physics
from calib.gap.signals.recording import Recording, prepare
from calib.gap.signals.terms import Term
from control.model.arm import Arm
from control.progress import Advance, silent

FAR_OFF = 20.0  # floors
# Of a sample: what a voltage lies off on the whole that changed in steps nobody recorded.
THINNED = (0.43, 0.57)
OF_THE_TIP = (
    "backlash",
    "joint_compliance",
    "link_flexure",
    "encoder_scale",
    "encoder_eccentricity",
    "belt_coupling",
)
READ, SCREENED, SEARCHED = 0.1, 0.25, 0.8  # of the time of a usual log, for the bar


@dataclass(frozen=True, slots=True)
class DynamicOutcome:
    """The finding, and what a report draws: residual rows over the floor before and after, what each row is,
    which rows report, sentences about the log, and where the floor comes from.
    """

    finding: GapFinding
    warnings: tuple[str, ...]
    rows: RowTable
    before: Array
    after: Array
    split: Split
    run_names: tuple[str, ...]
    gear_ratios: tuple[float, ...]


def find(
    arm: Arm,
    log: Log,
    advance: Advance | None = None,
    candidates: Collection[str] | None = None,
) -> GapFinding:
    """What is hidden in a log of this arm; `candidates`: only these effects of the list, by name.

    Raises UnusableLogError where no answer is possible (another arm's log, degrees, runs that are too short).
    """
    return examine(arm, log, advance, candidates).finding


def examine(
    arm: Arm,
    log: Log,
    advance: Advance | None = None,
    candidates: Collection[str] | None = None,
) -> DynamicOutcome:
    """`find`, with what a report shows beside the finding."""
    told = _rising(advance or silent)
    told("reading the runs", 0.0)
    recording = plausible(arm, prepare(arm, log))
    known = forms.known_terms(arm)
    rows = Rows(Physics(arm, recording), known)
    unmoved = without_motion(rows.table)
    parts = split(recording, rows.table)
    pool = all_candidates(arm, recording, candidates)
    told("what this recording could name", READ)
    choice = Choice(
        rows, known, parts, pool, lambda what, share: told(what, SCREENED + (SEARCHED - SCREENED) * share)
    )
    possible = nameable(arm, choice.screen, parts, pool)
    steps = choice.steps()
    told("the gap on runs used for nothing else", SEARCHED)
    before = rows.residual(known)
    last = validate(choice, steps, judge(choice, steps, arm))
    finding = _finding(arm, log.sources, recording, choice, steps, last, before, possible)
    told("done", 1.0)
    warnings = (
        *recording.warnings,
        *unmoved,
        *_doubts(before, rows.table),
        *_flying(rows, known, last.accepted),
        *_corrected(last.accepted, recording),
        *last.warnings,
        *_grown(finding),
    )
    names = tuple(run.name for run in recording.runs)
    ratios = tuple(drive.gear_ratio for drive in arm.drives)
    return DynamicOutcome(
        finding, warnings, rows.table, before, last.accepted.residual, choice.split, names, ratios
    )


def _finding(
    arm: Arm,
    sources: tuple[str, ...],
    recording: Recording,
    choice: Choice,
    steps: Sequence[Step],
    last: Validated,
    before: Array,
    possible: tuple[Nameable, ...],
) -> GapFinding:
    """What was decided, with the gap on the runs that were used for nothing else."""
    rows, known, parts, accepted = choice.rows, choice.known, choice.split, last.accepted
    after = accepted.residual
    moved = motion_gaps(rows.physics, known, (*known, *accepted.terms), parts.report_runs)
    return GapFinding(
        arm=arm.name,
        data=sources,
        noise_floor={**_floors(rows.table, arm), **_in_rad(moved, "floor_rad")},
        gap_before=gap(before, rows.table, parts.reporting),
        gap_after=gap(after, rows.table, parts.reporting),
        before_si={**_in_si(before, rows.table, parts.reporting, arm), **_in_rad(moved, "before_rad")},
        after_si={**_in_si(after, rows.table, parts.reporting, arm), **_in_rad(moved, "after_rad")},
        effects=_named(steps, last.verdict, accepted, rows, known, parts),
        ambiguous=last.verdict.ambiguous,
        unknown=last.verdict.unknown,
        nameable=possible,
        next_experiment=_next(recording, last.verdict),
    )


def _in_rad(moved: Mapping[str, MotionGap], which: str) -> dict[str, float]:
    return {channel: float(getattr(one, which)) for channel, one in moved.items()}


def _doubts(before: Array, table: RowTable) -> tuple[str, ...]:
    """Hidden effects are seen in some channels; where nearly all are far off, arm and log may not belong together."""
    sizes = [
        float(np.sqrt(np.mean(before[cell.rows] ** 2))) for cell in table.cells if before[cell.rows].size
    ]
    if len(sizes) < 3 or np.mean(np.array(sizes) > FAR_OFF) < 0.9:
        return ()
    return (
        f"nearly every channel disagrees by more than {FAR_OFF:.0f} times its noise: "
        "are the arm's file and the log of the same arm?",
    )


def _flying(rows: Rows, known: Sequence[Term], accepted: Fitted) -> tuple[str, ...]:
    """Said where rows are left out because a loose link is between its flanks."""
    resting = rows.resting((*known, *accepted.terms))
    said = []
    for cell in rows.table.cells:
        share = 1.0 - float(np.mean(resting[cell.rows])) if resting[cell.rows].size else 0.0
        if share > 0.0:
            said.append(
                f"{cell}: {share:.0%} of the rows are left out, as the link flies from flank to flank or lands there:"
                " when follows from the play, how hard does not"
            )
    return tuple(said)


def _grown(finding: GapFinding) -> tuple[str, ...]:
    """Said where the held-out runs do not bear out what the others accepted."""
    if not finding.effects or finding.gap_after <= finding.gap_before:
        return ()
    return (
        f"on the held-out runs the gap grows from {finding.gap_before:.2f} to {finding.gap_after:.2f}: what was named helps"
        " the other runs alone",
    )


def _corrected(accepted: Fitted, recording: Recording) -> tuple[str, ...]:
    """Said where clocks differ: when camera or currents are read is no effect of the arm, and is taken off."""
    said = []
    for term in accepted.terms:
        time_ms = 1e3 * abs(term.values[0])
        if term.form == CAMERA_TIME:
            way = "late" if term.values[0] < 0.0 else "early"
            said.append(f"the camera's times are {time_ms:.2f} ms {way}: taken into account")
        elif (
            term.form == SAMPLING_TIME
            and THINNED[0] < 1e-3 * time_ms * recording.filters.rate_Hz < THINNED[1]
        ):
            said.append(
                "other voltages were held between these samples, half a sample away on the whole: was the log thinned out? Taken"
                " into account; record every sample"
            )
        elif term.form == SAMPLING_TIME:
            than = (
                "after the voltage of their line took effect"
                if recording.has_voltage
                else "before the end of a step of the voltage"
            )
            said.append(f"angles and currents are read {time_ms:.2f} ms {than}: taken into account")
    return tuple(said)


def gap(residual: Array, table: RowTable, picked: Picked) -> float:
    """Root mean square over the floor; every cell counts the same, however many rows it has."""
    squares = []
    for cell in table.cells:
        values = residual[cell.rows][picked[cell.rows]]
        if len(values):
            squares.append(float(np.mean(values**2)))
    return float(np.sqrt(np.mean(squares))) if squares else float("nan")


def _rising(advance: Advance) -> Advance:
    """Progress that does not go back where a search begins again."""
    most = 0.0

    def told(what: str, share: float) -> None:
        nonlocal most
        most = max(most, share)
        advance(what, most)

    return told


def _floors(table: RowTable, arm: Arm) -> dict[str, float]:
    return _by_channel(table, arm, lambda cell: cell.floor)


def _in_si(residual: Array, table: RowTable, picked: Picked, arm: Arm) -> dict[str, float]:
    def size(cell: Cell) -> float:
        values = residual[cell.rows][picked[cell.rows]]
        return float(np.sqrt(np.mean(values**2)) * cell.floor) if len(values) else float("nan")

    return _by_channel(table, arm, size)


def _by_channel(table: RowTable, arm: Arm, size: Callable[[Cell], float]) -> dict[str, float]:
    """Root mean square over the joints of each channel, the voltage in volts."""
    squares: dict[str, list[float]] = {}
    for cell in table.cells:
        is_voltage = cell.channel == "voltage_as_A"
        factor = arm.drives[cell.joint].resistance_ohm if is_voltage else 1.0
        squares.setdefault("voltage_V" if is_voltage else cell.channel, []).append((size(cell) * factor) ** 2)
    return {channel: float(np.sqrt(np.mean(values))) for channel, values in squares.items()}


def _named(
    steps: Sequence[Step],
    verdict: Verdict,
    accepted: Fitted,
    rows: Rows,
    known: Sequence[Term],
    parts: Split,
) -> tuple[NamedEffect, ...]:
    begins = np.cumsum([0, *(len(term.values) for term in accepted.terms)])
    result, model = [], [*known, *accepted.terms[len(verdict.named) :]]  # with what was found of the sensors
    for place, k in enumerate(verdict.named):
        term, own = accepted.terms[place], slice(int(begins[place]), int(begins[place + 1]))
        model.append(term)
        after = gap(rows.residual(model), rows.table, parts.reporting)
        evidence = {
            "held_out_log_evidence": steps[k].evidence,
            "margin": steps[k].margin,
            "explained": verdict.explained[k],
        }
        values = forms.parameters(term, accepted.covariance[own, own])
        result.append(NamedEffect(steps[k].best.candidate.name, values, after, evidence))
    return tuple(result)


def _next(recording: Recording, verdict: Verdict) -> str | None:
    if verdict.ambiguous:
        names = ", ".join(str(name) for name in verdict.ambiguous[0])
        is_of_tip = any(name.effect in OF_THE_TIP for name in verdict.ambiguous[0])
        return f"To separate {names}, record {_advice(recording, is_of_tip)}."
    if verdict.unknown is not None:
        is_of_tip = verdict.unknown.where.startswith("the tip")
        where = verdict.unknown.where
        return f"To see more of what is left ({where}), record {_advice(recording, is_of_tip)}."
    return None


def _advice(recording: Recording, is_of_tip: bool = True) -> str:
    """What these runs lack; a camera only where it would see what is asked."""
    if is_of_tip and not recording.has_tip:
        return "the same runs with the camera on the tip"
    if not recording.has_current:
        return "the same runs with the motor currents"
    loads = {round(float(np.median(run.payload_kg)), 3) for run in recording.runs}
    if len(loads) < 2:
        return "the same runs with a known payload at the tip"
    return "slow ramps and reversals at several speeds, each twice, with and without payload"
