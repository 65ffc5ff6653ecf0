"""The vendor's client (moteus, from PyPI) makes the frames that ours are, byte for byte, and drives the mock."""

import asyncio
import math
from types import SimpleNamespace
from typing import Any

import pytest

from firmware_iface.moteus import wire
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


def controller(mock: MoteusMock | None = None) -> Any:
    """A client whose questions and commands have the resolutions that are used here."""
    asked = moteus.QueryResolution()
    asked.voltage, asked.q_current, asked.aux1_gpio = moteus.INT16, moteus.F32, moteus.INT8
    asked._extra = {0x070: moteus.INT32}
    said = moteus.PositionResolution()
    for name in (
        "kp_scale",
        "kd_scale",
        "ilimit_scale",
        "maximum_torque",
        "watchdog_timeout",
        "feedforward_torque",
    ):
        setattr(said, name, moteus.F32)
    transport = None if mock is None else Transport(mock)
    return moteus.Controller(ID, query_resolution=asked, position_resolution=said, transport=transport)


def unpadded(frame: wire.Frame) -> bytes:
    return frame[1].rstrip(bytes((wire.NOP,)))


def test_commands_and_questions_are_the_clients_byte_for_byte() -> None:
    client = controller()
    at = client.make_position(
        position=1.5, velocity=-0.25, feedforward_torque=0.1, kp_scale=1.0, kd_scale=1.0, maximum_torque=0.6,
        watchdog_timeout=0.1, velocity_limit=-1.0, accel_limit=-1.0, ilimit_scale=1.0, query=True,
    )  # fmt: skip
    assert unpadded(wire.position(ID, wire.Position(1.5, -0.25, 0.1, 1.0, 0.6, 0.1))) == at.data
    torque = client.make_position(
        position=math.nan, velocity=0.0, feedforward_torque=-0.2, kp_scale=0.0, kd_scale=0.0, maximum_torque=0.6,
        watchdog_timeout=0.1, velocity_limit=-1.0, accel_limit=-1.0, ilimit_scale=0.0, query=True,
    )  # fmt: skip
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
        assert (values[register.VOLTAGE], values[register.MODE], values[register.AUX1_GPIO_STATUS]) == (
            24.0,
            0,
            1,
        )
        await client.set_position(
            position=math.nan, kp_scale=0.0, kd_scale=0.0, ilimit_scale=0.0, feedforward_torque=0.1,
            watchdog_timeout=0.1, query=True,
        )  # fmt: skip
        assert mock.output == ("current", pytest.approx(2.0))
        values = (await client.set_brake(query=True)).values
        assert values[register.MODE] == 10  # as it was when the command came
        values = (await client.query()).values
        assert (values[register.MODE], values[register.Q_CURRENT]) == (15, 1.5)
        await client.set_stop()
        assert (mock.mode, mock.output.kind) == (0, "open")

    asyncio.run(talk())


def test_the_clients_stream_reads_a_setting_of_the_mock_and_its_frames_are_ours() -> None:
    client = controller()
    assert (
        unpadded(wire.say(ID, b"conf get id.id\n")) == client.make_diagnostic_write(b"conf get id.id\n").data
    )
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


def test_the_clients_currents_its_zero_velocity_and_its_set_output_are_obeyed() -> None:
    turns = [0.25]
    mock = MoteusMock(MoteusSetup(ID, 0.05, 8.0), lambda: turns[0])
    client = controller(mock)
    register = moteus.Register

    async def position() -> float:
        return float((await client.query()).values[register.POSITION])

    async def talk() -> None:
        await client.set_current(d_A=0.0, q_A=2.5, query=True)
        assert mock.output == ("current", 2.5)
        await client.set_zero_velocity(query=True)
        assert (mock.mode, mock.output.kind) == (12, "voltage")
        await client.set_stop()
        await client.set_output_nearest(position=3.0)
        await client.query()
        assert await position() == 3.25
        await client.set_output_exact(position=3.0)
        await client.query()
        assert await position() == 3.0

    asyncio.run(talk())
