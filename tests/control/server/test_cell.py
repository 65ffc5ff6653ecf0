"""Two arms on one runtime: names apart, one stop for both, and a fault of one stops the other."""

from __future__ import annotations

import socket
from dataclasses import replace
from pathlib import Path

import pytest

from benchmarks.arms import SIX
from control.model.arm import Arm
from control.model.cell import Cell, Placed
from control.safety.modes import Mode
from control.server.client import MotionStopped
from control.server.server import Server
from procedures.on_boards import on_boards
from tests.cell import scenario
from tests.pair import APART, FREE, PAIR, Pair, holding_pair, open_pair

TOLERANCE_rad = 2e-3  # friction and quantisation at the end of a move


def assert_at(pair: Pair, arm: str, q_rad: tuple[float, ...]) -> None:
    assert pair.robot(arm).joint_rad() == pytest.approx(q_rad, abs=TOLERANCE_rad)


def test_each_arm_does_what_it_is_asked_and_the_other_does_not() -> None:
    with open_pair() as pair:
        pair.clients["left"].enable()
        assert (pair.mode("left"), pair.mode("right")) == (Mode.HOLDING, Mode.OFF)
        pair.clients["right"].enable()
        pair.clients["right"].move_joints(FREE)
        assert_at(pair, "right", FREE)
        assert_at(pair, "left", APART)
        status = pair.clients["left"].status()
        assert (status["arm"], status["cell"]["arms"]) == ("left", {"left": "HOLDING", "right": "HOLDING"})


def test_a_request_may_name_another_arm_than_that_of_its_socket() -> None:
    with holding_pair() as pair:
        assert pair.clients["left"].ask("status", arm="right")["arm"] == "right"
        expected = "arm: expected one of left, right of cell 'pair', got 'middle'"
        assert pair.refusal("left", do="status", arm="middle") == expected


@pytest.mark.parametrize(("do", "reached"), [("stop", Mode.HOLDING), ("brake", Mode.FAULT)])
def test_a_stop_of_one_stops_both(do: str, reached: Mode) -> None:
    with holding_pair() as pair:
        pair.start_move("left", *FREE)
        pair.start_move("right", *FREE)
        pair.run(0.3)
        pair.clients["left"].ask(do)
        pair.until(lambda: pair.mode("left") is pair.mode("right") is reached, 0.6)
        pair.run(0.2)
        speeds = [speed for arm in pair.clients for speed in pair.runtime(arm).parts.measurement.speed_rad_s]
        assert max(map(abs, speeds)) < 1e-2


def test_a_fault_of_one_stops_the_other_on_its_path_and_says_why() -> None:
    with holding_pair() as pair:
        duration_s = pair.start_move("left", *FREE)
        pair.run(0.5 * duration_s)
        pair.inject("right", "lost_wire", "encoder", channel=1)
        pair.until(lambda: pair.mode("left") is Mode.HOLDING, 0.8)
        assert pair.mode("right") is Mode.FAULT
        assert pair.faults("left") == []
        with pytest.raises(MotionStopped, match="arm 'right' is in FAULT: "):
            pair.clients["left"].arrive(1.0)
        # A joint move is a straight line in joint space, and so is a stop on its path.
        shares = [(q - a) / (b - a) for q, a, b in zip(pair.runtime("left").set_point.q_rad, APART, FREE, strict=True)]
        assert shares == pytest.approx([shares[0]] * 3, abs=1e-3)
        assert 0.3 < shares[0] < 1.0


def test_beside_an_arm_in_fault_only_jogs_and_hands_move_the_other() -> None:
    with holding_pair() as pair:
        pair.inject("right", "over_temperature", "motor5")
        pair.until(lambda: pair.mode("right") is Mode.FAULT, 0.1)
        refusal = pair.refusal("left", do="move_joints", q_rad=FREE)
        assert refusal.startswith("arm 'right' is in FAULT, so arm 'left' cannot move joints: `armwright acknowledge --arm")
        assert pair.clients["left"].jog(joint=1, by_rad=0.05) == ""
        pair.robot("right").clear_faults()
        pair.until(lambda: pair.runtime("right").is_still(), 5.0)
        pair.clients["right"].acknowledge()
        pair.start_move("left", *FREE)


def test_a_lost_encoder_link_of_one_leaves_the_other_in_control() -> None:
    with holding_pair() as pair:
        pair.start_move("left", *FREE)
        pair.start_move("right", *FREE)
        pair.run(0.2)
        pair.rig.wires.serial[1].vanish()
        pair.until(lambda: pair.mode("right") is Mode.FAULT, 0.1)
        pair.until(lambda: pair.mode("left") is Mode.HOLDING, 0.8)
        pair.run(0.2)
        assert (pair.mode("left"), pair.faults("left")) == (Mode.HOLDING, [])


def test_a_board_that_restarts_is_a_fault_of_its_own_arm_alone() -> None:
    with holding_pair() as pair:
        pair.inject("right", "board_reset", "motor6")
        pair.until(lambda: pair.mode("right") is Mode.FAULT, 0.1)
        assert [code for code, _ in pair.faults("right")] == ["link"]
        assert "motor board" in pair.runtime("right").monitor.faults[0].message
        assert not pair.runtime("right").monitor.is_homed
        pair.run(0.1)
        assert (pair.mode("left"), pair.runtime("left").monitor.is_homed) == (Mode.HOLDING, True)


def test_a_conversation_with_a_dead_board_trips_no_watchdog_of_the_other_arm() -> None:
    with holding_pair() as pair:
        pair.inject("right", "silent", "motor5")
        pair.until(lambda: pair.mode("right") is Mode.FAULT, 0.1)
        held_rad = pair.robot("left").joint_rad()
        assert "does not reply" in pair.refusal("right", do="acknowledge")  # after 0.25 s
        pair.run(0.1)
        assert (pair.mode("left"), pair.faults("left")) == (Mode.HOLDING, [])
        assert pair.robot("left").joint_rad() == pytest.approx(held_rad, abs=1e-3)
        assert ("drive_fault", "joint 3") not in pair.faults("right")


def test_what_waits_for_boards_waits_until_the_other_arm_is_at_rest() -> None:
    with holding_pair() as pair:  # the right arm was enabled while the left one held
        assert pair.faults("left") == []
        pair.start_move("left", *FREE)
        refusal = pair.refusal("right", do="home")
        assert refusal.startswith("arm 'left' is MOVING, so arm 'right' cannot home: it waits for its boards")


def test_an_arm_begins_nothing_while_another_one_homes() -> None:
    with holding_pair() as pair:
        pair.clients["left"].ask("home", again=True)
        assert pair.refusal("right", do="jog", joint=1, by_rad=0.1).startswith("arm 'left' is HOMING")
        pair.clients["right"].stop()
        assert pair.mode("left") in (Mode.STOPPING, Mode.HOLDING)


def test_a_client_that_goes_stops_what_it_began_and_nothing_else() -> None:
    with holding_pair() as pair:
        pair.start_move("left", *FREE)
        pair.start_move("right", *FREE)
        pair.run(0.1)
        pair.channels["left"].close()
        assert (pair.mode("left"), pair.mode("right")) == (Mode.STOPPING, Mode.MOVING)


def test_off_with_quit_ends_the_runtime_when_both_arms_are_off() -> None:
    with holding_pair() as pair:
        pair.clients["left"].off(quit_runtime=True)
        assert not pair.channels["left"].is_running
        assert (pair.mode("left"), pair.mode("right")) == (Mode.OFF, Mode.OFF)


def test_each_arm_has_a_socket_of_its_own(tmp_path: Path) -> None:
    paths = {arm: tmp_path / f"{arm}.sock" for arm in ("left", "right")}
    with holding_pair() as pair:
        requests = pair.assembly.requests
        server = Server(paths, requests.handle, requests.on_gone)
        try:
            for arm, path in paths.items():
                with socket.socket(socket.AF_UNIX) as one:
                    one.connect(str(path))
                    one.sendall(b'{"do": "status"}\n')
                    for _ in range(3):
                        server.poll()
                    assert f'"arm":"{arm}"'.encode() in one.recv(1 << 16)
        finally:
            server.close()
    assert not any(path.exists() for path in paths.values())


def of_nodes(arm: Arm, name: str, first: int) -> Arm:
    """An arm with another name, and its motor boards from node `first`."""
    drives = tuple(replace(drive, motor_node=first + k) for k, drive in enumerate(arm.drives))
    return replace(arm, name=name, drives=drives)


def test_three_arms_of_two_kinds_need_nothing_else() -> None:
    right = PAIR.placed("right").arm
    arms = (
        Placed(of_nodes(right, "a", 1)),
        Placed(of_nodes(right, "b", 4), (0.0, 1.0, 0.0)),
        Placed(of_nodes(SIX, "six", 7), (0.0, -1.5, 0.0)),
    )
    with holding_pair(scenario(None), Cell("three", arms)) as cell:
        first, *others = cell.runtime("six").set_point.q_rad
        cell.start_move("six", first + 0.3, *others)
        cell.start_move("b", *FREE)
        cell.run(0.3)
        cell.clients["a"].stop()
        cell.until(lambda: all(cell.mode(arm) is Mode.HOLDING for arm in cell.clients), 1.0)
        assert cell.robot("six").joint_rad()[0] > first + 0.1


def test_a_brake_of_all_is_answered_by_those_that_were_braked() -> None:
    with open_pair() as pair:
        pair.clients["left"].enable()
        assert pair.mode("right") is Mode.OFF
        assert pair.channels["right"].request({"do": "brake"})["ok"]
        assert pair.mode("left") is Mode.BRAKED
        pair.clients["left"].off()
        assert "is OFF" in pair.refusal("left", do="brake")


def test_two_arms_whose_boards_must_be_asked_are_answered_as_often_as_one_alone() -> None:
    arms = []
    for number, placed in enumerate(PAIR.arms):
        arm = on_boards(placed.arm, "roboclaw")
        boards = tuple(replace(board, port=f"/dev/ttyACM{number}") for board in arm.boards)
        arms.append(replace(arm, name=placed.name, boards=boards))
    both, period_s = PAIR.with_arms(arms), 1.0 / arms[0].usual_rate_Hz
    ages_s = []
    for cell in (replace(both, arms=both.arms[:1]), both):
        with open_pair(cell=cell, period_s=period_s) as pair:
            looped, clock = pair.assembly.runtime, pair.rig.clock
            for runtime in looped.runtimes.values():
                runtime.now_s = -10_000.0  # as before the first cycle, on a computer that has run for hours
            begun_s = clock.now_s()
            looped.attend(begun_s + period_s)
            assert clock.now_s() == pytest.approx(begun_s + period_s)
            oldest_s = 0.0
            for _ in range(50):
                pair.run(period_s)
                for runtime in looped.runtimes.values():
                    oldest_s = max(oldest_s, clock.now_s() - runtime.parts.hardware.feedback.encoder_at_s)
            ages_s.append(oldest_s)
    assert ages_s[1] < 1.5 * ages_s[0]
