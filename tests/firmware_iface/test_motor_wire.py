"""The motor board's frames: struct against the DBC and against golden bytes, both ways, at the boundaries."""

import struct
from typing import Any

import cantools
import pytest

from firmware_iface.motor import wire
from firmware_iface.motor.wire import (
    DigitalCommand,
    DigitalReply,
    ParameterAnswer,
    ParameterRequest,
    Reply,
    SetpointMode,
    unpack_reply,
)
from tests.firmware_iface.motor_command import MotorCommand
from tests.places import ROOT

I32 = (-(2**31), -100_000, -1, 0, 1, 2**31 - 1)
SETPOINTS = {SetpointMode.OFF: "SetpointIgnored", SetpointMode.VOLTAGE: "SetpointVoltage"}
SETPOINTS |= {
    SetpointMode.CURRENT: "SetpointCurrent",
    SetpointMode.POSITION: "SetpointPosition",
    SetpointMode.HOLD: "SetpointUnused",
}
FAULTS = [f"Fault{fault.name.title().replace('_', '')}" for fault in wire.MotorFault if fault.name]
NODES = (1, 2, 3)
PARAMETER_SIGNALS = {
    0: "ProtocolVersion",
    1: "BoardSerialNumber",
    2: "FirmwareVersion",
    3: "EncoderCountsPerTurn",
    4: "PositionCount",
    5: "ControlPeriod",
    6: "ResetCause",
    16: "Kp",
    17: "Ki",
    18: "Kd",
    19: "DerivativeFilter",
    20: "CurrentLimit",
    21: "VoltageLimit",
    22: "IntegralLimit",
    23: "SpeedFeedforward",
    32: "Watchdog",
    33: "WatchdogAction",
    34: "DisabledOutput",
    35: "StopAfter",
    36: "StopTime",
    48: "DigitalPins",
    49: "DigitalOutputs",
    50: "DigitalSafeLevels",
    51: "DigitalSafeKeep",
}


@pytest.fixture(scope="module")
def dbc() -> Any:
    return cantools.database.load_file(ROOT / "firmware_iface/motor/motor_board.dbc")


def golden() -> list[tuple[str, int, bytes]]:
    lines = (ROOT / "tests/golden/motor_board.txt").read_text().splitlines()
    rows = [[cell.strip() for cell in line.split("|")] for line in lines if not line.startswith("#")]
    return [(name, int(can_id, 16), bytes.fromhex(payload)) for name, can_id, payload in rows]


Frame = MotorCommand | Reply | ParameterRequest | ParameterAnswer | DigitalCommand | DigitalReply
FRAMES: dict[str, Frame] = {
    "COMMAND voltage": MotorCommand(0x0F, SetpointMode.VOLTAGE, 5, -12_000),
    "COMMAND current": MotorCommand(0x0F, SetpointMode.CURRENT, 31, 1500),
    "COMMAND position": MotorCommand(0x0F, SetpointMode.POSITION, 0, -100_000, 250),
    "COMMAND shutdown": MotorCommand(0x06, SetpointMode.OFF, 1, 0),
    "COMMAND fault reset": MotorCommand(0x80, SetpointMode.OFF, 2, 0),
    "REPLY enabled": Reply(0x37, SetpointMode.VOLTAGE, 5, -2.5, 24.0, 41, 0),
    "REPLY fault": Reply(0x18, SetpointMode.OFF, 9, 0.0, 23.95, -5, wire.MotorFault.WATCHDOG | wire.MotorFault.EMERGENCY_STOP),
    "PARAMETER_REQUEST write kp": ParameterRequest(1, 16, 1, 6135),
    "PARAMETER_ANSWER kp": ParameterAnswer(0, 16, 1, 6135),
    "PARAMETER_REQUEST read serial number": ParameterRequest(0, 1, 2),
    "PARAMETER_ANSWER serial number": ParameterAnswer(0, 1, 2, 0xF0A1B2C3 - 2**32),
    "PARAMETER_ANSWER power-up": ParameterAnswer(0, 0, 0, 1),
    "PARAMETER_ANSWER not in this state": ParameterAnswer(4, 32, 3, 200),
    "PARAMETER_REQUEST write stop_after": ParameterRequest(1, 35, 4, 24),
    "PARAMETER_ANSWER stop_after": ParameterAnswer(0, 35, 4, 24),
    "DIGITAL_COMMAND set": DigitalCommand(7, 0b101, 0b100),
    "DIGITAL_REPLY set": DigitalReply(7, 0b1100, 0b100, 0),
}


def test_every_golden_frame_packs_and_unpacks() -> None:
    for name, _, payload in golden():
        if name == "EMERGENCY_STOP":
            continue
        frame = FRAMES[name]
        assert frame.pack() == payload, name
        if isinstance(frame, Reply):
            assert unpack_reply(payload) == pytest.approx(tuple(map(float, frame)))
        else:
            assert type(frame).unpack(payload) == frame


def test_the_golden_frames_have_the_ids_and_lengths_of_the_dbc(dbc: Any) -> None:
    for name, can_id, payload in golden():
        message = dbc.get_message_by_frame_id(can_id)
        assert message.name.startswith(name.split()[0])
        assert len(payload) == message.length


def test_ids_and_lengths_are_those_of_the_dbc(dbc: Any) -> None:
    bases = {"COMMAND": wire.COMMAND_ID, "REPLY": wire.REPLY_ID}
    bases |= {"PARAMETER_REQUEST": wire.PARAMETER_REQUEST_ID, "PARAMETER_ANSWER": wire.PARAMETER_ANSWER_ID}
    bases |= {"DIGITAL_COMMAND": wire.DIGITAL_COMMAND_ID, "DIGITAL_REPLY": wire.DIGITAL_REPLY_ID}
    expected = {f"{name}_{node}": (base + node, 8) for name, base in bases.items() for node in NODES}
    expected["EMERGENCY_STOP"] = (wire.EMERGENCY_STOP_ID, 1)
    assert {message.name: (message.frame_id, message.length) for message in dbc.messages} == expected


def test_the_nodes_of_the_dbc_are_copies_of_node_1(dbc: Any) -> None:
    for message in dbc.messages:
        if message.name[-1] in "23":
            first = dbc.get_message_by_name(f"{message.name[:-1]}1")
            ours = [(s.name, s.start, s.length, s.is_signed, s.scale, s.unit, s.choices) for s in message.signals]
            assert ours == [(s.name, s.start, s.length, s.is_signed, s.scale, s.unit, s.choices) for s in first.signals]


@pytest.mark.parametrize("mode", SetpointMode)
@pytest.mark.parametrize("setpoint_raw", I32)
@pytest.mark.parametrize("feedforward_mV", [-32768, 0, 32767])
def test_commands_are_those_of_the_dbc(dbc: Any, mode: SetpointMode, setpoint_raw: int, feedforward_mV: int) -> None:
    for sequence in (0, 1, 31):
        command = MotorCommand(0x8F, mode, sequence, setpoint_raw, feedforward_mV)
        signals = dbc.decode_message("COMMAND_1", command.pack(), scaling=False, decode_choices=False)
        assert signals == {
            "Controlword": 0x8F,
            "Mode": mode,
            "Sequence": sequence,
            SETPOINTS[mode]: setpoint_raw,
            "Feedforward": feedforward_mV,
        }
        encoded = dbc.encode_message("COMMAND_1", signals, scaling=False, strict=False)
        assert encoded == command.pack()
        assert MotorCommand.unpack(encoded) == command


@pytest.mark.parametrize("statusword", [0x00, 0x37, 0xFF])
@pytest.mark.parametrize("current_mA", [-32768, -1, 0, 32767])
@pytest.mark.parametrize("supply_mV", [0, 24_000, 65535])
@pytest.mark.parametrize("temperature", [-128, 127])
def test_replies_are_those_of_the_dbc(dbc: Any, statusword: int, current_mA: int, supply_mV: int, temperature: int) -> None:
    for faults in (0, 0x01, 0x80, 0xA5, 0xFF):
        bits = {name: faults >> bit & 1 for bit, name in enumerate(FAULTS)}
        signals = {"Statusword": statusword, "Mode": 3, "EchoedSequence": 31, "Current": current_mA * 1e-3}
        signals |= {"Supply": supply_mV * 1e-3, "Temperature": temperature} | bits
        payload = dbc.encode_message("REPLY_1", signals)
        reply = unpack_reply(payload)
        assert reply == pytest.approx((statusword, 3, 31, current_mA * 1e-3, supply_mV * 1e-3, temperature, faults), abs=1e-9)
        assert reply.pack() == payload


def test_digital_frames_are_those_of_the_dbc(dbc: Any) -> None:
    for byte in (0, 1, 0x55, 0xFF):
        command, reply = DigitalCommand(byte, 0xA5, byte), DigitalReply(byte, 0xA5, byte, 1)
        for name, frame, keys in (
            ("COMMAND", command, ("Sequence", "Mask", "Levels")),
            ("REPLY", reply, ("Sequence", "Levels", "Outputs", "IsSafe")),
        ):
            signals = dbc.decode_message(f"DIGITAL_{name}_1", frame.pack())
            values = [getattr(frame, field) for field in frame.__dataclass_fields__]
            assert signals == dict(zip(keys, values, strict=True))


@pytest.mark.parametrize("index", wire.MotorParameter)
def test_parameters_are_those_of_the_dbc(dbc: Any, index: wire.MotorParameter) -> None:
    signal_name = PARAMETER_SIGNALS[index]
    for kind, first, frame_type in (("REQUEST", "Operation", ParameterRequest), ("ANSWER", "Result", ParameterAnswer)):
        for value in I32:
            payload = frame_type(1, index, 255, value).pack()
            signals = dbc.decode_message(f"PARAMETER_{kind}_1", payload, scaling=False, decode_choices=False)
            as_sent = value & 0xFFFFFFFF if index == wire.MotorParameter.BOARD_SERIAL_NUMBER else value
            assert signals == {first: 1, "Index": index, "Sequence": 255, signal_name: as_sent}
            assert dbc.encode_message(f"PARAMETER_{kind}_1", signals, scaling=False, strict=False) == payload


def test_the_units_in_parameter_names_are_the_scales_of_the_dbc(dbc: Any) -> None:
    scales = {s.name: s.scale for s in dbc.get_message_by_name("PARAMETER_ANSWER_1").signals}
    for index in wire.MotorParameter:
        prefix = index.name.rsplit("_", 1)[-1]
        expected = {"us": 1e-6, "mA": 1e-3, "mV": 1e-3, "ms": 1e-3}.get(prefix, 1)
        expected = {16: 1e-6, 17: 1e-6, 18: 1e-9, 23: 1e-9}.get(index, expected)  # uV, uV, nV
        assert float(scales[PARAMETER_SIGNALS[index]]) == pytest.approx(expected), index.name


def test_choices_of_the_dbc_are_the_enums(dbc: Any) -> None:
    signals = {s.name: s.choices for s in dbc.get_message_by_name("PARAMETER_ANSWER_1").signals if s.choices}
    signals["Mode"] = dbc.get_message_by_name("COMMAND_1").get_signal_by_name("Mode").choices
    request = dbc.get_message_by_name("PARAMETER_REQUEST_1")
    signals["Operation"] = request.get_signal_by_name("Operation").choices
    enums = {
        "Result": wire.ParameterResult,
        "Mode": SetpointMode,
        "Operation": wire.Operation,
        "ResetCause": wire.ResetCause,
        "WatchdogAction": wire.IdleOutput,
    }
    for name, enum in enums.items():
        choices = {number: str(text).upper().replace(" ", "_") for number, text in signals[name].items()}
        assert choices == {member.value: member.name for member in enum}


def test_the_parameters_are_all_that_the_dbc_has(dbc: Any) -> None:
    signals = dbc.get_message_by_name("PARAMETER_ANSWER_1").signals
    found = {number: signal.name for signal in signals for number in signal.multiplexer_ids or []}
    assert found == PARAMETER_SIGNALS
    assert [parameter.value for parameter in wire.MotorParameter.__members__.values()] == sorted(found)


def test_the_document_lists_every_parameter() -> None:
    document = (ROOT / "docs/motor_board.md").read_text().split("## Parameters")[1]
    for index in wire.MotorParameter:
        stem = index.name.lower().split("_uv")[0].split("_nv")[0]
        row = next(line for line in document.splitlines() if line.startswith(f"| {index.value} | `"))
        assert row.lower().startswith(f"| {index.value} | `{stem}"), index.name


@pytest.mark.parametrize(
    "command",
    [MotorCommand(0, 0, 0, 2**31), MotorCommand(0, 0, 0, 0, 32768), MotorCommand(256, 0, 0, 0), MotorCommand(0, 0, 32, 0)],
)
def test_a_number_that_does_not_fit_is_never_cut(command: MotorCommand) -> None:
    with pytest.raises(struct.error):
        command.pack()


def test_a_reply_names_its_state_its_faults_and_its_limit() -> None:
    reply = unpack_reply(bytes.fromhex("98 48 00 00 8e 5d fb 90"))
    assert reply.state is not None
    assert reply.state.value == "FAULT"
    assert reply.fault_flags == wire.MotorFault.WATCHDOG | wire.MotorFault.EMERGENCY_STOP
    assert reply.is_limited
    assert not unpack_reply(bytes.fromhex("37 29 3c f6 c0 5d 29 00")).is_limited
