"""Mock arms of a cell: one world, each at its base, with boards, hand and hidden errors of its own."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from control.kinematics.kinematics import ForwardKinematics
from control.model.cell import Cell, load_cell
from firmware_iface.link import CanFormat
from hil_mocks.cell import MockCell, SteppedCell
from hil_mocks.errors import RigError, ScenarioError
from hil_mocks.robot import MockRobot
from hil_mocks.scenario import FaultTable
from tests.cell import STRETCHED, scenario

PAIR = load_cell("pair")
TURNED = replace(PAIR, arms=(PAIR.arms[0], replace(PAIR.arms[1], origin_m=(0.3, -0.8, 0.2), orientation=(0.8, 0.0, 0.0, -0.6))))


def ticked(cell: Cell, ticks: int) -> MockCell:
    mock = MockCell(cell, scenario())
    for _ in range(ticks):
        mock.tick()
    return mock


def test_an_arm_in_a_cell_moves_as_it_does_alone_wherever_its_base_is() -> None:
    mock = ticked(TURNED, 200)
    for placed in TURNED.arms:
        alone = MockRobot(placed.arm, scenario())
        for _ in range(200):
            alone.tick()
        beside = mock.robots[placed.name]
        assert beside.joint_rad() == pytest.approx(alone.joint_rad(), abs=1e-6)
        assert beside.tip_m() == pytest.approx(ForwardKinematics(placed.arm).tip(*beside.joint_rad()), abs=1e-9)
        assert beside.joint_rad() != pytest.approx(STRETCHED, abs=1e-3)  # drives off: it sinks


def test_the_hand_takes_one_tip_to_a_place_of_its_own_base_frame() -> None:
    mock = ticked(TURNED, 1)
    right = mock.robots["right"]
    x, y, z = right.tip_m()
    duration_s = right.hand.seat((x - 0.02, y + 0.03, z))
    left = mock.robots["left"].joint_rad()[0]
    for _ in range(math.ceil((duration_s + 0.1) / mock.tick_s)):
        mock.tick()
    assert right.hand.state == "holding"
    assert right.tip_m() == pytest.approx((x - 0.02, y + 0.03, z), abs=1e-4)
    assert mock.robots["left"].hand.state == "away"
    assert mock.robots["left"].joint_rad()[0] == pytest.approx(left, abs=1e-3)


def test_hidden_errors_differ_from_arm_to_arm_and_a_fault_is_of_one() -> None:
    mock = MockCell(PAIR, scenario(base="demo"))
    left, right = mock.robots["left"], mock.robots["right"]
    off_m = [
        math.dist(robot.tip_m(), ForwardKinematics(PAIR.placed(name).arm).tip(*robot.joint_rad()))
        for name, robot in mock.robots.items()
    ]
    assert min(off_m) > 1e-3
    assert abs(off_m[0] - off_m[1]) > 1e-4
    right.inject(FaultTable("dead_motor", "motor4"))
    assert "motor4" not in left.board_names
    with pytest.raises(RigError, match='`arm` to be one of left, right, got "middle"'):
        mock.robot("middle")
    with pytest.raises(ScenarioError, match=r"expected no \[\[fault\]\] for a cell of 2 arms"):
        MockCell(PAIR, scenario(fault=(FaultTable("dead_motor", "motor1"),)))


def test_the_same_cell_and_host_give_the_same_bytes() -> None:
    def sent() -> list[tuple[bytes, int]]:
        with SteppedCell(PAIR, scenario()) as rig:
            found = []
            for k in range(20):
                rig.mock.tick()
                found.append((rig.mock.serial_outgoing(k % 2), len(rig.mock.outgoing[CanFormat.STANDARD])))
            return found

    assert sent() == sent()
