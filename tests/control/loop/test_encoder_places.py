"""Arms of four joints whose encoders are where arm.toml says, on the rig: behind gears and belt, before them, or both."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest

from calib.arm_problem.joint_effects import effect_key, known_corrections
from calib.errors import CalibrationError
from calib.points.points import Points
from console.main import main
from control.dynamics.joint_side import JointSide, usable_range_rad
from control.model.arm import Arm, Effect
from control.model.arm_checks import check_arm
from control.model.description import load_arm
from control.model.reader import Rejected
from control.safety.modes import Mode
from hil_mocks.scenario import EffectTable
from tests.cell import PERIOD_S, Cell, open_cell, scenario
from tests.thirds import third_of

PLAY_rad, STIFFNESS_Nm_rad, BELT = 0.006, 600.0, 0.02
TRANSMISSION = (
    *(Effect("backlash", joint, {"width_rad": PLAY_rad}) for joint in (2, 3)),
    Effect("joint_compliance", 2, {"stiffness_Nm_rad": STIFFNESS_Nm_rad}),
    Effect("belt_coupling", None, {"ratio": BELT}),
)
FRICTION = tuple(Effect("coulomb_friction", j, {"torque_Nm": t}) for j, t in ((1, 0.15), (2, 0.3), (3, 0.15), (4, 0.03)))
HIDDEN = tuple(EffectTable(e.effect, e.joint or 0, dict(e.parameters)) for e in (*TRANSMISSION, *FRICTION))
PLACES = (0.4, 0.5, 0.6, -0.3), (-0.3, -0.6, 0.4, 0.5), (0.2, 0.3, -0.5, 0.2)


@cache
def arm_of_four(side: str) -> Arm:
    """As `armwright new` makes it, with its encoders on this side of the gears."""
    with TemporaryDirectory() as folder:
        file = Path(folder) / "four.toml"
        assert main(["new", "--out", str(file), "--joints", "4", "--encoders", side, "--yes"]) == 0
        return load_arm(file)


def known_friction(arm: Arm) -> Arm:
    """With the mock's friction in its file."""
    return replace(arm, effects=FRICTION)


@contextmanager
def holding_four(arm: Arm) -> Iterator[Cell]:
    """The arm on its mock, which hides play, a spring and a belt, HOLDING."""
    with open_cell(scenario(arm.rest.q_rad if arm.rest else None, effect=HIDDEN), arm) as cell:
        cell.client.enable()
        assert not cell.client.home()
        yield cell


def worst_rad(cell: Cell, speed: float = 0.6) -> float:
    """Largest error of a joint that rests at some places."""
    errors = []
    for place in PLACES:
        cell.client.move_joints(place, speed)
        cell.run(1.0)
        errors.append(np.abs(np.subtract(cell.rig.joint_rad(), place)).max())
    return float(max(errors))


@pytest.mark.parametrize("side", ["joint", "motor"])
def test_a_joint_with_its_own_encoder_rests_where_it_is_sent_whatever_is_in_its_gear(side: str) -> None:
    with holding_four(known_friction(arm_of_four(side))) as cell:
        error_rad = worst_rad(cell)
        assert cell.mode is Mode.HOLDING
        assert error_rad < PLAY_rad / 6 if side == "joint" else error_rad > PLAY_rad


HARDLY_RUBS = tuple(EffectTable(e.effect, e.joint or 0, {"torque_Nm": 0.1 * e.parameters["torque_Nm"]}) for e in FRICTION)
# Joint, its play in rad, whether there is an encoder on its motor, too.
WITH_PLAY = ((2, 0.006, False), (3, 0.015, True), (4, 0.015, False), (1, 0.015, True), (2, 0.015, False), (1, 0.002, False))


@pytest.mark.parametrize("case", third_of(WITH_PLAY))
def test_an_arm_homes_holds_moves_and_follows_with_play_before_its_encoder_by_the_gains_of_the_model(
    case: tuple[int, float, bool],
) -> None:
    joint, play_rad, has_both = case
    arm = arm_of_four("joint")
    play = EffectTable("backlash", joint, {"width_rad": play_rad})
    rest, steps = arm.rest.q_rad if arm.rest else None, 250
    hidden = scenario(rest, homed=False, effect=(play, *HARDLY_RUBS))
    with open_cell(hidden, with_both(arm) if has_both else arm) as cell:
        cell.client.enable()
        cell.client.home()
        assert worst_rad(cell, 0.3) < 1e-3
        at_rad: list[float] = []
        cell.watchers.append(lambda: at_rad.append(float(cell.rig.joint_rad()[joint - 1])))
        cell.run(1.0)
        assert np.ptp(at_rad) < 1e-3
        for step in range(steps):
            turned_rad = 0.03 * (1.0 - math.cos(2.0 * math.pi * step / steps))
            cell.client.follow([q + turned_rad for q in PLACES[-1]])
            cell.run(PERIOD_S)
        cell.client.stop()
        cell.run(1.0)
        assert (cell.mode, cell.faults) == (Mode.HOLDING, [])


def test_an_encoder_that_stands_on_a_moving_joint_is_found_once_play_cannot_explain_it() -> None:
    with holding_four(known_friction(arm_of_four("joint"))) as cell:
        cell.start_move(PLACES[0], 0.3)
        cell.run(0.6)
        before_rad = cell.rig.joint_rad()
        cell.inject("stuck_encoder", "encoder", channel=1)
        cell.until_fault(0.5)
        turned_rad = abs(cell.rig.joint_rad()[1] - before_rad[1])
        assert cell.faults[0] == ("encoder_contradicted", "joint 2")
        assert turned_rad < 2.0 * arm_of_four("joint").limits.transmission_slack_rad


@pytest.mark.parametrize("side", ["joint", "motor"])
def test_what_the_file_says_of_gear_and_belt_is_added_to_encoders_on_motors_alone(side: str) -> None:
    known = replace(arm_of_four(side), effects=(*TRANSMISSION, *FRICTION))
    q_rad = np.array([[0.1, 0.4, 0.2, 0.3]])
    unknown = np.full((1, 4), np.nan)
    points = Points(("a",), ("1",), (1,), q_rad, unknown[:, :3], np.ones((1, 4)), unknown, unknown[0, :1], np.zeros(1))
    shifts_rad = known_corrections(known, points)
    if side == "joint":
        assert JointSide.of(known) is None
        assert usable_range_rad(known) == known.limits_rad
        assert not shifts_rad.any()
        for effect in ("backlash:2", "joint_compliance:2", "belt_coupling"):
            with pytest.raises(CalibrationError, match='got encoder_on = "joint"'):
                effect_key(effect, known)
        return
    assert JointSide.of(known) is not None
    assert shifts_rad[0, 2] == pytest.approx(BELT * 0.4, abs=PLAY_rad)
    assert effect_key("backlash:2", known) == ("backlash", 2)


def with_both(arm: Arm, counts: int = 2048) -> Arm:
    """With an encoder on each motor, too, which its board reads."""
    return replace(arm, drives=tuple(replace(drive, motor_counts_per_rev=counts) for drive in arm.drives))


def test_two_encoders_show_the_play_and_the_spring_between_motor_and_joint() -> None:
    arm = with_both(known_friction(arm_of_four("joint")))
    with holding_four(arm) as cell:
        leads: list[list[float]] = [[], [], [], []]
        true: list[list[float]] = [[], [], [], []]

        motors_rad = [0.0] * 4

        def watch() -> None:
            speed_rad_s = cell.runtime.parts.measurement.speed_rad_s
            for joint, lead in enumerate(cell.runtime.parts.motor_leads.lead_rad):
                motor_rad = cell.rig.robot.plant.motor_rad(joint)
                motor_rad_s = (motor_rad - motors_rad[joint]) / PERIOD_S
                motors_rad[joint] = motor_rad
                # In motion the two are of two moments; a motor may move while its joint stands.
                if lead == lead and max(abs(speed_rad_s[joint]), abs(motor_rad_s)) < 0.01:
                    leads[joint].append(lead)
                    true[joint].append(motor_rad - cell.rig.joint_rad()[joint])

        cell.watchers.append(watch)
        worst_rad(cell)
        assert cell.faults == []
        for seen, is_so in zip(leads, true, strict=True):
            assert len(seen) > 10
            off = np.array(seen) - np.array(is_so)
            assert np.ptp(off) < 3e-4  # a count of each, and some milliseconds between the two
        assert np.ptp(leads[0]) < 3e-4  # a stiff gear without play
        assert np.ptp(leads[1]) > 0.5 * PLAY_rad


@pytest.mark.parametrize("share", [0.8, 1.2])
def test_an_encoder_that_slips_by_more_than_play_and_springs_is_found_by_the_other(share: float) -> None:
    arm = with_both(known_friction(arm_of_four("joint")))
    with holding_four(arm) as cell:
        slack_rad = arm.limits.transmission_slack_rad
        cell.run(0.5)
        slip = round(share * slack_rad * arm.drives[3].counts_per_joint_turn / (2.0 * np.pi) / 8)
        for _ in range(8):  # each too small for any other check
            cell.inject("slipped_encoder", "encoder2", channel=0, value=float(slip))
            cell.run(0.5)
        assert cell.faults == ([("encoders_differ", "joint 4")] if share > 1.0 else [])


def in_position_mode(arm: Arm) -> Arm:
    return replace(arm, drives=tuple(replace(drive, pid=replace(drive.pid, mode="position")) for drive in arm.drives))


def test_a_motor_board_closes_its_position_loop_on_the_encoder_of_the_motor() -> None:
    with holding_four(in_position_mode(with_both(known_friction(arm_of_four("joint"))))) as cell:
        cell.client.move_joints(PLACES[0], 0.3)
        cell.run(1.0)
        off_rad = np.subtract(cell.rig.joint_rad(), PLACES[0])
        assert np.abs(off_rad).max() < 5.0 * PLAY_rad  # play, spring and belt are behind that encoder


def test_a_position_loop_without_an_encoder_on_the_motor_is_refused() -> None:
    check_arm(in_position_mode(with_both(arm_of_four("joint"))))
    with pytest.raises(Rejected, match="closes its loop on an encoder on the motor"):
        check_arm(in_position_mode(arm_of_four("joint")))
