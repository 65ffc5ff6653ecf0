"""The vendor's SDK (ftservo-python-sdk, from PyPI) drives the mock STS servos, and its bytes are ours."""

from typing import Any

import pytest

from firmware_iface import feetech_wire
from firmware_iface.smart_servo import Instruction
from hil_mocks.devices.feetech import FeetechLineMock, FeetechMock, StsSetup

sdk = pytest.importorskip("scservo_sdk")


class Port:
    """The SDK's port handler: the mock's answers are there at once, its control period passes with every packet."""

    is_using = False

    def __init__(self, line: FeetechLineMock) -> None:
        self.written = b""
        self.line, self._received, self._now_s, self._looks = line, b"", 1.0, 0

    def clearPort(self) -> None:
        self._received = b""

    def writePort(self, packet: list[int]) -> int:
        self._now_s += 0.001
        self.written += bytes(packet)
        self.line.receive(bytes(packet), self._now_s)
        for servo in self.line.servos.values():
            servo.tick(self._now_s, -0.65, 12.0)
        self._received += b"".join(status for _, status in self.line.outgoing)
        self.line.outgoing.clear()
        return len(packet)

    def readPort(self, length: int) -> bytes:
        self._looks += 1
        got, self._received = self._received[:length], self._received[length:]
        return got

    def setPacketTimeout(self, length: int) -> None:
        self._looks = 0

    def isPacketTimeout(self) -> bool:
        self._looks += 1
        return self._looks > 50


@pytest.fixture
def port() -> Port:
    servos = [FeetechMock(StsSetup(number, 1.0, turns_on=True), lambda: -0.25) for number in (1, 2)]
    return Port(FeetechLineMock(servos, 1_000_000))


@pytest.fixture
def handler(port: Port) -> Any:
    return sdk.sms_sts(port)


def test_the_sdk_pings_reads_and_writes_the_mock(port: Port, handler: Any) -> None:
    assert handler.ping(1) == (777, sdk.COMM_SUCCESS, 0)
    assert handler.ReadPos(2) == (-1024, sdk.COMM_SUCCESS, 0)
    assert handler.write1ByteTxRx(1, sdk.SMS_STS_TORQUE_ENABLE, 1) == (sdk.COMM_SUCCESS, 0)
    assert port.line.servos[1].table[40] == 1
    assert handler.read2ByteTxRx(1, sdk.SMS_STS_PRESENT_CURRENT_L)[0] == 0x8000 | 100
    assert handler.ping(9)[1] == sdk.COMM_RX_TIMEOUT


def test_every_other_call_of_the_sdk_is_answered(port: Port, handler: Any) -> None:
    servo, done = port.line.servos[1], (sdk.COMM_SUCCESS, 0)
    assert handler.WriteSpec(1, -500, 10) == done
    assert (servo.table[41], servo.table[46:48]) == (10, feetech_wire.raw(-500))
    assert handler.ReadPosSpeed(1) == (-1024, 0, *done)
    assert (handler.ReadSpeed(1), handler.ReadMoving(1)) == ((0, *done), (0, *done))
    assert handler.read4ByteTxRx(1, 9) == (0, *done)
    assert handler.write2ByteTxRx(1, sdk.SMS_STS_GOAL_POSITION_L, 7) == done
    assert handler.write4ByteTxRx(1, 46, 0x01F4_0000) == done
    assert servo.table[42:50] == b"\x07\0\0\0\0\0\xf4\x01"
    assert handler.writeTxOnly(1, 41, 1, [9]) == sdk.COMM_SUCCESS
    assert handler.regWriteTxOnly(1, 41, 1, [8]) == sdk.COMM_SUCCESS
    assert (servo.table[41], servo.table[64]) == (9, 1)
    assert handler.action(1) == sdk.COMM_SUCCESS
    assert servo.table[41] == 8
    assert handler.SyncWritePosEx(1, 5, 6, 7)
    assert handler.groupSyncWrite.txPacket() == sdk.COMM_SUCCESS
    assert servo.table[41:44] == b"\x07" + feetech_wire.raw(5)
    assert handler.LockEprom(1) == done


def test_no_call_of_the_sdk_is_left_out() -> None:
    ways = {"read": ("TxRx", "Tx", "Rx"), "write": ("TxRx", "TxOnly")}
    sized = {f"{way}{n}Byte{how}" for way, hows in ways.items() for how in hows for n in (1, 2, 4)}
    made_of = {  # of which the others are made, numbers and words
        "txPacket",
        "rxPacket",
        "txRxPacket",
        "getProtocolVersion",
        "getRxPacketError",
        "getTxRxResult",
        "readTx",
        "readRx",
        "readTxRx",
        "syncReadTx",
        "syncReadRx",
        "syncWriteTxOnly",
        "writeTxRx",
        "regWriteTxRx",
    }
    called = {
        "LockEprom",
        "ReadMoving",
        "ReadPos",
        "ReadPosSpeed",
        "ReadSpeed",
        "RegAction",
        "RegWritePosEx",
        "SyncWritePosEx",
        "WheelMode",
        "WritePosEx",
        "WriteSpec",
        "action",
        "ping",
        "regWriteTxOnly",
        "unLockEprom",
        "writeTxOnly",
    }
    offered = {name for name in dir(sdk.sms_sts) if not name.startswith(("_", "scs_"))}
    assert offered == sized | made_of | called


@pytest.mark.parametrize(("size", "address"), [(1, 41), (2, 42), (4, 46)])
def test_each_size_is_written_and_read_in_each_of_the_sdks_ways(port: Port, handler: Any, size: int, address: int) -> None:
    read, write = f"read{size}Byte", f"write{size}Byte"
    assert getattr(handler, f"{write}TxOnly")(1, address, 1) == sdk.COMM_SUCCESS
    assert getattr(handler, f"{read}TxRx")(1, address) == (1, sdk.COMM_SUCCESS, 0)
    assert getattr(handler, f"{write}TxRx")(1, address, 0) == (sdk.COMM_SUCCESS, 0)
    assert getattr(handler, f"{read}Tx")(1, address) == sdk.COMM_SUCCESS
    assert getattr(handler, f"{read}Rx")(1) == (0, sdk.COMM_SUCCESS, 0)


def test_the_lock_keeps_what_is_stored(port: Port, handler: Any) -> None:
    handler.write1ByteTxRx(1, sdk.SMS_STS_MODE, 1)
    assert port.line.servos[1].table[33] == 0
    handler.unLockEprom(1)
    handler.WheelMode(1)
    assert port.line.servos[1].table[33] == 1


def test_the_sdks_sync_write_is_ours_and_sets_the_goals(port: Port, handler: Any) -> None:
    write = sdk.GroupSyncWrite(handler, sdk.SMS_STS_GOAL_POSITION_L, 2)
    for number, goal in ((1, 2048), (2, -2)):
        write.addParam(number, list(feetech_wire.raw(goal)))
    assert write.txPacket() == sdk.COMM_SUCCESS
    assert port.written == feetech_wire.sync_write(42, {1: feetech_wire.raw(2048), 2: feetech_wire.raw(-2)})
    assert [servo.table[42:44] for servo in port.line.servos.values()] == [b"\x00\x08", b"\x02\x80"]


def test_the_sdk_reads_several_servos_at_once(port: Port, handler: Any) -> None:
    handler.ping(1)  # a control period, so that there are values
    port.written = b""
    read = sdk.GroupSyncRead(handler, sdk.SMS_STS_PRESENT_POSITION_L, 8)
    for number in (2, 1):
        read.addParam(number)
    assert read.txRxPacket() == sdk.COMM_SUCCESS
    assert [read.getData(n, sdk.SMS_STS_PRESENT_POSITION_L, 2) for n in (1, 2)] == [0x8000 | 1024] * 2
    assert port.written == feetech_wire.sync_read((2, 1), 56, 8)


def test_after_a_servo_that_is_missing_nobody_answers(port: Port) -> None:
    port.line.receive(feetech_wire.sync_read((1, 9, 2), 56, 2), 1.0)
    assert len(port.line.outgoing) == 1


def test_what_the_sdk_registers_is_done_at_the_action_to_all(port: Port, handler: Any) -> None:
    for number in (1, 2):
        assert handler.RegWritePosEx(number, 1000 + number, 0, 0) == (sdk.COMM_SUCCESS, 0)
    servos = port.line.servos.values()
    assert [(servo.table[64], servo.table[42:44]) for servo in servos] == [(1, b"\0\0")] * 2
    assert handler.RegAction() == sdk.COMM_SUCCESS
    assert [servo.table[64] for servo in servos] == [0, 0]
    assert [int.from_bytes(servo.table[42:44], "little") for servo in servos] == [1001, 1002]


def test_of_what_is_sent_to_all_only_a_ping_is_answered_by_all_at_once(port: Port, handler: Any) -> None:
    port.writePort(list(feetech_wire.write(feetech_wire.BROADCAST, 40, b"\x01")))
    assert port._received == b""
    assert [servo.table[40] for servo in port.line.servos.values()] == [1, 1]
    ping = feetech_wire.packet(feetech_wire.BROADCAST, Instruction.PING)
    port.writePort(list(ping))
    with pytest.raises(ValueError, match="checksum"):
        feetech_wire.status_in(port._received)
    port.clearPort()
    del port.line.servos[1]
    port.writePort(list(ping))
    assert feetech_wire.status_in(port._received) == (2, 0, b"", 6)


def test_at_a_response_level_of_0_only_ping_and_read_are_answered(port: Port, handler: Any) -> None:
    handler.unLockEprom(1)
    handler.write1ByteTxRx(1, 8, 0)
    assert handler.write1ByteTxRx(1, 41, 5)[0] == sdk.COMM_RX_TIMEOUT
    assert handler.read1ByteTxRx(1, 41) == (5, sdk.COMM_SUCCESS, 0)
    assert handler.ping(1)[1] == sdk.COMM_SUCCESS


def test_our_packets_are_the_sdks_byte_for_byte(port: Port, handler: Any) -> None:
    handler.ReadPos(2)
    handler.write1ByteTxRx(1, sdk.SMS_STS_TORQUE_ENABLE, 1)
    handler.WritePosEx(1, 1000, 0, 0)
    assert port.written == (
        feetech_wire.read(2, 56, 2)
        + feetech_wire.write(1, 40, b"\x01")
        + feetech_wire.write(1, 41, b"\x00" + feetech_wire.raw(1000) + bytes(4))
    )


def test_an_error_is_in_every_status_until_its_cause_is_gone(port: Port, handler: Any) -> None:
    port.line.servos[1].forced_error = 0x20
    handler.ping(1)
    assert handler.ping(1)[2] == 0x20
    port.line.servos[1].forced_error = 0
    handler.ping(1)
    assert handler.ping(1)[2] == 0


@pytest.mark.parametrize(
    ("error", "unloads_at", "is_free"),
    [(0x01, 44, False), (0x02, 44, False), (0x04, 44, True), (0x08, 44, True), (0x01, 45, True)],
)
def test_an_error_frees_the_motor_by_the_unloading_condition(
    port: Port, handler: Any, error: int, unloads_at: int, is_free: bool
) -> None:
    servo = port.line.servos[1]
    handler.unLockEprom(1)
    handler.write1ByteTxRx(1, 19, unloads_at)
    handler.WritePosEx(1, 1000, 0, 0)
    servo.forced_error = error
    handler.ping(1)
    assert (servo.output.kind == "open") is is_free


def test_overload_leaves_the_protective_torque_until_the_torque_is_switched_off(port: Port, handler: Any) -> None:
    servo = port.line.servos[1]
    handler.WritePosEx(1, 3000, 0, 0)  # it is held at -1024
    for _ in range(1900):
        handler.read1ByteTxRx(1, 65)
    assert (handler.ping(1)[2], servo.output.value) == (0, 12.0)
    for _ in range(200):
        handler.read1ByteTxRx(1, 65)
    assert (handler.ping(1)[2], servo.output.value) == (0x20, pytest.approx(2.4))
    assert handler.read2ByteTxRx(1, sdk.SMS_STS_PRESENT_LOAD_L)[0] == 200
    handler.write1ByteTxRx(1, sdk.SMS_STS_TORQUE_ENABLE, 0)
    handler.ping(1)
    assert handler.ping(1)[2] == 0


def test_the_voltage_is_compared_with_what_is_stored(port: Port, handler: Any) -> None:
    handler.unLockEprom(1)
    handler.write1ByteTxRx(1, 15, 121)
    handler.ping(1)
    assert handler.ping(1)[2] == 0x01


def test_any_single_flipped_bit_of_a_status_packet_is_noticed(port: Port) -> None:
    port.line.servos[1].tick(1.0, 0.0, 12.0)
    status = port.line.servos[1].answer(0x02, bytes((56, 2)), 1.1)
    assert status is not None
    read = feetech_wire.status_in(status)
    assert read is not None
    assert feetech_wire.signed(int.from_bytes(read.parameters, "little")) == -1024
    for bit in range(8 * len(status)):
        flipped = bytearray(status)
        flipped[bit // 8] ^= 1 << bit % 8
        try:
            found = feetech_wire.status_in(bytes(flipped))
        except ValueError:
            continue
        assert found is None
