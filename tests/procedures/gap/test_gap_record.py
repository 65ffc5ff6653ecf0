"""`armwright gap --record` on a stepped mock arm: every step once, resumed after an interruption, in the interchange formats."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from calib.errors import CalibrationError
from calib.gap.leads import gears_by_leads
from calib.gap.log import Log, read_log
from calib.gap.plan.motions import MotionLimits, collision_free_box, multisine
from calib.gap.plan.plan import PlannedRun, PlannedVisit, RecordingPlan
from calib.points.points import Points, read_points
from console.main import main
from control.kinematics.kinematics import ForwardKinematics, PoseKinematics
from control.kinematics.rotation import logarithms, matrices, quaternions
from control.model.description import load_arm
from control.model.end_effector import Camera, CameraStream
from hil_mocks.devices.cameras import BASE_m, BASE_turn_rad, TARGET_turn_rad
from hil_mocks.devices.cameras import rotation_of as turn_of
from procedures.gap_recording import note, record
from procedures.mock import SteppedBench, scenario_bytes
from procedures.tour import Bench
from tests.cell import scenario
from tests.control.loop.test_encoder_places import BELT, HIDDEN, PLAY_rad, arm_of_four, known_friction, with_both

PLACE = tuple(quaternions(turn_of(BASE_turn_rad)[None])[0].tolist())
STREAM = CameraStream("vicon", "tool", "base", origin_m=BASE_m, orientation=PLACE)
RIGHT = dataclasses.replace(load_arm("right"), camera=Camera(1.4e-4, 1e-3, stream=STREAM))
POSES = ((0.10, 0.20, 0.30), (0.16, 0.14, 0.36))
SCENARIO = """
name = "tiny"
[start]
homed = true
q_rad = [0.1, 0.2, 0.3]
[plant]
timestep_s = 0.001
"""


class Interrupted(Exception):
    """Somebody ends the program."""


@dataclass
class Recorded:
    """What is on the disk, and what the arm was told."""

    out: Path
    points: Points
    log: Log
    hung: list[float]
    done_before: int
    shares: list[float]  # of what was left, as it went on


def tiny() -> RecordingPlan:
    """Two poses from two sides, one of them loaded, a short swing with and without the load."""
    room = collision_free_box(RIGHT)
    near = dataclasses.replace(room, lower_rad=np.array([0.0, 0.1, 0.2]), upper_rad=np.array([0.2, 0.3, 0.4]))
    swing = multisine(near, MotionLimits.of(RIGHT), (1.0, 3.0), 1.0, 1.8, 1)
    steps = (
        PlannedVisit("p1", 1, POSES[0], (1, 1, 1), 0.0),
        PlannedVisit("p1", 2, POSES[0], (-1, -1, -1), 0.0),
        PlannedRun("1", "swing", swing, 0.0),
        PlannedVisit("p2", 1001, POSES[1], (1, -1, 1), 0.4),
        PlannedRun("2", "swing", swing, 0.4),
    )
    return RecordingPlan(room, steps, 12.0)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory, nobody_below: None) -> Iterator[Recorded]:
    """Interrupted before the third step, and gone on with."""
    folder = tmp_path_factory.mktemp("gap_record")
    scenario, out = folder / "scenario.toml", folder / "recorded"
    scenario.write_text(SCENARIO)
    bench = SteppedBench(RIGHT, scenario, folder / "log")
    try:
        client = bench.start(RIGHT)
        client.enable()
        client.home()
        hung: list[float] = []

        def hang(mass_kg: float) -> None:
            hung.append(mass_kg)
            bench.rig.set_payload(mass_kg)

        mine = Bench(client, next((folder / "log").glob("*.armlog")), hang)

        def advance(what: str, share: float) -> None:
            if what.startswith("run 1"):
                raise Interrupted

        with pytest.raises(Interrupted):
            record(RIGHT, mine, tiny(), out, advance)
        before = len(read_points(out / "points.csv", 3)[0])
        shares: list[float] = []
        record(RIGHT, mine, tiny(), out, lambda _, share: shares.append(share))
        bench.stop()
        points, warnings = read_points(out / "points.csv", 3)
        log, log_warnings = read_log(out / "log.csv", 3)
        assert (warnings, log_warnings) == ((), ())
        yield Recorded(out, points, log, hung, before, shares)
    finally:
        bench.close()


def test_an_interrupted_recording_goes_on_and_holds_every_pose_once(recorded: Recorded) -> None:
    assert recorded.done_before == 2
    assert recorded.points.point == ("p1", "p1", "p2")
    assert recorded.points.payload_kg.tolist() == [0.0, 0.0, 0.4]
    assert set(recorded.points.setup) == {"free"}
    assert recorded.hung == [0.4, 0.0]


def test_progress_after_an_interruption_is_that_of_what_was_left(recorded: Recorded) -> None:
    """Two of five steps done in no time made the remaining time too short."""
    assert recorded.shares == [0.0, 1 / 3, 2 / 3, 1.0]


def test_poses_are_reached_and_their_directions_are_those_of_the_approach(recorded: Recorded) -> None:
    assert np.abs(recorded.points.q_rad - np.array([POSES[0], POSES[0], POSES[1]])).max() < 2e-3
    assert recorded.points.direction.tolist() == [[1, 1, 1], [-1, -1, -1], [1, -1, 1]]
    assert np.isfinite(recorded.points.tip_m).all()
    assert np.isfinite(recorded.points.t_s).all()
    assert np.isfinite(recorded.points.current_A).all()


def test_a_camera_that_measures_orientations_has_them_recorded_in_the_base_frame(recorded: Recorded) -> None:
    link = PoseKinematics(ForwardKinematics(RIGHT)).batch(recorded.points.q_rad).rotation
    seen = np.swapaxes(link, 1, 2) @ matrices(recorded.points.orientation)
    assert np.abs(logarithms(seen @ turn_of(TARGET_turn_rad).T)).max() < 2e-3


def test_runs_are_whole_on_one_clock_and_repeats_are_told_by_their_set_points(recorded: Recorded) -> None:
    first, second = recorded.log.runs
    assert (first.name, second.name) == ("1", "2")
    assert first.t_s[0] == 0.0
    assert np.diff(first.t_s) == pytest.approx(0.002, abs=1e-6)
    assert first.t_s[-1] == pytest.approx(tiny().runs[0].path.duration_s + 0.1, abs=0.01)
    assert (first.payload, second.payload) == (0.0, 0.4)
    assert np.isfinite(first.voltage_V).all()
    seen = int(np.isfinite(first.tip_m[:, 0]).sum())
    assert seen == pytest.approx(100.0 * first.t_s[-1], abs=4)  # 100 frames a second
    # the same motion, so the same set-points in the same rows: repeats but for the load
    both = min(len(first), len(second))
    assert np.abs(first.q_set_rad[:both] - second.q_set_rad[:both]).max() < 1e-6
    assert np.abs(first.q_rad - first.q_set_rad).max() < 0.01


@pytest.mark.nightly
def test_gears_between_two_encoders_are_named_from_what_was_recorded(tmp_path: Path) -> None:
    """An arm that is not supplied, whose belt makes leads beyond the usual `transmission_slack_rad`, as its fault then says."""
    both = with_both(known_friction(arm_of_four("joint")))
    arm = dataclasses.replace(both, limits=dataclasses.replace(both.limits, transmission_slack_rad=0.1))
    file = tmp_path / "scenario.toml"
    file.write_bytes(scenario_bytes(scenario((0.1, 0.2, 0.3, 0.1), homed=True, effect=HIDDEN)))
    room, limits = collision_free_box(arm), MotionLimits.of(arm)
    swings = [multisine(room, limits, (0.1, 0.5), 1.0, 8.0, seed) for seed in (1, 2, 3)]
    runs = tuple(PlannedRun(str(number), "swing", swing, 0.0) for number, swing in enumerate(swings, 1))
    bench = SteppedBench(arm, file, tmp_path / "log")
    try:
        client = bench.start(arm)
        client.enable()
        client.home()
        mine = Bench(client, next((tmp_path / "log").glob("*.armlog")), has_camera=False)
        record(arm, mine, RecordingPlan(room, runs, 30.0), tmp_path / "out", lambda *_: None)
        bench.stop()
    finally:
        bench.close()
    log, warnings = read_log(tmp_path / "out" / "log.csv", 4)
    assert warnings == ()
    found = {str(effect.name): effect.parameters for effect in gears_by_leads(arm, log)}
    assert found["belt_coupling on joint 3"]["ratio"][0] == pytest.approx(BELT, rel=0.03)
    assert found["backlash on joint 3"]["width_rad"][0] == pytest.approx(PLAY_rad, rel=0.15)
    assert found.keys() >= {"backlash on joint 2", "joint_compliance on joint 2"}


def test_the_folder_of_another_plan_is_left_alone(recorded: Recorded) -> None:
    other = dataclasses.replace(tiny(), steps=tiny().steps[:2])
    before = (recorded.out / "plan.json").read_bytes()
    with pytest.raises(CalibrationError, match="another plan or arm"):
        note(recorded.out, other, RIGHT)
    assert (recorded.out / "plan.json").read_bytes() == before


def test_plan_json_says_every_step(recorded: Recorded) -> None:
    content = json.loads((recorded.out / "plan.json").read_text())
    assert [step.get("point") or f"run {step['run']}" for step in content["steps"]] == ["p1", "p1", "run 1", "p2", "run 2"]


def test_the_plan_alone_is_said_and_nothing_is_made(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["gap", "--record", "--mock", "--plan-only", "--quick", "--only", "static", "--out", str(tmp_path / "d")]
    assert main(arguments) == 0
    said = capsys.readouterr().out
    assert "86 poses and 0 motions, some of them with 0.5 kg at the tip" in said
    assert "backlash on joint 2" in said
    assert not (tmp_path / "d").exists()


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--mock"], "--mock needs --record"),
        (["--quick"], "--quick needs --record"),
        (["--minutes", "3"], "--minutes needs --record"),
        (["--seed", "0"], "--seed needs --record"),
        (["--record", "--mock", "--points", "p.csv"], "omit --points and --log"),
        (["--record", "--mock", "--minutes", "-1"], "--minutes: expected a number above 0"),
        (["--record", "--mock", "--minutes", "0.1"], "the shortest useful recording takes"),
        (["--record", "--mock", "--payload", "-0.5"], "--payload: expected a mass"),
        (["--record", "--mock", "--payload", "4"], "4 kg, and the motors move 1.18 kg"),
        (["--record", "--scenario", "demo"], "need --mock"),
        (["--record", "--socket", "/nowhere/at.all", "--only", "motion"], "no runtime answers at /nowhere/at.all"),
    ],
)
def test_what_makes_no_sense_is_one_clear_error_and_nothing_is_written(
    arguments: list[str], says: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["gap", *arguments, "--out", str(tmp_path / "d")]) == 2
    assert says in capsys.readouterr().err
    assert not (tmp_path / "d").exists()
