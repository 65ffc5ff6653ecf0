"""Random and mutated bytes at every decoder and file reader: taken or refused in one sentence, never a crash."""

from __future__ import annotations

import math
import random
import re
import struct
import zlib

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from firmware_iface.encoder import wire
from firmware_iface.odrive import OdriveCommand
from tests.fuzz.bought import CANOPEN_IDS, MOTEUS_IDS, ODRIVE_IDS, packed
from tests.fuzz.bought_seeds import MOTEUS_VALUES, answers
from tests.fuzz.frames import mutated, wrong_accepts
from tests.fuzz.seeds import seeds_of
from tests.fuzz.targets import DECODERS, TARGETS, is_survived


@pytest.mark.parametrize("name", TARGETS)
def test_mutants_of_good_input_are_taken_or_refused_in_a_sentence(name: str) -> None:
    chance = random.Random(zlib.crc32(name.encode()))
    for seed in seeds_of(name):
        is_survived(name, seed)
        for _ in range(60 if name in DECODERS else 25):
            is_survived(name, mutated(seed, chance))


def odrive_frames(turns: float) -> bytes:
    return packed(ODRIVE_IDS, [(ODRIVE_IDS[list(OdriveCommand).index(OdriveCommand.ENCODER)], struct.pack("<ff", turns, 0.0))])


# What fuzzing has found: a count or a float that no recording holds, half an identity, damaged files, endless lists of errors.
FOUND: tuple[tuple[str, bytes], ...] = (
    ("odrive", odrive_frames(3e38)),
    ("odrive", odrive_frames(-1e6)),
    ("cia402", packed(CANOPEN_IDS, [(CANOPEN_IDS[0], struct.pack("<Hih", 0x27, 2**31 - 1, 0))])),
    ("dynamixel", answers(*[b"\0" + bytes(6) + b"\xff\xff\xff\x7f" + bytes(11)] * 60)),
    ("moteus", packed(MOTEUS_IDS, [(MOTEUS_IDS[0], b"\x2b\xa0\x02" + bytes(12))])),
    *(
        ("moteus", packed(MOTEUS_IDS, [(MOTEUS_IDS[0], MOTEUS_VALUES.replace(struct.pack("<f", 1.5), other))]))
        for other in (struct.pack("<f", math.inf), struct.pack("<f", 3e38))
    ),
    ("recorded.csv", seeds_of("recorded.csv")[0] + b"\xf5,1\n"),
    ("script", b"wrong\n" * 90),
    ("chunk.npz", b"PK"),
    ("chunk.npz", b""),
    ("run.csv", b""),
    ("run.csv", b"t_s\nx\n"),
    ("run.csv", b"t_s\n1\n"),
)


@pytest.mark.parametrize(("name", "content"), FOUND, ids=[name for name, _ in FOUND])
def test_what_was_found_once_is_taken_or_refused_in_a_sentence(name: str, content: bytes) -> None:
    is_survived(name, content)


@pytest.mark.parametrize("name", ["arm.toml", "cell.toml", "places.toml", "camera.json", "run.armlog"])
def test_any_number_of_a_good_file_may_be_any_other(name: str) -> None:
    """One with more digits than a float has, or whose square is none."""
    seed = seeds_of(name)[0]
    numbers = list(re.finditer(rb"(?<![\w.-])\d+(?:\.\d+)?(?!\w)", seed))
    assert len(numbers) >= 3
    for number in numbers:
        for other in (b"9" * 400, b"0x" + b"f" * 300, b"1e308", b"1e400"):
            is_survived(name, seed[: number.start()] + other + seed[number.end() :])


@pytest.mark.parametrize("name", DECODERS)
@settings(deadline=None, max_examples=40)
@given(content=st.binary(max_size=200))
def test_any_bytes_are_taken_or_refused_in_a_sentence(name: str, content: bytes) -> None:
    is_survived(name, content)


def test_fewer_frames_are_wrongly_accepted_than_the_length_of_the_crc_allows() -> None:
    accepted = wrong_accepts(20_000, seed=2)
    assert accepted.random_accepted <= 5  # 0.3 expected
    assert accepted.mutants_accepted <= 5


def test_no_frame_with_one_to_three_wrong_bits_is_accepted() -> None:
    """The distance of this CRC is 4 up to 32,751 bits."""
    right = bytes(wire.cobs_decode(wire.encode(wire.Report(1, 2, (3, 4, 5), (6, 7, 8)))[:-1]) or b"")
    chance = random.Random(3)
    for _ in range(3000):
        content = bytearray(right)
        for at in chance.sample(range(8 * len(content)), 1 + chance.randrange(3)):
            content[at // 8] ^= 1 << at % 8
        assert wire.Decoder().feed(wire.cobs_encode(bytes(content)) + b"\0") == []
