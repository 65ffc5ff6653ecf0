"""`armwright demo gap`: an effect is hidden in a mock arm; recorded, named, added to the model, and corrected on the arm.

Recording, analysis and motion get only the nominal arm and its links. The scenario with the hidden effect is read only at
the end, to check the name.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calib.design.candidates import spread_poses
from calib.gap.finding import EffectName, GapFinding, NamedEffect
from calib.gap.plan.collision_free_box import collision_free_box
from calib.gap.plan.plan import PlanRequest, RecordingPlan, recording_plan
from calib.gap.workflow import GapOutcome, Recordings, find_gap_in, read_recordings, write_gap
from calib.validation.verify import Comparison, TrackPair
from control.errors import ArmError
from control.kinematics.kinematics import ForwardKinematics
from control.model import table as tables
from control.model.arm import Arm
from control.progress import Advance
from control.server.client import ArmClient
from procedures import tour
from procedures.demo.gap_hidden import Hidden
from procedures.demo.handover import shut_down, start_again
from procedures.gap.recording import record
from procedures.mock import MockBench
from procedures.verify.models import Model
from procedures.verify.places import Place, ways
from procedures.verify.survey import Programme, Survey, compared, paired, recorded

PLACES = 10
TURN_rad = 1.2  # of joint 1 to either side: places visible to the camera
FROM_AXIS_m = 0.15  # from axis 1: closer to it the identified arm may not reach the places
INSIDE_rad = 0.15  # of the range: the runtime keeps a compliant joint this far from its ends
PAYLOAD_kg = 0.5
NO_NAMES = ("link_geometry", "base_frame")


@dataclass(frozen=True, slots=True)
class DrivenSurvey:
    """One model's visits and paths: camera measurements and following errors."""

    name: str
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
    Survey(
        Model(arm), programme, _near(arm), out / "driven.csv"
    )  # what the arm cannot do is said before it moves
    plans = _plans(arm, bench.speed)
    advance("homing", 0.0)
    client = bench.start(arm)
    client.enable()
    client.home()
    first = _newest(out)
    own = tour.Bench(client, first, bench.rig.set_payload, speed=bench.speed)
    recordings, outcome = _recorded(arm, own, plans, out, advance)
    advance("moving by the nominal model", 0.6)
    before = _driven("nominal", arm, arm, programme, client, first, bench, out)
    shut_down(arm, bench, client)

    if recordings.log_files:
        outcome = find_gap_in(arm, recordings, (), lambda what, done: advance(what, 0.65 + 0.15 * done))
    model = write_gap(outcome, arm, recordings, out / "gap")
    off, on = _driven_off_and_on(arm, model, programme, bench, out, advance)
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


def _driven_off_and_on(
    arm: Arm, model: Arm, programme: Programme, bench: MockBench, out: Path, advance: Advance
) -> tuple[DrivenSurvey, DrivenSurvey]:
    """On a runtime that uses `model`: by its geometry without the added effects, and by the whole model."""
    advance("moving with the correction off", 0.8)
    client = start_again(model, bench)
    recording = _newest(out)
    bare = dataclasses.replace(
        model, effects=tuple(e for e in model.effects if e in arm.effects or e.effect in NO_NAMES)
    )
    off = _driven("off", bare, model, programme, client, recording, bench, out)
    advance("moving with the correction on", 0.87)
    on = _driven("on", model, model, programme, client, recording, bench, out)
    shut_down(model, bench, client)
    return off, on


def named_in(found: GapFinding) -> tuple[NamedEffect, ...]:
    """The effects that a finding names, without geometry."""
    return tuple(one for one in found.effects if one.name.effect not in NO_NAMES)


def programme_of(arm: Arm) -> Programme:
    """Places without recordings, over the whole workspace, and a circle and a line above the table."""
    room = collision_free_box(arm).inset(INSIDE_rad)
    poses = spread_poses((room.lower_rad, room.upper_rad), 4 * PLACES)[PLACES:]
    poses[:, 0] = np.clip(poses[:, 0], -TURN_rad, TURN_rad)
    tips = ForwardKinematics(arm).tips(poses)
    model = Model(arm)
    found: list[Place] = []
    for pose, tip in zip(poses, tips.tolist(), strict=True):
        if len(found) == PLACES:
            break
        try:
            solved = np.array(model.inverse.nearest(tuple(tip), pose))
        except ArmError:
            continue
        if np.abs(solved - pose).max() < 1e-3 and np.hypot(tip[0], tip[1]) > FROM_AXIS_m:
            found.append(Place("free", f"v{len(found) + 1}", (tip[0], tip[1], tip[2]), tuple(pose.tolist())))
    return Programme(tuple(found), ways(tables.table_of(arm), ("normal",)))


def _driven(
    name: str,
    arm: Arm,
    runtime_model: Arm,
    programme: Programme,
    client: ArmClient,
    recording: Path,
    bench: MockBench,
    out: Path,
) -> DrivenSurvey:
    """Run every place and every path once by the model `arm`, on a runtime that uses the model `runtime_model`."""
    model = Model(arm)
    runtime = model if arm is runtime_model else Model(runtime_model)
    survey = Survey(model, programme, _near(arm), out / f"driven_{name}.csv")
    for _ in survey.tour(1, runtime, client, bench.speed):
        pass
    first = int(client.status()["run"]) + 1
    for _ in survey.run_ways(runtime, client, bench.speed):
        pass
    last = int(client.status()["run"])
    client.wait(0.3)
    return DrivenSurvey(name, survey, recording, _following_rad(recording, first, last, arm.joint_count))


def _near(arm: Arm) -> tuple[float, ...]:
    """Seed of the inverse kinematics."""
    return arm.rest.q_rad if arm.rest is not None else (0.0,) * arm.joint_count


def _following_rad(recording: Path, first: int, last: int, joints: int) -> float:
    """Root mean square of set-points minus angles in the runs first to last."""
    rows = recorded(recording)
    rows = rows[(rows["run"] >= first) & (rows["run"] <= last)]
    errors = [rows[f"q{j}_set_rad"] - rows[f"q{j}_rad"] for j in range(1, joints + 1)]
    return float(np.sqrt(np.mean(np.square(errors)))) if len(rows) else float("nan")


def _newest(out: Path) -> Path:
    """The recording in progress."""
    found: Sequence[Path] = sorted((out / "log").glob("*.armlog"), key=lambda path: path.stat().st_mtime_ns)
    if not found:
        raise ArmError(f"{out / 'log'}: the runtime writes no recording")
    return found[-1]
