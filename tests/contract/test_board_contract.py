"""Every kind of board keeps the same promises behind the loop's Protocol: what is safe does not depend on the board."""

from collections.abc import Iterator
from contextlib import suppress

import pytest

from control.hardware.interface import OutputMode
from control.safety.modes import Mode, Reaction
from control.server.client import ArmFaulted
from hil_mocks.firmware import compiler
from hil_mocks.protocol_mock import SerialLine
from hil_mocks.scenario import Scenario
from tests.cell import Cell, holding_cell, open_cell, restarted, scenario
from tests.kinds import ON_BOARDS, OnBoards
from tests.thirds import third_of


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """The reference boards keep every promise at each change, and of the others each kind a third."""
    if "on_boards" not in metafunc.fixturenames:
        return
    promises = [name for name in vars(metafunc.module) if name.startswith("test_")]
    place = promises.index(metafunc.function.__name__)
    always, *others = ON_BOARDS
    metafunc.parametrize("on_boards", [always, *third_of(others, place)], indirect=True)


@pytest.fixture
def on_boards(request: pytest.FixtureRequest) -> OnBoards:
    kind = ON_BOARDS[request.param]
    if kind.firmware == "c" and compiler() is None:
        pytest.skip("no C compiler: apt-get install gcc")
    return kind


def mock_of(on_boards: OnBoards) -> Scenario:
    return scenario(q_rad=None, homed=True, firmware=on_boards.firmware)


@pytest.fixture
def holding(on_boards: OnBoards) -> Iterator[Cell]:
    with holding_cell(mock_of(on_boards), on_boards.arm, period_s=on_boards.period_s) as cell:
        yield cell


def volts(cell: Cell) -> list[float]:
    """Mean terminal voltages of the motors, as the plant has them."""
    return [abs(value) if kind == "voltage" else 0.0 for kind, value in cell.rig.robot.outputs]


def test_an_arm_that_falls_is_caught_by_enable_whether_or_not_that_is_a_fault(on_boards: OnBoards) -> None:
    """Without friction, and stretched: where windings are open in OFF, joint 2 falls at 1.5 to 3.7 rad/s by then."""
    falling = scenario(homed=True, firmware=on_boards.firmware)
    with open_cell(falling, on_boards.arm, period_s=on_boards.period_s) as cell:
        speeds = cell.true_speeds()
        cell.run(0.2)
        fell_rad_s, here_rad = max(speeds), cell.rig.joint_rad()
        with suppress(ArmFaulted):
            cell.client.enable()
        cell.run(1.0)
        assert cell.connection.hardware.is_any_enabled()
        assert max(speeds) <= 1.2 * fell_rad_s + 0.2
        assert speeds[-1] < 0.01
        assert cell.rig.joint_rad() == pytest.approx(here_rad, abs=0.25)


@pytest.mark.usefixtures("nobody_below")
def test_nothing_is_driven_before_enable_nor_after_off(on_boards: OnBoards) -> None:
    with open_cell(mock_of(on_boards), on_boards.arm, period_s=on_boards.period_s) as cell:
        assert max(volts(cell)) == 0.0
        cell.client.enable()
        assert cell.connection.hardware.is_any_enabled()
        cell.client.off()
        cell.run(0.2)
        assert not cell.connection.hardware.is_any_enabled()
        assert max(volts(cell)) == 0.0


OBEYING = ("vesc", "roboclaw")  # their next command drives them again, whatever somebody else has sent
# They say that they have torque before they are told to let go; the others obey within the cycle.
HOLDING_AT_ONCE = ("feetech", "servo", "odrive")
DURING_A_CYCLE = 0.4  # of the period: at its end, a goal may switch a Feetech servo on again before its state is read


def test_off_is_without_torque_however_soon_it_follows_enable(on_boards: OnBoards) -> None:
    with open_cell(mock_of(on_boards), on_boards.arm, period_s=on_boards.period_s) as cell:
        cell.client.ask("enable")
        cell.client.ask("off")
        cell.until(lambda: cell.mode is Mode.OFF, 20.0)
        cell.run(0.2)
        assert not cell.connection.hardware.is_any_enabled()
        assert cell.torques() == [False] * 3
        cell.run(1.5)
        assert (cell.mode, cell.faults) == (Mode.OFF, [])


def test_a_held_arm_is_left_so_by_connecting_and_taken_over_without_a_step(holding: Cell, on_boards: OnBoards) -> None:
    with restarted(holding, on_boards.arm, on_boards.period_s) as cell:
        is_held, before_rad = cell.torques(), cell.rig.joint_rad()
        held_rad = [q for q, held in zip(before_rad, is_held, strict=True) if held]

        def held_now_rad() -> list[float]:
            return [q for q, held in zip(cell.rig.joint_rad(), is_held, strict=True) if held]

        cell.run(1.0)
        if not held_rad:  # these boards let go, or brake, without a host
            assert cell.mode is Mode.OFF
            return
        assert (cell.mode, cell.faults) == (Mode.HELD, [])
        assert cell.channel.request({"do": "status"})["drives"] == "AS_FOUND"
        assert held_now_rad() == pytest.approx(held_rad, abs=1e-4)
        assert "somebody must hold it" in cell.refusal(do="off")
        cell.client.enable()
        cell.run(0.5)
        assert (cell.mode, cell.faults) == (Mode.HOLDING, [])
        assert held_now_rad() == pytest.approx(held_rad, abs=5e-3)


def test_a_drive_that_somebody_else_switched_off_is_a_fault_and_stays_off(holding: Cell, on_boards: OnBoards) -> None:
    if on_boards.first.startswith(OBEYING):
        return
    at_s = holding.rig.clock.now_s() + DURING_A_CYCLE * on_boards.period_s
    holding.inject("switched_off", on_boards.first, at_s=at_s)
    holding.until_fault(0.1)
    assert {code for code, _ in holding.faults} <= {"drive_left", "link"}
    for _ in range(50):
        holding.run(0.01)
        assert not holding.torques()[0]
    assert holding.runtime.monitor.reaction is Reaction.HOLD


def test_a_drive_that_somebody_else_switches_on_while_off_is_switched_off(on_boards: OnBoards) -> None:
    with open_cell(mock_of(on_boards), on_boards.arm, period_s=on_boards.period_s) as cell:
        at_s = cell.rig.clock.now_s() + DURING_A_CYCLE * on_boards.period_s
        cell.inject("switched_on", on_boards.first, at_s=at_s)
        had_torque: list[bool] = []
        cell.watchers.append(lambda: had_torque.append(cell.connection.hardware.has_torque()))
        cell.run(0.3)
        assert True in had_torque or not on_boards.first.startswith(HOLDING_AT_ONCE)
        assert cell.torques() == [False] * 3
        assert (cell.mode, cell.faults) == (Mode.OFF, [])


def test_a_jog_moves_the_joint_in_its_positive_direction(holding: Cell) -> None:
    before_rad = holding.rig.joint_rad()
    holding.client.jog(joint=1, by_rad=0.1, speed_rad_s=0.5)
    moved = [now - was for now, was in zip(holding.rig.joint_rad(), before_rad, strict=True)]
    assert moved[0] > 0.05
    assert max(map(abs, moved[1:])) < 0.02
    assert holding.faults == []


def test_answers_that_come_late_are_no_speed(holding: Cell, monkeypatch: pytest.MonkeyPatch) -> None:
    """A busy host, hub or board keeps questions for up to 9 ms now and then: the count is younger than the host can know.

    A count of a servo in a cycle is 0.15 rad/s.
    """
    clock, read = holding.rig.clock, SerialLine.read
    monkeypatch.setattr(SerialLine, "read", lambda line: b"" if clock.now_s() % 0.037 < 0.009 else read(line))
    measured, shares = holding.runtime.parts.measurement, list[float]()
    true, fastest = holding.true_speeds(), [0.0]

    def watch() -> None:
        fastest[0] = max(fastest[0], *true[-1:], 0.25)
        shares.append(max(map(abs, measured.speed_rad_s)) / fastest[0])

    holding.watchers.append(watch)
    holding.client.jog(joint=1, by_rad=0.3, speed_rad_s=0.6)
    assert (holding.mode, holding.faults) == (Mode.HOLDING, [])
    assert max(shares) < 2.0


def test_a_silent_board_is_a_fault_and_its_motors_come_to_rest(holding: Cell, on_boards: OnBoards) -> None:
    holding.inject("silent", on_boards.first)
    holding.until_fault(0.5)
    assert any(code in ("drive_silent", "encoder_stale") for code, _ in holding.faults)
    holding.run(0.6)  # longer than any board's own watchdog
    q_rad = holding.rig.joint_rad()
    holding.run(0.05)
    assert holding.rig.joint_rad() == pytest.approx(q_rad, abs=2e-3)


def test_the_boards_stop_by_themselves_when_the_host_is_gone(holding: Cell, on_boards: OnBoards) -> None:
    holding.client.ask("jog", joint=1, by_rad=0.5, speed_rad_s=0.5)
    holding.run(0.15)
    clock = holding.rig.clock
    clock.wait_until_s(clock.now_s() + on_boards.arm.limits.watchdog_s + 0.6)
    drive = on_boards.arm.drives[0]
    if drive.pid.mode in on_boards.arm.kind_of(drive).frees_in:
        assert [kind for kind, _ in holding.rig.robot.outputs] == ["open"] * 3
        return
    before_rad = holding.rig.joint_rad()
    clock.wait_until_s(clock.now_s() + 0.05)
    assert holding.rig.joint_rad()[0] == pytest.approx(before_rad[0], abs=1e-3)


def test_a_boards_error_is_a_fault_that_only_a_person_ends(holding: Cell, on_boards: OnBoards) -> None:
    holding.inject("over_temperature", on_boards.first)
    holding.until_fault(0.5)
    assert ("drive_fault", "joint 1") in holding.faults
    assert "cannot be acknowledged" in holding.refusal(do="acknowledge")
    holding.rig.clear_faults()
    holding.run(0.3)
    assert holding.mode is Mode.FAULT
    assert holding.connection.hardware.feedback.drive_faults[0], "a fault that is gone has been forgotten"
    assert volts(holding)[0] == 0.0
    holding.client.ask("acknowledge")
    assert holding.mode is not Mode.HOLDING
    holding.client.enable()
    assert holding.mode is Mode.HOLDING


def test_an_emergency_stop_ends_a_motion_and_lasts(holding: Cell) -> None:
    holding.client.ask("jog", joint=1, by_rad=0.5, speed_rad_s=0.5)
    holding.run(0.2)
    holding.connection.hardware.emergency_stop()
    holding.run(0.3)
    assert holding.mode is Mode.FAULT
    before_rad = holding.rig.joint_rad()
    holding.run(0.3)
    assert holding.rig.joint_rad()[0] == pytest.approx(before_rad[0], abs=1e-3)


def test_a_board_that_restarts_is_noticed_and_set_up_anew(holding: Cell, on_boards: OnBoards) -> None:
    holding.inject("board_reset", on_boards.last, at_s=holding.rig.clock.now_s())
    holding.until_fault(0.5)
    holding.run(0.2)
    messages = [f"{fault.where} {fault.message}" for fault in holding.runtime.monitor.faults]
    assert any("restarted by itself" in message for message in messages), messages
    holding.client.ask("acknowledge")
    holding.run(0.1)
    holding.client.enable()
    assert holding.mode is Mode.HOLDING


def test_a_shifted_counter_reads_the_shifted_count(holding: Cell) -> None:
    feedback = holding.connection.hardware.feedback
    before = feedback.count[0]
    holding.connection.hardware.shift_count(0, 1000)
    holding.connection.hardware.read()
    assert abs(feedback.count[0] - before - 1000) <= 2
    assert feedback.shift_count[0] == 1000


def test_a_guided_joint_is_not_driven_and_is_held_again_where_it_was_left(holding: Cell) -> None:
    holding.client.guide()
    holding.run(0.1)
    assert max(volts(holding)) == 0.0
    holding.client.hold()
    holding.run(0.3)
    assert (holding.mode, holding.faults) == (Mode.HOLDING, [])
    q_rad = holding.rig.joint_rad()
    holding.run(0.1)
    assert holding.rig.joint_rad() == pytest.approx(q_rad, abs=5e-3)


def test_weightless_guiding_needs_boards_that_take_a_current(on_boards: OnBoards) -> None:
    with open_cell(mock_of(on_boards), on_boards.arm, period_s=on_boards.period_s) as cell:
        if OutputMode.CURRENT not in cell.connection.hardware.offers:
            cell.client.enable()
            cell.run(0.1)
            assert "docs/boards.md" in cell.refusal(do="guide", weightless=True)
