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
