"""How many wrong frames the encoder's decoder accepts: random ones, and mutants of real ones. `python -m tests.fuzz.frames [N]`.

A CRC of 16 bits lets one of 65,536 frames through whose errors it cannot tell from none. Fewer are, because COBS and length
reject some before.
"""

from __future__ import annotations

import random
import sys
import time
from dataclasses import dataclass

from firmware_iface.encoder import wire

CRC_CODES = 1 << 16


@dataclass(frozen=True, slots=True)
class Found:
    """Counts of frames sent and of those accepted that nobody has sent."""

    sent: int
    random_accepted: int
    mutants_accepted: int


def mutated(content: bytes, chance: random.Random) -> bytes:
    """One to four changes: a bit, a byte, a byte gone, a byte more, a piece twice, a piece lost."""
    changed = bytearray(content)
    for _ in range(chance.randrange(1, 5)):
        at = chance.randrange(len(changed) + 1)
        kind = chance.randrange(6)
        if kind == 0 and at < len(changed):
            changed[at] ^= 1 << chance.randrange(8)
        elif kind == 1 and at < len(changed):
            changed[at] = chance.randrange(256)
        elif kind == 2:
            del changed[at : at + 1]
        elif kind == 3:
            changed.insert(at, chance.randrange(256))
        elif kind == 4:
            changed[at:at] = changed[at : at + chance.randrange(1, 30)]
        else:
            del changed[at : at + chance.randrange(1, 30)]
    return bytes(changed)


def wrong_accepts(count: int, seed: int = 1) -> Found:
    """Send `count` random blocks, and as many mutants of reports; count what is accepted and was not sent."""
    chance, decoder = random.Random(seed), wire.Decoder()
    random_accepted = sum(len(decoder.feed(_random_block(chance))) for _ in range(count))
    mutants_accepted = 0
    for k in range(count):
        report = wire.Report(k & 0xFF, chance.getrandbits(32), (0, 4, 8), tuple(chance.getrandbits(24) for _ in range(3)))
        block = mutated(wire.encode(report)[:-1], chance)
        mutants_accepted += sum(frame != report for frame in decoder.feed(block + b"\0"))
    return Found(count, random_accepted, mutants_accepted)


def _random_block(chance: random.Random) -> bytes:
    """A delimited block without a zero, of 5 to 40 bytes."""
    return bytes(1 + byte % 255 for byte in chance.randbytes(chance.randrange(5, 41))) + b"\0"


def main() -> None:
    """Print what was found."""
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 1_000_000
    begun_s = time.perf_counter()
    found = wrong_accepts(count)
    for name, accepted in (("random", found.random_accepted), ("mutated", found.mutants_accepted)):
        print(
            f"{found.sent} {name} frames: {accepted} wrongly accepted, {1e6 * accepted / found.sent:.1f} in a million;"
            f" a CRC of 16 bits allows {1e6 / CRC_CODES:.1f}"
        )
    print(f"{time.perf_counter() - begun_s:.0f} s")


if __name__ == "__main__":
    main()
