"""The position loop of the mock servos."""

from __future__ import annotations

from hil_mocks.devices.servo_motor import ServoMotor

COUNT_turns = 1.0 / 4096


def held_V(off_turns: float, held_s: float) -> float:
    """The voltage of a loop whose shaft cannot move, so far off its goal, as against a stop."""
    motor = ServoMotor(4.8, lambda: off_turns, COUNT_turns)
    motor.goal_turns = 0.0
    output = motor.controlled(12.0)
    for tick in range(round(held_s / 0.001)):
        motor.measure(0.001 * tick)
        output = motor.controlled(12.0)
    return output.value


def test_what_a_servo_does_not_see_adds_up_to_no_torque() -> None:
    """A joint on its end stop, held where it was read, wound up until the loop told of a torque that nothing explains."""
    assert held_V(0.4 * COUNT_turns, 20.0) == held_V(0.4 * COUNT_turns, 1.0)


def test_what_it_sees_does() -> None:
    assert abs(held_V(0.6 * COUNT_turns, 20.0)) > 5.0 * abs(held_V(0.6 * COUNT_turns, 1.0))
