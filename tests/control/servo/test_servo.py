"""From set-point to output in the three modes: feed-forward, controller, and the current limit as a range of voltages."""

from __future__ import annotations

from collections.abc import Sequence

import pytest

from control.dynamics.dynamics import Dynamics
from control.dynamics.feedforward import Loads, Motor
from control.dynamics.gains import Gains
from control.hardware.interface import OutputMode
from control.model.description import load_arm
from control.motion.setpoint import SetPoint, at_rest
from control.servo import MotionTorque, Pid, Servo

MOTOR = Motor(amperes_per_Nm=1 / 3.0, resistance_ohm=0.3, volts_per_rad_s=3.0, supply_V=24.0, current_limit_A=8.0)


class Constant:
    """A torque model that always wants the same."""

    def __init__(self, torque_Nm: float) -> None:
        self.torque_Nm = torque_Nm

    def __call__(self, q: Sequence[float], speed: Sequence[float], acceleration: Sequence[float]) -> Sequence[float]:
        return (self.torque_Nm,)


def servo(mode: OutputMode, torque_Nm: float = 0.0, kp: float = 100.0, ki: float = 0.0, kd: float = 0.0) -> Servo:
    return Servo([mode], [MOTOR], [Pid(Gains(kp, ki, kd, 0.0), 24.0, 0.002)], Constant(torque_Nm), 0.002)


def moving(q: float, speed: float) -> SetPoint:
    return SetPoint((q,), (speed,), (0.0,))


def test_voltage_is_what_resistance_and_back_emf_need_plus_what_the_error_adds() -> None:
    first = servo(OutputMode.VOLTAGE, torque_Nm=6.0)
    first.update(moving(0.51, 0.2), moving(0.5, 0.2), knows_pose=True)
    assert first.output == [pytest.approx(6.0 / 3.0 * 0.3 + 3.0 * 0.2 + 100.0 * 0.01)]
    assert first.volts == first.output


def test_the_current_limit_is_a_range_of_voltages_about_the_back_emf() -> None:
    first = servo(OutputMode.VOLTAGE)
    for measured, expected in ((-9.0, 8.0 * 0.3 + 3.0), (9.0, -8.0 * 0.3 + 3.0)):
        first.update(at_rest((0.0,)), moving(measured, 1.0), knows_pose=True)
        assert first.output == [pytest.approx(expected)]


def test_homing_runs_with_a_part_of_the_current() -> None:
    first = servo(OutputMode.VOLTAGE)
    first.update(at_rest((1.0,)), moving(0.0, 0.0), knows_pose=False, current_fraction=0.5)
    assert first.output == [pytest.approx(4.0 * 0.3)]


def test_the_supply_is_never_exceeded_however_fast_the_motor_is_driven() -> None:
    first = servo(OutputMode.VOLTAGE)
    first.update(at_rest((9.0,)), moving(0.0, 100.0), knows_pose=True)
    assert first.output == [24.0]


def test_current_mode_commands_amperes_within_the_limit_and_implies_volts() -> None:
    first = servo(OutputMode.CURRENT, torque_Nm=6.0)
    first.update(moving(0.51, 0.2), moving(0.5, 0.2), knows_pose=True)
    assert first.output == [pytest.approx(6.0 / 3.0 + 100.0 * 0.01)]
    assert first.volts == [pytest.approx(first.output[0] * 0.3 + 3.0 * 0.2)]
    first.update(at_rest((5.0,)), moving(0.0, 0.0), knows_pose=True)
    assert first.output == [8.0]


def test_position_mode_passes_the_set_point_on_and_the_volts_as_feed_forward() -> None:
    first = servo(OutputMode.POSITION, torque_Nm=6.0)
    first.update(moving(0.51, 0.2), moving(0.1, 9.0), knows_pose=True)
    assert first.output == [0.51]
    assert first.feedforward_V == [pytest.approx(6.0 / 3.0 * 0.3 + 3.0 * 0.2)]
    first.update(moving(0.51, 20.0), moving(0.1, 9.0), knows_pose=True)
    assert first.feedforward_V == [24.0]


@pytest.mark.parametrize("mode", [OutputMode.VOLTAGE, OutputMode.CURRENT, OutputMode.POSITION])
def test_without_a_known_pose_gravity_is_left_to_the_integral(mode: OutputMode) -> None:
    first = servo(mode, torque_Nm=1000.0)
    first.update(at_rest((0.5,)), moving(0.5, 0.0), knows_pose=False)
    assert first.output == [0.5 if mode is OutputMode.POSITION else 0.0]
    assert first.feedforward_V == [0.0]


def test_a_reset_forgets_the_integral() -> None:
    first = servo(OutputMode.VOLTAGE, kp=0.0, ki=100.0)
    for _ in range(10):
        first.update(at_rest((0.1,)), moving(0.0, 0.0), knows_pose=True)
    wound_up = first.output[0]
    first.reset()
    first.update(at_rest((0.1,)), moving(0.0, 0.0), knows_pose=True)
    assert first.output[0] == pytest.approx(wound_up / 10)


def test_silence_is_0_V_everywhere() -> None:
    first = servo(OutputMode.POSITION, torque_Nm=6.0)
    first.update(moving(0.5, 0.2), moving(0.1, 0.0), knows_pose=True)
    first.silence()
    assert (first.output, first.feedforward_V, first.volts) == ([0.0], [0.0], [0.0])


def test_the_payloads_torque_is_that_of_the_dynamics_with_this_payload() -> None:
    arm = load_arm("right")
    loads = Loads(arm)
    model = MotionTorque(arm, loads)
    state = ((0.3, -0.7, 0.4), (0.5, -0.2, 0.3), (1.0, 2.0, -1.0))
    empty = list(model(*state))
    loads.state(arm.tool, 0.8)
    loads.take_at_once()
    laden = Dynamics(arm, 0.8).inverse(*state)
    bare = Dynamics(arm).inverse(*state)
    expected = [e + w - b for e, w, b in zip(empty, laden, bare, strict=True)]
    assert list(model(*state)) == pytest.approx(expected, abs=1e-9)
    assert max(abs(w - b) for w, b in zip(laden, bare, strict=True)) > 1.0
