"""Encoders and boards that are wrong and plausible: found in time, with little motion, and the zero is not trusted after."""

from __future__ import annotations

import pytest

from control.loop.cross_checks import IndexWatch, MotorCountWatch, SwitchPlace, SwitchWatch
from control.safety.modes import Mode
from tests.cell import RIGHT, STRETCHED, Cell, holding_cell, scenario, with_drive

TARGET = (1.2, -0.2, 0.8)


@pytest.fixture
def moving(cell: Cell) -> Cell:
    """The arm in the middle of a fast joint move."""
    cell.start_move(TARGET)
    cell.run(0.2)
    return cell


@pytest.mark.parametrize(
    ("kind", "keys", "code"),
    [
        ("drifting_encoder", {"channel": 0, "value": 2_000.0}, "encoder_contradicted"),
        ("drifting_encoder", {"channel": 1, "value": -2_000.0}, "encoder_contradicted"),
        ("drifting_encoder", {"channel": 2, "value": 20_000.0}, "encoder_contradicted"),
        ("frozen_clock", {}, "encoder_stale"),
        ("jumping_encoder", {"channel": 0, "value": 5_000.0}, "encoder_leap"),
    ],
)
def test_at_rest_a_lying_encoder_is_found_before_the_arm_has_moved(
    cell: Cell, kind: str, keys: dict[str, float], code: str
) -> None:
    cell.inject(kind, "encoder", **keys)
    cell.until_fault(0.3)
    cell.run(0.004)
    assert code in {found for found, _ in cell.faults}
    assert cell.rig.joint_rad() == pytest.approx(STRETCHED, abs=0.015)


@pytest.mark.parametrize("kind", ["stuck_encoder", "backwards_encoder"])
@pytest.mark.parametrize("channel", [0, 2])
def test_a_moving_joint_whose_counts_do_not_follow_is_found_at_once(moving: Cell, kind: str, channel: int) -> None:
    before = moving.rig.joint_rad()[channel]
    moving.inject(kind, "encoder", channel=channel)
    moving.until_fault(0.05)
    assert moving.faults == [("encoder_contradicted", f"joint {channel + 1}")]
    moving.run(0.3)
    assert abs(moving.rig.joint_rad()[channel] - before) < 0.15


@pytest.mark.parametrize(
    ("kind", "value", "code"),
    [
        ("says_supply", 0.0, "supply"),
        ("says_supply", 35.0, "supply"),
        ("says_temperature", 127.0, "over_temperature"),
        ("says_current", 32.7, "over_current"),
    ],
)
def test_values_that_no_healthy_board_says_are_faults(cell: Cell, kind: str, value: float, code: str) -> None:
    cell.inject(kind, "motor2", value=value)
    cell.until_fault(0.03)
    cell.run(0.03)
    assert {code, "encoder_contradicted"} & {found for found, where in cell.faults if where == "joint 2"}


def test_after_a_lie_of_its_encoder_the_arm_must_be_homed_whatever_the_board_says(cell: Cell) -> None:
    cell.inject("jumping_encoder", "encoder", channel=0, value=5_000.0)
    cell.until_fault(0.1)
    cell.run(0.3)
    cell.client.acknowledge()
    cell.client.hold()
    assert "home" in cell.refusal(do="move_joints", q_rad=list(STRETCHED))
    assert not cell.runtime.take_known_zeros()  # the board itself has still ZERO_SET
    assert cell.client.home() is True
    assert cell.runtime.parts.measurement.q_rad == pytest.approx(cell.rig.joint_rad(), abs=1e-4)
    cell.client.move_joints(STRETCHED)


def test_counts_lost_below_every_limit_are_found_by_the_next_index_pulse(cell: Cell) -> None:
    for _ in range(6):  # less than half a milliradian a time, so that nothing else sees it
        cell.inject("jumping_encoder", "encoder", channel=0, value=15.0)
        cell.run(0.1)
    assert cell.mode is Mode.HOLDING
    cell.start_move((0.25, *STRETCHED[1:]), speed=0.3)
    cell.until_fault(1.0)
    assert cell.faults == [("index_off", "joint 1")]
    assert "90 counts from its place" in cell.runtime.monitor.faults[0].message
    assert not cell.runtime.monitor.is_homed


def test_an_encoder_that_slipped_with_its_index_is_found_by_the_home_switch() -> None:
    with holding_cell(scenario((0.1, -0.6, 0.2))) as cell:
        cell.inject("loose_encoder", "encoder", channel=0, value=0.0)
        cell.run(0.01)
        for _ in range(90):  # of the disc that both boards read, too little a time for any other check
            cell.rig.robot._loose[0].slip_rad -= 15.0 / 32_595.0
            cell.run(0.04)
        assert cell.mode is Mode.HOLDING
        cell.start_move((-0.3, *STRETCHED[1:]), speed=0.3)
        cell.until_fault(3.0)
        assert cell.faults == [("switch_off", "joint 1")]


def test_a_gear_of_half_the_ratio_under_weight_is_found_by_its_torque() -> None:
    built = with_drive(RIGHT, 2, gear_ratio=0.5 * RIGHT.drives[1].gear_ratio)
    with holding_cell(scenario((0.05, 0.15, 0.75), homed=False, base="demo"), built, believed=RIGHT) as cell:
        cell.client.home()
        cell.start_move((0.05, -0.6, 0.2))
        cell.until_fault(1.0)
        assert cell.faults == [("unexplained_torque", "joint 2")]


def test_an_index_is_compared_modulo_a_turn_and_with_the_first_where_arm_toml_has_none() -> None:
    watch = IndexWatch([2048, 1000], [100, None], lambda joint, count: count, ("joint 1", "joint 2"))
    assert watch.look([(0, 100 + 7 * 2048), (0, 100 - 2048 + 40), (1, 777), (1, 777 - 3000)]) == []
    assert [fault.where for fault in watch.look([(0, 100 + 2048 + 42), (1, 777 + 21)])] == ["joint 1", "joint 2"]
    watch.forget()
    assert watch.look([(1, 5)]) == []


@pytest.mark.parametrize("sense", [1.0, -1.0])
def test_a_switch_must_agree_with_the_side_beyond_its_tolerance(sense: float) -> None:
    place = SwitchPlace("joint 1", 0.2, sense, 0.03)
    for beyond_rad, is_active, is_well in [
        (0.5, True, True),
        (0.5, False, False),
        (-0.5, False, True),
        (-0.5, True, False),
        (0.02, False, True),
        (-0.02, True, True),
    ]:
        watch = SwitchWatch([place])
        flags = [0x04 if is_active else 0]
        found = [watch.look(0.002, [0.2 + sense * beyond_rad], flags) for _ in range(20)]
        assert (found[-1] == []) is is_well
        assert found[0] == []  # a contact that bounces


@pytest.mark.parametrize("sign", [0, -1])
def test_a_motor_board_whose_own_encoder_is_dead_or_reversed_is_found_in_the_first_motion(sign: int) -> None:
    with holding_cell(scenario(STRETCHED)) as cell:
        board = cell.rig.robot.motor_boards[0]
        shaft = board._read_shaft
        board._read_shaft = lambda: sign * shaft()
        cell.run(0.3)
        cell.start_move((0.6, *STRETCHED[1:]), speed=0.3)
        cell.until_fault(0.4)
        assert cell.faults == [("encoders_differ", "joint 1")]
        assert abs(cell.rig.joint_rad()[0] - STRETCHED[0]) < 0.03


@pytest.mark.parametrize("bits", [16, 32])
def test_two_counts_of_one_motor_may_differ_by_when_they_were_read(bits: int) -> None:
    watch = MotorCountWatch([30_000.0], [bits], ("joint 1",))
    speed_rad_s, period_s = 2.0, 0.12
    wrap, narrow = 2**32, 2**bits
    for step in range(40):
        turned = round(30_000.0 * speed_rad_s * period_s * step) + 2**31 - 50_000
        count = (turned + narrow // 2) % narrow - narrow // 2
        late = (0, 300)[step % 2]
        pair = (0, count, (turned + late + 12_345 + wrap // 2) % wrap - wrap // 2)
        assert watch.look([pair], [speed_rad_s]) == []
    assert [fault.code for fault in watch.look([(0, count, pair[2] + 1000)], [0.0])] == ["encoders_differ"]
    watch.forget()
    assert watch.look([(0, count + 9_999, 0)], [0.0]) == []


def test_counts_that_drift_too_slowly_for_the_motors_voltage_are_found_by_the_motor_boards(cell: Cell) -> None:
    cell.inject("drifting_encoder", "encoder", channel=0, value=300.0)  # 9 mrad a second
    cell.until_fault(0.5)
    assert cell.faults == [("encoders_differ", "joint 1")]
