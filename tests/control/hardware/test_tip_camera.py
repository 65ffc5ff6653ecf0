"""A motion capture system as the camera of an arm: mock, bytes, driver, runtime and client."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import msgspec
import numpy as np
import pytest

from console.commands.status import described
from control.errors import ArmError
from control.hardware.measurement import MeanPose
from control.hardware.tip_camera import BodyCamera, open_camera
from control.kinematics.rotation import matrices, quaternion_of
from control.model.end_effector import Camera, CameraStream
from firmware_iface.clock import MonotonicClock
from hil_mocks.assembly import MOCAP
from hil_mocks.devices.cameras import BASE_m, BASE_turn_rad, TARGET_turn_rad, rotation_of
from procedures import ports
from tests.cell import RIGHT, Cell, open_cell, scenario

SYSTEMS = tuple(MOCAP)
LIMIT_S = 30.0  # of the simulation's time; a busy machine's kernel is late


@contextmanager
def seen_by(system: str, **stream: Any) -> Iterator[Cell]:
    """A mock arm that a system without noise looks at."""
    how = CameraStream(system, "tool", **{"base_body": "base", "host": "127.0.0.1", **stream})
    arm = replace(RIGHT, camera=Camera(1e-4, 1e-9, stream=how))
    hidden = scenario()
    table = msgspec.structs.replace(hidden.camera, noise_m=0.0, latency_s=0.0)
    with open_cell(msgspec.structs.replace(hidden, camera=table), arm) as cell:
        cell.client.enable()
        cell.run(0.15)  # the drives take the arm up, and it is at rest
        # The kernel sets up a connection in its own time, which is none of the simulation's.
        cell.until(lambda: target(cell) is not None, LIMIT_S)
        yield cell


def target(cell: Cell) -> MeanPose | None:
    return cell.client.average(0.03).target


def says(cell: Cell, words: str) -> None:
    """The camera's problem has these words before long."""
    cell.until(lambda: words in cell.client.status()["camera_problem"], LIMIT_S)


@pytest.mark.parametrize("system", SYSTEMS)
def test_a_system_measures_the_tip_and_says_which_bodies_are_hidden_or_exchanged(
    system: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    with seen_by(system) as cell:
        found = target(cell)
        assert found is not None
        tip, axes = cell.rig.robot.plant.tip_pose()
        turn = rotation_of(BASE_turn_rad)
        np.testing.assert_allclose(found.position_m, turn.T @ (np.array(tip) - BASE_m), atol=2e-5)
        (rotation,) = matrices(np.array([found.orientation]))
        np.testing.assert_allclose(rotation, turn.T @ np.array(axes).T @ rotation_of(TARGET_turn_rad), atol=2e-5)
        status = cell.client.status()
        assert status["camera_m"] is None
        assert "no known place" in status["camera_problem"]

        cell.inject("exchanged_bodies", "camera")
        says(cell, "tool and wand exchanged their names")
        assert target(cell) is None
        cell.rig.clear_faults()
        cell.run(0.02)
        assert ports.RuntimePort(cell.client, in_own_frame=True).measure(0.03).orientation is not None
        monkeypatch.setattr(ports, "CAMERA_PATIENCE_S", 0.02)
        with pytest.raises(ArmError, match=r"no known place to the arm.s base"):
            ports.RuntimePort(cell.client).measure(0.02)

        camera = cell.rig.robot.camera
        camera.setup = replace(camera.setup, dropout=1.0)
        says(cell, "body tool is")
        assert target(cell) is None


def test_a_frame_of_known_place_gives_the_tip_in_the_base_frame_and_a_wrong_name_those_there_are(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    orientation = quaternion_of(rotation_of(BASE_turn_rad).tolist())
    with seen_by("vicon", origin_m=BASE_m, orientation=orientation) as cell:
        assert cell.client.average(0.03).tip_m == pytest.approx(cell.rig.tip_m(), abs=2e-5)
        assert cell.client.status()["camera_m"] == pytest.approx(cell.rig.tip_m(), abs=2e-5)
        camera = cell.connection.camera
        assert isinstance(camera, BodyCamera)
        camera._body = "tooll"
        cell.run(0.02)
        said = cell.client.status()["camera_problem"]
        assert "tooll is not in the stream" in said
        assert "bodies there: base, tool, wand" in said
        monkeypatch.setattr(ports, "CAMERA_PATIENCE_S", 0.02)
        with pytest.raises(ArmError, match=r"no camera frame within .* \(body tooll is not in the stream"):
            ports.RuntimePort(cell.client).measure(0.02)
        assert "tip not measured now: body tooll is not in the stream" in described(cell.client.status())


def test_a_camera_that_has_gone_is_said_with_when_it_was_heard_last(monkeypatch: pytest.MonkeyPatch) -> None:
    orientation = quaternion_of(rotation_of(BASE_turn_rad).tolist())
    with seen_by("vicon", origin_m=BASE_m, orientation=orientation) as cell:
        assert "tip not measured" not in described(cell.client.status())
        monkeypatch.setattr(type(cell.connection.camera), "newest", lambda self: None)
        cell.run(0.6)
        assert "tip not measured now: its last frame came 0.6 s ago" in described(cell.client.status())


def test_packets_of_another_format_are_said() -> None:
    how = CameraStream("vicon", "tool", host="127.0.0.1")
    camera = open_camera(Camera(stream=how), 0, MonotonicClock())
    assert isinstance(camera, BodyCamera)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
        stranger.sendto(b"noise", ("127.0.0.1", int(camera._stream.name.rpartition(":")[2])))
    assert camera.newest() is None
    assert "1 packets on udp://127.0.0.1" in camera.problem()
    camera.close()
