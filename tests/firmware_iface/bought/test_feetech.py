"""Feetech STS: the packets of the vendor's manual, and a line that echoes, is silent, or has another servo on it."""

from pathlib import Path

import pytest

from benchmarks.loop.memory_link import byte_pair
from firmware_iface import feetech_wire
from firmware_iface.errors import BoardReset, BoardSilent, MisuseError, WrongIdentity
from firmware_iface.feetech import CURRENT_UNIT_A, FeetechLine, FeetechServo
from firmware_iface.smart_servo import Instruction
from hil_mocks.devices.feetech import FeetechLineMock, FeetechMock, StsSetup

GOLDEN = {
    line.split(" | ")[0]: bytes.fromhex(line.split(" | ")[1])
    for line in (Path(__file__).parents[2] / "golden" / "feetech.txt").read_text().splitlines()
    if not line.startswith("#")
}


def test_packets_are_those_of_the_manual() -> None:
    assert feetech_wire.packet(1, Instruction.PING) == GOLDEN["PING id 1"]
    assert feetech_wire.read(1, 56, 2) == GOLDEN["READ id 1 position"]
    assert feetech_wire.write(1, 40, b"\x01") == GOLDEN["WRITE id 1 torque on"]
    goals = {1: feetech_wire.raw(2048), 2: feetech_wire.raw(-2)}
    assert feetech_wire.sync_write(42, goals) == GOLDEN["SYNC WRITE positions 2048 and -2"]
    assert feetech_wire.sync_read((1, 2), 56, 8) == GOLDEN["SYNC READ ids 1 and 2, eight bytes from the position on"]
    assert feetech_wire.status_in(GOLDEN["STATUS id 1"]) == (1, 0, b"", 6)
    assert feetech_wire.status_in(GOLDEN["STATUS id 1 position 2048"]) == (1, 0, feetech_wire.raw(2048), 8)


@pytest.mark.parametrize("value", [0, 1, -1, 4095, -32767])
def test_signed_numbers_have_their_sign_in_bit_15(value: int) -> None:
    assert feetech_wire.signed(int.from_bytes(feetech_wire.raw(value), "little")) == value


class Cable:
    """A line with a mock servo; its clock is that of the servo. `echoes`: the adapter hears itself."""

    def __init__(self, model: int = 777, echoes: bool = False) -> None:
        self.link, self._far = byte_pair("/dev/ttyACM0", 1_000_000)
        self.servo = FeetechMock(StsSetup(3, 1.0, model), lambda: 0.25)
        self.mock = FeetechLineMock([self.servo], 1_000_000)
        self.is_cut = False
        self._echoes, self._now_s = echoes, 1.0

    def now_s(self) -> float:
        return self._now_s

    def wait_until_s(self, t: float) -> None:
        received = self._far.read()
        if self._echoes:
            self._far.write(received)
        if not self.is_cut:
            self.mock.receive(received, self._now_s)
        while self._now_s < t:
            self._now_s += 0.0005
            self.servo.tick(self._now_s, -0.65, 12.0)
        for _, status in self.mock.outgoing:
            self._far.write(status)
        self.mock.outgoing.clear()


@pytest.mark.parametrize("echoes", [False, True], ids=["clean", "echoing adapter"])
def test_a_servo_is_identified_set_up_and_read(echoes: bool) -> None:
    cable = Cable(echoes=echoes)
    servo = FeetechServo(FeetechLine(cable.link, cable), 3, "elbow")
    assert servo.identify() == (
        "model STS3215, firmware 3.10, position mode; free at heat, current; weaker at overload (above 80 % for 2 s; 20 % are"
        " left); holds on at voltage, sensor"
    )
    servo.set_up(0.2)
    assert (servo.position, servo.is_torque_on, servo.hardware_error) == (1024, False, 0)
    assert servo.current_A == pytest.approx(-100 * CURRENT_UNIT_A)
    assert (servo.supply_V, servo.temperature_degC) == (pytest.approx(12.0), 35)


def test_another_model_or_mode_and_a_silent_line_say_what_to_do() -> None:
    cable = Cable(model=0x050A)  # an HLS
    with pytest.raises(WrongIdentity, match=r"expected an STS, model 777 \(STS3215\), .*, it is model 1290 \(10.5\)"):
        FeetechServo(FeetechLine(cable.link, cable), 3, "elbow").identify()
    wheel = Cable()
    wheel.servo.table[33] = 1
    with pytest.raises(WrongIdentity, match=r"mode 0 .*, it is 1: set it with Feetech's FD tool"):
        FeetechServo(FeetechLine(wheel.link, wheel), 3, "elbow").identify()
    wheel.is_cut = True
    with pytest.raises(BoardSilent, match=r"no answer to READ 0 .*asked 3 times.*check its supply, id 3"):
        FeetechServo(FeetechLine(wheel.link, wheel), 3, "elbow").identify()
    with pytest.raises(MisuseError, match="0 to 252, got 253"):
        FeetechServo(FeetechLine(cable.link, cable), 253, "elbow")


def test_a_torque_that_goes_off_by_itself_is_a_restart() -> None:
    cable = Cable()
    line = FeetechLine(cable.link, cable)
    servo = FeetechServo(line, 3, "elbow")
    servo.post_torque(True)
    for _ in range(20):
        line.update()
        cable.wait_until_s(cable.now_s() + 0.001)
    assert (servo.is_torque_on, servo.problems) == (True, [])
    cable.servo.table[40] = 0
    servo.read_state()
    assert servo.resets == 1
    assert isinstance(servo.problems[0], BoardReset)


def test_of_two_wishes_for_its_torque_that_wait_only_the_latest_is_sent() -> None:
    cable = Cable()
    line = FeetechLine(cable.link, cable)
    servo = FeetechServo(line, 3, "elbow")
    cable.servo.table[40] = 1
    servo.read_state()
    servo.post_torque(False)
    servo.post_torque(True)
    for _ in range(20):
        line.update()
        cable.wait_until_s(cable.now_s() + 0.001)
        assert cable.servo.table[40] == 1


def test_an_answer_from_before_the_torque_was_switched_off_makes_no_restart() -> None:
    cable = Cable()
    servo = FeetechServo(FeetechLine(cable.link, cable), 3, "elbow")
    servo.post_torque(True)
    cable.servo.table[40] = 1
    servo.read_state()
    servo.post_torque(False)
    servo.read_state()  # it was asked before
    cable.servo.table[40] = 0
    servo.read_state()
    assert (servo.problems, servo.resets) == ([], 0)


def test_what_is_stored_of_its_position_is_told_and_counts_of_another_size_are_refused() -> None:
    cable = Cable()
    servo = FeetechServo(FeetechLine(cable.link, cable), 3, "elbow")
    servo.identify()
    assert (servo.known, servo.reached) == (range(4096), range(4096))
    table = cable.servo.table
    table[9:13] = (1500).to_bytes(2, "little") + (2600).to_bytes(2, "little")
    table[18], table[31:33] = 0x9C, (0x800 | 85).to_bytes(2, "little")
    told = "goals 1500 to 2600, position correction -85, counts on beyond a turn until its supply is cut, sense of its position"
    assert told in servo.identify()
    assert servo.reached == range(1500, 2601)
    table[9:13] = bytes(4)
    assert "no position limits: goals of several turns" in servo.identify()
    table[30] = 3
    with pytest.raises(WrongIdentity, match=r"angular resolution \(register 30\) 1 \(4096 .*\), it is 3"):
        servo.identify()


def test_what_it_does_at_an_error_is_what_is_stored_in_it() -> None:
    cable = Cable()
    servo = FeetechServo(FeetechLine(cable.link, cable), 3, "elbow")
    table = cable.servo.table
    table[7], table[19], table[34] = 250, 0x21, 0
    assert servo.identify().endswith("; free at voltage, overload; holds on at sensor, heat, current")
    assert (servo.frees_at, servo.weakens_at, servo.return_delay_s) == (0x21, 0, pytest.approx(5e-4))
    table[8] = 0
    with pytest.raises(WrongIdentity, match=r"response level 1 \(register 8\), .*; it is 0, and writing is not answered"):
        servo.identify()


def test_a_response_level_of_0_is_told_where_writing_is_answered_all_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    cable = Cable()
    answer = cable.servo.answer

    def answers_all(instruction: int, parameters: bytes, now_s: float) -> bytes | None:
        return answer(instruction, parameters, now_s) or cable.servo._status()

    monkeypatch.setattr(cable.servo, "answer", answers_all)
    cable.servo.table[8], cable.servo.table[41] = 0, 7
    assert "response level 0" in FeetechServo(FeetechLine(cable.link, cable), 3, "elbow").identify()
    assert cable.servo.table[40:42] == b"\0\x07"


def test_another_sts_is_taken_and_told() -> None:
    cable = Cable(model=0x0E09)
    servo = FeetechServo(FeetechLine(cable.link, cable), 3, "elbow")
    assert servo.identify().startswith("model 9.14, not known here: taken for one as the STS3215, firmware 3.10")


@pytest.mark.parametrize("phase", [0x00, 0x0C], ids=["a speed of 0 stands", "a speed of 0 is the fastest"])
def test_no_speed_limit_is_what_the_phase_takes_for_it(phase: int) -> None:
    cable = Cable()
    cable.servo.table[18] = phase
    line = FeetechLine(cable.link, cable)
    servo = FeetechServo(line, 3, "elbow")
    servo.identify()
    servo.set_up(0.2)
    servo.goal = 1100
    for _ in range(4):
        line.post_cycle()
        line.update()
        cable.wait_until_s(cable.now_s() + 0.005)
    assert cable.servo.output.value > 0.1  # it pulls towards its goal


def test_a_servo_that_only_damps_does_not_count_as_holding() -> None:
    cable = Cable()
    servo = FeetechServo(FeetechLine(cable.link, cable), 3, "elbow")
    cable.servo.write(40, b"\x02", cable.now_s())
    servo.read_state()
    assert (servo.is_torque_on, cable.servo.output.value) == (False, 0.0)


def test_a_gripper_needs_counts_and_goals_beyond_a_turn() -> None:
    cable = Cable()
    servo = FeetechServo(FeetechLine(cable.link, cable), 3, "hand")
    servo.identify()
    with pytest.raises(WrongIdentity, match=r"register 18 with bit 4, position limits 0 and 0"):
        servo.require_force_limit()
    cable.servo.table[9:13] = bytes(4)
    cable.servo.table[18] |= 0x10
    servo.identify()
    servo.require_force_limit()


def test_a_servo_without_torque_gets_no_goal_because_that_would_switch_it_on() -> None:
    cable = Cable()
    line = FeetechLine(cable.link, cable)
    servo = FeetechServo(line, 3, "elbow")
    for _ in range(20):
        line.post_cycle()
        line.update()
        cable.wait_until_s(cable.now_s() + 0.005)
    assert (servo.is_torque_on, cable.servo.table[42:44]) == (False, bytes(2))
    servo.goal = 1100
    for _ in range(4):
        line.post_cycle()
        line.update()
        cable.wait_until_s(cable.now_s() + 0.005)
    assert servo.is_torque_on  # the vendor's rule, in the mock


def test_torque_comes_with_the_goal_where_the_servo_stands() -> None:
    cable = Cable()
    line = FeetechLine(cable.link, cable)
    servo = FeetechServo(line, 3, "elbow")
    cable.servo.table[42:44] = feetech_wire.raw(7)  # an old goal
    servo.read_state()
    servo.post_torque(True)
    for _ in range(4):
        line.update()
        cable.wait_until_s(cable.now_s() + 0.005)
    assert (servo.is_torque_on, bytes(cable.servo.table[42:44])) == (True, feetech_wire.raw(1024))
