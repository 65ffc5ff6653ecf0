"""The gripper on the mock: what it does when asked, what stops it, what it does after a fault, and that nothing moves unasked."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any
from unittest.mock import Mock

import pytest

from control.end_effector import GripperControl
from control.errors import ArmError
from control.hardware.interface import GripperFeedback
from control.model.end_effector import Gripper
from control.recording.record import about_columns, layout_of
from control.safety.modes import Mode
from hil_mocks.scenario import GripperTable
from tests.cell import GRIPPER, RIGHT, Cell, handled, holding_cell, open_cell, restarted, scenario

END_m = 0.3e-3  # how far the whole force presses into an end


@contextmanager
def gripping(gripper: Gripper = GRIPPER, **real: Any) -> Iterator[Cell]:
    with holding_cell(scenario(gripper=GripperTable(**real)), replace(RIGHT, gripper=gripper)) as cell:
        yield cell


@pytest.fixture
def cell() -> Iterator[Cell]:
    with gripping() as cell:
        yield cell


def state(cell: Cell) -> dict[str, Any]:
    found: dict[str, Any] = cell.client.status()["gripper"]
    return found


def opening_m(cell: Cell) -> float:
    return cell.rig.gripper()[0]


def test_nothing_moves_when_it_is_enabled(cell: Cell) -> None:
    before_m = opening_m(cell)
    cell.run(0.5)
    assert state(cell)["state"] == "HOLDING"
    assert opening_m(cell) == before_m


@pytest.mark.parametrize("changed", [{}, {"motor_direction": -1}, {"rotor_inertia_kg_m2": 0.0}], ids=str)
def test_opening_finds_the_zero_and_then_it_goes_where_it_is_told(changed: dict[str, Any]) -> None:
    """A rotor inertia of 0 is one that the file does not know."""
    with gripping(replace(GRIPPER, **changed)) as cell:
        assert "armwright gripper open" in cell.refusal(do="gripper", action="move", opening_m=0.03)
        assert cell.client.grip("open")["state"] == "OPEN"
        assert opening_m(cell) == pytest.approx(0.08, abs=END_m)
        for wanted_m in (0.03, 0.05):
            grip = cell.client.grip("move", wanted_m)
            assert grip["state"] == "HOLDING"
            assert grip["opening_m"] == pytest.approx(wanted_m, abs=0.3e-3)
            assert opening_m(cell) == pytest.approx(wanted_m, abs=0.3e-3 + END_m)
        assert cell.client.grip("close")["state"] == "CLOSED"
        assert opening_m(cell) == pytest.approx(0.0, abs=0.3e-3 + END_m)


@pytest.mark.parametrize("force_N", [10.0, 30.0])
def test_it_holds_an_object_with_the_force_and_says_so(cell: Cell, force_N: float) -> None:
    cell.client.grip("open")
    cell.rig.set_object(0.025)
    found = cell.client.grip("close", force_N=force_N)
    assert found["state"] == "GRIPPED"
    cell.run(0.5)
    assert cell.rig.gripper()[1] == pytest.approx(force_N, abs=1.0 + 0.05 * force_N)  # dry friction is 1 N
    assert state(cell)["opening_m"] == pytest.approx(0.025 - force_N / 2e4, abs=0.3e-3)


def test_the_force_never_exceeds_that_of_the_current_limit(cell: Cell) -> None:
    forces: list[float] = []
    cell.client.grip("open")
    cell.rig.set_object(0.025)
    cell.watchers.append(lambda: forces.append(abs(cell.rig.robot.gripper.current_A)))  # type: ignore[union-attr]
    cell.client.grip("close", force_N=GRIPPER.force_limit_N)
    assert max(forces) <= GRIPPER.current_limit_A
    assert forces[-1] == pytest.approx(GRIPPER.current_limit_A, rel=0.1)


def test_an_object_that_slips_away_is_noticed_and_it_closes(cell: Cell) -> None:
    cell.rig.set_object(0.025)
    cell.client.grip("open")
    assert cell.client.grip("close")["state"] == "GRIPPED"
    cell.rig.set_object(None)
    cell.until(lambda: state(cell)["state"] == "CLOSED", 1.0)
    assert state(cell)["has_lost"]
    assert not cell.client.grip("open")["has_lost"]


def test_without_an_encoder_it_opens_and_closes_and_knows_no_opening() -> None:
    with gripping(replace(GRIPPER, encoder_counts_per_rev=0)) as cell:
        assert cell.client.grip("open")["state"] == "OPEN"
        assert opening_m(cell) == pytest.approx(0.08, abs=END_m)
        cell.rig.set_object(0.03)
        assert cell.client.grip("close", force_N=20.0)["state"] == "GRIPPED"
        cell.run(0.5)
        assert cell.rig.gripper()[1] == pytest.approx(20.0, abs=2.0)
        assert state(cell)["opening_m"] is None
        assert "no encoder" in cell.refusal(do="gripper", action="move", opening_m=0.03)


def test_a_motor_that_does_not_turn_ends_by_the_time(cell: Cell) -> None:
    cell.inject("dead_motor", "motor4")
    before_m = opening_m(cell)
    grip = cell.client.grip("open")
    assert (grip["state"], opening_m(cell)) == ("STOPPED", before_m)
    assert "in time" in grip["text"]


@pytest.mark.parametrize("how", ["stop", "gripper stop", "hang up"])
def test_whoever_may_stop_stops_it_where_it_is(cell: Cell, how: str) -> None:
    assert handled(cell, {"do": "gripper", "action": "open"}, 7)["ok"]
    cell.run(0.1)
    if how == "hang up":
        cell.assembly.requests.on_gone(7)
    else:
        handled(cell, {"do": "stop"} if how == "stop" else {"do": "gripper", "action": "stop"}, 7)
    cell.run(0.1)
    at_m = opening_m(cell)
    cell.run(0.5)
    assert state(cell)["state"] == "STOPPED"
    assert 0.04 < at_m < 0.075
    assert opening_m(cell) == pytest.approx(at_m, abs=0.5e-3)


def test_requests_that_cannot_be_are_refused_in_words(cell: Cell) -> None:
    assert "up to 62.8 N" in cell.refusal(do="gripper", action="close", force_N=63.0)
    assert "0 to 0.08 m" in cell.refusal(do="gripper", action="move", opening_m=25.0)
    assert "needs opening_m" in cell.refusal(do="gripper", action="move")
    assert "action" in cell.refusal(do="gripper", action="shut")
    with open_cell(arm=replace(RIGHT, gripper=GRIPPER)) as off:
        assert "the arm is OFF" in off.refusal(do="gripper", action="open")
    with open_cell() as bare:
        assert "add a [gripper]" in bare.refusal(do="gripper", action="open")
        assert bare.client.status()["gripper"] is None


@pytest.mark.parametrize("reaction", ["hold", "release"])
def test_after_a_fault_of_the_arm_it_does_what_the_file_says(reaction: Any) -> None:
    with gripping(replace(GRIPPER, on_fault=reaction), object_m=0.03) as cell:
        cell.client.grip("open")
        cell.client.grip("close", force_N=40.0)
        cell.inject("over_temperature", "motor1")
        cell.until_fault(0.1)
        cell.run(1.0)
        held_N = cell.rig.gripper()[1]
        assert state(cell)["state"] == ("GRIPPED" if reaction == "hold" else "RELEASED")
        assert held_N == pytest.approx(40.0, abs=3.0) if reaction == "hold" else held_N < 1.5  # friction holds 1 N
        cell.rig.clear_faults()
        cell.client.acknowledge()
        cell.run(0.5)
        assert cell.rig.gripper()[1] == pytest.approx(held_N, abs=0.5)  # nothing closes again by itself
        assert "FAULT" not in cell.refusal(do="gripper", action="close")


@pytest.mark.parametrize("reaction", ["hold", "release"])
def test_without_the_host_its_board_does_what_the_file_says(reaction: Any) -> None:
    with gripping(replace(GRIPPER, on_fault=reaction), object_m=0.03) as cell:
        cell.client.grip("open")
        cell.client.grip("close", force_N=40.0)
        clock = cell.rig.clock
        clock.wait_until_s(clock.now_s() + 1.0)  # no cycle
        held_N = cell.rig.gripper()[1]
        assert held_N > 25.0 if reaction == "hold" else held_N < 1.5


@contextmanager
def found_gripping() -> Iterator[Cell]:
    """The runtime was killed while the gripper held something; another one finds arm and gripper held by their boards."""
    with gripping(replace(GRIPPER, on_fault="hold"), object_m=0.03) as before:
        before.client.grip("open")
        before.client.grip("close", force_N=40.0)
        with restarted(before, replace(RIGHT, gripper=replace(GRIPPER, on_fault="hold"))) as cell:
            cell.run(0.1)
            assert cell.mode is Mode.HELD
            assert cell.rig.gripper()[1] > 25.0
            yield cell


def test_a_gripper_that_holds_after_a_time_out_is_taken_over_with_the_arm() -> None:
    with found_gripping() as cell:
        cell.client.enable()
        cell.run(0.5)
        assert (cell.mode, cell.faults) == (Mode.HOLDING, [])
        assert cell.client.grip("open")["state"] == "OPEN"


def test_a_gripper_that_holds_after_a_time_out_lets_go_with_the_arm() -> None:
    with found_gripping() as cell:
        assert cell.channel.request({"do": "off", "lets_go": True})["ok"]
        cell.run(1.0)
        assert (cell.mode, cell.faults) == (Mode.OFF, [])
        assert cell.rig.gripper()[1] < 5.0


@pytest.mark.parametrize(
    ("kind", "code"), [("silent", "gripper_silent"), ("over_current", "gripper_drive"), ("board_reset", "gripper_link")]
)
def test_a_board_that_fails_stops_the_arm_under_control_and_works_again_after(cell: Cell, kind: str, code: str) -> None:
    cell.client.grip("open")
    cell.start_move((0.6, -0.6, 0.2), 0.3)
    cell.run(0.3)
    cell.inject(kind, "motor4")
    cell.until_fault(0.3)
    assert cell.faults == [(code, "gripper")]
    assert cell.runtime.monitor.is_held_fault
    cell.run(1.0)
    at_m = opening_m(cell)
    if kind != "board_reset":
        assert "gripper" in refused_acknowledge(cell)
    cell.rig.clear_faults()
    cell.run(0.05)
    cell.client.acknowledge()
    cell.run(0.5)
    assert (cell.mode, cell.runtime.monitor.is_homed) == (Mode.HOLDING, True)
    assert opening_m(cell) == pytest.approx(at_m, abs=0.5e-3)
    assert (state(cell)["opening_m"] is None) == (kind == "board_reset")
    assert cell.client.grip("open")["state"] == "OPEN"


class Board:
    """Replies in every cycle, and counts until it is told not to."""

    def __init__(self) -> None:
        self.feedback, self.counts = GripperFeedback(is_enabled=True), True

    def read(self, now_s: float) -> GripperFeedback:
        counted_s = now_s if self.counts else self.feedback.moved_at_s
        self.feedback = replace(self.feedback, reply_at_s=now_s, moved_m=0.0, moved_at_s=counted_s)
        return self.feedback

    def write(self, volts: float | None, now_s: float) -> None: ...

    enable = disable = reset_fault = emergency_stop = lambda self: None


@pytest.mark.parametrize(("counts_per_rev", "codes"), [(2048, ["gripper_count"]), (0, [])])
def test_a_board_that_replies_without_a_count_is_found_where_an_encoder_is_described(
    counts_per_rev: int, codes: list[str]
) -> None:
    board = Board()
    control = GripperControl(replace(GRIPPER, encoder_counts_per_rev=counts_per_rev), board, RIGHT.limits.stale_s)
    found = []
    for cycle in range(200):
        board.counts = cycle < 100
        found.append(control.cycle(0.01 * cycle, is_ready=True, is_fault=False, is_off=False))
    assert not any(found[:115])
    assert [fault.code for fault in found if fault] == codes


@pytest.mark.parametrize(("stale_s", "silent_s"), [(0.02, 0.06), (0.06, 0.18)])
def test_a_gripper_may_keep_silent_three_times_as_long_as_a_joint(stale_s: float, silent_s: float) -> None:
    """On a bus of servos, whose joints may be silent for 60 ms, one late reply of the gripper stopped the arm."""
    board = Mock(spec=Board, feedback=GripperFeedback(is_enabled=True))
    board.read.return_value = board.feedback
    control = GripperControl(GRIPPER, board, stale_s)
    found = [control.cycle(0.01 * cycle, is_ready=True, is_fault=False, is_off=False) for cycle in range(50)]
    (cycle,) = [cycle for cycle, fault in enumerate(found) if fault]
    assert (found[cycle].code, 0.01 * cycle) == ("gripper_silent", pytest.approx(silent_s, abs=0.011))


def refused_acknowledge(cell: Cell) -> str:
    try:
        cell.client.acknowledge()
    except ArmError as error:
        return str(error)
    raise AssertionError("acknowledged")


def test_a_pause_of_the_host_is_no_silence(cell: Cell) -> None:
    cell.client.grip("open")
    cell.rig.set_object(0.025)
    cell.client.grip("close")
    for _ in range(3):
        clock = cell.rig.clock
        clock.wait_until_s(clock.now_s() + 0.17)
        cell.run(0.2)
    assert (cell.mode, state(cell)["state"]) == (Mode.HOLDING, "GRIPPED")
    assert cell.rig.gripper()[1] == pytest.approx(GRIPPER.usual_force_N, rel=0.1)


def test_each_row_says_what_it_did(cell: Cell) -> None:
    arm = replace(RIGHT, gripper=GRIPPER)
    layout, rows = layout_of(arm), []
    cell.watchers.append(lambda: rows.append(cell.runtime.parts.recorder.last_rows()[-1]))
    cell.client.grip("open")
    cell.client.grip("move", 0.06)
    seen = [dict(zip(layout.names, layout.packing.unpack(row), strict=True)) for row in rows]
    names = about_columns(arm)["gripper_states"]
    assert names[seen[0]["gripper_state"]] == "MOVING"
    assert names[seen[-1]["gripper_state"]] == "HOLDING"
    assert seen[-1]["gripper_m"] == pytest.approx(0.06, abs=0.3e-3)
    assert seen[-1]["gripper_goal_m"] == pytest.approx(0.06)
    assert max(row["gripper_A"] for row in seen) > 0.8
