"""Hand-guiding with drives that carry the arm: it stays where it is left, a hand moves it, and what runs away is braked."""

from __future__ import annotations

import math

import pytest

from control.safety.modes import Mode
from control.servo import FASTEST_rad_s
from tests.cell import FRICTION, RIGHT, Cell, holding_cell, scenario, with_drives

POSES = [(0.1, -0.6, 0.2), (0.0, 0.5, 1.0), (-1.0, -1.4, -0.5)]


def sag_rad(cell: Cell, duration_s: float) -> float:
    """How far a joint moves, at most."""
    before = cell.rig.joint_rad()
    cell.run(duration_s)
    return max(abs(a - b) for a, b in zip(cell.rig.joint_rad(), before, strict=True))


@pytest.mark.parametrize("q_rad", POSES)
def test_the_drives_carry_an_arm_without_friction_where_it_would_fall_without_them(q_rad: tuple[float, ...]) -> None:
    with holding_cell(scenario(q_rad)) as cell:
        cell.run(0.3)
        cell.client.guide(weightless=True)
        assert cell.client.status()["is_weightless"]
        assert sag_rad(cell, 1.0) < 0.02
        assert cell.mode is Mode.GUIDING
        cell.client.hold()
        cell.client.guide()
        assert not cell.client.status()["is_weightless"]
        assert sag_rad(cell, 0.3) > 0.02


def test_a_hand_moves_it_and_it_stays_where_it_is_left() -> None:
    with holding_cell(scenario(effect=FRICTION)) as cell:
        cell.client.guide(weightless=True)
        x, y, z = cell.rig.tip_m()
        took_s = cell.rig.hand.seat((x, y, z + 0.1))
        cell.run(took_s + 0.5)
        assert cell.rig.hand.residual_m() < 5e-3
        cell.rig.hand.let_go()
        cell.run(0.2)
        assert sag_rad(cell, 1.0) < 2e-3
        assert cell.mode is Mode.GUIDING
        cell.client.hold()
        assert cell.mode is Mode.HOLDING


def test_an_arm_that_falls_because_nobody_holds_it_is_braked() -> None:
    """Circuits open, and no hand: gravity alone takes joint 2 beyond 1.5 times its speed limit on the way to the table."""
    with holding_cell(scenario()) as cell:
        speeds = cell.true_speeds()
        cell.client.guide()
        cell.until_fault(2.0)
        assert cell.faults[0][0] == "guided_too_fast"
        assert max(speeds) < 1.3 * 3.0  # 1.5 times the joints' speed limit
        cell.run(1.0)
        assert max(speeds[-100:]) < 0.5  # shorted windings


def test_a_payload_that_nobody_told_of_runs_away_slowly_and_is_braked() -> None:
    with holding_cell(scenario()) as cell:
        cell.rig.set_payload(1.5)
        speeds = cell.true_speeds()
        cell.client.guide(weightless=True)
        cell.until_fault(3.0)
        assert cell.faults[0][0] == "guided_too_fast"
        assert max(speeds) < 1.3 * FASTEST_rad_s
        cell.run(1.0)
        assert max(speeds[-100:]) < 0.5  # shorted windings


def test_a_payload_that_is_told_is_carried() -> None:
    with holding_cell(scenario()) as cell:
        cell.rig.set_payload(0.8)
        cell.client.ask("payload", mass_kg=0.8)
        cell.run(1.0)
        cell.client.guide(weightless=True)
        assert sag_rad(cell, 0.5) < 0.02


def test_only_true_switches_the_carrying_on() -> None:
    with holding_cell(scenario()) as cell:
        for value in ("no", 1, None, [True]):
            assert "weightless: expected true or false, got" in cell.refusal(do="guide", weightless=value)
        assert cell.mode is Mode.HOLDING


def test_an_arm_that_does_not_know_its_angles_is_not_carried() -> None:
    with holding_cell(scenario(homed=False)) as cell:
        assert "needs a homed arm" in cell.refusal(do="guide", weightless=True)
        assert cell.mode is Mode.HOLDING


def test_a_stop_brakes_and_currents_stay_within_half_of_their_limit() -> None:
    weak = with_drives(RIGHT, current_limit_A=1.2)
    with holding_cell(scenario(), believed=weak) as cell:
        cell.client.guide(weightless=True)
        amperes: list[float] = []
        cell.watchers.append(lambda: amperes.extend(cell.runtime.parts.gravity_compensation.amperes))
        cell.run(0.05)
        assert max(map(abs, amperes)) <= 0.6
        assert not math.isnan(sum(amperes))
        cell.client.stop()
        assert cell.mode is Mode.BRAKED
