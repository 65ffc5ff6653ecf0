"""The encoder board's firmware in C beside the mock's own in Python: written from one document, they say the same bytes."""

from __future__ import annotations

import random

from hypothesis import given, settings
from hypothesis import strategies as st

from hil_mocks.devices.encoder_board import EncoderBoardMock
from hil_mocks.devices.encoder_inputs import EncoderBoardHardware, EncoderBoardSetup
from hil_mocks.devices.framing import deframe, frame
from hil_mocks.firmware.encoder_board import EncoderBoardFirmware
from tests.firmware import needs_compiler

pytestmark = needs_compiler
BITS = st.sampled_from((8, 16, 31, 32))
Step = tuple[str, object]


@st.composite
def requests(draw: st.DrawFn) -> bytes:
    """Frames as a host sends them, and as it must not."""
    kind = draw(st.sampled_from((1, 2, 3, 4, 5, 5, 0, 0x7E, 0x81)))
    body = {
        2: draw(st.sampled_from((0, 249, 250, 1000, 2000, 999_999, 1_000_000, 1_000_001))).to_bytes(4, "little"),
        3: bytes((draw(st.integers(0, 3)),)) + draw(st.binary(min_size=4, max_size=4)),
        4: bytes((draw(st.integers(0, 3)), draw(st.integers(0, 3)))),
    }.get(kind, b"")  # fmt: skip
    if draw(st.integers(0, 9)) == 0:
        body += draw(st.binary(max_size=60 - len(body)))
    coded = bytearray(frame(bytes((kind, draw(st.integers(1, 3)))) + body))
    if draw(st.integers(0, 9)) == 0:
        coded[draw(st.integers(0, len(coded) - 1))] ^= 1 << draw(st.integers(0, 7))
    return bytes(coded)


STEPS = st.lists(
    st.one_of(
        st.tuples(st.just("bytes"), requests()),
        st.tuples(st.just("bytes"), st.binary(max_size=100)),
        st.tuples(st.just("turn"), st.tuples(*(st.integers(-400, 400),) * 3)),
        st.tuples(st.just("turn"), st.tuples(*(st.sampled_from((0, 1, -1)),) * 3)),
        st.tuples(st.just("leap"), st.integers(-(2**31), 2**31)),
        st.tuples(st.just("lost"), st.booleans()),
        st.tuples(st.just("error"), st.integers(0, 2)),
        st.tuples(st.just("frozen"), st.booleans()),
        st.tuples(st.just("reset"), st.none()),
    ),
    max_size=60,
)


class Played:
    """A board, and what happens to it."""

    def __init__(self, board: EncoderBoardHardware) -> None:
        self.board, self.now_s, self.raw = board, 0.0, [0, 0, 0]

    def play(self, what: str, value: object) -> list[tuple[float, bytes]]:
        """All that the board says then, with the times at which it has left."""
        board = self.board
        if what == "bytes":
            board.receive(value, self.now_s)
        elif what in ("turn", "leap"):
            steps = value if what == "turn" else (value, 0, 0)
            self.raw = [raw + step for raw, step in zip(self.raw, steps, strict=True)]
            self.now_s += 1e-3
            board.tick(self.now_s, list(self.raw), [raw > 100 for raw in self.raw])
        elif what == "lost":
            (board.lost.add if value else board.lost.discard)(1)
        elif what == "error":
            board.quadrature_error(value, 3)
        elif what == "frozen":
            board.freeze_clock(value)
        else:
            board.power_up(self.now_s, self.raw)
        said, board.outgoing[:] = board.outgoing[:], []
        return said


@settings(max_examples=60, deadline=None)
@given(bits=BITS, ppm=st.sampled_from((0.0, 200.0, -35.0)), steps=STEPS)
def test_both_firmwares_say_the_same_bytes_at_the_same_times(
    bits: int, ppm: float, steps: list[Step]
) -> None:
    setup = EncoderBoardSetup(0xA1B2C3, (2048, 1000, 2048), bits, 0x0203, clock_ppm=ppm)
    python, c = (Played(kind(setup, (100, 7, -50))) for kind in (EncoderBoardMock, EncoderBoardFirmware))
    for what, value in steps:
        assert c.play(what, value) == python.play(what, value), (what, value)


def test_the_time_wraps_within_a_stream() -> None:
    setup = EncoderBoardSetup(1, (8,))
    boards = [kind(setup, (0,)) for kind in (EncoderBoardMock, EncoderBoardFirmware)]
    said = []
    for board in boards:
        board.tick(4294.966, [0], [False])
        board.receive(frame(b"\x02\x01\x00\x02\x00\x00"), 4294.966)
        board.tick(4294.970, [5], [False])
        said.append(board.outgoing)
    assert said[0] == said[1]
    assert len(said[0]) > 8


def test_a_blocked_line_costs_the_oldest_reports_and_no_answer() -> None:
    board = EncoderBoardFirmware(EncoderBoardSetup(1, (8,)), (0,))
    board.outgoing.clear()
    board.is_line_blocked = True
    polls = b"".join(frame(bytes((1, k))) for k in range(1, 21))
    board.receive(frame(b"\x05\x63") + polls + frame(b"\x7e\x64"), 1.0)
    assert board.outgoing == []
    board.is_line_blocked = False
    board.receive(b"\0", 1.0)
    answers = [deframe(wire[:-1]) or b"" for _, wire in board.outgoing]
    assert [answer[0] for answer in answers] == [0x82, *[0x81] * 6, 0x83]
    assert [answer[1] for answer in answers] == [1, *range(16, 22), 22]


def test_random_bytes_do_no_harm() -> None:
    source = random.Random(7)
    board = EncoderBoardFirmware(EncoderBoardSetup(1, (8,)), (0,))
    for _ in range(2000):
        board.receive(source.randbytes(source.randrange(90)), 1.0)
    board.outgoing.clear()
    board.receive(b"\0" + frame(b"\x05\x07"), 1.0)
    assert len(board.outgoing) == 1
