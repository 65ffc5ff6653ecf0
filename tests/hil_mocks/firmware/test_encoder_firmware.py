"""The encoder board's firmware in C beside the mock's own in Python: written from one document, they say the same bytes."""

from __future__ import annotations

import random

from hil_mocks.devices.encoder_board import EncoderBoardMock, EncoderBoardSetup, deframe, frame
from hil_mocks.firmware import EncoderBoardFirmware
from tests.firmware import needs_compiler

pytestmark = needs_compiler


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
