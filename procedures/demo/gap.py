"""`armwright demo gap`: an effect is hidden in a mock arm; recorded, named, added to the model, and corrected on the arm.

Recording, analysis and motion get only the nominal arm and its links. The scenario with the hidden effect is read only at
the end, to check the name.
"""

from __future__ import annotations

import dataclasses
import math
import random
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calib.design.candidates import spread_poses
from calib.errors import CalibrationError
from calib.gap.finding import EffectName, GapFinding, NamedEffect
from calib.gap.plan.motions import collision_free_box
from calib.gap.plan.plan import PlanRequest, RecordingPlan, recording_plan
from calib.gap.report import GapOutcome, gap_parts
from calib.gap.workflow import Recordings, find_gap_in, read_recordings, write_gap
from calib.points.points import FREE
from calib.report.page import Section, list_section, page, paragraph, table, tiles, verdict
from calib.report.report import paths_section, verification_section
from calib.results import Provenance, made_today
from calib.validation.verify import Comparison, TrackPair
from control.errors import ArmError
from control.files import write_whole
from control.kinematics.kinematics import ForwardKinematics
from control.model import table as tables
from control.model.arm import Arm, Effect
from control.plain_text import Advance
from control.server.client import ArmClient
from procedures import tour
from procedures.demo.job import shut_down, start_again
from procedures.gap_recording import record
from procedures.mock import MockBench
from procedures.survey import Model, Place, Programme, Survey, compared, paired, recorded, ways

Range = tuple[float, float]
GEOMETRY = {"d_m": 0.002, "theta_rad": 0.01, "L_m": 0.002, "alpha_rad": 0.01}  # also hidden, within these bounds
# Sizes that matter in practice. Joint 1 is vertical: nothing loads its spring at rest.
SIZES: Mapping[str, tuple[tuple[int, ...], Mapping[str, Range]]] = {
    "backlash": ((1, 2, 3), {"width_rad": (0.003, 0.008)}),
    "joint_compliance": ((2, 3), {"stiffness_Nm_rad": (250.0, 600.0)}),
    "encoder_scale": ((1, 2, 3), {"scale": (0.004, 0.010)}),
    "encoder_eccentricity": ((1, 2, 3), {"amplitude_rad": (0.003, 0.006), "phase_rad": (-3.0, 3.0)}),
    "belt_coupling": ((), {"ratio": (0.006, 0.015)}),
    "thermal_drift": ((1, 2, 3), {"final_rad": (0.004, 0.008), "time_constant_s": (40.0, 90.0)}),
    "coulomb_friction": ((1, 2, 3), {"torque_Nm": (0.4, 1.0)}),
    "viscous_friction": ((1, 2, 3), {"coefficient_Nm_s_rad": (0.5, 1.5)}),
    "stribeck_friction": ((1, 2, 3), {"torque_Nm": (0.5, 1.0), "speed_rad_s": (0.03, 0.08)}),
    "load_friction": ((2, 3), {"fraction": (0.10, 0.20)}),
    "asymmetric_friction": ((1, 2, 3), {"torque_Nm": (0.2, 0.5)}),
    "cogging": ((1, 2, 3), {"amplitude_Nm": (0.3, 0.6), "order": (4.0, 10.0), "phase_rad": (-3.0, 3.0)}),
    "torque_constant": ((1, 2, 3), {"scale": (0.92, 0.96)}),
    "link_inertia": ((2, 3), {"mass_kg": (0.15, 0.35)}),
    "payload": ((), {"mass_kg": (0.12, 0.30)}),
    "command_delay": ((), {"delay_s": (0.002, 0.004)}),
    "supply_sag": ((), {"resistance_ohm": (0.05, 0.12)}),
}
WHOLE = ("order",)  # integer parameters
# The demo draws from these by default: effects that the loop corrects or feeds forward, so the result shows on the arm.
DRAWN = (
    "backlash",
    "joint_compliance",
    "encoder_scale",
    "encoder_eccentricity",
    "belt_coupling",
    "viscous_friction",
    "coulomb_friction",
    "load_friction",
)
ON_TIP = ("backlash", "joint_compliance", "encoder_scale", "encoder_eccentricity", "belt_coupling", "thermal_drift")
KNOWN = ((1.0, 1.2), (1.2, 1.5), (0.7, 0.8))  # Coulomb [N m] and viscous [N m s/rad] friction in the arm's file


@dataclass(frozen=True, slots=True)
class Hidden:
    """The effect in the mock arm, unknown to the run."""

    effect: str
    joint: int | None
    parameters: Mapping[str, float]

    def __str__(self) -> str:
        """As `backlash on joint 2 (width_rad = 0.0051)`."""
        where = f" on {'link' if self.effect == 'link_inertia' else 'joint'} {self.joint}" if self.joint else ""
        values = ", ".join(f"{name} = {value:.4g}" for name, value in self.parameters.items())
        return f"{self.effect}{where} ({values})"

    def as_scenario(self, name: str, seed: int) -> str:
        """TOML of a scenario with this effect and small geometric errors."""
        joint = f"joint = {self.joint}\n" if self.joint else ""
        values = ", ".join(f"{key} = {value!r}" for key, value in self.parameters.items())
        geometry = "".join(f"{key} = {value}\n" for key, value in GEOMETRY.items())
        return (
            f'name = "{name}"\nseed = {seed}\n\n[plant]\ntimestep_s = 0.0005\n\n[true_dh]\n{geometry}\n'
            f'[[effect]]\neffect = "{self.effect}"\n{joint}parameters = {{ {values} }}\n'
        )


def drawn(seed: int, effect: str | None, joint: int | None) -> Hidden:
    """Draw the effect: as chosen, the rest by the seed. CalibrationError if the effect cannot act on the joint."""
    draw = random.Random(f"gap {seed}")
    name = effect or draw.choice(DRAWN)
    if name not in SIZES:
        raise CalibrationError(f'--effect: expected one of {", ".join(SIZES)}, got "{name}"')
    joints, sizes = SIZES[name]
    if joint is not None and joint not in joints:
        places = f"joint {' or '.join(map(str, joints))}" if joints else "no joint (it acts on the whole arm)"
        raise CalibrationError(f"--joint: expected {places} for {name}, got {joint}")
    at = joint or (draw.choice(joints) if joints else None)
    values = {key: draw.uniform(*between) for key, between in sizes.items()}
    rounded = {key: float(round(value)) if key in WHOLE else float(f"{value:.4g}") for key, value in values.items()}
    return Hidden(name, at, rounded)


def with_known_friction(arm: Arm) -> Arm:
    """The arm with known friction, as any gear has; the hidden effect is added to it."""
    has = {effect.effect for effect in arm.effects}
    added = [
        Effect(name, j + 1, {key: KNOWN[min(j, len(KNOWN) - 1)][k]})
        for j in range(arm.joint_count)
        for k, (name, key) in enumerate((("coulomb_friction", "torque_Nm"), ("viscous_friction", "coefficient_Nm_s_rad")))
        if name not in has
    ]
    return dataclasses.replace(arm, effects=(*arm.effects, *added))


def beyond_known(hidden: Hidden, arm: Arm) -> Hidden:
    """The plant's effect: if the file has a part of it, the sum."""
    for known in arm.effects:
        if (known.effect, known.joint) == (hidden.effect, hidden.joint):
            total = {key: value + known.parameters.get(key, 0.0) for key, value in hidden.parameters.items()}
            return Hidden(hidden.effect, hidden.joint, total)
    return hidden


PLACES = 10
TURN_rad = 1.2  # of joint 1 to either side: places visible to the camera
FROM_AXIS_m = 0.15  # from axis 1: closer to it the identified arm may not reach the places
INSIDE_rad = 0.15  # of the range: the runtime keeps a compliant joint this far from its ends
PAYLOAD_kg = 0.5
NO_NAMES = ("link_geometry", "base_frame")


@dataclass(frozen=True, slots=True)
class DrivenSurvey:
    """One model's visits and paths: camera measurements and following errors."""

    survey: Survey
    recording: Path
    following_rad: float


@dataclass(frozen=True, slots=True)
class Circle:
    """The whole demo: the hidden effect, the finding, and the tip error at each stage."""

    hidden: Hidden
    outcome: GapOutcome
    model: Arm
    nominal: Arm
    plans: tuple[RecordingPlan, ...]
    geometry_alone: Comparison
    corrected: Comparison
    paths: tuple[TrackPair, ...]
    following_rad: tuple[float, float]

    @property
    def named(self) -> tuple[NamedEffect, ...]:
        """The effects that the run named, without geometry."""
        return named_in(self.outcome.finding)

    @property
    def is_right(self) -> bool:
        """Whether exactly the hidden effect was named."""
        return [one.name for one in self.named] == [EffectName(self.hidden.effect, self.hidden.joint)]


def run(arm: Arm, bench: MockBench, hidden: Hidden, out: Path, advance: Advance) -> Circle:
    """Run the demo on the bench's arm; `arm` is the nominal one. Results in `out`."""
    programme = programme_of(arm)
    Survey(Model(arm), programme, out / "driven.csv")  # what the arm cannot do is said before it moves
    plans = _plans(arm, bench.speed)
    advance("homing", 0.0)
    client = bench.start(arm)
    client.enable()
    client.home()
    own = tour.Bench(client, _newest(out), bench.rig.set_payload, speed=bench.speed)
    recordings, outcome = _recorded(arm, own, plans, out, advance)
    advance("moving by the nominal model", 0.6)
    nominal = Model(arm)
    before = _driven(Survey(nominal, programme, out / "driven_nominal.csv"), nominal, client, bench.speed, out)
    shut_down(arm, bench, client)

    if recordings.log_files:
        outcome = find_gap_in(arm, recordings, (), lambda what, done: advance(what, 0.65 + 0.15 * done))
    model = write_gap(outcome, arm, recordings, out / "gap")
    advance("moving with the correction off", 0.8)
    client, whole = start_again(model, bench), Model(model)
    kept = tuple(e for e in model.effects if e in arm.effects or e.effect in NO_NAMES)
    uncorrected = Model(dataclasses.replace(model, effects=kept))
    off = _driven(Survey(uncorrected, programme, out / "driven_off.csv"), whole, client, bench.speed, out)
    advance("moving with the correction on", 0.87)
    on = _driven(Survey(whole, programme, out / "driven_on.csv"), whole, client, bench.speed, out)
    shut_down(model, bench, client)
    advance("reporting", 0.95)
    return Circle(
        hidden,
        outcome,
        model,
        arm,
        plans if recordings.log_files else plans[:1],
        compared(programme, off.survey.points(), on.survey.points()),
        compared(programme, before.survey.points(), on.survey.points()),
        paired(programme, before.survey.tracks(before.recording), on.survey.tracks(on.recording)),
        (before.following_rad, on.following_rad),
    )


def _plans(arm: Arm, speed: float) -> tuple[RecordingPlan, RecordingPlan]:
    """The poses' plan and the motions'."""
    poses = PlanRequest(has_motions=False, payload_kg=PAYLOAD_kg, is_quick=True)
    motions = PlanRequest(has_poses=False, payload_kg=PAYLOAD_kg, is_quick=True)
    return recording_plan(arm, poses, speed), recording_plan(arm, motions, speed)


def _recorded(
    arm: Arm, bench: tour.Bench, plans: tuple[RecordingPlan, RecordingPlan], out: Path, advance: Advance
) -> tuple[Recordings, GapOutcome]:
    """Record the poses and analyse them; if they name nothing, also the motions."""
    poses, motions = plans
    record(arm, bench, poses, out / "poses", lambda what, done: advance(what, 0.02 + 0.38 * done))
    recordings = read_recordings(arm, [out / "poses" / "points.csv"], [])
    outcome = find_gap_in(arm, recordings, (), lambda what, done: advance(what, 0.4 + 0.02 * done))
    if not named_in(outcome.finding):  # effects that poses do not show may show in motion
        record(arm, bench, motions, out / "motions", lambda what, done: advance(what, 0.42 + 0.18 * done))
        recordings = read_recordings(arm, recordings.point_files, [out / "motions" / "log.csv"])
    return recordings, outcome


def named_in(finding: GapFinding) -> tuple[NamedEffect, ...]:
    """The effects that a finding names, without geometry."""
    return tuple(one for one in finding.effects if one.name.effect not in NO_NAMES)


def programme_of(arm: Arm) -> Programme:
    """Places without recordings, over the whole workspace, and a circle and a line above the table."""
    room = collision_free_box(arm).inset(INSIDE_rad)
    poses = spread_poses((room.lower_rad, room.upper_rad), 4 * PLACES)[PLACES:]
    poses[:, 0] = np.clip(poses[:, 0], -TURN_rad, TURN_rad)
    tips = ForwardKinematics(arm).tips(poses)
    model = Model(arm)
    places: list[Place] = []
    for pose, tip in zip(poses, tips.tolist(), strict=True):
        if len(places) == PLACES:
            break
        try:
            solved = np.array(model.inverse.nearest(tuple(tip), pose))
        except ArmError:
            continue
        if np.abs(solved - pose).max() < 1e-3 and np.hypot(tip[0], tip[1]) > FROM_AXIS_m:
            places.append(Place(FREE, f"v{len(places) + 1}", (tip[0], tip[1], tip[2]), tuple(pose.tolist())))
    return Programme(tuple(places), ways(tables.table_of(arm), ("normal",)))


def _driven(survey: Survey, runtime: Model, client: ArmClient, speed: float, out: Path) -> DrivenSurvey:
    """Every place and every path once, on a runtime that uses the model `runtime`."""
    survey.drive(runtime, client, speed)
    client.wait(tour.FLUSH_s)
    recording = _newest(out)
    return DrivenSurvey(survey, recording, _following_rad(recording, survey))


def _following_rad(recording: Path, survey: Survey) -> float:
    """Root mean square of set-points minus angles on the survey's paths."""
    rows = recorded(recording)
    rows = rows[np.isin(rows["run"], survey.runs)]
    joints = range(1, survey.model.arm.joint_count + 1)
    errors = [rows[f"q{j}_set_rad"] - rows[f"q{j}_rad"] for j in joints]
    return float(np.sqrt(np.mean(np.square(errors)))) if len(rows) else float("nan")


def _newest(out: Path) -> Path:
    """The recording in progress."""
    recordings: Sequence[Path] = sorted((out / "log").glob("*.armlog"), key=lambda path: path.stat().st_mtime_ns)
    if not recordings:
        raise ArmError(f"{out / 'log'}: the runtime writes no recording")
    return recordings[-1]


def findings(circle: Circle) -> tuple[str, ...]:
    """Sentences: the named effects, whether they are correct, and the improvement."""
    named = ", ".join(str(one.name) for one in circle.named) or "nothing"
    right = "correct" if circle.is_right else "not correct"
    alone, after = (
        1e3 * summary.mean_m for summary in (circle.geometry_alone.of("all").before, circle.corrected.of("all").after)
    )
    before = 1e3 * circle.corrected.of("all").before.mean_m
    finding = circle.outcome.finding
    gap_after = f"{finding.gap_after:.2f}" if math.isfinite(finding.gap_after) else "not measured"
    notes = [
        f"Named by the run: {named}. Hidden: {circle.hidden}. The result is {right}.",
        f"The gap on {finding.judged_on}: {finding.gap_before:.2f} times the noise before, {gap_after} after.",
        f"Mean tip error at {len(circle.corrected.point)} held-out places: {before:.2f} mm with the nominal model,"
        f" {alone:.2f} mm with identified geometry and the correction off, {after:.2f} mm with the correction on.",
    ]
    following = tuple(1e3 * value for value in circle.following_rad)
    if circle.hidden.effect not in ON_TIP:
        notes.append(
            f"Following error on the paths: {following[0]:.3f} mrad before, {following[1]:.3f} mrad with the named"
            " effects fed forward."
        )
    return tuple(notes)


def write_page(circle: Circle, out: Path) -> Path:
    """report.html."""
    path, made = out / "report.html", made_today()
    about = f"{made.line} · mock arm with a hidden effect"
    write_whole(path, page("The gap, closed on the arm", circle.nominal.name, about, _parts(circle, made)))
    return path


def _parts(circle: Circle, made: Provenance) -> Iterator[Section | str]:
    yield verdict(findings(circle))
    yield tiles(_tiles(circle))
    yield list_section("Procedure", _steps(circle))
    yield _revealed(circle)
    yield verification_section(circle.geometry_alone, "at held-out places: correction off (before) and on (after)")
    yield paths_section(circle.paths)
    yield from gap_parts(circle.outcome)


def _tiles(circle: Circle) -> Iterator[tuple[str, str, str]]:
    yield ("before", f"{1e3 * circle.corrected.of('all').before.mean_m:.2f} mm", "mean tip error, nominal model")
    yield ("before", f"{1e3 * circle.geometry_alone.of('all').before.mean_m:.2f} mm", "geometry identified, correction off")
    yield "after", f"{1e3 * circle.corrected.of('all').after.mean_m:.2f} mm", "correction on"
    yield (
        "after",
        f"{1e3 * circle.following_rad[1]:.3f} mrad",
        (f"following error on the paths ({1e3 * circle.following_rad[0]:.3f} before)"),
    )


def _steps(circle: Circle) -> Iterator[str]:
    minutes = sum(plan.duration_s for plan in circle.plans) / 60.0
    motions = sum(len(plan.runs) for plan in circle.plans)
    more = f", then {motions} motions, since the poses named no effect" if motions else ""
    yield (
        f"Recorded {len(circle.plans[0].visits)} poses on the mock arm with the nominal model{more}: {minutes:.1f}"
        " minutes of arm time."
    )
    yield "Moved to held-out places and along a circle and a line with the nominal model; the camera measured."
    yield ("Analysed the recordings with the nominal arm.toml alone; named the missing effects and added them to a new arm.toml.")
    yield "Started the runtime with the new arm.toml and moved to the same places with the correction off, then on."


def _revealed(circle: Circle) -> Section:
    found = {one.name.effect: one for one in circle.named if one.name.joint == circle.hidden.joint}
    same = found.get(circle.hidden.effect)
    rows = []
    for key, value in circle.hidden.parameters.items():
        known, sd = same.parameters.get(key, (float("nan"), float("nan"))) if same else (float("nan"), float("nan"))
        rows.append((("text", key), f"{value:.4g}", "–" if known != known else f"{known:.4g}", "–" if sd != sd else f"{sd:.2g}"))
    head = (("text", "parameter"), "hidden", "found", "sd")
    return Section("Hidden effect", paragraph(f"{circle.hidden}; the run had no access to it.") + table(head, rows))
