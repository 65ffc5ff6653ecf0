"""The vendor's client (basicmicro, from PyPI) drives the mock RoboClaw, and its bytes are ours."""

from typing import Any

import pytest

from firmware_iface import roboclaw
from firmware_iface.roboclaw import RoboclawCommand
from hil_mocks.devices.roboclaw import E_STOP, FULL, RoboClawLineMock, RoboClawMock

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


# Calls that set something: what, the call that reads it back, and what that says, if that is something else.
SETS: dict[str, tuple[tuple[Any, ...], str, Any]] = {
    "SetTimeout": ((0.5,), "GetTimeout", None),
    "SetM1VelocityPID": ((1.5, 0.25, 0.125, 4400), "ReadM1VelocityPID", None),
    "SetM2VelocityPID": ((2.0, 0.5, 0.25, 5000), "ReadM2VelocityPID", None),
    "SetM1PositionPID": ((2.0, 1.0, 0.5, 9, 8, 7, 6), "ReadM1PositionPID", None),
    "SetM2PositionPID": ((3.0, 1.0, 0.5, 1, 2, 3, 4), "ReadM2PositionPID", None),
    "SetMainVoltages": ((70, 300, 1), "ReadMinMaxMainVoltages", None),
    "SetLogicVoltages": ((45, 340), "ReadMinMaxLogicVoltages", None),
    "SetM1DefaultAccel": ((1000, 2000), "GetDefaultAccels", (1000, 2000, 655_359, 655_359)),
    "SetM2DefaultAccel": ((3000, 4000), "GetDefaultAccels", (655_359, 655_359, 3000, 4000)),
    "SetM1DefaultSpeed": ((800,), "GetDefaultSpeeds", (800, 0)),
    "SetM2DefaultSpeed": ((900,), "GetDefaultSpeeds", (0, 900)),
    "SetPinFunctions": ((1, 0x62, 4, 2, 3), "ReadPinFunctions", None),
    "SetCtrlSettings": (tuple(range(1, 15)), "GetCtrlSettings", None),
    "SetM1EncoderMode": ((0x20,), "ReadEncoderModes", (0x20, 0)),
    "SetM2EncoderMode": ((0x40,), "ReadEncoderModes", (0, 0x40)),
    "SetSerialNumber": (("arm 7",), "GetSerialNumber", None),
    "SetConfig": ((0x8063,), "GetConfig", None),
    "SetAuxDutys": ((1, 2, 3, 4, 5), "GetAuxDutys", None),
    "SetAuto1": ((60_000,), "GetAutos", (60_000, 0)),
    "SetAuto2": ((70_000,), "GetAutos", (0, 70_000)),
    "SetSpeedErrorLimit": ((10, 20), "GetSpeedErrorLimit", None),
    "SetPosErrorLimit": ((30, 40), "GetPosErrorLimit", None),
    "SetOffsets": ((5, 6), "GetOffsets", None),
    "SetM1LR": ((0.5, 0.25), "GetM1LR", None),
    "SetM2LR": ((0.125, 2.0), "GetM2LR", None),
    "SetM1MaxCurrent": ((1000, 0), "ReadM1MaxCurrent", None),
    "SetM2MaxCurrent": ((2000, 0), "ReadM2MaxCurrent", None),
    "SetDOUT": ((1, 7), "GetDOUTS", (2, [0, 7])),
    "SetPriority": ((2, 1, 0), "GetPriority", None),
    "SetAddressMixed": ((0x81, 0), "GetAddressMixed", None),
    "SetSignal": ((2, *range(3, 20)), "GetSignals", (8, [{}, {}, dict(enumerate(range(3, 20))), *[{}] * 5])),
    "SetStream": ((1, 2, 115_200, 50), "GetStreams", (3, [{}, dict(enumerate((2, 115_200, 50))), {}])),
    "SetPWMMode": ((1, 0), "ReadPWMMode", None),
    "SetNodeID": ((7,), "GetNodeID", None),
    "SetPWMIdle": ((1.5, True, 0.0, False), "GetPWMIdle", None),
    "SetEStopLock": ((0x55,), "GetEStopLock", None),
    "SetScriptAutoRun": ((1000,), "GetScriptAutoRun", None),
}
# Calls that move: what, and by how many counts the motors have turned a second later, or which duties they have then.
MOVES: dict[str, tuple[tuple[Any, ...], tuple[float, float]]] = {
    "DutyM1": ((8192,), (0.25, 0)),
    "DutyM2": ((8192,), (0, 0.25)),
    "DutyM1M2": ((16384, -8192), (0.5, -0.25)),
    "DutyAccelM1": ((16384, 16384), (0.5, 0)),
    "DutyAccelM2": ((16384, 8192), (0, 0.25)),
    "DutyAccelM1M2": ((16384, 16384, 16384, -8192), (0.5, -0.25)),
    "SpeedM1": ((2000,), (2000, 0)),
    "SpeedM2": ((-2000,), (0, -2000)),
    "SpeedM1M2": ((2000, -1000), (2000, -1000)),
    "SpeedAccelM1": ((2000, 2000), (1000, 0)),
    "SpeedAccelM2": ((2000, -2000), (0, -1000)),
    "SpeedAccelM1M2": ((2000, 2000, -1000), (1000, -750)),
    "SpeedAccelM1M2_2": ((2000, 2000, 1000, -1000), (1000, -500)),
    "SpeedDistanceM1": ((4000, 1500, 1), (1500, 0)),
    "SpeedDistanceM2": ((-4000, 1500, 1), (0, -1500)),
    "SpeedDistanceM1M2": ((4000, 1500, -4000, 500, 1), (1500, -500)),
    "SpeedAccelDistanceM1": ((9000, 4000, 1500, 1), (1500, 0)),
    "SpeedAccelDistanceM2": ((9000, -4000, 1500, 1), (0, -1500)),
    "SpeedAccelDistanceM1M2": ((9000, 4000, 1500, -4000, 500, 1), (1500, -500)),
    "SpeedAccelDistanceM1M2_2": ((9000, 4000, 1500, 9000, -4000, 500, 1), (1500, -500)),
    "SpeedAccelDeccelPositionM1": ((9000, 4000, 9000, 1500, 1), (1500, 0)),
    "SpeedAccelDeccelPositionM2": ((9000, 4000, 9000, -1500 % 2**32, 1), (0, -1500)),
    "SpeedAccelDeccelPositionM1M2": ((9000, 4000, 9000, 1500, 9000, 4000, 9000, -500 % 2**32, 1), (1500, -500)),
    "PositionM1": ((1500, 1), (1500, 0)),
    "PositionM2": ((-1500 % 2**32, 1), (0, -1500)),
    "PositionM1M2": ((1500, -500 % 2**32, 1), (1500, -500)),
    "SpeedPositionM1": ((4000, 1500, 1), (1500, 0)),
    "SpeedPositionM2": ((4000, 1500, 1), (0, 1500)),
    "SpeedPositionM1M2": ((4000, 1500, 4000, -500 % 2**32, 1), (1500, -500)),
    "PercentPositionM1": ((16384, 1), (1000, 0)),
    "PercentPositionM2": ((-16384, 1), (0, -1000)),
    "PercentPositionM1M2": ((16384, -16384, 1), (1000, -1000)),
}
# Calls that read what is measured, of a board at 24 V whose counters are at 990 and 5, with 1.5 and 2 A.
READS: dict[str, tuple[Any, ...]] = {
    "ReadEncM1": (990, 0),
    "ReadEncM2": (5, 0),
    "GetEncoders": (990, 5),
    "ReadSpeedM1": (0xFFFF_FF9C, 1),
    "ReadSpeedM2": (100, 0),
    "ReadISpeedM1": (0xFFFF_FF9C, 1),
    "ReadISpeedM2": (100, 0),
    "GetSpeeds": (0xFFFF_FF9C, 100),
    "GetISpeeds": (0xFFFF_FF9C, 100),
    "ReadMainBatteryVoltage": (240,),
    "ReadLogicBatteryVoltage": (50,),
    "GetVolts": (240, 50),
    "ReadTemp": (300,),
    "ReadTemp2": (300,),
    "GetTemps": (300, 300),
    "ReadCurrents": (150, 200),
    "ReadPWMs": (16384, -8192),
    "ReadBuffers": (0x80, 0x80),
    "ReadError": (0x2_0000,),
    "GetEncStatus": (0, 0),
    "GetSpeedErrors": (0, 0),
    "GetPosErrors": (0, 0),
    "CANGetESR": (0,),
    "ReadVersion": (RoboClawMock.version,),
    "GetStatus": (700, 0x2_0000, 300, 300, 240, 50, 16384, -8192 % 2**16, 150, 200, 990, 5, 0, 0, 0xFFFF_FF9C, 100, 0, 0, 0, 0),
    "GetSignalsData": (2, [dict.fromkeys(("command", "position", "percent", "speed", "speeds"), 0)] * 2),
}
ELSEWHERE = {
    "SetEncM1",
    "SetEncM2",
    "ResetEncoders",
    "WriteNVM",
    "ReadNVM",
    "RestoreDefaults",
    "ResetEStop",
    "StartScript",
    "StopScript",
    "CANPutPacket",
    "CANGetPacket",
    "CANOpenWriteLocalDict",
    "CANOpenReadLocalDict",
    "ReadEeprom",
    "WriteEeprom",
    "ForwardMixed",
    "BackwardMixed",
    "TurnRightMixed",
    "TurnLeftMixed",
    "ForwardBackwardMixed",
    "LeftRightMixed",
}
# Of these, 2.0.10 sends but a head: it makes DutyAccelM1 and M2 of them, and passes a fraction where it needs a whole number.
HALF_SENT = {"ForwardM1", "BackwardM1", "ForwardM2", "BackwardM2", "ForwardBackwardM1", "ForwardBackwardM2"}
NO_COMMAND = {  # of the port, of words, noise, and what the client itself refuses as deprecated
    "Open",
    "close",
    "reconnect",
    "is_connected",
    "crc_clear",
    "crc_update",
    "SendRandomData",
    "decode_error_status",
    "decode_warning_status",
    "decode_full_status",
    "analyze_roboclaw_status",
    "print_status_analysis",
    "SetMinVoltageMainBattery",
    "SetMaxVoltageMainBattery",
    "SetMinVoltageLogicBattery",
    "SetMaxVoltageLogicBattery",
}


def test_no_call_of_the_vendors_client_is_left_out() -> None:
    offered = {name for name in dir(basicmicro.Basicmicro) if not name.startswith("_") and not name.isupper()}
    read_back = {reads for _, reads, _ in SETS.values()}
    assert offered == {*SETS, *read_back, *MOVES, *READS} | ELSEWHERE | HALF_SENT | NO_COMMAND


def plain(said: Any) -> Any:
    """Rows as their values in order, those that are all 0 as none."""
    if isinstance(said, dict):
        return dict(enumerate(said.values())) if any(said.values()) else {}
    return [plain(one) for one in said] if isinstance(said, list | tuple) else said


@pytest.mark.parametrize("writes", SETS)
def test_what_the_vendors_client_sets_it_reads_back_also_when_it_was_saved(
    claw: tuple[Any, Port, RoboClawMock], writes: str
) -> None:
    client, _, board = claw
    values, reads, said = SETS[writes]
    expected = list(values if said is None else said)
    before = plain(getattr(client, reads)(0x80)[1:])
    assert before != expected
    assert getattr(client, writes)(0x80, *values)
    assert plain(getattr(client, reads)(0x80)[1:]) == expected
    assert client.ReadNVM(0x80)
    assert plain(getattr(client, reads)(0x80)[1:]) == before
    assert getattr(client, writes)(0x80, *values)
    assert client.WriteNVM(0x80)
    board.power_up()
    assert plain(getattr(client, reads)(0x80)[1:]) == expected
    assert client.RestoreDefaults(0x80)
    assert plain(getattr(client, reads)(0x80)[1:]) == before


@pytest.mark.parametrize("moves", MOVES)
def test_what_the_vendors_client_moves_moves(claw: tuple[Any, Port, RoboClawMock], moves: str) -> None:
    client, _, board = claw
    shafts = [0.0, 0.0]
    board._read_shaft = lambda channel: round(shafts[channel])
    board.power_up()
    for number in (1, 2):
        getattr(client, f"SetM{number}VelocityPID")(0x80, 0.25, 1.0, 0.0, 5000)
        getattr(client, f"SetM{number}PositionPID")(0x80, 0.0, 0.0, 0.0, 0, 0, -2000 % 2**32, 2000)
    values, turned = MOVES[moves]
    assert getattr(client, moves)(0x80, *values)
    for step in range(1, 1501):
        board._obeyed_s = 0.001 * step
        board.tick(0.001 * step, [0.0, 0.0], 24.0, [False, False])
        shafts = [shaft + 5.0 * duty / FULL for shaft, duty in zip(shafts, board.duty, strict=True)]
        if step == 1000:
            after_1_s = list(shafts)
    if all(abs(share) <= 1.0 for share in turned):
        assert [duty / FULL for duty in board.duty] == pytest.approx(turned, abs=0.01)
    else:
        at = shafts if "istance" in moves or "osition" in moves else after_1_s
        assert at == pytest.approx(turned, abs=12)


@pytest.mark.parametrize("half_sent", sorted(HALF_SENT))
def test_what_the_vendors_client_does_not_finish_moves_nothing(claw: tuple[Any, Port, RoboClawMock], half_sent: str) -> None:
    client, _, board = claw
    with pytest.raises(basicmicro.exceptions.PacketTimeoutError):
        getattr(client, half_sent)(0x80, 64)
    assert board.movements == [{"u": 0}, {"u": 0}]


def test_movements_wait_for_the_end_of_the_one_that_lasts(claw: tuple[Any, Port, RoboClawMock]) -> None:
    client, _, board = claw
    shaft = 0.0
    board._read_shaft = lambda channel: round(shaft) if channel == 0 else 0
    board.power_up()
    assert client.SetM1VelocityPID(0x80, 0.25, 1.0, 0.0, 44_000)
    assert client.SpeedDistanceM1(0x80, 4000, 300, 1)
    assert client.SpeedDistanceM1(0x80, -4000, 100, 0)
    assert client.ReadBuffers(0x80)[1:] == (1, 0x80)
    most = 0.0
    for step in range(1, 2001):
        board._obeyed_s = 0.001 * step
        board.tick(0.001 * step, [0.0, 0.0], 24.0, [False, False])
        shaft += 44.0 * board.duty[0] / FULL
        most = max(most, shaft)
    assert most == pytest.approx(300, abs=30)
    assert shaft == pytest.approx(most - 100, abs=30)
    assert client.ReadBuffers(0x80)[1:] == (0x80, 0x80)


@pytest.mark.parametrize("reads", READS)
def test_the_vendors_client_reads_what_is_measured(claw: tuple[Any, Port, RoboClawMock], reads: str) -> None:
    client, _, board = claw
    client.DutyM1M2(0x80, 16384, -8192)
    for counts in ((1000, -5), (1000, -5), (990, 5)):
        board._read_shaft = counts.__getitem__
        board._offsets = [0, 0]
        board.tick(board._ticked_s + 0.1 if board._ticked_s else 0.5, [1.5, -2.0], 24.0, [False, True])
    said = getattr(client, reads)(0x80)
    assert said[0]
    assert tuple(one.strip() if isinstance(one, str) else one for one in said[1:]) == READS[reads]


def test_the_vendors_client_sets_counts_and_ends_an_emergency_stop(claw: tuple[Any, Port, RoboClawMock]) -> None:
    client, _, board = claw
    assert client.SetEncM1(0x80, 1234)
    assert client.SetEncM2(0x80, 7)
    assert client.GetEncoders(0x80) == (1, 1234, 7)
    assert client.ResetEncoders(0x80)
    assert client.GetEncoders(0x80) == (1, 0, 0)
    board.forced_errors = E_STOP
    assert client.ResetEStop(0x80)
    assert not client.ReadError(0x80)[1]


def test_the_vendors_client_mixes_forward_and_turn(claw: tuple[Any, Port, RoboClawMock]) -> None:
    client, _, board = claw
    for forward, backward, right, left in (
        (client.ForwardMixed, client.BackwardMixed, client.TurnRightMixed, client.TurnLeftMixed),
        (client.ForwardBackwardMixed, client.ForwardBackwardMixed, client.LeftRightMixed, client.LeftRightMixed),
    ):
        for call in (forward, right, backward, left):
            client._ST_Power = client._ST_Turn = 0
            board.movements = [{}, {}]
            assert call(0x80, 100)
            assert {abs(movement["u"]) for movement in board.movements} != {0}


def test_the_vendors_client_has_memory_scripts_and_a_can_bus(claw: tuple[Any, Port, RoboClawMock]) -> None:
    client, _, board = claw
    assert client.WriteEeprom(0x80, 3, 0xBEEF)
    board.power_up()
    assert client.ReadEeprom(0x80, 3) == (True, 0xBEEF)
    assert client.StartScript(0x80)
    assert client.StopScript(0x80)
    assert client.CANPutPacket(0x80, 0x181, 0, [1, 2, 3])
    assert board.can_sent == [b"\x01\x81\0\3\1\2\3\0\0\0\0\0"]
    assert client.CANGetPacket(0x80) == (True, False, 0, 0, 0, [])
    board.can_heard.append(board.can_sent[0])
    assert client.CANGetPacket(0x80) == (True, True, 0x181, 0, 3, [1, 2, 3, 0, 0, 0, 0, 0])
    assert client.CANOpenWriteLocalDict(0x80, 1, 0x6040, 0, 6, 2) == (True, 0)
    assert client.CANOpenReadLocalDict(0x80, 1, 0x6040, 0) == (True, 6, 2, 0, 0)
    assert client.CANOpenReadLocalDict(0x80, 1, 0x6041, 0)[4] == 0x0602_0000


def test_a_packet_with_a_wrong_address_is_not_answered(claw: tuple[Any, Port, RoboClawMock]) -> None:
    client, _, _ = claw
    with pytest.raises(basicmicro.exceptions.PacketTimeoutError):
        client.GetEncoders(0x81)


def test_our_packets_are_the_vendors_byte_for_byte(claw: tuple[Any, Port, RoboClawMock]) -> None:
    client, port, _ = claw
    ours = b"".join(
        (
            roboclaw.command_packet(0x80, RoboclawCommand.DUTY_M1_M2, roboclaw.duty_data(16384, -8192)),
            roboclaw.command_packet(0x80, RoboclawCommand.SET_SERIAL_TIMEOUT, b"\x02"),
            roboclaw.command_packet(0x80, RoboclawCommand.SET_ENCODER_2, (1000).to_bytes(4, "big")),
            roboclaw.command_packet(0x80, RoboclawCommand.SET_CURRENT_LIMIT_1, (1000).to_bytes(4, "big") + bytes(4)),
            roboclaw.command_packet(0x80, RoboclawCommand.SET_DUTY_ACCELERATION_2, (655_359).to_bytes(4, "big") * 2),
            roboclaw.read_packet(0x80, RoboclawCommand.READ_PIN_MODES),
            roboclaw.read_packet(0x80, RoboclawCommand.READ_ENCODERS),
            roboclaw.read_packet(0x80, RoboclawCommand.READ_STATUS),
            roboclaw.read_packet(0x80, RoboclawCommand.READ_TEMPERATURE),
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
