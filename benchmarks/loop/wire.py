"""Cost of encoding and decoding a frame: motor board frames compared with cantools, a REPORT with the `cobs` package.

cantools reads the same DBC in this process; `cobs` runs in a separate environment. Alternating; the fastest run counts.
"""

import contextlib
import math
from collections.abc import Callable
from importlib.resources import as_file, files
from typing import Any

import cantools

from benchmarks.peers.peer import Peer, PeerMissing
from benchmarks.table import BenchRow, compared, seconds_a_call
from firmware_iface.encoder import wire as encoder_wire
from firmware_iface.motor import wire as motor_wire

ROUNDS = 25
CALLS = 200
REPLY_ID, COMMAND_ID = 0x181, 0x101
REPLY = motor_wire.Reply(0x27, 1, 5, 1.234, 24.05, 31, 0)
REPORT = encoder_wire.Report(7, 123_456_789, (8, 8, 8), (12_345, -67_890, 256))
Work = Callable[[], object]


def rows() -> list[BenchRow]:
    """Return the measured rows."""
    work = _work()
    coded = encoder_wire.encode(REPORT)
    cobs_peer: Peer | None = None
    try:
        cobs_peer = Peer("wire_peer.py", {"frame": coded.hex(), "calls": CALLS}, "wire")
        cobs_name = f"cobs {cobs_peer.answers['version']}, binascii, struct"
        if cobs_peer.answers["counts"] != list(REPORT.counts):
            raise PeerMissing("computes something else")
    except PeerMissing as error:
        cobs_name = f"cobs {error}"
    with cobs_peer if cobs_peer is not None else contextlib.nullcontext():
        us = _alternate(work, cobs_peer)
    peer = f"cantools {cantools.__version__}"
    return [
        compared("COMMAND, set-point in V to bytes", us["encode"], "us", peer, us["cantools encode"], "", None),
        compared("REPLY, bytes to A, V and degC", us["decode"], "us", peer, us["cantools decode"], "", None),
        compared("REPORT, bytes to counts, COBS and CRC checked", us["report"], "us", cobs_name, us.get("cobs"), "", None),
        BenchRow("REPORT, counts to bytes (in a mock board)", us["encode report"], "us"),
    ]


def _work() -> dict[str, Work]:
    """The timed work, each CALLS times."""
    with as_file(files("firmware_iface.motor") / "motor_board.dbc") as path:
        database: Any = cantools.database.load_file(path)
    pack, unpack, payload = motor_wire.pack_raw_command, motor_wire.unpack_reply, REPLY.pack()
    named = {"Controlword": 15, "Mode": 1, "Sequence": 5, "SetpointVoltage": 1.234, "Feedforward": 0.0}
    command, reply = database.get_message_by_frame_id(COMMAND_ID), database.get_message_by_frame_id(REPLY_ID)
    coded, decoder = encoder_wire.encode(REPORT), encoder_wire.Decoder()
    if command.encode(named) != pack(15, 1 | 5 << 3, 1234, 0) or decoder.feed(coded) != [REPORT]:
        raise RuntimeError("own and peer's frames differ: see tests/firmware_iface")
    once: dict[str, Work] = {
        "encode": lambda: pack(15, 1 | 5 << 3, round(1.234 * 1e3), 0),
        "cantools encode": lambda: command.encode(named),
        "decode": lambda: unpack(payload),
        "cantools decode": lambda: reply.decode(payload, decode_choices=False),
        "report": lambda: decoder.feed(coded),
        "encode report": lambda: encoder_wire.encode(REPORT),
    }
    return {name: _repeated(work) for name, work in once.items()}


def _repeated(work: Work) -> Work:
    return lambda: [work() for _ in range(CALLS)]


def _alternate(work: dict[str, Work], cobs_peer: Peer | None) -> dict[str, float]:
    """Return the fastest microseconds a call."""
    us = dict.fromkeys(work, math.inf)
    for _ in range(ROUNDS):
        for name, run in work.items():
            us[name] = min(us[name], 1e6 * seconds_a_call(run, CALLS))
        if cobs_peer is not None:
            us["cobs"] = min(us.get("cobs", math.inf), cobs_peer.ask("measure")["report_us"])
    return us
