"""Bring-up of arms on bought boards: signs and outputs that are wired wrongly, end stops, and what a kind of board cannot do."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import ClassVar

import pytest

from console.main import main
from control.errors import ArmError
from control.model.arm import Arm, Home, LimitSwitches
from control.model.arm_checks import check_arm
from control.model.description import load_arm
from control.model.end_effector import Digital
from hil_mocks.rig import SteppedRig
from hil_mocks.scenario import FaultTable
from procedures.bringup.bench import open_bench
from procedures.bringup.procedure import BringupOptions, BringupOutcome, Journal, bring_up, brought_up, caution_of
from procedures.bringup.workbench import MockOperator
from procedures.on_boards import on_boards
from tests.cell import RIGHT, scenario, wired_to, with_drive
from tests.procedures.bringup.test_bringup import said_of, short
from tests.procedures.bringup.test_bringup import short_ways as short_ways

SURVEY = BringupOptions((), None, 0.3, False)
A_COUNT_rad = 0.0016  # of a servo
LAST = BringupOptions((3,), None, 0.6, True)


def brought(
    tmp_path: Path,
    draft: Arm,
    options: BringupOptions,
    *faults: FaultTable,
    real: Arm | None = None,
    operator_kind: type[MockOperator] = MockOperator,
) -> tuple[BringupOutcome, Arm]:
    """What was found, and the new arm."""
    with SteppedRig(real or draft, scenario(None, homed=False, base="demo", fault=faults)) as rig:
        arm, operator = wired_to(draft, rig), operator_kind(rig, is_silent=True)
        journal = Journal(tmp_path / "journal.json", draft)
        currents_A = {drive.joint: caution_of(arm, drive, options).current_A for drive in arm.drives}
        with open_bench(arm, rig.clock, operator, currents_A) as bench:
            outcome = bring_up(arm, bench, operator, journal, options)
    return outcome, brought_up(draft, journal, {})


def test_a_joint_on_boards_that_limit_the_current_is_measured_to_its_end_stops_and_its_switch(tmp_path: Path) -> None:
    draft = on_boards(short(), "moteus")
    outcome, arm = brought(tmp_path, draft, LAST)
    assert (outcome.problems, outcome.diagnoses[3].changes) == ([], [])
    figures = outcome.diagnoses[3].figures
    assert figures["coulomb_Nm"] == pytest.approx(0.7, rel=0.05)
    assert figures["lower_stop_rad"] == pytest.approx(0.50, abs=5e-3)
    assert figures["upper_stop_rad"] == pytest.approx(1.00, abs=5e-3)
    assert "counts per turn are the draft's" in said_of(outcome)
    assert arm.drives == draft.drives


def test_a_servo_under_a_weight_is_measured_beside_others_that_hold(tmp_path: Path) -> None:
    """It moves ahead of its set-point where the weight helps; and a hand that blocked the others would make them press until they
    switch themselves off.
    """
    file = tmp_path / "five.toml"
    assert main(["new", "--out", str(file), "--joints", "5", "--boards", "feetech", "--yes"]) == 0
    outcome, _ = brought(tmp_path, load_arm(file), BringupOptions((2, 3), None, 0.2, False))
    assert outcome.problems == []
    assert sorted(outcome.diagnoses) == [2, 3]


def test_a_survey_finds_boards_that_changed_places_signs_and_a_joint_that_is_stuck(tmp_path: Path) -> None:
    draft = on_boards(RIGHT, "vesc")
    first, second, *rest = draft.boards
    swapped = (replace(first, address=second.address), replace(second, address=first.address), *rest)
    real = with_drive(replace(draft, boards=swapped), 2, encoder_direction=-1, motor_direction=-1)
    outcome, _ = brought(tmp_path, draft, SURVEY, FaultTable("stuck_joint", "vesc3"), real=real)
    assert [
        (joint, found.board, found.motor_direction, found.encoder_direction)
        for joint, found in sorted(outcome.wiring.joints.items())
    ] == [(1, "vesc2", 1, 1), (2, "vesc1", -1, -1)]
    sentences = said_of(outcome)
    assert 'joint 1: SWAPPED MOTOR: board "vesc2" (output 1) moves it, draft board "vesc1" (output 1)' in sentences
    assert "joint 2: REVERSED MOTOR" in sentences
    assert "joint 2: REVERSED ENCODER" in sentences
    assert 'board "vesc3" (output 1) (joint 3 in the draft): STUCK JOINT' in sentences


def test_a_joint_that_swings_back_onto_the_switch_which_it_left_goes_on_to_its_other_end(tmp_path: Path) -> None:
    """Joint 1 has no weight that keeps it beside the edge; its lower switch is also its home."""
    draft = with_drive(
        on_boards(RIGHT, "roboclaw"),
        1,
        joint_lower_rad=-0.4,
        joint_upper_rad=0.4,
        limit_switches=LimitSwitches("drive", ""),
        home=Home(-0.4, -0.4, speed_rad_s=0.1, switch="lower"),
    )
    outcome, arm = brought(tmp_path, draft, BringupOptions((1,), None, 0.3, True))
    assert outcome.problems == []
    assert arm.drives[0].joint_upper_rad == pytest.approx(0.4, abs=0.01)
    check_arm(arm)


def test_mixed_boards_are_refused_before_anything_moves(tmp_path: Path) -> None:
    with pytest.raises(ArmError, match=r"all take a voltage, or all close the position loop"):
        brought(tmp_path, on_boards(RIGHT, "mixed"), SURVEY)
    claws = on_boards(RIGHT, "roboclaw")
    beside = replace(claws, drives=(*claws.drives[:2], RIGHT.drives[2]), encoder_boards=RIGHT.encoder_boards, can=RIGHT.can)
    with pytest.raises(ArmError, match=r"takes reference motor boards or \[\[board\]\]s, not both"):
        brought(tmp_path, beside, SURVEY)


@pytest.mark.parametrize(("kind", "still_rad"), [("feetech", A_COUNT_rad), ("odrive", 1e-3)])
def test_a_bench_leaves_boards_that_hold_as_they_are_until_the_operator_allows_a_motion(kind: str, still_rad: float) -> None:
    draft = on_boards(RIGHT, kind)
    with SteppedRig(draft, scenario(homed=True)) as rig:
        for name in rig.robot.drive_names:
            rig.inject(FaultTable("switched_on", name))
        rig.clock.wait_until_s(0.3)
        before_rad = rig.joint_rad()
        arm = wired_to(draft, rig)
        currents_A = {drive.joint: 1.0 for drive in arm.drives}
        with open_bench(arm, rig.clock, MockOperator(rig, is_silent=True), currents_A) as bench:
            bench.observe(0.5)
            assert rig.joint_rad() == pytest.approx(before_rad, abs=still_rad)
        rig.clock.wait_until_s(rig.clock.now_s() + 0.3)
        assert rig.joint_rad() == pytest.approx(before_rad, abs=still_rad)


class Watching(MockOperator):
    """Sees where joint 3 is in each cycle."""

    seen_rad: ClassVar[list[float]] = []

    def wants_stop(self) -> bool:
        self.seen_rad.append(self._rig.joint_rad()[2])
        return super().wants_stop()


@pytest.mark.parametrize("kind", ["reference", "cia402", "roboclaw"])
def test_a_joint_turns_back_at_its_limit_switches_and_keeps_in_front_of_them(tmp_path: Path, kind: str) -> None:
    """Two at pins of a reference board or at a drive of CiA 402; a RoboClaw has an input for one, on which the joint homes."""
    lower_rad, upper_rad, stop_rad = 0.55, 0.95, 0.4  # the range ends 0.05 rad before the stops
    if kind == "reference":
        pins = tuple(Digital(name, 3, pin, "input") for pin, name in enumerate(("low", "high")))
        draft = replace(short(half_rad=0.3), digital=pins)
        switches = LimitSwitches("low", "high", lower_rad, upper_rad)
    else:
        draft = on_boards(short(half_rad=0.3), kind)
        switches = LimitSwitches("drive" if kind == "cia402" else "", "drive", lower_rad, upper_rad)
    draft = with_drive(draft, 3, limit_switches=switches)
    if kind == "roboclaw":
        draft = with_drive(draft, 3, home=Home(upper_rad, upper_rad, speed_rad_s=0.1, switch="upper"))
    check_arm(draft)
    Watching.seen_rad.clear()
    outcome, arm = brought(tmp_path, draft, BringupOptions((3,), None, 0.3, True), operator_kind=Watching)
    assert outcome.problems == []
    assert max(Watching.seen_rad) < upper_rad + 0.02
    if kind == "cia402":  # without a limit of its current it is not sent to its ends
        assert min(Watching.seen_rad) > lower_rad - 0.02
        return
    is_alone = kind == "roboclaw"
    assert min(Watching.seen_rad) == pytest.approx(stop_rad if is_alone else lower_rad, abs=0.02)
    named = "END STOPS and LIMIT SWITCHES" if is_alone else "LIMIT SWITCHES"
    assert f"joint 3: {named} are at" in said_of(outcome)
    found = arm.drives[2]
    assert found.joint_upper_rad == pytest.approx(upper_rad - 0.02, abs=0.01)
    assert found.joint_lower_rad == pytest.approx(0.45 if is_alone else lower_rad + 0.02, abs=0.01)
    check_arm(arm)
