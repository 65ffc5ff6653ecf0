"""A whole verification, on an arm through its runtime or on recorded points."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calib.arm_problem.joint_effects import LAWS
from calib.distance_calibration import compare_lengths
from calib.distances import WireKnowledge, has_readings
from calib.errors import CalibrationError
from calib.points.points import Points, points_for
from calib.points.writer import write_points
from calib.report.report import Verification, write_verification_json, write_verification_report
from calib.results import InputFile, input_file, made_today
from calib.session.take import with_reference_tips
from calib.validation.verify import Comparison, TrackPair, already_used, compare_arms, compare_turns
from control.dynamics.feedforward import FED_FORWARD
from control.dynamics.joint_side import SIDE_EFFECTS
from control.model import table as tables
from control.model.arm import Arm, Effect
from control.plain_text import Advance
from control.server.client import ArmClient
from procedures.survey import Model, ModelPair, Programme, Survey, compared, paired, raw_points


@dataclass(slots=True)
class SurveyPair:
    """The planned surveys of one arm by both models."""

    programme: Programme
    before: Survey
    after: Survey

    @classmethod
    def planned(cls, pair: ModelPair, programme: Programme, out: Path) -> "SurveyPair":
        """Plan both surveys; ArmError if something is out of reach by either model."""
        return cls(
            programme, Survey(pair.nominal, programme, out / "before.csv"), Survey(pair.calibrated, programme, out / "after.csv")
        )

    def run(self, runtime_model: Model, client: ArmClient, speed: float, advance: Advance) -> None:
        """Tours by the nominal and the calibrated model in turn, so that drift affects both equally; then the paths."""
        places, ways = len(self.programme.places), len(self.programme.ways)
        total, done = 2 * (places * self.programme.repeats + 2 * ways), 0
        for what in self._steps(runtime_model, client, speed):
            done += 2 if what.startswith("path") else 1
            advance(what, done / total)
        rest = self.after.model.arm.rest
        if rest is not None:
            client.move_joints(rest.q_rad, speed)

    def _steps(self, runtime_model: Model, client: ArmClient, speed: float) -> Iterator[str]:
        for repeat in range(1, self.programme.repeats + 1):
            for survey, name in self._named():
                for stop in survey.tour(repeat, runtime_model, client, speed):
                    yield f"{name}: {stop.name}, visit {repeat}"
        for survey, name in self._named():
            for way in survey.run_ways(runtime_model, client, speed):
                yield f"path, {name}: {way.setup} {way.name}"

    def _named(self) -> tuple[tuple[Survey, str], tuple[Survey, str]]:
        return (self.before, "nominal"), (self.after, "calibrated")

    def results(self, recording: Path | None, out: Path) -> tuple[Comparison, tuple[TrackPair, ...]]:
        """Return the measurements; writes points.csv."""
        before, after = self.before.points(), self.after.points()
        write_points(out / "points.csv", raw_points(self.programme, before, after))
        paths: tuple[TrackPair, ...] = ()
        if recording is not None and self.programme.ways:
            paths = paired(self.programme, self.before.tracks(recording), self.after.tracks(recording))
        return compared(self.programme, before, after), paths


def driven(pair: ModelPair, drive: SurveyPair, comparison: Comparison, paths: tuple[TrackPair, ...]) -> Verification:
    """The verification of an arm that was moved."""
    programme = drive.programme
    how = [
        f"Moved the tip to {len(programme.places)} points that calibration did not use, {programme.repeats} times"
        " with each model in turn (nominal, calibrated); the camera measured at rest."
    ]
    if programme.ways:
        how.append(
            f"Ran {len(programme.ways)} paths with each model at {programme.path_speed_m_s:g} m/s; the camera"
            " measured during motion."
        )
    q_rad = np.concatenate((drive.before.q_rad, drive.after.q_rad))
    used = already_used(pair.calibrated.arm, q_rad)
    nominal, calibrated = pair.nominal.arm, pair.calibrated.arm
    return Verification(
        nominal,
        calibrated,
        comparison,
        paths,
        tuple(how),
        (*used.warnings, *_left_out(nominal, calibrated, is_driven=True)),
        is_driven=True,
        made=made_today(*_arm_files(nominal, calibrated)),
        used_count=used.count,
        pose_count=len(q_rad),
    )


def on_recorded(pair: ModelPair, file: Path, wires: WireKnowledge, is_as_given: bool = False) -> Verification:
    """The verification on static poses with measured tips, or lengths: each model's prediction from the encoders.

    wires: of lengths, as in a calibration by them.
    """
    nominal, calibrated = pair.nominal.arm, pair.calibrated.arm
    points, warnings = points_for(calibrated, [file], is_as_given)
    if has_readings(points):
        comparison = compare_lengths(nominal, calibrated, points, file, wires)
        what = f"{len(comparison.setup)} lengths"
        seen = int(np.isfinite(points.tip_m).all(axis=1).sum())
        warnings += (f"{seen} measured tips beside the lengths were not compared",) if seen else ()
    elif wires.free_zero or wires.known_m:
        raise CalibrationError(f"{file}: --wire-at and --free-zero: expected lengths (docs/distances.md)")
    else:
        comparison = compare_arms(nominal, calibrated, _with_tips(calibrated, points))
        what, warnings = "measured tips", (*warnings, *comparison.cautions)
    used_file = input_file(file, f"recorded poses and {what}")
    how = (
        f"Compared {len(points)} recorded poses of {file.name}: {what} against the predictions of the nominal"
        " and the calibrated model from the encoders. Nothing moved.",
    )
    used = already_used(calibrated, points.q_rad, used_file.sha256)
    return Verification(
        nominal,
        calibrated,
        comparison,
        (),
        how,
        (*used.warnings, *warnings, *_left_out(nominal, calibrated, is_driven=False)),
        is_driven=False,
        made=made_today(*_arm_files(nominal, calibrated), used_file),
        used_count=used.count,
        pose_count=len(points),
        turns=compare_turns(nominal, calibrated, points),
    )


def _with_tips(arm: Arm, points: Points) -> Points:
    """Replace missing tips by the cavities of a table whose pose is known."""
    if np.isfinite(points.tip_m).all() or arm.table is None or not arm.table.known_pose:
        return points
    table = arm.table
    return with_reference_tips(points, lambda setup: tables.cavities(table, setup))


def _arm_files(nominal: Arm, calibrated: Arm) -> tuple[InputFile, ...]:
    return tuple(
        input_file(arm.path, what)
        for arm, what in ((nominal, "the nominal arm"), (calibrated, "the calibrated arm"))
        if arm.path is not None and arm.path.is_file()
    )


def _left_out(nominal: Arm, calibrated: Arm, is_driven: bool) -> tuple[str, ...]:
    """Unused effects: the runtime corrects and feeds forward some, predictions use the static ones."""
    known = {"base_frame"} | (SIDE_EFFECTS | FED_FORWARD if is_driven else set(LAWS))
    notes = []
    unused: dict[str, list[str]] = {}
    for effect in calibrated.effects:
        if effect.effect not in known:
            unused.setdefault(effect.effect, []).append(str(effect.joint or ""))
    if unused:
        names = (f"{name} of {', '.join(joints)}" if all(joints) else name for name, joints in unused.items())
        notes.append(f"effects of the calibrated arm that were not used here: {'; '.join(names)}")
    was = [_named(effect) for effect in nominal.effects if effect.effect in SIDE_EFFECTS]
    if is_driven and was and not Model(nominal).has_gears_of(Model(calibrated)):
        notes.append(
            f"the nominal arm's {', '.join(was)} was not used for its motions: the runtime corrects with one arm file only"
        )
    return tuple(notes)


def _named(effect: Effect) -> str:
    return f"{effect.effect} of {effect.joint}" if effect.joint else effect.effect


def write(verification: Verification, out: Path) -> None:
    """verify.json and report.html."""
    write_verification_json(out / "verify.json", verification)
    write_verification_report(out / "report.html", verification)
