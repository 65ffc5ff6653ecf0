"""The vendor's SDK (dynamixel-sdk, from PyPI) drives the mock servos, and its bytes are ours."""

import struct
from typing import Any

import pytest

from firmware_iface.dynamixel import wire
from hil_mocks.devices.dynamixel import DynamixelLineMock, DynamixelMock, ServoSetup

sdk = pytest.importorskip("dynamixel_sdk")


class Port:
    """The SDK's port handler: the mock's answers are there at once, its control period passes with every packet."""

    is_using = False

    def __init__(self, line: DynamixelLineMock) -> None:
        self.written = b""
        self.line, self._received, self._now_s, self._looks = line, b"", 0.0, 0

    def clearPort(self) -> None:
        self._received = b""

    def writePort(self, packet: list[int]) -> int:
        self._now_s += 0.001
        self.written += bytes(packet)
        self.line.receive(bytes(packet), self._now_s)
        for servo in self.line.servos.values():
            servo.tick(self._now_s, 0.5, 12.0)
        self._received += b"".join(status for _, status in self.line.outgoing)
        self.line.outgoing.clear()
        return len(packet)

    def readPort(self, length: int) -> bytes:
        self._looks += 1
        got, self._received = self._received[:length], self._received[length:]
        return got

    def getBytesAvailable(self) -> int:
        return len(self._received)

    def setPacketTimeout(self, length: int) -> None:
        self._looks = 0

    setPacketTimeoutMillis = setPacketTimeout

    def isPacketTimeout(self) -> bool:
        self._looks += 1
        return self._looks > 50


@pytest.fixture
def line() -> DynamixelLineMock:
    servos = [DynamixelMock(ServoSetup(number, 1.0), lambda: 0.25) for number in (1, 2)]
    return DynamixelLineMock(servos, 1_000_000)


@pytest.fixture
def handler() -> Any:
    return sdk.PacketHandler(2.0)


def test_the_sdk_pings_reads_and_writes_the_mock(line: DynamixelLineMock, handler: Any) -> None:
    port = Port(line)
    assert handler.ping(port, 1) == (1020, sdk.COMM_SUCCESS, 0)
    assert handler.read4ByteTxRx(port, 2, 132) == (1024, sdk.COMM_SUCCESS, 0)
    assert handler.write1ByteTxRx(port, 1, 64, 1) == (sdk.COMM_SUCCESS, 0)
    assert line.servos[1].table[64] == 1
    _, error = handler.write1ByteTxRx(port, 1, 11, 4)  # EEPROM, while the torque is on
    assert error == 7
    assert handler.ping(port, 9)[1] == sdk.COMM_RX_TIMEOUT


def test_the_sdks_sync_write_sets_the_goals(line: DynamixelLineMock, handler: Any) -> None:
    port = Port(line)
    write = sdk.GroupSyncWrite(port, handler, 116, 4)
    for number, goal in ((1, 1000), (2, -5)):
        write.addParam(number, list(struct.pack("<i", goal)))
    assert write.txPacket() == sdk.COMM_SUCCESS
    assert [struct.unpack_from("<i", servo.table, 116)[0] for servo in line.servos.values()] == [1000, -5]
    assert port.written == wire.sync_write(116, {1: struct.pack("<i", 1000), 2: struct.pack("<i", -5)})


def test_our_packets_are_the_sdks_byte_for_byte(line: DynamixelLineMock, handler: Any) -> None:
    port = Port(line)
    handler.read4ByteTxRx(port, 2, 132)
    handler.write1ByteTxRx(port, 1, 64, 1)
    handler.write4ByteTxRx(port, 1, 116, 123456)
    handler.reboot(port, 1)
    assert port.written == (
        wire.read(2, 132, 4)
        + wire.write(1, 64, b"\x01")
        + wire.write(1, 116, struct.pack("<i", 123456))
        + wire.packet(1, wire.Instruction.REBOOT)
    )


def test_a_header_inside_of_parameters_is_stuffed_and_the_sdk_reads_it_back(
    line: DynamixelLineMock, handler: Any
) -> None:
    # Not compared with what the SDK sends: 4.1.0 computes the stuffing and then sends the packet without it.
    packet = wire.write(1, 116, b"\xff\xff\xfd\x00")
    assert packet[5:].startswith(b"\x0a\x00\x03\x74\x00\xff\xff\xfd\xfd\x00")
    port = Port(line)
    port.writePort(list(packet))
    port.clearPort()
    assert handler.read4ByteTxRx(port, 1, 116) == (0x00FD_FFFF, sdk.COMM_SUCCESS, 0)


def test_a_hardware_error_is_an_alert_that_only_a_restart_ends(line: DynamixelLineMock, handler: Any) -> None:
    port, servo = Port(line), line.servos[1]
    servo.forced_error = 0x20
    handler.ping(port, 1)
    servo.forced_error = 0
    _, _, error = handler.ping(port, 1)
    assert error & wire.ALERT
    handler.write1ByteTxRx(port, 1, 64, 1)
    assert servo.table[64] == 0
    handler.reboot(port, 1)
    assert servo.table[70] == 0


def test_any_single_flipped_bit_of_a_status_packet_is_noticed(line: DynamixelLineMock) -> None:
    line.servos[1].tick(0.05, 0.0, 12.0)
    status = line.servos[1].answer(0x02, struct.pack("<HH", 132, 4), 0.1)
    assert status is not None
    read = wire.status_in(status)
    assert read is not None
    assert read.parameters == struct.pack("<i", 1024)
    for bit in range(8 * len(status)):
        flipped = bytearray(status)
        flipped[bit // 8] ^= 1 << bit % 8
        try:
            assert wire.status_in(bytes(flipped)) is None
        except ValueError:
            continue
