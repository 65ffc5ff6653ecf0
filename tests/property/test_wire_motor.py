"""Motor frames: every value survives, and random payloads never raise anything but a bus's counted problem."""

from contextlib import suppress

from hypothesis import given
from hypothesis import strategies as st

from benchmarks.loop.memory_link import MemoryBus
from firmware_iface.errors import LinkError
from firmware_iface.motor import wire
from firmware_iface.motor.board import MotorBoard
from firmware_iface.motor.bus import MotorBus
from tests.firmware_iface.motor_command import MotorCommand

u8 = st.integers(0, 255)
i16 = st.integers(-(2**15), 2**15 - 1)
i32 = st.integers(-(2**31), 2**31 - 1)
mode = st.integers(0, 7)
sequence = st.integers(0, 31)


@given(st.builds(MotorCommand, u8, mode, sequence, i32, i16))
def test_commands_survive(command: MotorCommand) -> None:
    assert MotorCommand.unpack(command.pack()) == command


@given(st.binary(min_size=8, max_size=8))
def test_replies_survive_whatever_their_bytes(payload: bytes) -> None:
    assert wire.unpack_reply(payload).pack() == payload


@given(st.builds(wire.ParameterRequest, u8, u8, u8, i32), st.builds(wire.ParameterAnswer, u8, u8, u8, i32))
def test_parameters_survive(request: wire.ParameterRequest, answer: wire.ParameterAnswer) -> None:
    assert wire.ParameterRequest.unpack(request.pack()) == request
    assert wire.ParameterAnswer.unpack(answer.pack()) == answer


class StillClock:
    def now_s(self) -> float:
        return 0.0

    def wait_until_s(self, t: float) -> None:
        raise AssertionError("nothing waits here")


@given(st.lists(st.tuples(st.integers(0, 0x7FF), st.binary(max_size=8)), max_size=30))
def test_random_frames_raise_link_errors_only(frames: list[tuple[int, bytes]]) -> None:
    wires = MemoryBus()
    noise = wires.join()
    bus = MotorBus(wires.join(), StillClock())
    boards = [MotorBoard(bus, node) for node in (1, 2, 3)]
    for board in boards:
        board.command_voltage(0.0)
    for frame in frames:
        noise.send(*frame)
    for _ in range(len(frames) * 2 + 1):
        with suppress(LinkError):
            bus.update()
    bus.update()
