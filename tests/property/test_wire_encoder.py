"""Encoder frames: every value survives the line, and random bytes never raise."""

from hypothesis import given
from hypothesis import strategies as st

from firmware_iface.encoder import wire

u8 = st.integers(0, 255)
u16 = st.integers(0, 2**16 - 1)
u32 = st.integers(0, 2**32 - 1)
i32 = st.integers(-(2**31), 2**31 - 1)

FRAMES = st.one_of(
    st.builds(wire.Report, u8, u32, st.tuples(u8, u8, u8), st.tuples(i32, i32, i32)),
    st.builds(wire.Identity, u8, u8, u8, u16, u32, u8, st.tuples(u32, u32, u32), u8),
    st.builds(wire.Ack, u8, u8, u8),
    st.builds(wire.IndexLatch, u8, u8, u32, i32),
    st.builds(wire.Poll, u8),
    st.builds(wire.Stream, u8, u32),
    st.builds(wire.SetZero, u8, u8, i32),
    st.builds(wire.ArmIndex, u8, u8, u8),
    st.builds(wire.Identify, u8),
)


@given(st.lists(FRAMES, max_size=5), st.integers(1, 40))
def test_frames_survive_the_line_in_pieces_of_any_size(frames: list[wire.Frame], size: int) -> None:
    stream = b"".join(map(wire.encode, frames))
    decoder = wire.Decoder()
    pieces = [stream[at : at + size] for at in range(0, len(stream), size)]
    assert [frame for piece in pieces for frame in decoder.feed(piece)] == frames
    assert decoder.crc_errors == decoder.framing_errors == 0


@given(st.lists(st.binary(max_size=120), max_size=5), FRAMES)
def test_random_bytes_never_raise_and_a_frame_behind_them_is_found(noise: list[bytes], frame: wire.Frame) -> None:
    decoder = wire.Decoder()
    for piece in noise:
        decoder.feed(piece)
    assert decoder.feed(b"\x00" + wire.encode(frame))[-1:] == [frame]


@given(st.binary(max_size=1000))
def test_cobs_gives_back_what_it_was_given_without_zeros_on_the_way(raw: bytes) -> None:
    coded = wire.cobs_encode(raw)
    assert 0 not in coded
    assert len(coded) <= len(raw) + len(raw) // 254 + 1
    assert wire.cobs_decode(coded) == raw


@given(st.binary(max_size=300))
def test_what_cobs_decodes_it_encodes_to_the_same_block(block: bytes) -> None:
    decoded = wire.cobs_decode(block)
    if decoded is not None and 0xFF not in block:
        assert wire.cobs_encode(bytes(decoded)) == block
