"""A REPORT decoded with the `cobs` package (C), binascii's CRC and struct, in the peers' environment. JSON lines in and out.

The first line gives the frame and the number of calls; for every further line they are timed once. Nothing of this repository
is imported here.
"""

import importlib
import json
import sys
from binascii import crc_hqx
from importlib.metadata import version
from struct import Struct
from time import perf_counter
from typing import Any

cobs: Any = importlib.import_module("cobs.cobs")  # only in the peers' environment

REPORT = Struct("<xBI3B3iH")


def decoded(frame: bytes) -> tuple[int, ...]:
    """Numbers of a REPORT, or None if the CRC is wrong."""
    raw = cobs.decode(frame[:-1])
    numbers = REPORT.unpack(raw)
    return numbers if crc_hqx(raw[:-2], 0xFFFF) == numbers[-1] else ()


def main() -> None:
    task = json.loads(sys.stdin.readline())
    frame, calls = bytes.fromhex(task["frame"]), task["calls"]
    print(json.dumps({"counts": decoded(frame)[5:8], "version": version("cobs")}), flush=True)
    for _ in sys.stdin:
        start = perf_counter()
        for _ in range(calls):
            decoded(frame)
        print(json.dumps({"report_us": 1e6 * (perf_counter() - start) / calls}), flush=True)


if __name__ == "__main__":
    main()
