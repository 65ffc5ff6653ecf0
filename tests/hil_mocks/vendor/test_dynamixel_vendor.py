"""The vendor's SDK (dynamixel-sdk, from PyPI) drives the mock servos, and its bytes are ours."""

import struct
from pathlib import Path
from typing import Any

import pytest

from firmware_iface import dynamixel_wire
from firmware_iface.dynamixel import MODELS, WITH_LOAD
from firmware_iface.smart_servo import Instruction
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

    def getBaudRate(self) -> int:
        return 1_000_000

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
    for number, goal in ((1, 1000), (2, 4095)):
        write.addParam(number, list(struct.pack("<i", goal)))
    assert write.txPacket() == sdk.COMM_SUCCESS
    assert [struct.unpack_from("<i", servo.table, 116)[0] for servo in line.servos.values()] == [1000, 4095]
    assert port.written == dynamixel_wire.sync_write(116, {1: struct.pack("<i", 1000), 2: struct.pack("<i", 4095)})


def test_the_sdk_reads_several_servos_at_once(line: DynamixelLineMock, handler: Any) -> None:
    port = Port(line)
    handler.ping(port, 1)  # a control period, so that there are values
    port.written = b""
    for way in ("txRxPacket", "fastSyncRead"):
        read = sdk.GroupSyncRead(port, handler, 126, 21)
        for number in (2, 1):
            read.addParam(number)
        assert getattr(read, way)() == sdk.COMM_SUCCESS
        assert [(read.getData(n, 132, 4), read.getData(n, 144, 2)) for n in (1, 2)] == [(1024, 120)] * 2
    bulk = sdk.GroupBulkRead(port, handler)
    bulk.addParam(1, 132, 4)
    bulk.addParam(2, 146, 1)
    for way in ("txRxPacket", "fastBulkRead"):
        assert getattr(bulk, way)() == sdk.COMM_SUCCESS
        assert (bulk.getData(1, 132, 4), bulk.getData(2, 146, 1)) == (1024, 35)
    assert port.written.startswith(dynamixel_wire.sync_read((2, 1), 126, 21))


def test_after_a_servo_that_is_missing_nobody_answers(line: DynamixelLineMock, handler: Any) -> None:
    read = sdk.GroupSyncRead(Port(line), handler, 132, 4)
    for number in (1, 9, 2):
        read.addParam(number)
    assert read.txRxPacket() == sdk.COMM_RX_TIMEOUT
    line.receive(dynamixel_wire.sync_read((1, 9, 2), 132, 4), 1.0)
    assert len(line.outgoing) == 1


def test_the_sdk_writes_several_servos_at_once_and_at_a_sign(line: DynamixelLineMock, handler: Any) -> None:
    port, servo = Port(line), line.servos[1]
    bulk = sdk.GroupBulkWrite(port, handler)
    bulk.addParam(1, 116, 4, [1, 2, 0, 0])
    bulk.addParam(2, 65, 1, [1])
    assert bulk.txPacket() == sdk.COMM_SUCCESS
    assert (bytes(servo.table[116:118]), line.servos[2].table[65]) == (b"\x01\x02", 1)
    assert handler.regWriteTxRx(port, 1, 116, 4, [9, 0, 0, 0]) == (sdk.COMM_SUCCESS, 0)
    assert (servo.table[116], servo.table[69]) == (1, 1)
    handler.action(port, sdk.BROADCAST_ID)
    assert (servo.table[116], servo.table[69]) == (9, 0)
    assert handler.action(port, 1) == sdk.COMM_SUCCESS  # the SDK passes its error over
    said = line.servos[1].answer(0x05, b"", 9.0)
    assert said is not None
    assert said[8] == 0x02  # nothing is registered any more


@pytest.mark.parametrize(
    ("address", "data", "error"),
    [
        (116, struct.pack("<i", 4096), sdk.ERRNUM_DATA_RANGE),
        (116, struct.pack("<i", -1), sdk.ERRNUM_DATA_RANGE),
        (98, b"\x80", sdk.ERRNUM_DATA_RANGE),
        (102, struct.pack("<h", 1001), sdk.ERRNUM_DATA_LIMIT),
        (116, b"\x05\x00", sdk.ERRNUM_DATA_LENGTH),
        (132, bytes(4), sdk.ERRNUM_ACCESS),
        (66, b"\x01", sdk.ERRNUM_ACCESS),
    ],
)
def test_what_a_servo_does_not_take_is_refused_with_the_sdks_number(
    line: DynamixelLineMock, handler: Any, address: int, data: bytes, error: int
) -> None:
    port, servo = Port(line), line.servos[1]
    handler.write2ByteTxRx(port, 1, 38, 1000)  # the limit of the goal current
    before = bytes(servo.table[:126])
    for write in (handler.writeTxRx, handler.regWriteTxRx):
        assert write(port, 1, address, len(data), list(data)) == (sdk.COMM_SUCCESS, error)
    assert servo.table[:126] == before


def test_an_unknown_instruction_and_a_wrong_crc_are_answered_with_their_errors(line: DynamixelLineMock) -> None:
    line.receive(dynamixel_wire.packet(1, 0x77), 0.1)
    damaged = bytearray(dynamixel_wire.read(2, 132, 4))
    damaged[-1] ^= 1
    line.receive(bytes(damaged), 0.2)
    said = [dynamixel_wire.status_in(status) for _, status in line.outgoing]
    assert [(one.servo, one.error) for one in said if one] == [(1, sdk.ERRNUM_INSTRUCTION), (2, sdk.ERRNUM_CRC)]


@pytest.mark.parametrize("level", [0, 1, 2])
def test_the_status_return_level_says_what_is_answered(line: DynamixelLineMock, handler: Any, level: int) -> None:
    port = Port(line)
    handler.write1ByteTxRx(port, 1, 68, level)
    assert handler.ping(port, 1)[1] == sdk.COMM_SUCCESS
    assert (handler.read1ByteTxRx(port, 1, 68)[1] == sdk.COMM_SUCCESS) is (level >= 1)
    assert (handler.write1ByteTxRx(port, 1, 65, 1)[0] == sdk.COMM_SUCCESS) is (level == 2)
    assert line.servos[1].table[65] == 1


def test_all_answer_a_ping_to_all_and_nobody_a_write(line: DynamixelLineMock, handler: Any) -> None:
    port = Port(line)
    assert handler.broadcastPing(port) == ({1: [1020, 46], 2: [1020, 46]}, sdk.COMM_SUCCESS)
    handler.write1ByteTxOnly(port, sdk.BROADCAST_ID, 65, 1)
    assert port.getBytesAvailable() == 0
    assert [servo.table[65] for servo in line.servos.values()] == [1, 1]


def test_what_is_stored_outlives_a_restart_and_the_rest_does_not(line: DynamixelLineMock, handler: Any) -> None:
    port, servo = Port(line), line.servos[1]
    handler.write1ByteTxRx(port, 1, 11, 4)
    handler.write1ByteTxRx(port, 1, 65, 1)
    handler.reboot(port, 1)
    assert (servo.table[11], servo.table[65]) == (4, 0)


def test_our_packets_are_the_sdks_byte_for_byte(line: DynamixelLineMock, handler: Any) -> None:
    port = Port(line)
    handler.read4ByteTxRx(port, 2, 132)
    handler.write1ByteTxRx(port, 1, 64, 1)
    handler.write4ByteTxRx(port, 1, 116, 123456)
    handler.reboot(port, 1)
    assert port.written == (
        dynamixel_wire.read(2, 132, 4)
        + dynamixel_wire.write(1, 64, b"\x01")
        + dynamixel_wire.write(1, 116, struct.pack("<i", 123456))
        + dynamixel_wire.packet(1, Instruction.REBOOT)
    )


@pytest.mark.parametrize(("option", "kept"), [(0xFF, ()), (0x01, (7,)), (0x02, (7, 8))])
def test_a_reset_to_delivery_keeps_id_and_baud_rate_as_it_is_asked_to(
    line: DynamixelLineMock, handler: Any, option: int, kept: tuple[int, ...]
) -> None:
    port, servo = Port(line), line.servos[2]
    for address, value in ((7, 9), (8, 3), (11, 4)):
        handler.write1ByteTxRx(port, servo.table[7], address, value)
    handler.write1ByteTxRx(port, 9, 64, 1)
    assert handler.factoryReset(port, 9, option)[1] == 1  # result fail: its torque is on
    handler.write1ByteTxRx(port, 9, 64, 0)
    assert handler.factoryReset(port, 9, option) == (sdk.COMM_SUCCESS, 0)
    assert bytes(servo.table[7:9]) == bytes({7: 9, 8: 3}[at] if at in kept else 1 for at in (7, 8))
    assert servo.table[11] == 3


def test_turns_are_cleared_to_the_position_within_one(line: DynamixelLineMock, handler: Any) -> None:
    port, servo = Port(line), line.servos[1]
    servo.turned_on = 3
    handler.ping(port, 1)
    for _ in range(50):
        handler.ping(port, 1)  # it stands
    servo._motor.speed_turns_s = 0.0
    assert handler.clearMultiTurn(port, 1) == (sdk.COMM_SUCCESS, 0)
    handler.ping(port, 1)
    assert handler.read4ByteTxRx(port, 1, 132)[0] == 1024
    servo._motor.speed_turns_s = 1.0
    assert handler.clearMultiTurn(port, 1)[1] == 1


@pytest.mark.parametrize(("size", "address"), [(1, 65), (2, 100), (4, 116)])
def test_each_size_is_written_and_read_in_each_of_the_sdks_ways(
    line: DynamixelLineMock, handler: Any, size: int, address: int
) -> None:
    port, done = Port(line), (sdk.COMM_SUCCESS, 0)
    read, write = f"read{size}Byte", f"write{size}Byte"
    assert getattr(handler, f"{write}TxOnly")(port, 1, address, 1) == sdk.COMM_SUCCESS
    assert getattr(handler, f"{read}TxRx")(port, 1, address) == (1, *done)
    assert getattr(handler, f"{write}TxRx")(port, 1, address, 0) == done
    assert getattr(handler, f"{read}Tx")(port, 1, address) == sdk.COMM_SUCCESS
    assert getattr(handler, f"{read}Rx")(port, 1) == (0, *done)


def test_no_call_of_the_sdk_is_left_out() -> None:
    sized = {
        f"{read}{n}Byte{way}"
        for n in (1, 2, 4)
        for read, way in (("read", "Tx"), ("read", "Rx"), ("read", "TxRx"), ("write", "TxOnly"), ("write", "TxRx"))
    }
    made_of = {  # of which the others are made, or words
        "addStuffing",
        "removeStuffing",
        "updateCRC",
        "txPacket",
        "rxPacket",
        "txRxPacket",
        "getProtocolVersion",
        "getRxPacketError",
        "getTxRxResult",
        "readTx",
        "readRx",
        "readTxRx",
        "writeTxOnly",
        "regWriteTxOnly",
        "syncReadTx",
        "syncWriteTxOnly",
        "bulkReadTx",
        "bulkWriteTxOnly",
        "fastSyncReadRx",
        "fastBulkReadRx",
    }
    called = {"ping", "broadcastPing", "action", "reboot", "clearMultiTurn", "factoryReset", "regWriteTxRx", "writeTxRx"}
    assert {name for name in dir(sdk.Protocol2PacketHandler) if not name.startswith("_")} == sized | made_of | called
    for group, ways in (
        (sdk.GroupSyncRead, {"txRxPacket", "fastSyncRead"}),
        (sdk.GroupBulkRead, {"txRxPacket", "fastBulkRead"}),
        (sdk.GroupSyncWrite, {"txPacket"}),
        (sdk.GroupBulkWrite, {"txPacket"}),
    ):
        bookkeeping = {"addParam", "changeParam", "clearParam", "getData", "isAvailable", "makeParam", "removeParam"}
        halves = {"rxPacket", "txPacket", *(f"{way}{half}Packet" for way in ways for half in ("Rx", "Tx"))}
        assert {name for name in dir(group) if not name.startswith("_")} - bookkeeping <= ways | halves


easy = pytest.importorskip("dynamixel_easy_sdk")
# What the vendor's Easy SDK sets, and where it then stands in the control table: address, bytes, value.
EASY_SETS: dict[str, tuple[tuple[Any, ...], tuple[int, int, int]]] = {
    "enableTorque": ((), (64, 1, 1)),
    "LEDOn": ((), (65, 1, 1)),
    "setGoalPosition": ((2000,), (116, 4, 2000)),
    "setGoalVelocity": ((-5,), (104, 4, -5)),
    "setGoalCurrent": ((30,), (102, 2, 30)),
    "setGoalPWM": ((-40,), (100, 2, -40)),
    "changeID": ((5,), (7, 1, 5)),
    "setOperatingMode": ((easy.OperatingMode.EXTENDED_POSITION,), (11, 1, 4)),
    "setProfileConfiguration": ((easy.ProfileConfiguration.TIME_BASED,), (10, 1, 4)),
    "setDirection": ((easy.Direction.REVERSE,), (10, 1, 1)),
    "setPositionPGain": ((10,), (84, 2, 10)),
    "setPositionIGain": ((11,), (82, 2, 11)),
    "setPositionDGain": ((12,), (80, 2, 12)),
    "setVelocityPGain": ((13,), (78, 2, 13)),
    "setVelocityIGain": ((14,), (76, 2, 14)),
    "setHomingOffset": ((-15,), (20, 4, -15)),
    "setMaxPositionLimit": ((4000,), (48, 4, 4000)),
    "setMinPositionLimit": ((16,), (52, 4, 16)),
    "setVelocityLimit": ((17,), (44, 4, 17)),
    "setCurrentLimit": ((18,), (38, 2, 18)),
    "setPWMLimit": ((19,), (36, 2, 19)),
}
EASY_READS = {
    "ping": 1020,
    "isTorqueOn": 0,
    "isLEDOn": 0,
    "getPresentPosition": 1024,
    "getPresentVelocity": 0,
    "getPresentCurrent": 186,
    "getPresentPWM": 0,
    "getMaxPositionLimit": 4095,
    "getMinPositionLimit": 0,
    "getVelocityLimit": 350,
    "getCurrentLimit": 1193,
    "getPWMLimit": 885,
    "getOperatingMode": 3,
}
STAGED = {f"stage{name[0].upper()}{name[1:]}" for name in (*EASY_SETS, *EASY_READS, "disableTorque", "LEDOff")}
NEEDS_MODE = {"setGoalVelocity": 1, "setGoalCurrent": 5}


@pytest.fixture
def connector(line: DynamixelLineMock, monkeypatch: pytest.MonkeyPatch) -> Any:
    port = Port(line)
    monkeypatch.setattr(port, "setBaudRate", lambda _: True, raising=False)
    monkeypatch.setattr(port, "closePort", port.clearPort, raising=False)
    monkeypatch.setattr("dynamixel_easy_sdk.connector.PortHandler", lambda _: port)
    return easy.Connector("/dev/ttyUSB0", 1_000_000)


def test_no_call_of_the_easy_sdk_is_left_out(connector: Any) -> None:
    offered = {name for name in dir(easy.Motor) if not name.startswith("_")}
    ends = {"disableTorque", "LEDOff", "reboot", "factoryResetAll", "factoryResetExceptID", "factoryResetExceptIDAndBaudRate"}
    staged = {name for name in offered if name.startswith("stage")}
    assert offered - staged == {*EASY_SETS, *EASY_READS} | ends
    assert staged <= STAGED
    motor = connector.createMotor(1)
    for name in sorted(ends):
        getattr(motor, name)()
        connector._port_handler._now_s += 1.0
        motor.id = motor.ping() and 1


@pytest.mark.parametrize("name", EASY_SETS)
def test_what_the_easy_sdk_sets_stands_in_the_control_table(connector: Any, line: DynamixelLineMock, name: str) -> None:
    servo = line.servos[1]
    motor = connector.createMotor(1)
    if name in NEEDS_MODE:
        motor.setOperatingMode(easy.OperatingMode(NEEDS_MODE[name]))
    if name.startswith("setGoal"):
        motor.enableTorque()
    given, (address, size, value) = EASY_SETS[name]
    getattr(motor, name)(*given)
    assert int.from_bytes(servo.table[address : address + size], "little", signed=value < 0) == value
    if name.startswith(("setGoal", "enable", "LED")):
        group = connector.createGroupExecutor()
        servo.table[address : address + size] = bytes(size)
        if name.startswith("setGoal"):
            servo.table[64] = 1
        group.addCmd(getattr(motor, f"stage{name[0].upper()}{name[1:]}")(*given))
        group.executeWrite()
        assert int.from_bytes(servo.table[address : address + size], "little", signed=value < 0) == value


@pytest.mark.parametrize("name", EASY_READS)
def test_what_the_easy_sdk_reads_is_what_is_measured_and_stored(connector: Any, name: str) -> None:
    motor = connector.createMotor(1)
    assert getattr(motor, name)() == EASY_READS[name]
    if (staged := f"stage{name[0].upper()}{name[1:]}") in dir(motor):
        group = connector.createGroupExecutor()
        group.addCmd(getattr(motor, staged)())
        assert group.executeRead() == [EASY_READS[name]]


def test_a_header_inside_of_parameters_is_stuffed_and_the_sdk_reads_it_back(line: DynamixelLineMock, handler: Any) -> None:
    # Not compared with what the SDK sends: 4.1.0 computes the stuffing and then sends the packet without it.
    line.servos[1].table[11] = 4  # several turns
    packet = dynamixel_wire.write(1, 116, b"\xff\xff\xfd\xff")
    assert packet[5:].startswith(b"\x0a\x00\x03\x74\x00\xff\xff\xfd\xfd\xff")
    port = Port(line)
    port.writePort(list(packet))
    port.clearPort()
    assert handler.read4ByteTxRx(port, 1, 116) == (0xFFFD_FFFF, sdk.COMM_SUCCESS, 0)


def test_a_hardware_error_is_an_alert_that_only_a_restart_ends(line: DynamixelLineMock, handler: Any) -> None:
    port, servo = Port(line), line.servos[1]
    servo.forced_error = 0x20
    handler.ping(port, 1)
    servo.forced_error = 0
    _, _, error = handler.ping(port, 1)
    assert error & dynamixel_wire.ALERT
    handler.write1ByteTxRx(port, 1, 64, 1)
    assert servo.table[64] == 0
    handler.reboot(port, 1)
    assert servo.table[70] == 0


def test_an_error_that_does_not_shut_down_leaves_the_torque_and_ends_with_its_cause(
    line: DynamixelLineMock, handler: Any
) -> None:
    port, servo = Port(line), line.servos[1]
    handler.write1ByteTxRx(port, 1, 64, 1)
    struct.pack_into("<H", servo.table, 34, 121)  # lowest voltage, 0.1 V
    handler.ping(port, 1)
    assert (servo.table[64], servo.table[70]) == (1, 0x01)
    struct.pack_into("<H", servo.table, 34, 95)
    handler.ping(port, 1)
    assert (servo.table[64], servo.table[70]) == (1, 0)
    servo.table[63] |= 0x01
    struct.pack_into("<H", servo.table, 34, 121)
    handler.ping(port, 1)
    assert (servo.table[64], servo.table[70]) == (0, 0x01)


def test_any_single_flipped_bit_of_a_status_packet_is_noticed(line: DynamixelLineMock) -> None:
    line.servos[1].tick(0.05, 0.0, 12.0)
    status = line.servos[1].answer(0x02, struct.pack("<HH", 132, 4), 0.1)
    assert status is not None
    read = dynamixel_wire.status_in(status)
    assert read is not None
    assert read.parameters == struct.pack("<i", 1024)
    for bit in range(8 * len(status)):
        flipped = bytearray(status)
        flipped[bit // 8] ^= 1 << bit % 8
        try:
            assert dynamixel_wire.status_in(bytes(flipped)) is None
        except ValueError:
            continue


def test_models_and_where_they_have_their_values_are_those_of_the_vendors_tables() -> None:
    tables = pytest.importorskip("dynamixel_easy_sdk").__path__[0]
    folder = Path(tables) / "control_table"
    numbers = dict(line.split() for line in (folder / "dynamixel.model").read_text().splitlines()[1:])
    for number, name in MODELS.items():
        if not (file := numbers.get(str(number))):
            assert number == 1280  # in its Arduino library alone
            continue
        assert file == name.lower().replace("-", "_") + ".model"
        items = {line.split("\t")[2]: tuple(map(int, line.split("\t")[:2])) for line in _items(folder / file)}
        effort = "Present Load" if number in WITH_LOAD else "Present Current"
        assert (items[effort], items["Present Position"], items["Goal Position"]) == ((126, 2), (132, 4), (116, 4))
        assert (items["Present Input Voltage"], items["Bus Watchdog"], items["Shutdown"]) == ((144, 2), (98, 1), (63, 1))


def test_no_x_servo_of_the_vendors_tables_is_refused() -> None:
    tables = pytest.importorskip("dynamixel_easy_sdk").__path__[0]
    lines = (Path(tables) / "control_table" / "dynamixel.model").read_text().splitlines()[1:]
    x_series = {
        int(number) for number, name in map(str.split, lines) if name.lstrip("2").startswith("x") and name != "xl320.model"
    }
    assert x_series <= MODELS.keys()


def _items(file: Path) -> list[str]:
    return [line for line in file.read_text().split("[control table]")[1].splitlines()[2:] if line.strip()]
