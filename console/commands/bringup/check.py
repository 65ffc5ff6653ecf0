"""`armwright check`: find the boards of arm.toml and compare their identities. Nothing moves."""

import argparse
from typing import Any

from console.commands.progress import answer
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
    rights = remedy or "granted"
    answer(
        given,
        {"format": FORMAT, "arm": arm.name, **found, "rights": rights},
        f"{described(found)}\nreal-time rights: {rights}\narm {arm.name}: all boards answer and match arm.toml",
    )
    return 0


def found_boards(connection: Connection) -> dict[str, list[dict[str, Any]]]:
    """Every board that answered, by kind, with its identity."""
    encoders = [
        _entry(encoder.where, found, "channels", "encoder_bits")
        for encoder in connection.encoders
        if (found := encoder.identity) is not None
    ]
    motors = [
        _entry(motor.where, who, "encoder_counts_per_turn")
        for motor in connection.motors
        if (who := motor.identity) is not None
    ]
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


def _entry(where: str, identity: Any, *more: str) -> dict[str, Any]:
    firmware = f"{identity.firmware >> 8}.{identity.firmware & 255}"
    known = {"where": where, "serial_number": identity.serial_number, "firmware": firmware}
    return known | {name: getattr(identity, name) for name in more}
