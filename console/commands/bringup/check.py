"""`armwright check`: find the boards of arm.toml and compare their identities. Nothing moves."""

import argparse
import json
import sys
from typing import Any

from console.commands.serve import camera_port
from control.hardware.connect import Connection, connect, with_links
from control.model.description import load_arm
from control.server.scheduling import punctuality_remedy
from firmware_iface.clock import MonotonicClock
from procedures.link_options import link_options

FORMAT = "check/1"


def run(given: argparse.Namespace) -> int:
    """Connect, print the boards that answered, disconnect."""
    arm = with_links(load_arm(given.arm), link_options(given))
    connection = connect(arm, MonotonicClock(), 1.0 / arm.usual_rate_Hz, camera_port(given, arm))
    try:
        found = found_boards(connection)
    finally:
        connection.close()
    remedy = punctuality_remedy()
    if given.json:
        content = {"format": FORMAT, "arm": arm.name, **found, "rights": remedy or "granted"}
        _say(json.dumps(content, indent=2))
    else:
        _say(described(found))
        _say(f"real-time rights: {remedy or 'granted'}")
        _say(f"arm {arm.name}: all boards answer and match arm.toml")
    return 0


def found_boards(connection: Connection) -> dict[str, list[dict[str, Any]]]:
    """Every board that answered, by kind, with its identity."""
    encoders = [
        {
            "where": encoder.where, "serial_number": found.serial_number, "firmware": _version(found.firmware),
            "channels": found.channels, "encoder_bits": found.encoder_bits,
        }
        for encoder in connection.encoders
        if (found := encoder.identity) is not None
    ]  # fmt: skip
    motors = [
        {
            "where": motor.where, "serial_number": who.serial_number, "firmware": _version(who.firmware),
            "encoder_counts_per_turn": who.encoder_counts_per_turn,
        }
        for motor in connection.motors
        if (who := motor.identity) is not None
    ]  # fmt: skip
    others = [{"where": where, "identity": identity} for where, identity in connection.others]
    return {"encoder_boards": encoders, "motor_boards": motors, "boards": others}


def described(found: dict[str, list[dict[str, Any]]]) -> str:
    """The boards as text, one per line."""
    lines = [
        f"{one['where']}: serial number {one['serial_number']}, firmware {one['firmware']}, {one['channels']} channels,"
        f" {one['encoder_bits']}-bit counters"
        for one in found["encoder_boards"]
    ]
    lines += [
        f"{one['where']}: serial number {one['serial_number']}, firmware {one['firmware']},"
        f" {one['encoder_counts_per_turn']} counts per turn"
        for one in found["motor_boards"]
    ]
    lines += [f"{one['where']}: {one['identity']}" for one in found["boards"]]
    return "\n".join(lines)


def _version(firmware: int) -> str:
    return f"{firmware >> 8}.{firmware & 255}"


def _say(text: str) -> None:
    sys.stdout.write(f"{text}\n")
