"""The model run forward from voltages: what its motion must be without looking at any measurement."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calib.arrays import Array
from calib.gap.effects.catalogue import RECORDS, known_laws
from calib.gap.finding import EffectName
from calib.gap.log import Log
from calib.gap.series.find import find
from calib.gap.signals.motion import CLOSED, OPEN, Forward, ForwardState, motion_gaps
from calib.gap.signals.physics import Physics
from calib.gap.signals.recording import prepare
from calib.gap.signals.terms import Law
from control.dynamics.dynamics import Dynamics
from tests.calib.gap.series.prescribed import LONG, arm_with_friction, log_of
from tests.calib.gap.series.test_find import FEW

ARM = arm_with_friction()
LOG = log_of(ARM)
PHYSICS = Physics(ARM, prepare(ARM, LOG))
POSE = np.array([[0.3, -0.7, 0.4]])


def resting() -> ForwardState:
    still = np.zeros((1, 3))
    current = Dynamics(ARM).torques(POSE, still, still) / PHYSICS.torque_per_A
    return ForwardState(POSE.copy(), still, still.copy(), POSE.copy(), still.copy(), current)


def run(model: list[Law], samples: int, push_V: float = 0.0) -> ForwardState:
    state = resting()
    held = state.current_A * PHYSICS.resistance_ohm + push_V
    forward = Forward(PHYSICS, model, np.zeros(1))
    for _ in range(samples):
        forward.advance(state, held, held, np.zeros((1, 3), dtype=bool))
    return state


def gear(effect: str, *values: float) -> list[Law]:
    series = RECORDS[effect].series
    assert series is not None
    return [Law(EffectName(effect, 2), series.form, values)]


@pytest.mark.parametrize(
    ("effect", "known", "more"),
    [("backlash", (0.006, 0.0), (0.004, 0.3)), ("joint_compliance", (1 / 900.0, 3.0, 0.0), (1 / 700.0, 5.0, 0.2))],
)
def test_what_the_file_has_of_a_gear_and_what_is_found_besides_are_one_gear(
    effect: str, known: tuple[float, ...], more: tuple[float, ...]
) -> None:
    """Else what is found is the whole, and the known part is added to it once more in the file."""
    physics = Physics(LONG, prepare(LONG, log_of(LONG)))
    both = gear(effect, *(one + other for one, other in zip(known, more, strict=True)))
    apart = [*gear(effect, *known), *gear(effect, *more)]
    whole = physics.following.beyond(both)
    for one, other in zip(physics.following.beyond(apart), whole, strict=True):
        np.testing.assert_allclose(np.vstack(one), np.vstack(other), atol=1e-12)
    alone = physics.following.beyond(gear(effect, *more))
    assert np.abs(np.vstack(alone[0]) - np.vstack(whole[0])).max() > 1e-3


def test_a_gear_that_is_soft_and_loose_is_both_in_whichever_order_they_are_said() -> None:
    physics = Physics(LONG, prepare(LONG, log_of(LONG)))
    soft, play = gear("joint_compliance", 1 / 500.0, 4.0, 0.1), gear("backlash", 0.008, 0.1)
    both, turned = (physics.following.beyond([*one, *other])[0] for one, other in ((soft, play), (play, soft)))
    np.testing.assert_array_equal(np.vstack(both), np.vstack(turned))
    for alone in (soft, play):
        assert np.abs(np.vstack(physics.following.beyond(alone)[0]) - np.vstack(both)).max() > 1e-3
    at_rest = np.abs(np.vstack(both)[:, 1]).max()
    assert at_rest > 0.004 + 1e-4  # half the play, and what the load turns the spring by


def test_a_soft_and_loose_gear_hangs_on_its_flank_by_gravity_over_its_stiffness() -> None:
    state = run([*gear("backlash", 0.01, 0.0), *gear("joint_compliance", 1 / 400.0, 8.0, 0.0)], 600)
    gravity = Dynamics(ARM).torques(state.q, 0 * POSE, 0 * POSE)[0, 1]
    assert state.q[0, 1] - state.motor[0, 1] == pytest.approx(-0.005 * np.sign(gravity) - gravity / 400.0, rel=0.02)


def test_voltages_that_hold_the_arm_keep_it_where_it_is() -> None:
    state = run([], 100)
    np.testing.assert_allclose(state.q, POSE, atol=1e-6)


def test_a_spring_hangs_through_by_gravity_over_its_stiffness() -> None:
    state = run(gear("joint_compliance", 1 / 400.0, 8.0, 0.0), 600)
    gravity = Dynamics(ARM).torques(state.q, 0 * POSE, 0 * POSE)[0, 1]
    assert state.q[0, 1] - state.motor[0, 1] == pytest.approx(-gravity / 400.0, rel=0.02)


def test_a_loose_link_lies_on_the_flank_that_gravity_presses_it_to() -> None:
    state = run(gear("backlash", 0.01, 0.0), 600)
    gravity = Dynamics(ARM).torques(state.q, 0 * POSE, 0 * POSE)[0, 1]
    assert state.q[0, 1] - state.motor[0, 1] == pytest.approx(-0.005 * np.sign(gravity), rel=0.1)


@pytest.mark.parametrize("model", [gear("joint_compliance", 1e-7, 1.0, 0.0), gear("backlash", 0.0, 0.0)])
def test_a_gear_without_play_that_hardly_gives_moves_as_a_rigid_one(model: list[Law]) -> None:
    rigid, other = run([], 60, push_V=1.5), run(model, 60, push_V=1.5)
    assert np.abs(rigid.q - POSE).max() > 0.01
    np.testing.assert_allclose(other.q, rigid.q, atol=5e-4)


def test_without_voltages_there_is_no_motion_to_compare() -> None:
    runs = tuple(replace(one, voltage_V=np.full_like(one.voltage_V, np.nan)) for one in LOG.runs)
    physics = Physics(ARM, prepare(ARM, Log(runs)))
    assert not motion_gaps(physics, (), (), ("2", "7"))


def test_where_a_driver_is_off_only_windows_are_compared() -> None:
    voltage = LOG.runs[1].voltage_V.copy()
    voltage[900:1000] = np.nan
    runs = (LOG.runs[0], replace(LOG.runs[1], voltage_V=voltage), *LOG.runs[2:])
    physics = Physics(ARM, prepare(ARM, Log(runs)))
    known = known_laws(ARM)
    assert set(motion_gaps(physics, known, known, ("2", "7"))) == {OPEN}
    assert set(motion_gaps(physics, known, known, ("7",))) == {OPEN, CLOSED}


def test_load_friction_is_named_with_its_joint_and_fraction_and_the_motion_from_voltage_comes_closer() -> None:
    """Windows of 0.2 s from measured states, and whole runs in closed loop: checks that took no part in naming."""

    def law(j: int, q: Array, speed: Array, link: Array) -> Array:
        return np.asarray(0.2 * np.abs(link) * np.sign(speed)) if j == 1 else np.zeros_like(q)

    found = find(ARM, log_of(ARM, law), candidates=FEW)
    assert [effect.name for effect in found.effects] == [EffectName("load_friction", 2)]
    assert found.effects[0].parameters["fraction"][0] == pytest.approx(0.2, rel=0.1)
    assert found.gap_after < 1.3 < found.gap_before
    assert found.after_si["q_rad"] < 0.5 * found.before_si["q_rad"]
    assert found.noise_floor["q_rad"] < found.after_si["q_rad"]
    assert found.after_si["q_loop_rad"] < 0.5 * found.before_si["q_loop_rad"] < found.before_si["q_rad"]
