"""The LeRobot plugin against LeRobot itself: its registries, base classes and datasets (`make test-lerobot`)."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import armwright
from armwright.connection import RunningArm
from control.model.description import save_arm
from control.safety.modes import Mode
from control.server.client import ArmClient
from control.server.in_process import InProcessChannel
from tests.cell import Cell, open_cell, scenario

WITHOUT = "LeRobot and the plugin are not installed: `make test-lerobot` makes an environment of their own"
plugin: Any = pytest.importorskip("lerobot_robot_armwright", reason=WITHOUT)
SO101 = armwright.load_arm("so101")
START = (0.2, -0.4, 0.3, 0.2, -0.1)
STEP_s = 1.0 / 30.0  # as LeRobot's programs go round
JOINTS = [f"{name}.pos" for name in ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll")]


@contextmanager
def cell_of(monkeypatch: pytest.MonkeyPatch, arm: armwright.Arm, **hidden: Any) -> Iterator[Cell]:
    """A mock whose loop `armwright.connect` finds."""
    with open_cell(scenario(START[: arm.joint_count], **hidden), arm, period_s=1.0 / arm.usual_rate_Hz) as cell:

        def connected(*_: object) -> RunningArm:
            channel = InProcessChannel(cell.assembly, cell.rig.clock, cell.channel.loop, number=1)
            return RunningArm(ArmClient(channel), arm)

        monkeypatch.setattr(armwright, "connect", connected)
        yield cell


@pytest.fixture
def cell(monkeypatch: pytest.MonkeyPatch) -> Iterator[Cell]:
    """An SO-101, whose gripper's opening is known."""
    with cell_of(monkeypatch, SO101) as cell:
        cell.client.enable()
        cell.client.grip("open")
        yield cell


@pytest.fixture
def guided(monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[Cell, Any]]:
    """The arm `right`, whose boards can bear its weight, and a leader that is connected to it."""
    from lerobot.teleoperators import make_teleoperator_from_config

    with cell_of(monkeypatch, armwright.load_arm("right")) as cell:
        leader = make_teleoperator_from_config(plugin.ArmwrightLeaderConfig(arm="right", weightless=True))
        leader.connect()
        yield cell, leader


@pytest.fixture(autouse=True)
def keeps_to_its_folder(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """LeRobot makes a folder for calibrations."""
    for module in ("robots.robot", "teleoperators.teleoperator"):
        monkeypatch.setattr(f"lerobot.{module}.HF_LEROBOT_CALIBRATION", tmp_path)


def robot_of(arm: str = "so101", **keys: Any) -> Any:
    from lerobot.robots import make_robot_from_config

    return make_robot_from_config(plugin.ArmwrightConfig(arm=arm, **keys))


def at_deg(cell: Cell) -> dict[str, float]:
    """What the plant knows of the joints."""
    return dict(zip(JOINTS, map(math.degrees, cell.rig.joint_rad()), strict=True))


def goal(values: dict[str, float], by_deg: float) -> dict[str, float]:
    return {name: value + by_deg * (name in JOINTS) for name, value in values.items()}


def test_lerobot_finds_the_plugin_by_its_name_and_its_types_by_theirs() -> None:
    import draccus
    from lerobot.robots import Robot, RobotConfig, make_robot_from_config
    from lerobot.teleoperators import Teleoperator, TeleoperatorConfig, make_teleoperator_from_config
    from lerobot.utils.import_utils import register_third_party_plugins

    both = dataclasses.make_dataclass("Both", [("robot", RobotConfig), ("teleop", TeleoperatorConfig)])
    register_third_party_plugins()
    given: Any = draccus.parse(
        both,
        args=[
            "--robot.type=armwright",
            "--robot.arm=so101",
            "--robot.id=mine",
            "--teleop.type=armwright",
            "--teleop.arm=so101",
            "--teleop.weightless=true",
        ],
    )
    assert given.robot == plugin.ArmwrightConfig(arm="so101", id="mine")
    assert given.teleop == plugin.ArmwrightLeaderConfig(arm="so101", weightless=True)
    assert isinstance(make_robot_from_config(given.robot), Robot)
    assert isinstance(make_teleoperator_from_config(given.teleop), Teleoperator)


def test_connecting_moves_nothing_and_the_robot_reads_as_lerobots_own(cell: Cell) -> None:
    before, robot = at_deg(cell), robot_of()
    assert not robot.is_connected
    robot.connect()
    cell.run(0.2)
    assert robot.is_connected
    assert robot.is_calibrated
    assert cell.mode is Mode.HOLDING
    seen = robot.get_observation()
    assert list(seen) == list(robot.observation_features) == [*JOINTS, "gripper.pos"]
    assert all(isinstance(value, robot.observation_features[name]) for name, value in seen.items())
    assert {name: seen[name] for name in JOINTS} == pytest.approx(before, abs=0.3)  # 3 counts of a servo
    robot.disconnect()


def test_the_arm_goes_where_actions_lead_and_an_action_beyond_a_range_ends_there(cell: Cell) -> None:
    robot = robot_of()
    robot.connect()
    wanted = goal(robot.get_observation(), 8.0) | {"gripper.pos": 60.0}
    for _ in range(60):
        assert robot.send_action(wanted) == pytest.approx(wanted)
        cell.run(STEP_s)
    assert at_deg(cell) == pytest.approx({name: wanted[name] for name in JOINTS}, abs=0.5)
    assert robot.get_observation()["gripper.pos"] == pytest.approx(60.0, abs=3.0)
    sent = robot.send_action(wanted | {"wrist_roll.pos": 500.0, "gripper.pos": 130.0})
    assert sent["wrist_roll.pos"] == pytest.approx(math.degrees(SO101.limits_rad[4][1]))
    assert sent["gripper.pos"] == 100.0
    robot.disconnect()


def test_without_actions_the_arm_rests_and_goes_on_with_the_next(cell: Cell) -> None:
    robot = robot_of()
    robot.connect()
    wanted = goal(robot.get_observation(), 20.0)
    for _ in range(5):
        robot.send_action(wanted)
        cell.run(STEP_s)
    cell.until(lambda: cell.mode is Mode.HOLDING, 1.0)  # an episode is being saved
    robot.send_action(wanted)
    assert cell.mode is Mode.JOGGING
    robot.disconnect()


def test_a_stop_by_somebody_else_is_raised_and_the_arm_stays(cell: Cell) -> None:
    robot = robot_of()
    robot.connect()
    wanted = goal(robot.get_observation(), 20.0)
    for _ in range(5):
        robot.send_action(wanted)
        cell.run(STEP_s)
    cell.client.stop()
    with pytest.raises(armwright.MotionStopped, match="was stopped and is HOLDING"):
        robot.send_action(wanted)
    cell.run(1.0)  # the servos come back from their overshoot
    rested = at_deg(cell)
    cell.run(1.0)
    assert at_deg(cell) == pytest.approx(rested, abs=0.1)
    assert cell.mode is Mode.HOLDING
    robot.disconnect()


def test_a_fault_is_raised_and_disconnecting_raises_nothing(cell: Cell) -> None:
    robot = robot_of()
    robot.connect()
    robot.send_action(goal(robot.get_observation(), 20.0))
    cell.run(0.1)
    cell.client.ask("brake")
    cell.until_fault(0.1)
    with pytest.raises(armwright.ArmFaulted, match="braked while moving"):
        robot.get_observation()
    with pytest.raises(armwright.ArmFaulted, match="braked while moving"):
        robot.send_action(dict.fromkeys(robot.action_features, 0.0))
    robot.disconnect()
    assert not robot.is_connected


def test_disconnecting_on_the_way_lets_the_arm_hold_and_others_command(cell: Cell) -> None:
    from lerobot.utils.errors import DeviceNotConnectedError

    robot = robot_of()
    robot.connect()
    robot.send_action(goal(robot.get_observation(), 20.0))
    cell.run(0.1)
    assert "taken control" in cell.refusal(do="move_joints", q_rad=list(START))
    robot.disconnect()
    assert cell.mode is Mode.HOLDING
    cell.client.enable()
    with pytest.raises(DeviceNotConnectedError, match="connect"):
        robot.get_observation()


def test_a_loop_that_is_gone_is_raised_and_disconnecting_raises_nothing(cell: Cell) -> None:
    robot = robot_of()
    robot.connect()
    cell.channel.loop.is_running = False
    with pytest.raises(armwright.RuntimeGone):
        robot.get_observation()
    robot.disconnect()


def test_an_arm_that_is_not_homed_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    with cell_of(monkeypatch, armwright.load_arm("right"), homed=False) as cell:
        with pytest.raises(armwright.ArmError, match="not homed: find its zeros with `armwright home --arm right`"):
            robot_of("right").connect()
        assert cell.mode is Mode.HOLDING
        cell.client.take_control()  # nobody has it


def test_an_arm_without_names_and_gripper_has_its_joints_by_number(monkeypatch: pytest.MonkeyPatch) -> None:
    with cell_of(monkeypatch, armwright.load_arm("right")):
        robot = robot_of("right")
        robot.connect()
        assert list(robot.get_observation()) == list(robot.action_features) == ["joint1.pos", "joint2.pos", "joint3.pos"]
        robot.disconnect()


def test_a_gripper_whose_opening_is_unknown_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    with (
        cell_of(monkeypatch, SO101),
        pytest.raises(armwright.ArmError, match="open it once with `armwright gripper open --arm so101`"),
    ):
        robot_of().connect()


def test_a_guided_arm_leads_and_the_end_of_guiding_is_raised(guided: tuple[Cell, Any]) -> None:
    cell, leader = guided
    assert cell.mode is Mode.GUIDING
    before = leader.get_action()
    x, y, z = cell.rig.robot.tip_m()
    cell.rig.robot.hand.seat((x, y + 0.04, z))
    cell.run(1.0)
    action = leader.get_action()
    assert list(action) == list(leader.action_features) == ["joint1.pos", "joint2.pos", "joint3.pos"]
    assert list(action.values()) == pytest.approx([math.degrees(q) for q in cell.rig.joint_rad()], abs=0.1)
    assert action["joint1.pos"] - before["joint1.pos"] > 2.0
    cell.client.stop()
    with pytest.raises(armwright.MotionStopped, match="has ended: it is BRAKED"):
        leader.get_action()
    leader.disconnect()


def test_disconnecting_a_leader_lets_it_hold(guided: tuple[Cell, Any]) -> None:
    cell, leader = guided
    leader.disconnect()
    assert cell.mode is Mode.HOLDING


def test_an_episode_of_the_robot_is_recorded_and_loaded_by_lerobots_dataset(cell: Cell, tmp_path: Path) -> None:
    datasets: Any = pytest.importorskip("lerobot.datasets.lerobot_dataset")
    try:
        from lerobot.utils.feature_utils import build_dataset_frame, hw_to_dataset_features  # lerobot 0.6
    except ImportError:
        from lerobot.datasets.utils import build_dataset_frame, hw_to_dataset_features
    robot = robot_of()
    robot.connect()
    features = {
        **hw_to_dataset_features(robot.observation_features, "observation"),
        **hw_to_dataset_features(robot.action_features, "action"),
    }
    written = datasets.LeRobotDataset.create("me/mock", 30, features, tmp_path / "set", robot.name, use_videos=False)
    wanted, states = goal(robot.get_observation(), 5.0), []
    for _ in range(20):
        seen, sent = robot.get_observation(), robot.send_action(wanted)
        states.append(list(seen.values()))
        frame = {**build_dataset_frame(features, seen, "observation"), **build_dataset_frame(features, sent, "action")}
        written.add_frame({**frame, "task": "move"})
        cell.run(STEP_s)
    written.save_episode()
    written.finalize()
    robot.disconnect()
    loaded = datasets.LeRobotDataset("me/mock", root=tmp_path / "set")
    assert (loaded.num_episodes, len(loaded), loaded.meta.robot_type) == (1, 20, "armwright")
    np.testing.assert_allclose([frame["observation.state"].numpy() for frame in loaded], states, rtol=1e-6)
    assert loaded.meta.features["action"]["names"] == list(wanted)


def test_what_armwright_exports_is_loaded_by_lerobots_dataset(tmp_path: Path) -> None:
    datasets: Any = pytest.importorskip("lerobot.datasets.lerobot_dataset")
    from console.main import main

    save_arm(SO101, tmp_path / "arm.toml")
    with armwright.mock_arm(SO101, folder=tmp_path / "log") as running:
        running.enable()
        running.move_joints([0.2, 0.1, -0.1, 0.1, 0.2])
        recording = running.recording
    out = tmp_path / "set"
    assert main(["export", str(recording), "--lerobot", "--task", "move", "--fps", "50", "--out", str(out)]) == 0
    loaded = datasets.LeRobotDataset("me/mock", root=out)
    assert (loaded.num_episodes, loaded.fps) == (1, 50)
    np.testing.assert_allclose(loaded[len(loaded) - 1]["action"].numpy(), [0.2, 0.1, -0.1, 0.1, 0.2], atol=1e-3)
