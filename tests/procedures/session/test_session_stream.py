"""A session with a motion capture system as its camera, and what a calibration makes of its frame."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calib.arm_problem.observations import Frame, rotation_of
from calib.calibration import with_placed_stream
from calib.points.points import read_points
from calib.session.conduct import Boards, Station, conduct
from calib.session.conversation import GO, Recorded
from calib.session.folder import SessionFolder
from calib.session.moves import ArmGeometry, SeenTip, chosen_free_poses
from calib.session.plan import SessionPlan, fingerprint, free_targets
from calib.session.residual_watch import ResidualWatch
from console.main import main
from control.kinematics.kinematics import ForwardKinematics
from control.kinematics.rotation import matrices
from control.model.arm import Effect
from control.model.description import load_arm, save_arm
from control.model.end_effector import Camera, CameraStream
from hil_mocks.devices.cameras import BASE_m, BASE_turn_rad
from hil_mocks.devices.cameras import rotation_of as turn_of
from tests.calib.session.session_arm import ScriptedArm

RIGHT = load_arm("right")
STREAM = CameraStream("vicon", "tool", "base")


@pytest.fixture
def arm_file(tmp_path: Path) -> Path:
    save_arm(replace(RIGHT, camera=Camera(1e-4, 1e-3, stream=STREAM)), tmp_path / "arm.toml")
    return tmp_path / "arm.toml"


def session(arm_file: Path, *options: str) -> int:
    return main(["session", "--mock", "--arm", str(arm_file), "--out", str(arm_file.parent / "s"), *options])


class Seen(ScriptedArm):
    """Its camera sees a body on the last link, in the frame of a body on the base."""

    def measure(self, duration_s: float) -> SeenTip:
        seen = super().measure(duration_s)
        x, y, z = (turn_of(BASE_turn_rad).T @ (np.array(seen.tip_m) - BASE_m)).tolist()
        return SeenTip((x, y, z), seen.sd_m, (0.6, 0.0, 0.8, 0.0))


def test_full_poses_are_recorded_in_the_frame_of_the_base_body(tmp_path: Path) -> None:
    poses = chosen_free_poses(RIGHT, 7)
    plan = SessionPlan("right", "x", 3, free_targets(poses), "unknown", has_camera=True, pose_frame="stream")
    arm = Seen()
    verdicts = []
    for begins in (True, False):
        with SessionFolder(tmp_path, plan if begins else None) as folder:
            station = Station(arm, ArmGeometry(RIGHT), Boards(RIGHT, folder.plan), ResidualWatch(RIGHT), camera=arm)
            talk = conduct(folder, station)
            saying = next(talk)
            while len(verdicts) < (4 if begins else 7):
                if isinstance(saying, Recorded):
                    verdicts.append(saying.verdict)
                saying = talk.send(GO)
            talk.close()
    assert not any(verdict.is_suspect for verdict in verdicts)
    assert verdicts[-1].off_m < 1e-3  # predicted although the frame is anywhere
    points, warnings = read_points(tmp_path / "points.csv", 3)
    assert (warnings, points.extra["frame"], points.in_camera_frame) == ((), ("stream",) * 7, True)
    np.testing.assert_allclose(points.orientation, [(0.6, 0.0, 0.8, 0.0)] * 7)
    tips = points.tip_m @ turn_of(BASE_turn_rad).T + BASE_m
    np.testing.assert_allclose(tips, ForwardKinematics(RIGHT).tips(points.q_rad), atol=1e-6)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("--camera", "--points", "1,2"), "cannot say where the cavities of a board are"),
        (("--camera", "--free", "3", "--setups", "normal"), "record --free poses and calibrate first"),
        (("--free", "3"), "add --camera"),
    ],
)
def test_what_a_frame_of_unknown_place_cannot_do_is_refused_before_anything_exists(
    arm_file: Path, options: tuple[str, ...], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert session(arm_file, *options) == 2
    assert said in capsys.readouterr().err
    assert not (arm_file.parent / "s").exists()


def test_a_calibrated_stream_measures_tips_as_the_base_frame_has_them() -> None:
    vector = (0.2, -0.1, 0.3)
    frame = Frame("camera", rotation_of(np.array(vector)), np.array([0.4, 0.5, 0.6]))
    shift = Effect("base_frame", None, {"x_m": 0.01, "rz_rad": 0.2})
    arm = replace(RIGHT, camera=Camera(stream=STREAM), effects=(shift,))
    camera = with_placed_stream(arm, frame).camera
    assert camera is not None
    assert camera.stream is not None
    assert camera.stream.origin_m is not None
    (turn,) = matrices(np.array([camera.stream.orientation]))
    seen = np.array([0.1, 0.2, 0.3])
    in_world = turn @ seen + camera.stream.origin_m
    in_base = rotation_of(np.array([0.0, 0.0, 0.2])) @ in_world + [0.01, 0.0, 0.0]
    np.testing.assert_allclose(in_base, frame.rotation @ seen + frame.origin_m, atol=1e-12)
    assert with_placed_stream(RIGHT, frame) == RIGHT


def test_another_port_is_the_same_arm_and_another_body_is_not() -> None:
    def arm(**keys: object) -> str:
        return fingerprint(replace(RIGHT, camera=Camera(stream=replace(STREAM, **keys))))  # type: ignore[arg-type]

    assert arm(port=5) == arm()
    assert arm(body="other") != arm()
