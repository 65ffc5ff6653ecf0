"""From a log to what is missing in the model: the time-series half of the gap workflow."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from calib.arrays import Array
from calib.gap.effects.catalogue import SHARED, known_laws, role_of
from calib.gap.effects.links import FRAME
from calib.gap.effects.motor import ORDERS
from calib.gap.finding import GEOMETRY, DrawnLaw, EffectName, GapFinding, OpenQuestion, Unknown, as_totals, updated_arm
from calib.gap.log import Log
from calib.gap.posterior.constants import GROWS, REMAINS
from calib.gap.posterior.term import Key
from calib.gap.posterior.told import Told
from calib.gap.residuals.rows import ResidualRows, RowTable, without_motion
from calib.gap.residuals.scene import SeriesScene
from calib.gap.series.answer import (
    SeriesVerdict,
    judged,
    nameable_effects,
    named_effects,
    refitted_effects,
    seen_by_sensors,
    what_is_left,
)
from calib.gap.series.file import in_best_forms, laws_of, read_back, with_least_left
from calib.gap.series.iterations import COMPARED, fitted, unknown_rotors
from calib.gap.series.linear import SeriesFit
from calib.gap.series.outcome import doubts, drawn_laws, floors_si, gap, grown, in_rad, in_si, left_out
from calib.gap.series.plausible import plausible
from calib.gap.series.split import RowSplit, split
from calib.gap.series.validation import members, validated, with_only
from calib.gap.signals.motion import motion_gaps
from calib.gap.signals.physics import Physics
from calib.gap.signals.recording import EvenRun, RunSet, prepare
from calib.gap.signals.terms import Law
from control.model.arm import Arm
from control.plain_text import Advance
from control.plain_text import silent as quiet

IN_KINEMATICS = (GEOMETRY, FRAME)  # what the file has of them is no law of its own


def find(arm: Arm, log: Log, advance: Advance | None = None, candidates: Collection[str] | None = None) -> GapFinding:
    """What is hidden in a log of this arm; `candidates`: only these effects of the list, by name.

    Raises UnusableLogError where no answer is possible (another arm's log, degrees, runs that are too short).
    """
    return examine(arm, log, advance, candidates).finding


def examine(
    arm: Arm, log: Log, advance: Advance | None = None, candidates: Collection[str] | None = None, prior: Told | None = None
) -> DynamicOutcome:
    """`find`, with what a report shows beside the finding; `prior`: what other recordings of the arm tell of its effects."""
    return decided(arm, log, advance, candidates, prior).outcome()


def decided(
    arm: Arm, log: Log, advance: Advance | None = None, candidates: Collection[str] | None = None, prior: Told | None = None
) -> Examined:
    """What is decided about a log, before any file is evaluated on it."""
    progress = _rising(advance or quiet)
    progress("reading the runs", 0.0)
    recording = plausible(arm, prepare(arm, log))
    rows, known = _rows(Physics(arm, recording), recording, known_laws(arm))
    warnings = [*recording.warnings, *without_motion(rows.table)]
    warnings += map(str, ripples(recording, rows.physics.gear_ratios))
    parts, scene = split(recording, rows.table), SeriesScene(rows, known, prior and prior.beyond(arm))
    fit = fitted(scene, known, parts, candidates, progress)
    progress("the gap on runs used for nothing else", COMPARED)
    parts = parts.only(scene.usable)
    weighed = fit
    fit, harming = validated(weighed, parts.reporting)
    warnings += [*left_out(scene.usable, rows.table), *unknown_rotors(fit)]

    def concluded(fit: SeriesFit, harming: Sequence[Key]) -> Examined:
        verdict = judged(fit, parts, harming)
        return Examined(arm, log, rows, known, verdict, parts, _told(weighed, verdict, arm), tuple(warnings)).with_least_left()

    examined = concluded(fit, harming)
    while examined.verdict.laws and examined.growth > GROWS:
        # no file that predicts worse than the arm as it was given: without the name that it is best without
        fits = [(with_only(fit, [k for k in fit.numbers if k != number]), key) for number, key in _named(fit, examined)]
        tried = [(concluded(rest, [*harming, key]), rest, key) for rest, key in fits]
        examined, fit, key = min(tried, key=lambda one: one[0].growth)
        harming = [*harming, key]
    return examined


def _named(fit: SeriesFit, examined: Examined) -> Iterator[tuple[int, EffectName]]:
    """Terms of the best set by number that got a name."""
    for number in fit.numbers:
        key = fit.linear.terms[number].key
        if isinstance(key, EffectName) and key in examined.verdict.laws:
            yield number, key


def _told(fit: SeriesFit, verdict: SeriesVerdict, arm: Arm) -> Told:
    """What these runs alone tell, of totals; departures that look like a law itself leave its size so much less sure.

    By the set as it was weighed, with all that was withdrawn since: what that explained would else speak for other effects.
    """
    open_ = {name for names in verdict.ambiguous for name in names}
    withdrawn = fit.names - verdict.laws.keys() - open_
    posterior = Told.by(fit.evidence, fit.best, SHARED, fit.point.scene.told, withdrawn)
    for member in members(fit):
        if isinstance(member.term.key, EffectName) and member.term.key in posterior.places:
            laws = slice(0, member.term.laws)
            posterior = posterior.widened(member.term.key, member.alike[laws, laws] * member.term.size**2)
    return posterior.beyond(arm, -1.0)


def _rows(physics: Physics, recording: RunSet, known: Sequence[Law]) -> tuple[ResidualRows, tuple[Law, ...]]:
    """Rows, and what the file has, so that what is found adds up to its total."""
    rows = ResidualRows(physics, known)
    model = tuple(in_best_forms(rows, known, split(recording, rows.table).deciding))
    return (rows if model == tuple(known) else ResidualRows(physics, model)), model


@dataclass(frozen=True, slots=True)
class DynamicOutcome:
    """The finding, and what a report draws: residual rows over the floor before and after, what each row is,
    which rows report, and sentences about the log; `model`: all that is known and named, as `physics` takes it;
    `examined`: what the outcome of another arm.toml follows from, and what the runs tell of the arm's effects.
    """

    finding: GapFinding
    warnings: tuple[str, ...]
    rows: RowTable
    before: Array
    after: Array
    split: RowSplit
    run_names: tuple[str, ...]
    physics: Physics
    model: tuple[Law, ...]
    laws: tuple[DrawnLaw, ...]
    examined: Examined


@dataclass(frozen=True, slots=True)
class Examined:
    """A log that was looked at, from which its outcome follows for any arm.toml: `known` is what the given one has."""

    arm: Arm
    log: Log
    rows: ResidualRows
    known: tuple[Law, ...]
    verdict: SeriesVerdict
    parts: RowSplit
    told: Told
    warnings: tuple[str, ...]

    def laws_of(self, file: Arm) -> dict[EffectName, Law]:
        """What a file says of these runs, by name, with what is in its kinematics."""
        stated = laws_of(self.rows, file, self.parts.deciding)
        return stated | {name: law for name, law in self.verdict.laws.items() if name.effect in IN_KINEMATICS}

    @property
    def file(self) -> Arm:
        """The arm.toml of the log's own names, as whoever starts it reads it."""
        return read_back(updated_arm(self.arm, as_totals(self.arm, self.finding)))

    @property
    def sensors(self) -> tuple[Law, ...]:
        """What is taken off as the sensors' own."""
        return tuple(term.law(size) for term, size in self.verdict.corrected if term.law is not None)

    def left_by(self, laws: Mapping[EffectName, Law]) -> Array:
        """What laws leave of all rows, (rows,)."""
        return self.rows.residual([*laws.values(), *self.sensors]) + seen_by_sensors(self.verdict, len(self.rows.table.run))

    def with_least_left(self) -> Examined:
        """With the values that leave least of the rows that decide, where a law bends; what no file says of it, such as the share
        of friction behind a loose gear, stays as the posterior has it.
        """
        laws, stated, given = self.verdict.laws, self.laws_of(self.file), {law.name: np.array(law.values) for law in self.known}
        names = [name for name in laws if name in stated and name.effect not in IN_KINEMATICS]
        if all(laws[name].form.is_straight for name in names):
            return self
        begun = {name: stated[name].at(tuple((laws[name].values + given.get(name, np.zeros(1))).tolist())) for name in names}
        sd = {name: np.sqrt(np.diag(self.verdict.covariance[name])) for name in names}
        settled = with_least_left(lambda model: self.left_by(model)[self.parts.deciding], stated | begun, sd)
        moved = {name: np.subtract(settled[name].values, begun[name].values) for name in names}
        values = {name: law.at(tuple((law.values + moved[name]).tolist())) for name, law in laws.items() if name in moved}
        covariance = {name: self.verdict.covariance[name] + np.outer(step, step) for name, step in moved.items()}
        verdict = dataclasses.replace(self.verdict, laws={**laws, **values}, covariance={**self.verdict.covariance, **covariance})
        return dataclasses.replace(self, verdict=verdict)

    @property
    def growth(self) -> float:
        """Share by which the squared gap on the runs kept apart is larger with the file than with the given arm."""
        given, with_file = (
            gap(self.left_by(laws), self.rows.table, self.parts.reporting)
            for laws in ({law.name: law for law in self.known}, self.laws_of(self.file))
        )
        return (with_file / given) ** 2 - 1.0 if given > 0.0 else 0.0

    def outcome(self, file: Arm | None = None) -> DynamicOutcome:
        """With the gap that a file leaves on the runs that were used for nothing else; by default that of the log's own names."""
        rows, verdict, recording = self.rows, self.verdict, self.rows.recording
        before, finding = rows.residual(self.known), self.finding
        stated = self.laws_of(self.file if file is None else file)

        # the given laws, with one name after the other as the file has it
        laws, staged = {law.name: law for law in self.known}, []
        for effect in finding.effects:
            laws.pop(effect.name, None)
            laws |= {name: law for name, law in stated.items() if name == effect.name}
            staged.append(dataclasses.replace(effect, gap_after=gap(self.left_by(laws), rows.table, self.parts.reporting)))
        after, laws = self.left_by(stated), stated
        moved = motion_gaps(rows.physics, self.known, tuple(laws.values()), self.parts.report_runs)
        finding = dataclasses.replace(
            finding,
            noise_floor={**finding.noise_floor, **in_rad(moved, "floor_rad")},
            gap_after=gap(after, rows.table, self.parts.reporting),
            before_si={**finding.before_si, **in_rad(moved, "before_rad")},
            after_si={**in_si(after, rows.table, self.parts.reporting, self.arm), **in_rad(moved, "after_rad")},
            effects=tuple(staged),
        )
        return DynamicOutcome(
            finding,
            (*self.warnings, *doubts(before, rows.table), *verdict.warnings, *grown(finding)),
            rows.table,
            before,
            after,
            self.parts,
            tuple(run.name for run in recording.runs),
            rows.physics,
            (*laws.values(), *self.sensors),
            drawn_laws(verdict.fit, [effect.name for effect in finding.effects]),
            self,
        )

    @property
    def finding(self) -> GapFinding:
        """What was decided, without the gap that a file leaves."""
        verdict, table, reporting = self.verdict, self.rows.table, self.parts.reporting
        before = self.rows.residual(self.known)
        explained = what_is_left(verdict.fit, verdict.explaining) if verdict.explaining else before
        return GapFinding(
            arm=self.arm.name,
            data=self.log.sources,
            noise_floor=floors_si(table, self.arm),
            gap_before=gap(before, table, reporting),
            gap_after=math.nan,
            before_si=in_si(before, table, reporting, self.arm),
            after_si={},
            effects=named_effects(verdict),
            refitted=refitted_effects(verdict),
            ambiguous=verdict.ambiguous,
            unknown=verdict.unknown,
            nameable=nameable_effects(verdict.fit),
            next_experiment=next_experiment(self.rows.recording, verdict.ambiguous, verdict.unknown),
            remainder=verdict.remainder,
            open_questions=open_questions(self.rows.recording, verdict),
            gap_explained=gap(explained, table, reporting),
        )


def _rising(advance: Advance) -> Advance:
    """Progress that does not go back where a search begins again."""
    most = 0.0

    def progress(what: str, share: float) -> None:
        nonlocal most
        most = max(most, share)
        advance(what, most)

    return progress


# What to record next, to settle what a verdict on time series leaves open.
def next_experiment(recording: RunSet, sets: Sequence[Sequence[EffectName]], unknown: Unknown | None) -> str | None:
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
            f"What causes the residual in {part.where}?", f"Record {_advice(recording, part.where.startswith('the tip'))}."
        )
        for part in verdict.remainder
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


# What comes round with a motor faster than the equations are looked at: it is said, with how to record it.
SAMPLES_LEAST = 200  # in each half
SAMPLES_MOST = 8000  # that are looked at; more tell nothing else
FASTEST = 0.4  # of the sampling rate
CLEAR = 1.2  # times the band: within, the rows show it themselves


@dataclass(frozen=True, slots=True)
class Ripple:
    """A current that follows its motor `order` times a turn, at `rate_Hz` in the middle of these runs; below `slow_rad_s` of the
    joint it is within `band_Hz`, where the equations are looked at. `share`: of what is above the band.
    """

    joint: int
    order: float
    amplitude_A: float
    rate_Hz: float
    share: float
    band_Hz: float
    slow_rad_s: float

    def __str__(self) -> str:
        """For the user."""
        return (
            f"the current of joint {self.joint} follows its motor {self.order:g} times a turn by {self.amplitude_A:.2g} A, at"
            f" {self.rate_Hz:.0f} Hz. So does cogging, but the equations are looked at up to {self.band_Hz:.0f} Hz: record the"
            f" joint slower than {self.slow_rad_s:.2g} rad/s, every sample of the controller, and it can be named"
        )


def ripples(recording: RunSet, gear_ratios: Sequence[float]) -> Iterator[Ripple]:
    """The largest of each joint, if it predicts recordings that it was not fitted to."""
    if not recording.has_current:
        return
    for j, gear_ratio in enumerate(gear_ratios):
        if (ripple := _ripple(recording, j, gear_ratio)) is not None:
            yield ripple


def _ripple(recording: RunSet, j: int, gear_ratio: float) -> Ripple | None:
    """The order that explains most of what the half of the recording that it was not fitted to has above the band."""
    parts = [_above_the_band(recording, run, j) for run in recording.runs]
    angle, speed, current = (np.concatenate([part[k] for part in parts]) for k in range(3))
    band_Hz, fastest_Hz = recording.filters.row_Hz, FASTEST * recording.filters.rate_Hz
    step = max(1, len(angle) // SAMPLES_MOST)
    motor, rate_Hz = gear_ratio * angle[::step], np.abs(gear_ratio * speed[::step]) / (2.0 * np.pi)
    high = current[::step]
    is_fitted = np.arange(len(high)) < len(high) // 2
    best: Ripple | None = None
    whole = float(high[~is_fitted] @ high[~is_fitted])
    for order in ORDERS:
        seen = (order * rate_Hz > CLEAR * band_Hz) & (order * rate_Hz < fastest_Hz)
        if min(np.sum(seen & is_fitted), np.sum(seen & ~is_fitted)) < SAMPLES_LEAST:
            continue
        waves = np.column_stack((np.sin(order * motor), np.cos(order * motor)))
        size = np.linalg.lstsq(waves[seen & is_fitted], high[seen & is_fitted], rcond=None)[0]
        held_out = high[seen & ~is_fitted]
        residual = held_out - waves[seen & ~is_fitted] @ size
        share = float(held_out @ held_out - residual @ residual) / whole if whole > 0.0 else 0.0
        if share > REMAINS and (best is None or share > best.share):
            middle = float(np.median(order * rate_Hz[seen]))
            slow = 2.0 * np.pi * band_Hz / (CLEAR * order * gear_ratio)
            best = Ripple(j + 1, order, float(np.hypot(*size)), middle, share, band_Hz, slow)
    return best


def _above_the_band(recording: RunSet, run: EvenRun, j: int) -> tuple[Array, Array, Array]:
    """Angle, speed and what the measured current has beyond the rows' band, of the samples that count."""
    filters = recording.filters
    if len(run) <= 2 * filters.reach:  # shorter than the filter of a row
        return (np.zeros(0),) * 3
    inner = slice(filters.reach, len(run) - filters.reach)
    raw = run.current_raw_A[:, j]
    high = raw[inner] - np.convolve(raw, filters.row, "valid")
    usable = run.usable[inner, j]
    return run.q_raw[inner, j][usable], run.speed[inner, j][usable], high[usable]
