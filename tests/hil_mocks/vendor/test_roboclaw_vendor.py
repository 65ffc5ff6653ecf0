"""The vendor's client (basicmicro, from PyPI) drives the mock RoboClaw, and its bytes are ours."""

from typing import Any

import pytest

from firmware_iface.roboclaw import wire
from firmware_iface.roboclaw.wire import RoboclawCommand
from hil_mocks.devices.roboclaw import RoboClawLineMock, RoboClawMock

basicmicro = pytest.importorskip("basicmicro")


class Port:
    """What the client takes for its serial port; time passes while it reads."""

    is_open = True

    def __init__(self, mock: RoboClawLineMock) -> None:
        self.written = b""
        self._mock, self._received, self._now_s = mock, b"", 0.0

    def write(self, sent: bytes) -> None:
        self.written += bytes(sent)
        self._mock.receive(bytes(sent), self._now_s)

    def read(self, count: int) -> bytes:
        self._now_s += 0.005
        self._received += b"".join(answer for _, answer in self._mock.outgoing)
        self._mock.outgoing.clear()
        got, self._received = self._received[:count], self._received[count:]
        return got

    def flushInput(self) -> None:
        self._received = b""

    reset_input_buffer = reset_output_buffer = close = flushInput


@pytest.fixture
def claw(monkeypatch: pytest.MonkeyPatch) -> tuple[Any, Port, RoboClawMock]:
    board = RoboClawMock(0x80, lambda channel: (1000, -5)[channel])
    port = Port(RoboClawLineMock([board], 115_200))
    monkeypatch.setattr("basicmicro.controller.serial.Serial", lambda **_: port)
    client = basicmicro.Basicmicro("/dev/ttyACM0", 115_200)
    assert client.Open()
    return client, port, board


def test_the_vendors_client_reads_what_the_mock_has(claw: tuple[Any, Port, RoboClawMock]) -> None:
    client, _, board = claw
    assert client.SetEncM1(0x80, 1234)
    assert client.GetEncoders(0x80) == (1, 1234, 0)
    assert client.ReadEncM1(0x80) == (1, 1234, 0)
    assert client.ReadVersion(0x80)[1].strip() == board.version
    assert client.ReadMainBatteryVoltage(0x80) == (1, 240)
    board.tick(0.001, [1.5, -2.0], 24.0, [False, True])
    assert client.ReadCurrents(0x80) == (True, 150, -200)
    assert client.ReadError(0x80) == (1, 0x20000)
    assert client.ReadEncoderModes(0x80) == (1, 0, 0)
    assert client.GetTimeout(0x80) == (True, 1.0)
    assert client.ReadPinFunctions(0x80) == (1, 0, 0x62, 0x62, 0, 0)
    assert client.SetPWMIdle(0x80, 1.5, True, 0.0, False)
    assert client.GetPWMIdle(0x80) == (True, 1.5, True, 0.0, False)
    assert client.SetM1DefaultAccel(0x80, 1000, 2000)
    assert (board.settings.duty_accelerations[0], board.settings.duty_falls[0]) == (1000, 2000)


def test_the_vendors_client_drives_the_mock(claw: tuple[Any, Port, RoboClawMock]) -> None:
    client, _, board = claw
    assert client.DutyM1M2(0x80, 16384, -8192)
    board.tick(0.2, [0.0, 0.0], 24.0, [False, False])
    assert board.duty == [16384, -8192]
    assert client.ReadPWMs(0x80) == (1, 16384, -8192)


@pytest.mark.parametrize(
    ("writes", "reads", "values", "read_back"),
    [
        ("SetM1VelocityPID", "ReadM1VelocityPID", (1.5, 0.25, 0.125, 44000), (1.5, 0.25, 0.125, 44000)),
        ("SetM2VelocityPID", "ReadM2VelocityPID", (2.0, 0.5, 0.25, 5000), (2.0, 0.5, 0.25, 5000)),
        ("SetM1PositionPID", "ReadM1PositionPID", (2.0, 1.0, 0.5, 9, 8, 7, 6), (2.0, 1.0, 0.5, 9, 8, 7, 6)),
        ("SetM2PositionPID", "ReadM2PositionPID", (3.0, 1.0, 0.5, 1, 2, 3, 4), (3.0, 1.0, 0.5, 1, 2, 3, 4)),
        ("SetLogicVoltages", "ReadMinMaxLogicVoltages", (45, 340), (45, 340)),
        ("SetM2DefaultSpeed", "GetDefaultSpeeds", (900,), (0, 900)),
        ("SetConfig", "GetConfig", (0x8063,), (0x8063,)),
        ("SetAuxDutys", "GetAuxDutys", (1, 2, 3, 4, 5), (1, 2, 3, 4, 5)),
        ("SetAuto2", "GetAutos", (70_000,), (0, 70_000)),
        ("SetSpeedErrorLimit", "GetSpeedErrorLimit", (10, 20), (10, 20)),
        ("SetPosErrorLimit", "GetPosErrorLimit", (30, 40), (30, 40)),
        ("SetOffsets", "GetOffsets", (5, 6), (5, 6)),
        ("SetPriority", "GetPriority", (2, 1, 0), (2, 1, 0)),
        ("SetAddressMixed", "GetAddressMixed", (0x81, 0), (0x81, 0)),
        ("SetPWMMode", "ReadPWMMode", (1, 0), (1, 0)),
        ("SetNodeID", "GetNodeID", (7,), (7,)),
        ("SetEStopLock", "GetEStopLock", (0x55,), (0x55,)),
    ],
)  # fmt: skip
def test_what_the_vendors_client_sets_it_reads_back_also_when_it_was_saved(
    claw: tuple[Any, Port, RoboClawMock],
    writes: str,
    reads: str,
    values: tuple[Any, ...],
    read_back: tuple[Any, ...],
) -> None:
    client, _, board = claw
    assert getattr(client, writes)(0x80, *values)
    assert getattr(client, reads)(0x80)[1:] == read_back
    assert client.WriteNVM(0x80)
    board.power_up()
    assert getattr(client, reads)(0x80)[1:] == read_back
    assert client.RestoreDefaults(0x80)
    assert getattr(client, reads)(0x80)[1:] != read_back


def test_the_vendors_client_reads_speeds_temperatures_and_all_at_once(
    claw: tuple[Any, Port, RoboClawMock],
) -> None:
    client, _, board = claw
    assert client.DutyAccelM1M2(0x80, 1000, 16384, 2000, -8192)
    for moment in (0.5, 0.6):
        board.tick(moment, [1.5, -2.0], 24.0, [False, False])
    assert board.duty == pytest.approx([600.0, -1200.0])
    board._read_shaft = lambda channel: (990, 5)[channel]  # 10 counts back, and 10 on, in 0.1 s
    board.tick(0.7, [1.5, -2.0], 24.0, [False, False])
    assert client.GetSpeeds(0x80)[1:] == client.GetISpeeds(0x80)[1:] == (0xFFFF_FF9C, 100)
    assert client.ReadSpeedM2(0x80)[1] == client.ReadISpeedM2(0x80)[1] == 100
    assert client.GetVolts(0x80) == (True, 240, 50)
    assert client.GetTemps(0x80) == (True, 300, 300)
    assert client.ReadTemp2(0x80)[1] == 300
    assert client.ReadBuffers(0x80)[1:] == (0x80, 0x80)
    assert client.GetDefaultAccels(0x80)[1:] == (655_359,) * 4
    assert (
        client.GetEncStatus(0x80)[1:]
        == client.GetSpeedErrors(0x80)[1:]
        == client.GetPosErrors(0x80)[1:]
        == (0, 0)
    )
    tick_ms, state, *_ = client.GetStatus(0x80)[1:]
    assert (tick_ms, state) == (700, 0)
    assert client.ReadNVM(0x80)


def test_a_packet_with_a_wrong_address_is_not_answered(claw: tuple[Any, Port, RoboClawMock]) -> None:
    client, _, _ = claw
    with pytest.raises(basicmicro.exceptions.PacketTimeoutError):
        client.GetEncoders(0x81)


def test_our_packets_are_the_vendors_byte_for_byte(claw: tuple[Any, Port, RoboClawMock]) -> None:
    client, port, _ = claw
    ours = b"".join(
        (
            wire.command_packet(0x80, RoboclawCommand.DUTY_M1_M2, wire.duty_data(16384, -8192)),
            wire.command_packet(0x80, RoboclawCommand.SET_SERIAL_TIMEOUT, b"\x02"),
            wire.command_packet(0x80, RoboclawCommand.SET_ENCODER_2, (1000).to_bytes(4, "big")),
            wire.command_packet(
                0x80, RoboclawCommand.SET_CURRENT_LIMIT_1, (1000).to_bytes(4, "big") + bytes(4)
            ),
            wire.command_packet(
                0x80, RoboclawCommand.SET_DUTY_ACCELERATION_2, (655_359).to_bytes(4, "big") * 2
            ),
            wire.read_packet(0x80, RoboclawCommand.READ_PIN_MODES),
            wire.read_packet(0x80, RoboclawCommand.READ_ENCODERS),
            wire.read_packet(0x80, RoboclawCommand.READ_STATUS),
            wire.read_packet(0x80, RoboclawCommand.READ_TEMPERATURE),
        )
    )
    client.DutyM1M2(0x80, 16384, -8192)
    client.SetTimeout(0x80, 0.2)
    client.SetEncM2(0x80, 1000)
    client.SetM1MaxCurrent(0x80, 1000, 0)
    client.SetM2DefaultAccel(0x80, 655_359, 655_359)
    client.ReadPinFunctions(0x80)
    client.GetEncoders(0x80)
    client.ReadError(0x80)
    client.ReadTemp(0x80)
    assert port.written == ours
