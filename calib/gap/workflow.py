"""The gap workflow as one entry: look at poses, at time series or at both, bring the answers together, write the result."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from calib.arm_problem.parallel_axes import numbers_before
from calib.errors import CalibrationError
from calib.gap.effects.catalogue import needing_drives
from calib.gap.finding import (
    GEOMETRY,
    EffectName,
    GapFinding,
    MeasuredMaps,
    Nameable,
    NamedEffect,
    Unknown,
    as_totals,
    updated_arm,
    with_geometry,
    with_given_numbers,
    write_gap_json,
)
from calib.gap.leads import gears_by_leads
from calib.gap.log import (
    AMPERES,
    TORQUES,
    Log,
    amperes_per,
    joined_logs,
    log_in_amperes,
    points_in_amperes,
    read_log,
    with_ideal_drives,
    without_voltages,
)
from calib.gap.maps.choose import MapsFound, angle_maps
from calib.gap.maps.torques import torque_maps
from calib.gap.poses.find import find, look
from calib.gap.poses.outcome import StaticGap
from calib.gap.posterior.constants import SILENT_MOST
from calib.gap.posterior.told import Told
from calib.gap.report import GapOutcome, gap_page
from calib.gap.series.find import decided
from calib.points.points import Points, base_points_for
from calib.results import input_file, made_today
from control.errors import ArmError
from control.files import write_whole
from control.model.arm import Arm
from control.model.description import save_arm
from control.model.effects import EFFECTS
from control.plain_text import Advance, silent

# One finding of two: static poses and time series of one arm, each looked at with what the other tells (`posterior.told`).

POSES, SERIES = "poses", "time series"
IN_KINEMATICS = (GEOMETRY, "base_frame")


def brought_together(static: GapFinding | None, dynamic: GapFinding | None) -> GapFinding:
    """Floors and gaps of all channels, every name once. The gap of both is the root mean square of the two, and what either
    leaves open is open. One level alone is returned unchanged.
    """
    if static is None or dynamic is None:
        if (only := static or dynamic) is None:
            raise ValueError("expected the finding of at least one level")
        return only
    static, dynamic = _as_looked_at(static, dynamic), _as_looked_at(dynamic, static)
    sentences = [text[:1].upper() + text[1:] for text in (static.next_experiment, dynamic.next_experiment) if text]
    unknowns = [unknown for unknown in (static.unknown, dynamic.unknown) if unknown is not None]
    nearest = max(unknowns, key=lambda unknown: unknown.explained, default=None)
    seen: dict[EffectName, Nameable] = {}  # every effect where it is seen better
    for nameable in (*static.nameable, *dynamic.nameable):
        if nameable.name not in seen or _rank(nameable) > _rank(seen[nameable.name]):
            seen[nameable.name] = nameable

    def rms(key: str) -> float:
        return math.hypot(getattr(static, key), getattr(dynamic, key)) / math.sqrt(2.0)

    return GapFinding(
        arm=static.arm,
        data=(*static.data, *dynamic.data),
        noise_floor={**dynamic.noise_floor, **static.noise_floor},
        gap_before=rms("gap_before"),
        gap_after=rms("gap_after"),
        gap_explained=rms("gap_explained"),
        before_si={**dynamic.before_si, **static.before_si},
        after_si={**dynamic.after_si, **static.after_si},
        effects=_effects(static, dynamic),
        refitted=tuple(effect for effect in dynamic.refitted if effect.name not in {named.name for named in static.effects}),
        ambiguous=_sets(static, dynamic),
        unknown=nearest and dataclasses.replace(nearest, where="; ".join(dict.fromkeys(unknown.where for unknown in unknowns))),
        nameable=tuple(seen.values()),
        next_experiment=" ".join(sentence if sentence.endswith(".") else f"{sentence}." for sentence in sentences) or None,
        is_held_out=static.is_held_out and dynamic.is_held_out,
        remainder=(*static.remainder, *dynamic.remainder),
        open_questions=(*static.open_questions, *dynamic.open_questions),
        maps=static.maps,
    )


def changed_between(finding: GapFinding, poses: Told, series: Told) -> tuple[str, ...]:
    """A doubt for each name whose size the two recordings by no means share: was the arm changed between them?"""
    return tuple(
        f"{name}: poses show {poses.words(name)}, time series {series.words(name)}. No arm has both: was it changed between the"
        " recordings? The new arm.toml has what is likeliest for both"
        for name in (effect.name for effect in finding.effects)
        if poses.differs_from(series, name)
    )


def _as_looked_at(finding: GapFinding, counterpart: GapFinding) -> GapFinding:
    """Without a gap afterwards where its counterpart names one of a set that this one left open even so: nobody has looked with
    that name added. It takes the place of the map that the set had.
    """
    named = {effect.name for effect in counterpart.effects}
    later = {name.acts_on for names in finding.ambiguous for name in names if name in named}
    if not later:
        return finding
    maps = tuple(correction for correction in (finding.maps or MeasuredMaps()).maps if correction.joint not in later)
    return dataclasses.replace(
        finding,
        gap_after=math.nan,
        gap_explained=math.nan,
        after_si=dict.fromkeys(finding.after_si, math.nan),
        maps=MeasuredMaps(maps, ()) if maps else None,
    )


def _sets(static: GapFinding, dynamic: GapFinding) -> tuple[tuple[EffectName, ...], ...]:
    """Ambiguous sets of which the other level names none; two that share members become what they share."""
    of_poses, of_series = (
        [names for names in finding.ambiguous if not {*names} & {effect.name for effect in counterpart.effects}]
        for finding, counterpart in ((static, dynamic), (dynamic, static))
    )
    sets = []
    for names in of_poses:
        shared = (tuple(name for name in names if name in of_set) for of_set in of_series)
        sets.append(next((common for common in shared if len(common) > 1), names))
    sets += [names for names in of_series if not any({*names} & {*of_set} for of_set in of_poses)]
    return tuple(dict.fromkeys(sets))


def _effects(static: GapFinding, dynamic: GapFinding) -> tuple[NamedEffect, ...]:
    """Those of the poses first; an effect of both with their parameters and what motion alone shows, and both in its evidence.

    The file's geometry is that of the poses, identified beside these parameters; the time series were looked at with it.
    """
    by_name = {effect.name: effect for effect in static.effects}
    for effect in dynamic.effects:
        known = by_name.setdefault(effect.name, effect)
        if known is not effect and effect.name.effect not in IN_KINEMATICS:
            values = {
                f"{name} by {level}": source.parameters[name][0]
                for level, source in ((POSES, known), (SERIES, effect))
                for name in source.parameters
                if name in known.parameters and name in effect.parameters
            }
            evidence = {**effect.evidence, **known.evidence, **values}
            parameters = {**effect.parameters, **known.parameters}  # damping shows in motion alone
            by_name[effect.name] = dataclasses.replace(known, parameters=parameters, evidence=evidence)
    return tuple(by_name.values())


def _rank(nameable: Nameable) -> tuple[bool, float]:
    return nameable.is_nameable, nameable.detectability / nameable.needed_sd


RESULTS = ("gap.json", "arm.toml", "report.html")
SHARES = 0.2, 0.9  # of the time, when poses alone and then runs are looked at, where there are both


@dataclass(frozen=True, slots=True)
class Recordings:
    """What was measured, and the files that it stands in; `warnings` are sentences about them.

    `are_torques`: the columns of currents were torques of the joints.
    """

    points: Points | None
    log: Log | None
    point_files: tuple[Path, ...]
    log_files: tuple[Path, ...]
    warnings: tuple[str, ...]
    are_torques: bool = False


def read_recordings(
    arm: Arm, points: Sequence[str | Path], logs: Sequence[str | Path], current_unit: str = AMPERES, is_as_given: bool = False
) -> Recordings:
    """All files, read strictly; CalibrationError where one cannot be used, or where there is none.

    `current_unit`: one of calib.gap.log.UNITS, in which the columns i1_A ... are written. `is_as_given`: the points mean what
    they say (`calib.arm_problem.misread`).
    """
    motors = with_ideal_drives(arm) if current_unit == TORQUES else arm
    if current_unit != AMPERES:
        amperes_per(motors, current_unit)
    if not points and not logs:
        raise CalibrationError("gap: give --points for static poses, --log for time series, or both; --record records them")
    point_files, log_files = tuple(map(Path, points)), tuple(map(Path, logs))
    poses = [base_points_for(arm, point_files, "gap", is_as_given)] if point_files else []
    runs = [read_log(path, arm.joint_count) for path in log_files]
    log = joined_logs(tuple(log for log, _ in runs)) if runs else None
    return Recordings(
        points_in_amperes(motors, poses[0][0], current_unit) if poses else None,
        log_in_amperes(motors, log, current_unit) if log is not None else None,
        point_files,
        log_files,
        tuple(sentence for _, messages in (*poses, *runs) for sentence in messages),
        are_torques=current_unit == TORQUES,
    )


def find_gap(
    arm: Arm, points: Points | None = None, log: Log | None = None, *, without: Collection[str] = (), advance: Advance = silent
) -> GapOutcome:
    """What the model of `arm` lacks, by static poses (`points`), by time series (`log`), or by both.

    `finding` of the result is what gap.json holds. Time series are looked at with the geometry that the poses gave.
    `without`: effects that are not tried, by name. `advance` hears what is being done and the share that is done, 0 to 1.
    UnusablePointsError, UnusableLogError where the recordings cannot be used; CalibrationError for an unknown name in
    `without`, or where there are neither points nor a log.
    """
    require_effects(without)
    if points is None and log is None:
        raise CalibrationError("gap: expected static poses, time series, or both; got neither")
    notes = [f"{arm.name}: its maps are not used; they are measured anew"] if arm.maps else []
    arm = given_arm = dataclasses.replace(arm, maps=())
    first, last = (0.0, 1.0) if points is None else (1.0, 1.0) if log is None else SHARES
    doubts: tuple[str, ...] = ()
    static = dynamic = None
    if points is not None:
        static = find(given_arm, points, lambda what, done: advance(what, first * done), without)
        arm = static.arm
    if log is not None:
        tried = [name for name in EFFECTS if name not in without] if without else None
        runs = decided(
            arm if static is None else static.fitted_arm,
            log,
            lambda what, done: advance(what, first + (last - first) * done),
            tried,
            None if static is None else static.told,
        )
        file = None
        if static is not None:
            # what the runs tell settles what the poses left open; then what one file of both leaves of the runs
            static = look(static.looked, lambda what, done: advance(what, last + (1.0 - last) * done), runs.told)
            both = brought_together(static.finding, as_totals(arm, runs.finding))
            doubts = changed_between(both, static.told, runs.told)
            file = _updated(arm, both, static)
        dynamic = runs.outcome(file)
    finding = brought_together(
        None if static is None else static.finding, None if dynamic is None else as_totals(arm, dynamic.finding)
    )
    levels = [level for level in (static, dynamic) if level is not None]
    warnings = (*doubts, *notes, *(sentence for level in levels for sentence in level.warnings))
    if log is not None:
        finding = dataclasses.replace(finding, effects=(*finding.effects, *gears_by_leads(given_arm, log)))
    outcome = GapOutcome(consistent(finding), static, dynamic, warnings)
    before = {} if static is None else numbers_before(given_arm, static.arm)
    return _with_given_numbers(outcome, before) if before else outcome


def _with_given_numbers(outcome: GapOutcome, before: Mapping[int, int]) -> GapOutcome:
    """All that is said of links, by their numbers in the given file, too; what is only computed with stays."""
    static, dynamic = outcome.static, outcome.dynamic
    if static is not None:
        finding, stages = with_given_numbers((static.finding, static.stages), before)
        static = dataclasses.replace(static, finding=finding, stages=stages)
    if dynamic is not None:
        dynamic = dataclasses.replace(dynamic, finding=with_given_numbers(dynamic.finding, before))
    finding, warnings = with_given_numbers((outcome.finding, outcome.warnings), before)
    return GapOutcome(finding, static, dynamic, warnings)


def find_gap_in(
    arm: Arm, recordings: Recordings, without: Collection[str] = (), advance: Advance = silent, with_maps: bool = False
) -> GapOutcome:
    """`find_gap` of recordings that were read from files: the finding names the files.

    `with_maps`: what is left is measured as maps besides, which stand in arm.toml where they help what was not fitted.
    """
    searched, log, notes = arm, recordings.log, list(recordings.warnings)
    if recordings.are_torques and len(arm.drives) < arm.joint_count:
        searched, without = with_ideal_drives(arm), (*without, *needing_drives())
        log = None if log is None else without_voltages(log)
        notes.append(
            f"arm {arm.name} has no [[drive]] of some joints: its torques are taken as they are, without rotors; not tried are"
            f" {', '.join(needing_drives())}"
        )
    outcome = find_gap(searched, recordings.points, log, without=without, advance=advance)
    files = (*recordings.point_files, *recordings.log_files)
    outcome = dataclasses.replace(
        outcome,
        finding=dataclasses.replace(outcome.finding, data=tuple(path.name for path in files)),
        warnings=(*notes, *outcome.warnings),
    )
    return _mapped(arm, outcome) if with_maps else outcome


def _mapped(arm: Arm, outcome: GapOutcome) -> GapOutcome:
    """With maps of what the arm leaves that has everything named."""
    model, maps = _updated(arm, outcome.finding, outcome.static), MapsFound((), ())
    if outcome.static is not None:
        model, angles = angle_maps(model, outcome.static)
        maps += angles
    if outcome.dynamic is not None:
        model, torques = torque_maps(model, outcome.dynamic)
        maps += torques
    shared = outcome.finding.maps or MeasuredMaps()
    summary = MeasuredMaps((*shared.maps, *maps.maps), (*shared.checks, *maps.checks))
    finding = dataclasses.replace(outcome.finding, maps=summary)
    return dataclasses.replace(outcome, finding=finding, maps=maps, mapped=model, warnings=(*outcome.warnings, *maps.sentences))


def _updated(arm: Arm, finding: GapFinding, static: StaticGap | None) -> Arm:
    """The arm with what is named, as identified at the poses if there are any."""
    if static is None:
        return updated_arm(with_geometry(arm, finding), finding)
    return updated_arm(dataclasses.replace(static.file, drives=arm.drives), finding)


def require_effects(names: Collection[str]) -> None:
    """CalibrationError for a name that is not in the list of effects."""
    for name in names:
        if name not in EFFECTS:
            raise CalibrationError(f'--without: expected some of {", ".join(EFFECTS)}, got "{name}"')


def require_free(out: Path) -> None:
    """ArmError where a result is there already: nothing is ever overwritten."""
    for name in RESULTS:
        if (out / name).exists():
            raise ArmError(f"{out / name} exists already and is never overwritten: choose another --out")


def write_gap(outcome: GapOutcome, arm: Arm, recordings: Recordings, out: Path) -> Arm:
    """gap.json, arm.toml with what was named, report.html; returns the new model. ArmError where one of them exists.

    The page is last: the result is on disk before anything is drawn, and a page that cannot be drawn says so itself.
    """
    require_free(out)
    made = made_today(*(input_file(path, "") for path in (*recordings.point_files, *recordings.log_files)))
    out.mkdir(parents=True, exist_ok=True)
    write_gap_json(out / "gap.json", outcome.finding)
    model = outcome.mapped or _updated(arm, outcome.finding, outcome.static)
    model = dataclasses.replace(model, calibration=made.of_arm(arm, "gap workflow"))
    save_arm(model, out / "arm.toml")
    try:
        page = gap_page(outcome, made)
    except Exception as error:  # whatever a picture stumbles over, the words stand: what was found is worth more
        notice = f"the pictures could not be drawn ({type(error).__name__}: {error}): please report this"
        bare = GapOutcome(outcome.finding, None, None, (*outcome.warnings, notice), outcome.maps)
        page = gap_page(bare, made)
    write_whole(out / "report.html", page)
    return model


# A finding that does not contradict itself: what is named is in no set of what may be, and what is left is not passed over.
MORE = "Record more runs, slow and fast, each motion twice: these do not say more."
CHANNELS = {
    "current_A": "the motors' currents",
    "voltage_V": "the motors' voltages",
    "tip_m": "the tip",
    "turn_rad": "the tip's orientation",
}  # those that name effects


def consistent(finding: GapFinding) -> GapFinding:
    """The same without sets that a name has settled, and with what is left said where nothing else says it."""
    named = {effect.name for effect in finding.effects}
    sets = tuple(names for names in finding.ambiguous if not named.intersection(names))
    settled = finding if sets == finding.ambiguous else dataclasses.replace(finding, ambiguous=sets, next_experiment=MORE)
    is_silent = finding.unknown is None and not sets and not finding.remainder
    if is_silent and finding.unexplained > SILENT_MOST:
        return dataclasses.replace(settled, unknown=Unknown(_excess_in_words(settled), None, 0.0), next_experiment=MORE)
    return settled


def _excess_in_words(finding: GapFinding) -> str:
    """How much is left, and in which channel most of it."""
    times = {
        channel: finding.after_si.get(channel, math.nan) / floor
        for channel, floor in finding.noise_floor.items()
        if channel in CHANNELS and floor > 0.0
    }
    seen = {channel: value for channel, value in times.items() if math.isfinite(value)}
    if not seen:
        return f"{finding.unexplained:.1f} times the noise"
    channel = max(seen, key=lambda key: seen[key])
    return f"{CHANNELS[channel]}, {seen[channel]:.1f} times the noise"
