"""Good conversations with bought boards, as the pieces that `tests.fuzz.bought` cuts."""

from __future__ import annotations

import struct
from binascii import crc_hqx

from firmware_iface import canopen_wire
from firmware_iface import vesc as vesc_wire
from firmware_iface.odrive import OdriveCommand
from firmware_iface.vesc import Packet
from tests.fuzz.bought import AT_ONCE, CANOPEN_IDS, MOTEUS_IDS, NODE, ODRIVE_IDS, VESC_IDS, Frame, packed

MOTEUS_VALUES = (
    b"\x21\x00\x0a\x2c\x04\x01"
    + struct.pack("<4f", 1.5, -0.25, 0.1, 0.6)
    + b"\x25\x0d\xf0\x00\x22\x0e\x1e\x00\x21\x5e\x01\x29\x70"
    + struct.pack("<i", 12_345)
)
MOTEUS_IDENTITY = b"\x21\x0c\x02\x29\x81\x02\x0a\x01\x00\x00\x2b\xa0\x02" + bytes(range(12))
SERVO_STATE = bytes((1, *bytes(15), 0, 8, 0, 0, 0, 0, 120, 30, 0, 0, 0, 0, 0, 10, 0))


def answers(*said: bytes) -> bytes:
    """Answers of which each gets a right checksum."""
    return b"".join(bytes((0, len(one))) + one for one in said)


def _odrive() -> list[Frame]:
    at = NODE << 5
    heartbeats = [(at | OdriveCommand.HEARTBEAT, struct.pack("<IBBH", *said)) for said in ((0, 1, 0, 0), (0, 8, 0, 0))]
    pairs = [
        (at | command, struct.pack("<ff", 2.5, -0.5))
        for command in (OdriveCommand.ENCODER, OdriveCommand.IQ, OdriveCommand.TEMPERATURE, OdriveCommand.BUS)
    ]
    return [*heartbeats, *pairs, (at | OdriveCommand.HEARTBEAT, struct.pack("<IBBH", 0x100, 1, 3, 0)), *pairs]


def _vesc() -> list[Frame]:
    host = vesc_wire.HOST
    said: list[tuple[int, int, str]] = [
        (Packet.PONG, host, "01 00"),
        (Packet.PROCESS_SHORT_BUFFER, host, "01 01 32 00 00 80 00 02"),
        (Packet.STATUS, NODE, "ff ff f4 48 00 0c ff 06"),
        (Packet.STATUS_2, NODE, "00 00 27 10 00 00 13 88"),
        (Packet.STATUS_4, NODE, "01 5e 01 2c 00 06 46 4f"),
        (Packet.STATUS_5, NODE, "ff ff ff f9 00 f1 00 00"),
        (Packet.STATUS_6, NODE, "0c e4 00 00 00 00 00 00"),
        (Packet.PROCESS_SHORT_BUFFER, host, "01 01 32 00 00 80 00 00"),
    ]
    stored = struct.pack(">B4xBIf20xB", vesc_wire.GET_APPCONF, NODE, 100, 20.0, 0)
    ended = struct.pack(">BBHH", NODE, 1, len(stored), crc_hqx(stored, 0))
    return [
        *((packet << 8 | number, bytes.fromhex(text)) for packet, number, text in said),
        *((Packet.FILL_RX_BUFFER << 8 | host, bytes((at,)) + stored[at : at + 7]) for at in range(0, len(stored), 7)),
        (Packet.FILL_RX_BUFFER_LONG << 8 | host, bytes.fromhex("01 00 00 00")),
        (Packet.PROCESS_RX_BUFFER << 8 | host, ended),
        (Packet.NOTIFY_BOOT << 8 | NODE, bytes(2)),
    ]


def _canopen() -> list[Frame]:
    answer = canopen_wire.SDO_ANSWER + NODE
    read = [(0x1000, 0, 402), *((0x1018, sub, 7) for sub in (1, 2, 3, 4)), (0x6076, 0, 1000)]
    return [
        *((answer, struct.pack("<BHBI", 0x43, *entry)) for entry in read),
        (answer, struct.pack("<BHBI", 0x60, 0x1400, 1, 0)),
        (answer, struct.pack("<BHBI", 0x80, 0x1400, 2, 0x0602_0000)),
        (canopen_wire.TPDO_1 + NODE, struct.pack("<Hih", 0x27, -5, 30)),
        (canopen_wire.TPDO_2 + NODE, struct.pack("<II", 24_000, 4)),
        (canopen_wire.EMERGENCY + NODE, bytes.fromhex("10 23 02 00 00 00 00 00")),
        (canopen_wire.HEARTBEAT + NODE, b"\0"),
    ]


def bought_seeds() -> dict[str, list[bytes]]:
    """A conversation with each kind."""
    texts = [b"\x41\x01\x00", b"\x41\x01\x05165.4", b"\x41\x01\x02\r\n"]
    texts = [text for text in texts for _ in range(AT_ONCE)]
    moteus_said = [MOTEUS_IDENTITY, *[MOTEUS_VALUES] * (2 * AT_ONCE - 1), *texts, MOTEUS_VALUES.ljust(64, b"\x50")]
    frames = [(NODE << 8, said) for said in moteus_said]
    dynamixel_stored = struct.pack("<BH4xB2xBBB8xi24xii7xB4xB", 0, 1020, 46, 0, 0, 3, 0, 4095, 0, 52, 2)
    feetech_stored = struct.pack("<BBBxH2xBBHH5xBB10xBHBBBB", 0, 3, 10, 777, 0, 1, 0, 4095, 12, 44, 1, 0, 0, 20, 200, 80)
    dynamixel = [dynamixel_stored, *[b"\0"] * 3, b"\0" + bytes(35), b"\0" + bytes(21)]
    feetech = [feetech_stored, *[b"\0"] * 2, b"\0" + SERVO_STATE, b"\0"]
    claw = [b"USB Roboclaw 2x30a v4.2\n\0", bytes(3), bytes(2), b"\x02"]
    acknowledged, counts = b"\x01\x01\xff" * 5, answers(bytes(8), bytes(4))
    return {
        "moteus": [packed(MOTEUS_IDS, frames)],
        "odrive": [packed(ODRIVE_IDS, _odrive())],
        "vesc": [packed(VESC_IDS, _vesc())],
        "cia402": [packed(CANOPEN_IDS, _canopen())],
        "dynamixel": [answers(*dynamixel, *dynamixel[-2:] * 3)],
        "feetech": [answers(*feetech, *feetech[-2:-1] * 4)],
        "roboclaw": [answers(*claw) + (acknowledged + counts) * 2 + answers(bytes(2))],
    }
