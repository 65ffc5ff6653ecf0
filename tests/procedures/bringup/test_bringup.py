"""Bring-up on mock arms that are wired wrongly: what is said, what the new file mends, and that no motor gets too much."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from importlib.resources import files
from pathlib import Path
from typing import Any

import pytest

from console.main import main
from control.hardware.connect import connect
from control.model.arm import Arm, DrivePid
from control.model.description import load_arm
from control.server.assemble import assemble
from control.server.client import ArmClient
from control.server.in_process import InProcessChannel
from firmware_iface.errors import BoardFaulted
from firmware_iface.motor.cia402 import DriveState
from hil_mocks.rig import SteppedRig
from hil_mocks.scenario import FaultTable, Scenario
from procedures.bringup import measuring
from procedures.bringup.bench import ReferenceBench
from procedures.bringup.diagnosis import Diagnosis, place_limits, rewired
from procedures.bringup.measuring import JointMeasurements
from procedures.bringup.procedure import BringupOptions, BringupOutcome, Journal, bring_up, brought_up, caution_of
from procedures.bringup.workbench import DriveLimits, MockOperator, SafetyTrip, Stopped
from tests.cell import RIGHT, scenario, wired_to, with_drive
from tests.places import RIGHT_TOML

QUICK = BringupOptions((1,), None, 0.3, False)
TURN_rad = 0.0628  # of the motor, at the joint
SURVEY = BringupOptions((), None, 0.3, False)


@pytest.fixture(autouse=True)
def short_ways(monkeypatch: pytest.MonkeyPatch) -> None:
    """Fewer index pulses and passes than a real arm gets: a test waits for every second of them."""
    monkeypatch.setattr(measuring, "LATCHES", 3)
    monkeypatch.setattr(measuring, "INDEX_SPEED_rad_s", 0.25)
    monkeypatch.setattr(measuring, "PASS_SPEEDS_rad_s", (0.15, 0.3))
    monkeypatch.setattr(measuring, "LONG_ANGLE_RAD", 0.3)
    monkeypatch.setattr(measuring, "KNOWN_ANGLE_RAD", 0.12)
    monkeypatch.setattr(measuring, "TOUCHES", 2)


def hidden(*faults: FaultTable, **changes: Any) -> Scenario:
    return scenario(None, homed=False, base="demo", fault=faults, **changes)


def short(arm: Arm = RIGHT, half_rad: float = 0.2) -> Arm:
    """An arm whose joints have little way to their end stops, home switch within."""
    centres = (0.0, 0.15, 0.75)
    drives = tuple(
        replace(drive, joint_lower_rad=centre - half_rad, joint_upper_rad=centre + half_rad)
        for drive, centre in zip(arm.drives, centres, strict=True)
    )
    return replace(arm, drives=drives)


def brought(
    tmp_path: Path,
    *faults: FaultTable,
    draft: Arm = RIGHT,
    real: Arm | None = None,
    options: BringupOptions = QUICK,
    operator_kind: type[MockOperator] = MockOperator,
) -> tuple[BringupOutcome, Journal]:
    """Run it; the operator's eyes are the rig's."""
    with SteppedRig(real or draft, hidden(*faults)) as rig:
        arm = wired_to(draft, rig)
        operator = operator_kind(rig, is_silent=True)
        journal = Journal(tmp_path / "journal.json", draft)
        with ReferenceBench(arm, rig.clock, operator) as bench:
            outcome = bring_up(arm, bench, operator, journal, options)
    return outcome, journal


def said_of(outcome: BringupOutcome) -> str:
    lines = [*outcome.problems, *outcome.wiring.notes]
    for result in outcome.diagnoses.values():
        lines += result.changes + result.notes
    return "\n".join(lines)


def new_arm(outcome: BringupOutcome, journal: Journal, draft: Arm = RIGHT) -> Arm:
    assert not outcome.problems, outcome.problems
    return brought_up(draft, journal, {})


@contextmanager
def homing(arm: Arm, *faults: FaultTable, real: Arm = RIGHT) -> Iterator[SteppedRig]:
    """A runtime that believes the new file homes the same miswired arm."""
    with SteppedRig(real, hidden(*faults)) as rig:
        model = wired_to(arm, rig)
        connection = connect(model, rig.clock, 0.002)
        assembly = assemble(model, connection.hardware, 0.002, None, None, rig.clock.now_s)
        client = ArmClient(InProcessChannel(assembly, rig.clock))
        client.wait(0.02)
        client.enable()
        client.home()
        q_rad = client.status()["q_rad"]
        # Play and the true index: within 3 mrad of what the joints truly stand at.
        assert q_rad == pytest.approx(rig.joint_rad(), abs=3e-3)
        connection.close()
        yield rig


def test_a_good_arm_passes_and_its_keys_stay_as_they_are(tmp_path: Path) -> None:
    draft = short()
    outcome, journal = brought(tmp_path, draft=draft, options=BringupOptions((3,), None, 0.6, True))
    assert not outcome.problems
    assert outcome.diagnoses[3].changes == []
    figures = outcome.diagnoses[3].figures
    # The mock's demo scenario: 0.7 Nm + 0.8 Nm s/rad at joint 3, stops 0.05 rad behind the limits.
    assert figures["coulomb_Nm"] == pytest.approx(0.7, rel=0.03)
    assert figures["viscous_Nm_s_rad"] == pytest.approx(0.8, rel=0.1)
    assert figures["torque_constant_Nm_A"] == pytest.approx(0.0302, rel=0.01)
    assert figures["resistance_ohm"] == pytest.approx(0.299, rel=0.05)
    assert figures["lower_stop_rad"] == pytest.approx(0.50, abs=2e-3)
    assert figures["upper_stop_rad"] == pytest.approx(1.00, abs=2e-3)
    arm = new_arm(outcome, journal, draft)
    assert arm.drives == draft.drives
    assert {(e.effect, e.joint) for e in arm.effects} == {("coulomb_friction", 3), ("viscous_friction", 3)}


def test_a_weak_motor_whose_link_sinks_on_shorted_windings_is_measured_like_a_strong_one(tmp_path: Path) -> None:
    """At 0.6 rad/s: past index pulses from one motion to the next, and faster than the motions are."""
    options = ["--joints", "3", "--lengths", "0.12", "0.36", "0.28", "--yes", "--out", str(tmp_path / "w.toml")]
    assert main(["new", *options]) == 0
    draft = with_drive(load_arm(tmp_path / "w.toml"), 3, joint_lower_rad=0.3, joint_upper_rad=1.6)
    outcome, journal = brought(tmp_path, draft=draft, options=BringupOptions((3,), None, 0.6, True))
    assert (outcome.problems, outcome.diagnoses[3].changes) == ([], [])
    figures = outcome.diagnoses[3].figures
    assert figures["index_spacing_counts"] == draft.drives[2].encoder_counts_per_rev
    assert figures["coulomb_Nm"] == pytest.approx(0.0768, rel=0.1)  # 4 % of 1.92 Nm
    assert figures["upper_stop_rad"] == pytest.approx(1.65, abs=4e-3)
    assert new_arm(outcome, journal, draft).drives == draft.drives


def test_end_stops_that_leave_no_range_are_a_problem_and_no_limits() -> None:
    result = Diagnosis(RIGHT.drives[0])
    place_limits(result, JointMeasurements(stops_rad=[[-1.0], [-1.0]]), 0.0, 1.0)
    assert "END STOPS at -57.3 deg and -57.3 deg leave no range" in result.problems[0]
    assert result.drive == RIGHT.drives[0]


REWIRED = [
    ((FaultTable("swapped_polarity", "motor1"),), "joint 1: REVERSED MOTOR", (1, -1, (0, 0), 1)),
    ((FaultTable("reversed_encoder", "encoder", channel=0),), "joint 1: REVERSED ENCODER", (1, 1, (0, 0), -1)),
    (
        (FaultTable("reversed_encoder", "encoder", channel=0), FaultTable("swapped_polarity", "motor1")),
        "joint 1: REVERSED ENCODER",
        (1, -1, (0, 0), -1),
    ),
    (
        (FaultTable("swapped_channels", "encoder", channel=0, value=2.0),),
        "joint 1: SWAPPED ENCODER: channel 2 counts it",
        (1, 1, (0, 2), 1),
    ),
    ((FaultTable("swapped_motors", "motor1", value=3.0),), "joint 1: SWAPPED MOTOR: motor board 3 moves it", (3, 1, (0, 0), 1)),
]


@pytest.mark.parametrize(("faults", "words", "keys"), REWIRED, ids=["-".join(f.kind for f in case[0]) for case in REWIRED])
def test_wrong_wiring_is_named_and_known(
    tmp_path: Path, faults: tuple[FaultTable, ...], words: str, keys: tuple[object, ...]
) -> None:
    outcome, _ = brought(tmp_path, *faults, options=SURVEY)
    found = outcome.wiring.joints[1]
    assert words in said_of(outcome)
    assert (found.node, found.motor_direction, found.channel, found.encoder_direction) == keys


def test_position_mode_is_refused_where_the_board_would_run_away(tmp_path: Path) -> None:
    draft = with_drive(RIGHT, 1, pid=DrivePid("position"))
    outcome, _ = brought(tmp_path, FaultTable("swapped_polarity", "motor1"), draft=draft, options=SURVEY)
    assert any("REVERSED MOTOR" in problem and "run away" in problem for problem in outcome.problems)


MISCOUNTED = [
    (
        (FaultTable("wrong_encoder", "encoder", channel=0, value=1024.0),),
        "WRONG COUNTS: 1024",
        {"encoder_counts_per_rev": 1024, "gear_ratio": 100.0},
    ),
    ((FaultTable("wrong_gear", "motor1", value=50.0),), "WRONG GEAR: 50", {"encoder_counts_per_rev": 2048, "gear_ratio": 50.0}),
]


@pytest.mark.parametrize(("faults", "words", "keys"), MISCOUNTED, ids=["-".join(f.kind for f in case[0]) for case in MISCOUNTED])
def test_counts_and_gear_are_told_apart_and_mended(
    tmp_path: Path, faults: tuple[FaultTable, ...], words: str, keys: dict[str, float]
) -> None:
    outcome, journal = brought(tmp_path, *faults)
    assert words in said_of(outcome)
    drive = new_arm(outcome, journal).drive(1)
    assert {name: getattr(drive, name) for name in keys} == keys
    # The motor's own constant has nothing to do with either.
    assert outcome.diagnoses[1].figures["torque_constant_Nm_A"] == pytest.approx(0.0302, rel=0.02)


class _Misreading(MockOperator):
    """Reads half of the second angle."""

    readings = 0

    def angle_rad(self, joint: int) -> float | None:
        self.readings += 1
        seen_rad = super().angle_rad(joint)
        return seen_rad if seen_rad is None or self.readings != 2 else 0.5 * seen_rad


def test_a_misread_angle_is_no_other_gear(tmp_path: Path) -> None:
    outcome, journal = brought(tmp_path, operator_kind=_Misreading)
    assert any("an angle was misread" in problem for problem in outcome.problems)
    assert journal.passed() == []


def test_the_rewired_arm_homes(tmp_path: Path) -> None:
    faults = (
        FaultTable("swapped_motors", "motor1", value=3.0),
        FaultTable("swapped_channels", "encoder", channel=0, value=1.0),
        FaultTable("reversed_encoder", "encoder", channel=2),
        FaultTable("swapped_polarity", "motor2"),
    )
    outcome, _ = brought(tmp_path, *faults, options=SURVEY)
    assert outcome.problems == []
    drives = [rewired(RIGHT.drive(joint), found) for joint, found in sorted(outcome.wiring.joints.items())]
    assert [drive.board_holds for drive in drives] == [True, False, True]  # the leads of motor 2 are swapped
    with homing(replace(RIGHT, drives=tuple(drives)), *faults):
        pass


BROKEN = [
    ((FaultTable("dead_motor", "motor1"),), ["motor board 1", "DEAD MOTOR", "check the motor's cable"]),
    ((FaultTable("stuck_joint", "motor1"),), ["motor board 1", "STUCK JOINT", "transport lock"]),
    ((FaultTable("stuck_encoder", "encoder", channel=0),), ["DEAD ENCODER", "joint 1", "the encoder works"]),
    ((FaultTable("lost_wire", "encoder", channel=0),), ["DEAD ENCODER", "lost signal on channel 0"]),
    ((FaultTable("loose_encoder", "encoder", channel=0),), ["joint 1", "LOOSE ENCODER", "tighten"]),
    (
        (FaultTable("stuck_joint", "motor1"), FaultTable("dead_motor", "motor2")),
        ["motor board 1 (joint 1 in the draft): STUCK JOINT", "motor board 2 (joint 2 in the draft): DEAD MOTOR"],
    ),
]


@pytest.mark.parametrize(("faults", "words"), BROKEN, ids=["-".join(f.kind for f in case[0]) for case in BROKEN])
def test_what_software_cannot_mend_is_named_with_its_remedy(
    tmp_path: Path, faults: tuple[FaultTable, ...], words: list[str]
) -> None:
    outcome, journal = brought(tmp_path, *faults)
    said = "\n".join(outcome.problems)
    assert [word for word in words if word not in said] == []
    assert journal.passed() == []


def test_the_draft_is_the_one_that_is_wrong_about_the_stops_and_the_index(tmp_path: Path) -> None:
    real = short(half_rad=0.15)
    home = RIGHT.drive(3).home
    assert home is not None
    draft = with_drive(
        short(half_rad=0.25), 3, home=replace(home, index_rad=home.index_rad + TURN_rad, switch_rad=home.switch_rad + TURN_rad)
    )
    outcome, journal = brought(tmp_path, draft=draft, real=real, options=BringupOptions((3,), None, 0.6, True))
    drive = new_arm(outcome, journal, draft).drive(3)
    sentences = said_of(outcome)
    assert "INDEX MOVED" in sentences
    assert "END STOPS" in sentences
    assert drive.home is not None
    assert drive.home.index_rad == pytest.approx(home.index_rad, abs=8e-3)  # as well as the angle was read
    assert drive.joint_lower_rad == pytest.approx(0.55 + 0.02, abs=8e-3)
    assert drive.joint_upper_rad == pytest.approx(0.95 - 0.02, abs=8e-3)


def test_no_motor_gets_more_than_what_was_announced(tmp_path: Path) -> None:
    most = {"volts": 0.0, "amperes": 0.0}
    jammed = FaultTable("stuck_joint", "motor1")  # takes all that it is given
    with SteppedRig(RIGHT, hidden(jammed)) as rig:
        arm = wired_to(RIGHT, rig)
        operator = MockOperator(rig, is_silent=True)
        tick = rig.robot.tick

        def watched() -> None:
            tick()
            enabled = [board for board in rig.robot.motor_boards if board.state.name == "ENABLED"]
            assert len(enabled) <= 1
            for joint, board in enumerate(rig.robot.motor_boards):
                if board in enabled and board.output.kind == "voltage":
                    most["volts"] = max(most["volts"], abs(board.output.value))
                    most["amperes"] = max(most["amperes"], abs(rig.robot.plant.current_A(joint)))

        rig.robot.tick = watched  # type: ignore[method-assign]
        with ReferenceBench(arm, rig.clock, operator) as bench:
            bring_up(arm, bench, operator, Journal(tmp_path / "j.json", RIGHT), SURVEY)
        assert all(board.state.name == "SWITCH_ON_DISABLED" for board in rig.robot.motor_boards)
    allowed_A = caution_of(RIGHT, RIGHT.drive(1), QUICK).current_A
    assert most["amperes"] == pytest.approx(allowed_A, rel=0.05)
    assert most["volts"] <= 24.0 / 8.0


class Nervous(MockOperator):
    """Stops the n-th cycle of motion, or does not allow the n-th motion."""

    def __init__(self, rig: SteppedRig, stops_at: int = -1, refuses: int = -1) -> None:
        super().__init__(rig, is_silent=True)
        self.cycles, self.allowed = 0, 0
        self._stops_at, self._refuses = stops_at, refuses

    def wants_stop(self) -> bool:
        self.cycles += 1
        return self.cycles == self._stops_at

    def allow(self, what: str) -> bool:
        self.allowed += 1
        return super().allow(what) and self.allowed != self._refuses


@pytest.mark.parametrize("how", [{"stops_at": 40}, {"refuses": 1}, {"refuses": 4}])
def test_a_key_stops_at_once_and_the_drive_is_off(tmp_path: Path, how: dict[str, int]) -> None:
    with SteppedRig(RIGHT, hidden()) as rig:
        arm = wired_to(RIGHT, rig)
        operator = Nervous(rig, **how)
        with ReferenceBench(arm, rig.clock, operator) as bench:
            with pytest.raises(Stopped):
                bring_up(arm, bench, operator, Journal(tmp_path / "j.json", RIGHT), QUICK)
            assert all(motor.state in (None, DriveState.SWITCH_ON_DISABLED) for motor in bench.motors.values())
            before = rig.joint_rad()
            bench.observe(0.1)
            assert rig.joint_rad() == pytest.approx(before, abs=2e-3)  # it settles in its play


def test_a_board_that_goes_silent_ends_the_drive(tmp_path: Path) -> None:
    with SteppedRig(RIGHT, hidden(FaultTable("silent", "encoder", at_s=1.0))) as rig:
        arm = wired_to(RIGHT, rig)
        operator = MockOperator(rig, is_silent=True)
        with ReferenceBench(arm, rig.clock, operator) as bench, pytest.raises(Exception, match="no report for"):
            bring_up(arm, bench, operator, Journal(tmp_path / "j.json", RIGHT), QUICK)
        rig.clock.wait_until_s(rig.clock.now_s() + 0.1)
        assert all(board.state.name != "ENABLED" for board in rig.robot.motor_boards)


def test_a_joint_that_is_pushed_too_fast_is_let_go_of() -> None:
    with (
        SteppedRig(RIGHT, hidden()) as rig,
        ReferenceBench(wired_to(RIGHT, rig), rig.clock, MockOperator(rig, is_silent=True)) as bench,
    ):
        rig.robot.plant.push(0, 20.0)
        with pytest.raises(SafetyTrip, match=r"RAN AWAY|moved"), bench.driving(1, DriveLimits(1.0, 1.0, 8000.0, 5000.0)):
            [bench.cycle(0.0) for _ in range(1000)]
        assert bench.motors[1].state is DriveState.SWITCH_ON_DISABLED


def test_a_drive_that_hears_nothing_more_brakes_within_the_watchdog_of_the_arm() -> None:
    with (
        SteppedRig(RIGHT, hidden()) as rig,
        ReferenceBench(wired_to(RIGHT, rig), rig.clock, MockOperator(rig, is_silent=True)) as bench,
        contextlib.suppress(BoardFaulted),
        bench.driving(1, DriveLimits(1.0, 1.0)),
    ):
        bench.cycle(1.0)
        board, heard_s = rig.robot.motor_boards[0], rig.clock.now_s()
        for share, kind in ((0.5, "voltage"), (1.3, "brake")):
            rig.clock.wait_until_s(heard_s + share * RIGHT.limits.watchdog_s)
            assert board.output.kind == kind


class Sinking:
    """A driver whose joint sinks back over an index pulse while the next one is armed."""

    drive = RIGHT.drive(2)

    def where_rad(self) -> float:
        return 0.0

    def go_to(self, angle_rad: float, speed_rad_s: float) -> None: ...

    def latches(self, wanted: int, direction: int, speed_rad_s: float, longest_rad: float) -> list[int]:
        return [100, 100, 2148, 2147, 4196]


def test_an_index_pulse_that_is_met_twice_is_no_turn() -> None:
    measured = JointMeasurements()
    measuring.measure_index_spacing(Sinking(), measured)  # type: ignore[arg-type]
    assert measured.spacings_count == [2048, 2049]


def draft_file(tmp_path: Path) -> Path:
    file = tmp_path / "draft.toml"
    text = RIGHT_TOML.read_text("utf-8")
    file.write_text(text, "utf-8")
    return file


def run_command(tmp_path: Path, *more: str) -> int:
    out = tmp_path / "new" / "arm.toml"
    return main(["bringup", "--arm", str(draft_file(tmp_path)), "--out", str(out), "--mock", "--no-stops", *more])


def test_the_command_writes_a_new_file_once_and_says_which_joints_are_unchecked(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run_command(tmp_path, "--joint", "1") == 0
    said = capsys.readouterr().out
    assert "Not checked, taken from the draft: joint 2, 3" in said
    assert load_arm(tmp_path / "new" / "arm.toml").drive(1) == RIGHT.drive(1)
    assert run_command(tmp_path, "--joint", "2") == 2
    assert "never overwritten" in capsys.readouterr().err


def test_after_a_repair_only_what_had_not_passed_is_measured(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    hurt = tmp_path / "hurt.toml"
    demo = (files("hil_mocks.scenarios") / "demo.toml").read_text("utf-8")
    hurt.write_text(f'{demo}\n[[fault]]\nkind = "dead_motor"\nboard = "motor2"\n')
    assert run_command(tmp_path, "--scenario", str(hurt), "--joint", "1", "--joint", "2") == 1
    assert not (tmp_path / "new" / "arm.toml").exists()
    said = capsys.readouterr()
    assert "DEAD MOTOR" in said.err
    journal = json.loads((tmp_path / "new" / "arm.bringup.json").read_text())
    assert [joint for joint, entry in journal["joints"].items() if entry["passed"]] == ["1"]
    measured: list[int] = []
    monkeypatch.setattr("procedures.bringup.procedure.measure_joint", lambda driver, *_: measured.append(driver.wiring.joint))
    assert run_command(tmp_path) == 0
    assert measured == [2, 3]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--joint", "7"], "--joint 7: the draft has joints 1, 2, 3"),
        (["--current", "99"], "--current: expected 0.05 to 8 A"),
        (["--speed", "9"], "--speed: expected 0.02 to 1 rad/s"),
        (["--mock-arm", "nobody"], "a path to an arm.toml"),
    ],
)
def test_wrong_input_moves_nothing(tmp_path: Path, options: list[str], words: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run_command(tmp_path, *options) == 2
    assert words in capsys.readouterr().err
    assert not (tmp_path / "new" / "arm.toml").exists()


def test_a_journal_of_another_draft_is_not_taken(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "new").mkdir()
    (tmp_path / "new" / "arm.bringup.json").write_text('{"format": "bringup/1", "draft_sha256": "0"}')
    assert run_command(tmp_path) == 2
    assert "this journal belongs to another draft" in capsys.readouterr().err
    (tmp_path / "new" / "arm.bringup.json").write_text("[]")
    assert run_command(tmp_path) == 2
    assert "not a bring-up journal" in capsys.readouterr().err
