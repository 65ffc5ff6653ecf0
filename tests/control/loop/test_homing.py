"""Homing as a state machine on a joint that follows perfectly, and on the rig with real bytes, in every wiring."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import msgspec
import pytest

from control.hardware.interface import HOME_SWITCH, Feedback
from control.loop.homing_sequence import HomingFailed, HomingSequence, JointHome, Phase
from control.model.arm import Home
from control.motion.setpoint import SetPoint, at_rest
from control.safety.modes import Mode
from control.server.client import ArmFaulted
from hil_mocks.scenario import EncoderBoardTable
from tests.cell import FRICTION, RIGHT, holding_cell, open_cell, scenario, with_drive, with_drives
from tests.thirds import third_of

COUNTS_PER_RAD = 10_000.0
TURN_rad = 0.06
PERIOD_S = 0.002
HOME = JointHome(
    name="joint 1",
    speed_rad_s=0.3,
    acceleration_rad_s2=2.0,
    backoff_rad=0.05,
    travel_rad=3.0,
    switch_rad=0.2,
    index_rad=0.23,
    sense=1.0,
    edge_rad=0.35 * TURN_rad,
    turn_rad=TURN_rad,
    count_rad=1.0 / COUNTS_PER_RAD,
    index_count=2300,
)


@dataclass
class Joint:
    """A joint that is where its set-point is, with a switch, an index once a turn, and a counter with any zero."""

    q_rad: float
    zero_rad: float = 0.0
    index_rad: float = HOME.index_rad
    switch_at_rad: float = HOME.switch_rad
    sign: float = 1.0  # of the side on which the switch is active
    stuck: bool | None = None
    active_in: range = range(0)  # cycles in which its switch says active, wherever the joint is
    cycle: int = 0
    has_index: bool = True
    hunts_counts: int = 1  # a held joint hunts by a count
    is_armed: bool = False
    latched: int | None = None
    shifts: list[int] = field(default_factory=list)

    def count(self) -> int:
        return round((self.q_rad - self.zero_rad) * COUNTS_PER_RAD) + sum(self.shifts)

    def is_active(self) -> bool:
        if self.stuck is not None:
            return self.stuck
        return self.cycle in self.active_in or self.sign * (self.q_rad - self.switch_at_rad) > 0.0

    def go(self, step_rad: float) -> None:
        before, self.q_rad = self.q_rad, self.q_rad + step_rad
        turns = [math.floor((q - self.index_rad) / TURN_rad) for q in (before, self.q_rad)]
        if self.is_armed and self.has_index and turns[0] != turns[1]:
            at_rad = self.index_rad + max(turns) * TURN_rad
            self.latched, self.is_armed = (round((at_rad - self.zero_rad) * COUNTS_PER_RAD) + sum(self.shifts), False)

    # what homing asks of the hardware

    def arm_index(self, joint: int) -> None:
        self.is_armed, self.latched = True, None

    def index_count(self, joint: int) -> int | None:
        return self.latched

    def shift_count(self, joint: int, counts: int) -> None:
        self.shifts.append(counts)


def home(joint: Joint, how: JointHome = HOME, limit_s: float = 60.0) -> list[Phase]:
    """Home the joint; returns the phases that it went through. HomingFailed when it says so."""
    sequence, feedback = HomingSequence([(0, how)], joint), Feedback(1)
    set_point, phases = at_rest((joint.q_rad,)), [Phase.RELEASE]
    for cycle in range(int(limit_s / PERIOD_S)):
        joint.cycle = cycle
        feedback.count[0] = joint.count() + cycle % 2 * joint.hunts_counts
        feedback.channel_flags[0] = HOME_SWITCH if joint.is_active() else 0
        following = sequence.step(set_point, feedback, PERIOD_S)
        assert abs(following.speed_rad_s[0] - set_point.speed_rad_s[0]) <= how.acceleration_rad_s2 * PERIOD_S + 1e-12
        assert abs(following.speed_rad_s[0]) <= how.speed_rad_s + 1e-12
        joint.go(following.q_rad[0] - set_point.q_rad[0])
        set_point = following
        if sequence.is_done:
            return phases
        if sequence.phase is not None and sequence.phase is not phases[-1]:
            phases.append(sequence.phase)
    pytest.fail("homing does not end")


def is_homed(joint: Joint) -> bool:
    """Within a count and its rounding."""
    return abs(joint.count() / COUNTS_PER_RAD - joint.q_rad) <= 1.5 / COUNTS_PER_RAD


@pytest.mark.parametrize("cycles", [1, 3, 100_000], ids=["glitch", "bounce", "wire off"])
def test_a_switch_that_lies_from_any_moment_on_gives_no_wrong_zero(cycles: int) -> None:
    failed = []
    for start in range(0, 1500, 23):
        joint = Joint(-0.25, active_in=range(start, start + cycles))
        try:
            home(joint)
        except HomingFailed as failure:
            failed.append(failure.message)
        else:
            assert is_homed(joint), start
    assert any("at two places" in message for message in failed)
    assert any("stays active" in message for message in failed) is (cycles > 1000)


@pytest.mark.parametrize("start_rad", [-1.5, -0.3, 0.1999, 0.2001, 0.22, 0.5, 1.9])
@pytest.mark.parametrize("zero_rad", [0.0, 3.7, -11.1])
def test_wherever_the_joint_stands_and_the_counter_starts_its_zero_is_found(start_rad: float, zero_rad: float) -> None:
    joint = Joint(start_rad, zero_rad)
    phases = home(joint)
    assert [p for p in phases if p is not Phase.RELEASE] == [
        Phase.SEEK,
        Phase.CHECK,
        Phase.SEEK,
        Phase.INDEX,
        Phase.SETTLE,
        Phase.SHIFTED,
    ]
    assert is_homed(joint)
    assert len(joint.shifts) == 1


@pytest.mark.parametrize("start_rad", [-1.5, 0.1, 0.9])
def test_a_switch_that_is_active_below_is_searched_downwards(start_rad: float) -> None:
    joint = Joint(start_rad, 1.0, index_rad=0.17, sign=-1.0)
    home(joint, replace(HOME, index_rad=0.17, sense=-1.0, index_count=1700))
    assert is_homed(joint)


def test_a_switch_that_is_active_at_the_start_is_left_first_and_taken_from_the_same_side() -> None:
    from_inside, from_outside = Joint(0.4), Joint(-0.4)
    assert home(from_inside)[:2] == [Phase.RELEASE, Phase.SEEK]
    home(from_outside)
    assert from_inside.shifts == from_outside.shifts


@pytest.mark.parametrize(
    ("stuck", "said"), [(True, "its home switch stays active"), (False, "its home switch never became active")]
)
def test_a_stuck_switch_ends_the_search_after_the_joints_travel(stuck: bool, said: str) -> None:
    joint = Joint(0.0, stuck=stuck)
    with pytest.raises(HomingFailed, match=said):
        home(joint)
    assert abs(joint.q_rad) < HOME.travel_rad + 0.01
    assert joint.shifts == []


def test_a_missing_index_ends_the_search_after_two_motor_turns() -> None:
    joint = Joint(0.0, has_index=False)
    with pytest.raises(HomingFailed, match="no index pulse within two turns of the encoder"):
        home(joint)
    assert joint.q_rad < HOME.switch_rad + 2.2 * TURN_rad
    assert joint.shifts == []


def test_a_joint_that_hunts_by_a_milliradian_rests() -> None:
    joint = Joint(0.0, hunts_counts=10)
    home(joint)
    assert is_homed(joint)


def test_a_joint_that_hunts_by_more_is_not_waited_for_without_end() -> None:
    joint = Joint(0.0, hunts_counts=30)
    with pytest.raises(HomingFailed, match=r"does not come to rest.*come from the model, or lower them"):
        home(joint)
    assert joint.shifts == []


@pytest.mark.parametrize("off_turns", [-0.4, -0.36, 0.36, 0.45, 0.6])
def test_an_index_that_could_be_of_another_turn_is_refused(off_turns: float) -> None:
    joint = Joint(0.0, switch_at_rad=HOME.switch_rad - off_turns * TURN_rad)
    with pytest.raises(HomingFailed, match="the encoder's turn is ambiguous"):
        home(joint)
    assert joint.shifts == []


@pytest.mark.parametrize("off_turns", [-0.34, -0.2, 0.2, 0.34])
def test_a_switch_that_moved_by_less_than_a_third_of_a_turn_does_not_matter(off_turns: float) -> None:
    joint = Joint(0.0, switch_at_rad=HOME.switch_rad - off_turns * TURN_rad)
    home(joint)
    assert is_homed(joint)


def test_joints_home_one_after_the_other_while_the_others_stand() -> None:
    class Both:
        """Two joints behind one counter."""

        def __init__(self) -> None:
            self.joints = [Joint(0.0), Joint(-0.5, 2.0)]

        def arm_index(self, joint: int) -> None:
            self.joints[joint].arm_index(0)

        def index_count(self, joint: int) -> int | None:
            return self.joints[joint].index_count(0)

        def shift_count(self, joint: int, counts: int) -> None:
            self.joints[joint].shift_count(0, counts)

    both, feedback = Both(), Feedback(2)
    sequence = HomingSequence([(0, HOME), (1, replace(HOME, name="joint 2"))], both)
    set_point: SetPoint = at_rest((0.0, -0.5))
    for _ in range(30_000):
        feedback.count[:] = [joint.count() for joint in both.joints]
        feedback.channel_flags[:] = [HOME_SWITCH * joint.is_active() for joint in both.joints]
        following = sequence.step(set_point, feedback, PERIOD_S)
        moved = [b - a for a, b in zip(set_point.q_rad, following.q_rad, strict=True)]
        assert 0.0 in moved
        for joint, step_rad in zip(both.joints, moved, strict=True):
            joint.go(step_rad)
        set_point = following
        if sequence.is_done:
            break
    assert all(is_homed(joint) for joint in both.joints)


# ---- on the rig

COUNT_rad = max(2 * math.pi / (d.gear_ratio * d.encoder_counts_per_rev) for d in RIGHT.drives)
NEAR_HOME = (-0.1, 0.0, 0.6)  # just below the switches: a short search


def homing_error_rad(start: tuple[float, ...], arm: object = RIGHT, index_error_rad: float = 0.0) -> float:
    """Largest difference between measured and true angle after homing on the rig, with the friction that a gear has."""
    hidden = scenario(start, homed=False, encoder_board=EncoderBoardTable(index_error_rad=index_error_rad), effect=FRICTION)
    with holding_cell(hidden, arm) as cell:  # type: ignore[arg-type]
        speeds = cell.true_speeds()
        cell.client.home()
        cell.run(0.05)
        assert cell.client.status()["is_homed"]
        assert max(speeds) < 0.6
        # Encoders are on the motors, so a joint that moves would differ by what the report is old.
        return max(abs(q - p) for q, p in zip(cell.runtime.parts.measurement.q_rad, cell.rig.joint_rad(), strict=True))


@pytest.mark.parametrize("start", [NEAR_HOME, (0.05, 0.14, 0.75)])
def test_after_homing_every_angle_is_true_to_a_count(start: tuple[float, ...]) -> None:
    assert homing_error_rad(start) < COUNT_rad


def test_an_index_that_is_off_shows_as_an_angle_that_is_off_by_no_more() -> None:
    assert homing_error_rad(NEAR_HOME, index_error_rad=5e-4) < 5e-4 + COUNT_rad


@pytest.mark.parametrize("wiring", third_of([(-1, -1), (1, -1), (-1, 1)]), ids=str)
def test_every_wiring_that_arm_toml_can_say_homes_alike(wiring: tuple[int, int]) -> None:
    encoder, motor = wiring
    wired = with_drives(RIGHT, encoder_direction=encoder, motor_direction=motor)
    assert homing_error_rad(NEAR_HOME, wired) < COUNT_rad


def test_a_16_bit_counter_that_wraps_during_the_search_homes_alike() -> None:
    """As a wide one does, to the last digit. From the truth it is two counts off at most: that of the report, and one by which
    the motor may creep while the counter is set.
    """
    start = msgspec.structs.replace(scenario(NEAR_HOME, homed=False).start, raw_counts=(32_700, -32_700, 0))
    found = []
    for bits in (16, 32):
        hidden = msgspec.structs.replace(scenario(NEAR_HOME, homed=False), start=start)
        with holding_cell(hidden, with_drives(RIGHT, encoder_bits=bits)) as cell:
            cell.client.home()
            cell.run(0.05)
            found.append(tuple(cell.runtime.parts.measurement.q_rad))
            assert found[-1] == pytest.approx(cell.rig.joint_rad(), abs=2.0 * COUNT_rad)
            # A zero of 16 bits cannot be believed by the next runtime: they are 2 rad, and the joint has 5.
            assert cell.client.ask("home")["homing"] == (bits == 16)
    assert found[0] == found[1]


def test_boards_that_still_know_their_zero_are_left_alone() -> None:
    with holding_cell(scenario(NEAR_HOME, homed=True)) as cell:
        assert cell.client.ask("home") == {"ok": True, "homing": False}
        assert cell.mode is Mode.HOLDING
        assert cell.client.ask("home", again=True)["homing"]
        cell.client.until(["HOLDING"], 30.0)
        # Without friction a held joint hunts by a count, so its zero is set a count off, and it is read a count off.
        assert cell.runtime.parts.measurement.q_rad == pytest.approx(cell.rig.joint_rad(), abs=2 * COUNT_rad)


def test_a_joint_that_does_not_find_its_switch_stops_all_and_is_named() -> None:
    lost = replace(RIGHT.drives[0].home or Home(0.0, 0.0), switch_rad=-0.05)
    with open_cell(scenario(NEAR_HOME, homed=False), RIGHT, believed=with_drive(RIGHT, 1, home=lost)) as cell:
        cell.client.enable()
        with pytest.raises(ArmFaulted, match=r"joint 1: its index was .* the encoder's turn is ambiguous"):
            cell.client.home()
        cell.run(0.5)
        assert cell.runtime.monitor.is_held_fault
        held = cell.rig.joint_rad()
        cell.run(0.1)
        assert cell.rig.joint_rad() == pytest.approx(held, abs=1e-4)
        cell.client.acknowledge()
        assert "home" in cell.refusal(do="move_joints", q_rad=list(NEAR_HOME))


def test_homing_is_stopped_by_stop_and_the_arm_is_not_homed() -> None:
    with holding_cell(scenario(NEAR_HOME, homed=False)) as cell:
        cell.client.ask("home")
        cell.run(0.3)
        cell.client.stop()
        assert cell.mode is Mode.HOLDING
        assert not cell.client.status()["is_homed"]
