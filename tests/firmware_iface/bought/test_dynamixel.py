"""Dynamixel protocol 2.0: the packets of the e-Manual, and a line that is late, echoes or is silent."""

import math
import re
import struct
from pathlib import Path

import pytest

from benchmarks.loop.memory_link import byte_pair
from firmware_iface import dynamixel_wire
from firmware_iface.dynamixel import DynamixelLine, DynamixelServo
from firmware_iface.errors import BoardRefused, BoardSilent, MisuseError, WrongIdentity
from firmware_iface.smart_servo import Instruction
from hil_mocks.devices.dynamixel import DynamixelLineMock, DynamixelMock, ServoSetup, status_packet

GOLDEN = {
    line.split("|")[0].strip(): bytes.fromhex(line.split("|")[1])
    for line in (Path(__file__).parents[2] / "golden" / "dynamixel.txt").read_text().splitlines()
    if not line.startswith("#")
}


def test_packets_are_those_of_the_manual() -> None:
    assert dynamixel_wire.packet(1, Instruction.PING) == GOLDEN["PING id 1"]
    assert dynamixel_wire.read(1, 132, 4) == GOLDEN["READ id 1 present position"]
    assert dynamixel_wire.write(1, 116, struct.pack("<i", 512)) == GOLDEN["WRITE id 1 goal position 512"]
    assert dynamixel_wire.sync_read((1, 2), 132, 4) == GOLDEN["SYNC READ ids 1 and 2 present position"]
    status = dynamixel_wire.status_in(GOLDEN["STATUS id 1 ping, model 1030 firmware 38"])
    assert status == (1, 0, struct.pack("<HB", 1030, 38), 14)


UNITS_A = {1060: 0.0}  # an XL430 measures no current


class Cable:
    """A line with a mock servo; its clock is that of the servo. `echoes`: the adapter hears itself."""

    def __init__(self, model: int = 1020, echoes: bool = False) -> None:
        self.link, self._far = byte_pair("/dev/ttyU2D2", 1_000_000)
        self.servo = DynamixelMock(ServoSetup(3, 1.0, model, UNITS_A.get(model, 0.00269)), lambda: 0.25)
        self.other = DynamixelMock(ServoSetup(4, 1.0, model), lambda: 0.5)
        self.mock = DynamixelLineMock([self.servo, self.other], 1_000_000)
        self.is_cut = False
        self._echoes = echoes
        self._now_s = 0.0

    def now_s(self) -> float:
        return self._now_s

    def wait_until_s(self, t: float) -> None:
        while self._now_s < t:
            self._now_s += 0.0005
            received = self._far.read()
            if self._echoes and received:
                self._far.write(received)
            self.mock.receive(received, self._now_s)
            for servo in self.mock.servos.values():
                servo.tick(self._now_s, 0.0, 12.0)
            sent, self.mock.outgoing = self.mock.outgoing, []
            for _, status in [] if self.is_cut else sent:
                self._far.write(status)


@pytest.mark.parametrize("echoes", [False, True])
def test_a_servo_says_who_and_where_it_is(echoes: bool) -> None:
    cable = Cable(echoes=echoes)
    servo = DynamixelServo(DynamixelLine(cable.link, cable), 3, "elbow")
    told = "model XM430-W350, firmware 46, position mode; free at heat, shock, overload; holds on at voltage, encoder"
    assert servo.identify() == told
    servo.set_up(0.2)
    assert (servo.position, servo.supply_V, servo.is_torque_on) == (1024, 12.0, False)
    assert cable.servo.table[98] == 10


def test_unknown_models_other_modes_and_bad_ids_are_refused() -> None:
    cable = Cable(model=350)
    with pytest.raises(WrongIdentity, match="measures its current or its load"):
        DynamixelServo(DynamixelLine(cable.link, cable), 3, "elbow").identify()
    cable = Cable()
    cable.servo.table[11] = 1
    with pytest.raises(WrongIdentity, match="operating mode 3, 4 or 5"):
        DynamixelServo(DynamixelLine(cable.link, cable), 3, "elbow").identify()
    with pytest.raises(MisuseError, match="0 to 252"):
        DynamixelServo(DynamixelLine(cable.link, cable), 254, "elbow")


def test_a_model_without_a_current_tells_its_load_and_speed_and_limits_its_duty() -> None:
    cable = Cable(model=1060)
    line = DynamixelLine(cable.link, cable)
    servo = DynamixelServo(line, 3, "elbow")
    assert "current reckoned from its load" in servo.identify()
    with pytest.raises(WrongIdentity, match=r"expected operating mode 4 \(extended position\) for a gripper, it is 3"):
        servo.require_force_limit()
    servo.set_up(0.2)
    servo.post_torque(True)
    servo.limit_force(0.5, 0.25)
    cycles(cable, line, 5)
    servo.goal = 1100  # 76 counts from where it is held
    cycles(cable, line, 5)
    assert struct.unpack_from("<h", cable.servo.table, 100)[0] == round(0.25 * 885)
    servo.read_state()
    assert math.isnan(servo.current_A)
    assert servo.load == pytest.approx(cable.servo.output.value / 12.0, abs=0.001)
    assert servo.load > 0.01
    assert servo.speed_rad_s == pytest.approx(0.0, abs=0.03)


@pytest.mark.parametrize(
    ("address", "value", "expected"),
    [
        (6, 36, r"firmware 38 or newer \(bus watchdog\), it is 36: update it with Dynamixel Wizard"),
        (68, 1, r"status return level 2 \(register 68\), .*; it is 1, and writing is not answered: set it with Dynamixel Wizard"),
    ],
)
def test_what_the_watchdog_and_the_answers_need_is_compared(address: int, value: int, expected: str) -> None:
    cable = Cable()
    cable.servo.table[address] = value
    with pytest.raises(WrongIdentity, match=expected):
        DynamixelServo(DynamixelLine(cable.link, cable), 3, "elbow").identify()


def test_torque_that_comes_by_itself_at_power_up_is_refused() -> None:
    cable = Cable()
    cable.servo.table[60] = 1
    cable.servo.power_up()
    assert cable.servo.table[64] == 1
    with pytest.raises(WrongIdentity, match=r"no torque at power-up \(register 60, bit 0\), it is 1 there: set it to 0"):
        DynamixelServo(DynamixelLine(cable.link, cable), 3, "elbow").identify()


def test_registers_that_are_not_set_stop_no_servo(monkeypatch: pytest.MonkeyPatch) -> None:
    cable = Cable()
    answer = cable.servo.answer

    def answers_all(instruction: int, parameters: bytes, now_s: float) -> bytes | None:
        return answer(instruction, parameters, now_s) or status_packet(cable.servo.setup.number, 0)

    cable.servo.table[6] = 0  # firmware
    cable.servo.table[20:64] = bytes(44)  # limits of voltage and position, shutdown
    cable.servo.table[68] = 1
    monkeypatch.setattr(cable.servo, "answer", answers_all)
    servo = DynamixelServo(DynamixelLine(cable.link, cable), 3, "elbow")
    assert re.search("firmware 0, position mode, goals 0 to 0, status return level 1; holds on at", servo.identify())
    assert (servo.bears_V, 4095 in servo.reached, cable.servo.table[65]) == ((0.0, 0.0), True, 0)


def test_every_xl330_has_a_watchdog() -> None:
    cable = Cable(model=1200)
    cable.servo.table[6] = 10
    assert "firmware 10" in DynamixelServo(DynamixelLine(cable.link, cable), 3, "elbow").identify()


def test_a_silent_servo_is_an_error_that_says_what_to_check() -> None:
    cable = Cable()
    cable.is_cut = True
    with pytest.raises(BoardSilent, match=r'Dynamixel "elbow" \(id 3\) on /dev/ttyU2D2.*protocol 2.0.*1000000'):
        DynamixelServo(DynamixelLine(cable.link, cable), 3, "elbow").identify()


def test_the_bus_watchdog_stops_a_servo_whose_host_is_gone_until_it_is_cleared() -> None:
    cable = Cable()
    servo = DynamixelServo(DynamixelLine(cable.link, cable), 3, "elbow")
    servo.identify()
    servo.set_up(0.1)
    cable.servo.write(64, b"\x01")
    cable.wait_until_s(cable.now_s() + 0.3)
    servo.read_state()
    assert servo.is_watchdog_expired
    assert cable.servo.write(116, struct.pack("<i", 5)) == 4  # goals are read-only
    servo.set_up(0.1)
    assert not servo.is_watchdog_expired


def cycles(cable: Cable, line: DynamixelLine, count: int) -> None:
    """Cycles of 10 ms; in the rest of each the line is looked at."""
    for _ in range(count):
        line.update()
        line.post_cycle()
        end_s = cable.now_s() + 0.01
        while cable.now_s() < end_s:
            line.attend()
            cable.wait_until_s(cable.now_s() + 0.0005)


def test_the_values_of_all_servos_come_with_one_question() -> None:
    cable = Cable()
    line = DynamixelLine(cable.link, cable)
    servos = [DynamixelServo(line, number, f"joint{number}") for number in (3, 4)]
    cycles(cable, line, 3)
    assert [servo.position for servo in servos] == [1024, 2048]
    assert servos[0].at_s == servos[1].at_s
    assert (line.timeouts, line.wrong_answers) == (0, 0)


def test_a_silent_servo_does_not_silence_those_that_would_answer_after_it() -> None:
    cable = Cable()
    line = DynamixelLine(cable.link, cable)
    servos = [DynamixelServo(line, number, f"joint{number}") for number in (3, 4)]
    cycles(cable, line, 3)
    cable.mock.servos.pop(3)
    silent_s = cable.now_s()
    cycles(cable, line, 10)
    assert servos[0].at_s < silent_s
    assert cable.now_s() - servos[1].at_s < 0.06  # what an arm at 100 Hz allows
    assert line.timeouts > 2


def test_what_a_servo_refuses_is_said_in_and_outside_of_the_cycle() -> None:
    cable = Cable()
    line = DynamixelLine(cable.link, cable)
    servo = DynamixelServo(line, 3, "grip")
    servo.identify()
    struct.pack_into("<H", cable.servo.table, 38, 100)  # the limit of the goal current
    servo.limit_force(1.0, 1.0)
    cycles(cable, line, 3)
    (refused, *_) = servo.problems
    assert isinstance(refused, BoardRefused)
    assert re.search(r'"grip" \(id 3\).*refused WRITE 102 of 74 01: .*beyond the limit', str(refused))
    cable.servo.table[98] = 0xFF
    cable.servo.table[64] = 1
    with pytest.raises(BoardRefused, match=r"WRITE 116: the value is out of range \(error 4\)"):
        servo._write(116, struct.pack("<i", 9))
