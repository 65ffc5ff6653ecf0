"""The encoder board's frames against golden bytes, and what noise does to the decoder."""

import pytest

from firmware_iface.encoder import wire
from firmware_iface.errors import MisuseError
from tests.places import ROOT

FRAMES = {
    "POLL": wire.Poll(1),
    "STREAM": wire.Stream(2, 2000),
    "SET_ZERO": wire.SetZero(3, 1, -100_000),
    "ARM_INDEX": wire.ArmIndex(4, 2, wire.IndexAction.ARM),
    "IDENTIFY": wire.Identify(1),
    "REPORT": wire.Report(7, 1_234_567, (0x08, 0x0D, 0x00), (1024, -1, -(2**31))),
    "IDENTITY": wire.Identity(0, 1, 1, 0x0203, 0x00A1B2C3, 3, (2048, 2048, 2048), 32),
    "ACK": wire.Ack(8, 2, wire.AckResult.DONE),
    "INDEX": wire.IndexLatch(9, 2, 1_234_500, -4711),
}


def golden() -> dict[str, tuple[bytes, bytes]]:
    lines = (ROOT / "tests/golden/encoder_board.txt").read_text().splitlines()
    rows = [[cell.strip() for cell in line.split("|")] for line in lines if not line.startswith("#")]
    return {name: (bytes.fromhex(decoded), bytes.fromhex(coded)) for name, decoded, coded in rows}


def test_the_crc_is_ccitt_false() -> None:
    assert wire.crc16(b"123456789") == 0x29B1


def test_there_is_a_golden_frame_for_every_type() -> None:
    assert set(golden()) == set(FRAMES)


@pytest.mark.parametrize("name", FRAMES)
def test_frames_encode_to_the_golden_bytes(name: str) -> None:
    decoded, coded = golden()[name]
    assert wire.encode(FRAMES[name]) == coded
    assert wire.cobs_decode(coded[:-1]) == decoded


@pytest.mark.parametrize("name", FRAMES)
def test_golden_bytes_decode_to_the_frames(name: str) -> None:
    assert wire.Decoder().feed(golden()[name][1]) == [FRAMES[name]]


def test_a_report_takes_25_bytes_on_the_wire_whatever_it_holds() -> None:
    for filler in (0, 1, -1):
        report = wire.Report(filler & 0xFF, filler & 0xFFFFFFFF, (filler & 0xFF,) * 3, (filler,) * 3)
        assert len(wire.encode(report)) == wire.REPORT_WIRE_BYTES


@pytest.mark.parametrize("name", FRAMES)
def test_any_single_flipped_bit_never_yields_another_frame(name: str) -> None:
    coded = golden()[name][1]
    for bit in range(8 * len(coded)):
        flipped = bytearray(coded)
        flipped[bit // 8] ^= 1 << bit % 8
        decoder = wire.Decoder()
        # A flipped delimiter joins the frame with the next one: that one may be lost, never changed.
        frames = decoder.feed(bytes(flipped) + b"\x00" + coded)
        assert frames in ([FRAMES[name]], []), f"bit {bit}"
        assert frames == [FRAMES[name]] or bit // 8 == len(coded) - 1
        assert decoder.crc_errors + decoder.framing_errors >= 1


def test_a_frame_is_decoded_however_it_is_cut() -> None:
    stream = b"\x00" + b"".join(coded for _, coded in golden().values())
    for cut in range(len(stream)):
        decoder = wire.Decoder()
        assert decoder.feed(stream[:cut]) + decoder.feed(stream[cut:]) == list(FRAMES.values())
        assert decoder.crc_errors == decoder.framing_errors == 0


def test_a_half_frame_costs_itself_only() -> None:
    coded = golden()["REPORT"][1]
    decoder = wire.Decoder()
    assert decoder.feed(coded[:9] + b"\x00" + coded) == [FRAMES["REPORT"]]
    assert decoder.framing_errors + decoder.crc_errors == 1


def test_bytes_without_end_are_thrown_away_up_to_the_next_delimiter() -> None:
    coded = golden()["REPORT"][1]
    decoder = wire.Decoder()
    for _ in range(1000):
        assert decoder.feed(b"\x55" * 20) == []
    assert decoder.framing_errors == 1  # given up already, not gathered until an end comes
    assert decoder.feed(b"\x55\x55\x00" + coded) == [FRAMES["REPORT"]]
    assert decoder.framing_errors == 1


def test_a_good_frame_behind_skipped_bytes_in_the_same_block_is_not_taken() -> None:
    decoder = wire.Decoder()
    decoder.feed(b"\x55" * 67)
    assert decoder.feed(golden()["REPORT"][1]) == []
    assert decoder.feed(golden()["REPORT"][1]) == [FRAMES["REPORT"]]


@pytest.mark.parametrize("raw", [b"\x7e\x05", b"\x81\x05\x00", b"\xf0\x00" + bytes(50)])
def test_a_frame_of_no_known_kind_is_foreign(raw: bytes) -> None:
    coded = wire.cobs_encode(raw + wire.crc16(raw).to_bytes(2, "little")) + b"\x00"
    assert wire.Decoder().feed(coded) == [wire.Foreign(raw)]


def test_a_frame_too_short_for_a_crc_is_a_framing_error() -> None:
    decoder = wire.Decoder()
    assert decoder.feed(wire.cobs_encode(b"\x01\x02\x03") + b"\x00") == []
    assert decoder.framing_errors == 1


@pytest.mark.parametrize(
    "frame", [wire.Stream(1, -1), wire.Stream(256, 1), wire.SetZero(1, 0, 2**31), wire.Report(0, 2**32, (0,) * 3, (0,) * 3)]
)
def test_a_number_that_does_not_fit_is_our_misuse(frame: wire.Frame) -> None:
    with pytest.raises(MisuseError, match="does not fit"):
        wire.encode(frame)


@pytest.mark.parametrize(
    ("raw", "coded"),
    [
        (b"", "01"),
        (b"\x00", "01 01"),
        (b"\x00\x00", "01 01 01"),
        (b"\x11\x22\x00\x33", "03 11 22 02 33"),
        (b"\x11\x00\x00\x00", "02 11 01 01 01"),
        (bytes(range(1, 255)), "ff" + bytes(range(1, 255)).hex()),
        (b"\x00" + bytes(range(1, 255)), "01 ff" + bytes(range(1, 255)).hex()),
        (bytes(range(1, 256)), "ff" + bytes(range(1, 255)).hex() + "02 ff"),
        (bytes(range(2, 256)) + b"\x00", "ff" + bytes(range(2, 256)).hex() + "01 01"),
    ],
)
def test_cobs_is_as_published(raw: bytes, coded: str) -> None:
    """Examples of Cheshire and Baker's code as commonly tabulated."""
    assert wire.cobs_encode(raw).hex() == coded.replace(" ", "")
    assert wire.cobs_decode(wire.cobs_encode(raw)) == raw


@pytest.mark.parametrize("block", [b"", b"\x00", b"\x03\x01", b"\x02\x01\x05", b"\x01\x00", b"\xff" * 300])
def test_what_is_no_cobs_block_decodes_to_none(block: bytes) -> None:
    assert wire.cobs_decode(block) is None
