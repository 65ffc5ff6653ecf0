"""The vendor's client (moteus, from PyPI) makes the frames that ours are, byte for byte, and drives the mock."""

import asyncio
import math
from types import SimpleNamespace
from typing import Any

import pytest

from firmware_iface import moteus as wire
from hil_mocks.devices.moteus import MoteusMock, MoteusSetup

moteus = pytest.importorskip("moteus")
ID = 5


class Transport:
    """What the client takes for its bus: the mock answers, and its control period passes."""

    def __init__(self, mock: MoteusMock) -> None:
        self.mock, self.now_s = mock, 0.0

    async def cycle(self, commands: list[Any]) -> list[Any]:
        for command in commands:
            can_id = command.source << 8 | command.destination | (0x8000 if command.reply_required else 0)
            self.mock.receive(can_id, bytes(command.data), self.now_s)
            self.now_s += 0.001
            self.mock.tick(self.now_s, 1.5, 24.0)
        answers, self.mock.outgoing = self.mock.outgoing, []
        results = [SimpleNamespace(arbitration_id=can_id, data=payload) for can_id, payload in answers]
        return [command.parse(result) for command, result in zip(commands, results, strict=False)]

    async def read(self) -> None:
        raise TimeoutError


def controller(mock: MoteusMock | None = None) -> Any:
    """A client whose questions and commands have the resolutions that are used here."""
    asked = moteus.QueryResolution()
    asked.voltage, asked.q_current, asked.aux1_gpio = moteus.INT16, moteus.F32, moteus.INT8
    asked._extra = {0x070: moteus.INT32}
    said = moteus.PositionResolution()
    for name in ("kp_scale", "kd_scale", "ilimit_scale", "maximum_torque", "watchdog_timeout", "feedforward_torque"):
        setattr(said, name, moteus.F32)
    transport = None if mock is None else Transport(mock)
    return moteus.Controller(ID, query_resolution=asked, position_resolution=said, transport=transport)


def unpadded(frame: wire.Frame) -> bytes:
    return frame[1].rstrip(bytes((wire.NOP,)))


def test_commands_and_questions_are_the_clients_byte_for_byte() -> None:
    client = controller()
    at = client.make_position(
        position=1.5,
        velocity=-0.25,
        feedforward_torque=0.1,
        kp_scale=1.0,
        kd_scale=1.0,
        maximum_torque=0.6,
        watchdog_timeout=0.1,
        velocity_limit=-1.0,
        accel_limit=-1.0,
        ilimit_scale=1.0,
        query=True,
    )
    assert unpadded(wire.position(ID, wire.Position(1.5, -0.25, 0.1, 1.0, 0.6, 0.1))) == at.data
    torque = client.make_position(
        position=math.nan,
        velocity=0.0,
        feedforward_torque=-0.2,
        kp_scale=0.0,
        kd_scale=0.0,
        maximum_torque=0.6,
        watchdog_timeout=0.1,
        velocity_limit=-1.0,
        accel_limit=-1.0,
        ilimit_scale=0.0,
        query=True,
    )
    assert unpadded(wire.position(ID, wire.torque(-0.2, 0.6, 0.1))) == torque.data
    for ours, theirs in (
        (wire.brake(ID), client.make_brake(query=True)),
        (wire.stop(ID), client.make_stop(query=True)),
        (wire.ask(ID), client.make_query()),
    ):
        assert unpadded(ours) == theirs.data
        assert ours[0] == 0x8000 | theirs.destination


def test_the_client_reads_what_the_mock_answers_and_the_mock_obeys_it() -> None:
    mock = MoteusMock(MoteusSetup(ID, 0.05, 8.0), lambda: -2.125)
    mock.is_home = True
    client = controller(mock)

    async def talk() -> None:
        values = (await client.query()).values
        register = moteus.Register
        assert values[register.POSITION] == -2.125
        assert (values[register.VOLTAGE], values[register.MODE], values[register.AUX1_GPIO_STATUS]) == (24.0, 0, 1)
        await client.set_position(
            position=math.nan,
            kp_scale=0.0,
            kd_scale=0.0,
            ilimit_scale=0.0,
            feedforward_torque=0.1,
            watchdog_timeout=0.1,
            query=True,
        )
        assert mock.output.value == pytest.approx(2.0)
        values = (await client.set_brake(query=True)).values
        assert values[register.MODE] == 10  # as it was when the command came
        values = (await client.query()).values
        assert (values[register.MODE], values[register.Q_CURRENT]) == (15, 1.5)
        await client.set_stop()
        assert (mock.mode, mock.output.kind) == (0, "open")

    asyncio.run(talk())


def test_the_clients_stream_reads_a_setting_of_the_mock_and_its_frames_are_ours() -> None:
    client = controller()
    assert unpadded(wire.say(ID, b"conf get id.id\n")) == client.make_diagnostic_write(b"conf get id.id\n").data
    assert unpadded(wire.ask_text(ID)) == client.make_diagnostic_read().data
    mock = MoteusMock(MoteusSetup(ID, 0.05, 8.0), lambda: 0.0)
    stream = moteus.Stream(controller(mock), use_flow_control=False)

    async def talk() -> None:
        kv = await stream.command(b"conf get motor.Kv", allow_any_response=True)
        assert 8.27 / float(kv) == pytest.approx(0.05, rel=1e-3)
        assert await stream.command(b"conf get no.such", allow_any_response=True) == b"ERR error reading"

    asyncio.run(talk())


def test_a_position_without_a_limit_of_its_own_is_gone_to_by_the_stored_acceleration() -> None:
    turns = [0.0]
    mock = MoteusMock(MoteusSetup(ID, 0.05, 8.0), lambda: turns[0])
    client = controller(mock)

    async def goal_after(**limits: float) -> float:
        await client.set_stop()
        await client.set_position(position=1.0, watchdog_timeout=math.nan, query=True, **limits)
        for _ in range(50):
            await client.query()
        return mock._motor.goal_turns

    assert asyncio.run(goal_after()) == pytest.approx(0.5 * 50.0 * 0.05**2, rel=0.1)
    assert asyncio.run(goal_after(accel_limit=-1.0)) == 1.0


async def _seen(client: Any, register: int, kind: int = moteus.F32) -> Any:
    return (await client.custom_query({register: kind})).values[register]


FIELD_V = 2.0 * math.sin(math.pi / 2 - 14 * math.pi * 0.25)  # of 2 V at a right angle, on a rotor of 7 pole pairs at 0.25 turns
STANDS = {"position": math.nan, "kp_scale": 0.0, "kd_scale": 0.0, "ilimit_scale": 0.0}
# What each call that commands makes of the mock, whose motor stands at 0.25 turns: mode and output.
COMMANDS: dict[str, tuple[dict[str, Any], int, tuple[str, Any]]] = {
    "set_stop": ({}, 0, ("open", 0.0)),
    "set_brake": ({}, 15, ("voltage", 0.0)),
    "set_position": ({**STANDS, "feedforward_torque": 0.1}, 10, ("current", pytest.approx(2.0))),
    "set_vfoc": ({"theta": math.pi / 2, "voltage": 2.0}, 7, ("voltage", pytest.approx(FIELD_V))),
    "set_current": ({"d_A": 0.0, "q_A": 2.5}, 9, ("current", 2.5)),
    "set_zero_velocity": ({"kd_scale": 0.5}, 12, ("voltage", pytest.approx(0.0, abs=1e-9))),
    "set_stay_within": ({"lower_bound": 0.0, "upper_bound": 1.0, "feedforward_torque": 0.1}, 13, ("current", pytest.approx(2.0))),
}
# Calls that set something else, and what is read of it.
SETS: dict[str, tuple[dict[str, Any], int, Any]] = {
    "set_output": ({"position": 3.0, "cmd": 0x131}, 0x001, 3.0),
    "set_output_exact": ({"position": 3.0}, 0x001, 3.0),
    "set_output_nearest": ({"position": 3.0}, 0x001, 3.25),
    "set_rezero": ({"rezero": 3.0}, 0x001, 3.25),
    "set_require_reindex": ({}, 0x00C, 0),
    "set_write_gpio": ({"aux1": 5, "aux2": 2}, 0x05D, 2),
    "set_trim": ({"trim": -3}, 0x071, -3),
    "set_aux_pwm": ({"aux1_pwm2": 0.5, "aux2_pwm5": 0.25}, 0x07F, pytest.approx(0.25, abs=1e-4)),
}
ELSEWHERE = {
    "query",
    "custom_query",
    "read_gpio",
    "diagnostic_read",
    "diagnostic_read_flow",
    "send_diagnostic_write",
    "set_position_wait_complete",
    "set_recapture_position_velocity",
}
STREAM = {
    "command",
    "drain",
    "flush_read",
    "read",
    "read_binary_blob",
    "read_data",
    "read_until_OK",
    "readline",
    "write",
    "write_message",
}


def test_no_call_of_the_vendors_client_is_left_out() -> None:
    offered = {name for name in dir(moteus.Controller) if not name.startswith("_")}
    assert {name for name in offered if not name.startswith("make_")} == {
        *COMMANDS,
        *SETS,
        *ELSEWHERE,
        "execute",
        "flush_transport",
    }
    frames = {name.removeprefix("make_") for name in offered if name.startswith("make_")}
    sent = {*COMMANDS, *SETS, *ELSEWHERE}
    assert frames <= sent | {name.removeprefix("set_").removeprefix("send_") for name in sent}
    assert {name for name in dir(moteus.Stream) if not name.startswith("_")} == STREAM


@pytest.mark.parametrize("call", COMMANDS)
def test_what_the_client_commands_is_done(call: str) -> None:
    mock = MoteusMock(MoteusSetup(ID, 0.05, 8.0), lambda: 0.25)
    given, mode, output = COMMANDS[call]

    async def talk() -> None:
        client = controller(mock)
        await getattr(client, call)(query=True, **given)
        assert (mock.mode, mock.output) == (mode, output)
        assert await _seen(client, 0x000, moteus.INT8) == mode

    asyncio.run(talk())


@pytest.mark.parametrize("call", SETS)
def test_what_the_client_sets_is_read_back(call: str) -> None:
    mock = MoteusMock(MoteusSetup(ID, 0.05, 8.0), lambda: 0.25)
    given, register, expected = SETS[call]

    async def talk() -> None:
        client = controller(mock)
        before = await _seen(client, register)
        await getattr(client, call)(**given)
        mock.tick(0.1, 0.0, 24.0)
        assert before != expected
        assert await _seen(client, register) == expected

    asyncio.run(talk())


def test_every_register_of_the_client_that_can_be_read_is_answered_in_all_its_types() -> None:
    mock = MoteusMock(MoteusSetup(ID, 0.05, 8.0), lambda: 0.25)
    client = controller(mock)
    write_only = {0x130, 0x131, 0x132, 0x133, *range(0x154, 0x158)}

    async def talk() -> None:
        for register in {int(register) for register in moteus.Register} - write_only:
            for kind in (moteus.INT16, moteus.INT32, moteus.F32):
                await _seen(client, register, kind)
        assert await client.read_gpio() == bytes(2)

    asyncio.run(talk())


def test_a_frame_for_another_uuid_is_not_obeyed() -> None:
    mock = MoteusMock(MoteusSetup(ID, 0.05, 8.0), lambda: 0.25)
    for uuid, mode in ((99, 0), (1, 15)):
        mock.receive(ID, b"\x09\xd4\x02" + uuid.to_bytes(4, "little") + b"\x01\x00\x0f", 0.0)
        assert mock.mode == mode


def test_it_stays_within_bounds_and_a_stop_position_ends_a_speed() -> None:
    turns = [0.25]
    mock = MoteusMock(MoteusSetup(ID, 0.05, 8.0), lambda: turns[0])
    client = controller(mock)

    async def talk() -> None:
        for turns[0], sign in ((0.25, 0), (1.5, -1), (-0.5, 1)):
            await client.set_stay_within(lower_bound=0.0, upper_bound=1.0, watchdog_timeout=math.nan, query=True)
            await client.query()
            assert math.copysign(bool(mock.output.value), mock.output.value) == sign
        await client.set_stay_within(lower_bound=0.0, upper_bound=1.0, kp_scale=0.0, query=True)
        assert mock.output.kind == "open"
        turns[0] = 0.0
        await client.set_stop()
        await client.set_position(
            position=math.nan, velocity=2.0, stop_position=0.01, accel_limit=-1.0, watchdog_timeout=math.nan, query=True
        )
        for _ in range(20):
            await client.query()
        assert await _seen(client, 0x038) == pytest.approx(0.01)
        await client.set_recapture_position_velocity()
        await client.query()
        assert await _seen(client, 0x038) == 0.0
        await client.set_stop()
        there = await client.set_position_wait_complete(
            position=0.02, velocity_limit=1.0, accel_limit=50.0, watchdog_timeout=math.nan, period_s=0.0
        )
        assert there.values[moteus.Register.TRAJECTORY_COMPLETE]
        assert mock._motor.goal_turns == pytest.approx(0.02, abs=1e-5)
        assert mock._now_s > 0.03  # 20 ms at most speed, and 20 to come to it and to slow down

    asyncio.run(talk())


@pytest.mark.parametrize("has_flow_control", [False, True, None])
def test_the_clients_stream_sets_stores_and_reads(has_flow_control: bool | None) -> None:
    mock = MoteusMock(MoteusSetup(ID, 0.05, 8.0), lambda: 0.25)
    client = controller(mock)
    stream = moteus.Stream(client, use_flow_control=has_flow_control)

    async def talk() -> None:
        assert await stream.command(b"conf set servo.max_current_A 5") == b""
        await stream.write_message(b"conf enumerate")
        assert b"servo.max_current_A 5\n" in await stream.read_until_OK()
        for then, expected in ((b"conf load", b"8.000000"), (b"conf default", b"8.000000")):
            await stream.command(then)
            assert await stream.command(b"conf get servo.max_current_A", allow_any_response=True) == expected
        await stream.command(b"conf set servo.timeout_mode 15")
        await stream.command(b"conf write")
        mock.power_up(None)
        await client.set_position(position=0.25, watchdog_timeout=0.001, query=True)
        await client.query()
        await client.query()
        assert (mock.mode, mock.output) == (11, ("voltage", 0.0))
        assert await stream.command(b"tel list") == b"servo_stats\n"
        assert tuple(await stream.read_data("servo_stats")) == (11, True, 0.25)
        with pytest.raises(moteus.CommandError, match="unknown command"):
            await stream.command(b"d flash")
        await stream.flush_read(timeout=0.001)

    asyncio.run(talk())


def test_what_was_lost_of_the_stream_is_said_again() -> None:
    mock = MoteusMock(MoteusSetup(ID, 0.05, 8.0), lambda: 0.25)
    client = controller(mock)

    async def talk() -> None:
        await client.send_diagnostic_write(data=b"conf get motor.poles\n")
        said = [(await client.diagnostic_read_flow(packet_number=number, max_length=2))[0] for number in (0, 0, 1)]
        assert [(one.packet_number, one.data) for one in said] == [(1, b"14"), (1, b"14"), (2, b"\r\n")]
        await client.send_diagnostic_write(data=b"conf get motor.poles\n")
        assert (await client.diagnostic_read())[0].data == b"14\r\n"

    asyncio.run(talk())
