"""An arm that its boards held when the runtime connected, and ways on and off that requests cross."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from itertools import product

import pytest

from control.hardware.connect import CellConnection, SharedBuses
from control.hardware.interface import Wanted
from control.safety.modes import Fault, Mode, Reaction
from tests.cell import Cell, holding_cell, open_cell, restarted, scenario
from tests.kinds import ON_BOARDS
from tests.thirds import third_of

pytestmark = pytest.mark.usefixtures("nobody_below")
TAKEN_OVER = ("dynamixel", "odrive", "moteus", "reference")  # a third of cycles and kinds has each of both
JUMP = Fault("encoder_leap", "joint 1", "its encoder jumped", "look at it", Reaction.CONTROLLED)


@contextmanager
def held_on(kind: str) -> Iterator[Cell]:
    """The runtime of an arm was killed while it held; another one has connected."""
    on = ON_BOARDS[kind]
    with (
        holding_cell(scenario(q_rad=None), on.arm, period_s=on.period_s) as before,
        restarted(before, on.arm, on.period_s) as cell,
    ):
        cell.run(0.1)
        assert cell.mode is Mode.HELD
        yield cell


@pytest.fixture
def held() -> Iterator[Cell]:
    with held_on("dynamixel") as cell:
        yield cell


@pytest.mark.parametrize("kind", ["dynamixel", "moteus"])
def test_the_end_of_the_runtime_leaves_it_held(kind: str) -> None:
    on = ON_BOARDS[kind]
    with open_cell(scenario(q_rad=None), on.arm, period_s=on.period_s) as before:
        for name in before.rig.robot.drive_names:  # by another program, which is gone
            before.inject("switched_on", name, at_s=before.rig.clock.now_s() + on.period_s)
        with restarted(before, on.arm, on.period_s) as held:
            held.run(0.1)
            assert held.mode is Mode.HELD
            before_rad = held.rig.joint_rad()
            held.runtime.go_off(quits=True)  # as Ctrl-C
            held.run(0.1)
            assert not held.channel.is_running
            CellConnection({"right": held.connection}, SharedBuses(held.rig.clock)).leave_safely()
            held.rig.clock.wait_until_s(held.rig.clock.now_s() + 1.0)
            assert all(held.torques())
            assert held.rig.joint_rad() == pytest.approx(before_rad, abs=1e-3)


@pytest.mark.parametrize("kind", ["dynamixel", "reference", "moteus", "cia402"])
def test_off_with_consent_lets_it_go_at_once_and_may_end_the_runtime(kind: str) -> None:
    """Also boards that hold in a state of their own: after the time-out of the host that was killed."""
    with held_on(kind) as held:
        assert held.channel.request({"do": "off", "lets_go": True, "quit": True})["ok"]
        assert held.mode is Mode.OFF
        held.run(0.5)
        assert held.torques() == [False] * 3
        assert not held.channel.is_running


def test_boards_that_let_go_by_themselves_end_it(held: Cell) -> None:
    for name in held.rig.robot.drive_names:
        held.inject("switched_off", name, at_s=held.rig.clock.now_s())
    held.run(0.2)
    assert (held.mode, held.faults) == (Mode.OFF, [])


@pytest.mark.parametrize("case", third_of(product([0, 1, 2], TAKEN_OVER)), ids=str)
def test_a_stop_while_it_is_taken_over_ends_where_every_stop_does(case: tuple[int, str]) -> None:
    """Boards of which some obey already are not left without a watch: the arm holds, under control."""
    cycles, kind = case
    with held_on(kind) as held:
        before_rad = held.rig.joint_rad()
        held.client.ask("enable")
        held.run(cycles * held.runtime.period_s)
        held.client.ask("stop")
        held.run(1.0)
        assert (held.mode, held.runtime.drives.wanted) == (Mode.HOLDING, Wanted.ENABLED)
        assert held.rig.joint_rad() == pytest.approx(before_rad, abs=5e-3)


@pytest.mark.parametrize("case", third_of(product([0, 1, 2], TAKEN_OVER, [False, True]), 1), ids=str)
def test_off_while_it_is_taken_over_is_the_way_off_of_every_arm(case: tuple[int, str, bool]) -> None:
    cycles, kind, quits = case
    with held_on(kind) as held:
        held.client.ask("enable")
        held.run(cycles * held.runtime.period_s)
        held.runtime.go_off(quits)
        modes = []
        for _ in range(20_000):
            held.run(held.runtime.period_s)
            modes += [held.mode] if held.mode not in modes else []
            if held.mode is Mode.OFF:
                break
        held.run(0.2)
        assert modes[-3:] == [Mode.HOLDING, Mode.BRAKED, Mode.OFF]
        assert (held.torques(), held.faults, held.channel.is_running) == ([False] * 3, [], not quits)


@pytest.mark.parametrize("case", third_of(product([0, 1, 2, 3], [*TAKEN_OVER, "cia402"]), 2), ids=str)
def test_a_fault_while_it_is_taken_over_leaves_it_held(case: tuple[int, str]) -> None:
    """Boards on their way on hold nothing: the take-over goes to its end, and then they hold."""
    cycles, kind = case
    with held_on(kind) as held:
        before_rad = held.rig.joint_rad()
        held.client.ask("enable")
        held.run(cycles * held.runtime.period_s)
        held.runtime.fail(replace(JUMP, reaction=Reaction.HOLD))
        held.run(2.0)
        assert (held.mode, held.runtime.drives.wanted) == (Mode.FAULT, Wanted.ENABLED)
        assert held.rig.joint_rad() == pytest.approx(before_rad, abs=5e-3)
        assert held.torques()[1:] == [True, True]  # joint 1 stands upright


@pytest.mark.parametrize("kind", ["reference", "moteus"])
def test_a_drive_that_cannot_be_taken_over_lets_no_other_go(kind: str) -> None:
    with held_on(kind) as held:
        before_rad = held.rig.joint_rad()
        held.client.ask("enable")
        held.inject("over_temperature", ON_BOARDS[kind].first)
        held.until_fault(0.05)
        held.run(2.0)
        assert held.faults == [("drive_fault", "joint 1")]
        assert held.torques()[1:] == [True, True]
        assert held.rig.joint_rad() == pytest.approx(before_rad, abs=1e-2)


@pytest.mark.parametrize("kind", ["reference", "moteus"])
def test_acknowledge_lets_nothing_go(kind: str) -> None:
    """Boards that hold after the time-out of their host let go when they are reset."""
    with held_on(kind) as held:
        before_rad = held.rig.joint_rad()
        assert any("`armwright enable` takes it over" in one for one in held.channel.request({"do": "status"})["warnings"])
        assert "`armwright enable` takes it over" in held.refusal(do="acknowledge")
        held.runtime.fail(JUMP)
        held.run(0.1)
        held.client.acknowledge()
        held.run(0.5)
        assert (held.mode, held.runtime.hardware.has_torque()) == (Mode.HELD, True)
        assert held.rig.joint_rad() == pytest.approx(before_rad, abs=1e-3)  # and none of them fell


def test_a_fault_changes_nothing_and_is_acknowledged_to_it(held: Cell) -> None:
    before_rad = held.rig.joint_rad()
    held.runtime.fail(JUMP)
    held.run(0.3)
    assert (held.mode, held.runtime.monitor.reaction) == (Mode.FAULT, Reaction.HOLD)
    assert held.runtime.drives.wanted is Wanted.AS_FOUND
    assert "somebody must hold it" in held.refusal(do="off")
    held.client.acknowledge()
    assert held.mode is Mode.HELD
    assert held.rig.joint_rad() == pytest.approx(before_rad, abs=1e-3)


@pytest.mark.parametrize("do", ["guide", "brake", "gripper"])
def test_nothing_else_is_done_with_it(held: Cell, do: str) -> None:
    held.refusal(do=do, **({"action": "open"} if do == "gripper" else {}))
    assert held.mode is Mode.HELD


# ---- ways that cross, on the reference arm


@pytest.mark.parametrize("do", ["enable", "hold"])
def test_a_runtime_that_ends_is_not_held_back(cell: Cell, do: str) -> None:
    cell.client.ask("off", quit=True)
    cell.until(lambda: cell.mode is Mode.BRAKED, 2.0)
    assert "being switched off" in cell.refusal(do=do)
    cell.client.ask("off")  # takes nothing back
    cell.until(lambda: not cell.channel.is_running, 20.0)


def test_a_way_off_that_was_caught_is_forgotten(cell: Cell) -> None:
    cell.client.ask("off")
    cell.until(lambda: cell.mode is Mode.BRAKED, 2.0)
    cell.client.hold()
    cell.run(2.0)
    assert (cell.mode, cell.channel.is_running) == (Mode.HOLDING, True)


@pytest.mark.parametrize("do", ["stop", "brake", "off"])
@pytest.mark.parametrize("cycles", [0, 1, 2, 3])
def test_what_ends_the_way_on_from_off_leads_back_to_it(do: str, cycles: int) -> None:
    on = ON_BOARDS["feetech"]
    with open_cell(scenario(q_rad=None), on.arm, period_s=on.period_s) as cell:
        cell.client.ask("enable")
        cell.run(cycles * on.period_s)
        is_on = cell.mode is Mode.HOLDING
        cell.client.ask(do)
        if not is_on:
            assert cell.mode is Mode.OFF
            cell.run(1.5)
            assert (cell.mode, cell.torques(), cell.faults) == (Mode.OFF, [False] * 3, [])


def test_a_drive_that_was_lost_is_told_until_it_is_enabled_again() -> None:
    on = ON_BOARDS["feetech"]
    with holding_cell(scenario(q_rad=None), on.arm, period_s=on.period_s) as cell:
        cell.inject("switched_off", "feetech2", at_s=cell.rig.clock.now_s() + 0.4 * on.period_s)
        cell.until_fault(0.2)
        cell.client.acknowledge()
        assert cell.mode is Mode.BRAKED
        assert not cell.torques()[1]
        warnings = cell.channel.request({"do": "status"})["warnings"]
        assert "the drive of joint 2 is out of operation: `armwright enable` takes it back" in warnings
        cell.client.enable()
        cell.run(0.2)
        assert (cell.mode, cell.faults) == (Mode.HOLDING, [])


@pytest.mark.parametrize("do", ["stop", "brake"])
def test_a_stop_ends_the_way_on(cell: Cell, do: str) -> None:
    cell.client.ask("brake")
    cell.client.ask("hold")
    cell.client.ask(do)
    cell.run(1.5)
    assert (cell.mode, cell.faults) == (Mode.BRAKED, [])
