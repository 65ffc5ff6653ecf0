"""`armwright serve`: runs the loop in this process until it is stopped.
`armwright check`: find the boards of arm.toml and compare their identities. Nothing moves.
"""

import argparse
import sys
from pathlib import Path
from typing import Any

from console.commands.connection import socket_path
from console.commands.progress import answer
from control.errors import ArmError
from control.hardware.connect import Connection, connect, link_options, with_links
from control.model.arm import Arm
from control.model.can_bus import USUAL_LOAD, bus_load, good_rate_Hz, usual_rate_Hz
from control.model.cell import Cell, cell_of_one, load_cell
from control.model.description import load_arm
from control.server.channel import default_path
from control.server.process import ServeOptions, serve
from control.server.scheduling import punctuality_remedy
from firmware_iface.clock import MonotonicClock

LOWEST_RATE_Hz, HIGHEST_RATE_Hz = 50.0, 1200.0  # three boards at 1 Mbit/s end at 1234 Hz
LARGEST_LOAD = 0.95  # of a CAN bus that several arms share
OF_ONE_ARM = ("socket", "encoder", "can_interface", "can_channel", "can_option", "camera_port")


def run_serve(args: argparse.Namespace) -> int:
    """Connect and serve."""
    if args.rate is not None and not LOWEST_RATE_Hz <= args.rate <= HIGHEST_RATE_Hz:
        raise ArmError(f"--rate: expected {LOWEST_RATE_Hz:g} to {HIGHEST_RATE_Hz:g} Hz, got {args.rate:g}")
    if args.cell is not None:
        cell = _cell(args)
        sockets = {name: default_path(name) for name in cell.names}
    else:
        arm = with_links(load_arm(args.arm), link_options(args))
        cell, sockets = cell_of_one(arm), {arm.name: socket_path(args, arm)}
    arms = [placed.arm for placed in cell.arms]
    rate_Hz = args.rate or usual_rate_Hz(arms)
    load = bus_load(arms, rate_Hz)
    if args.cell is not None and load > LARGEST_LOAD:
        raise ArmError(
            f"--rate: at {rate_Hz:g} Hz the arms' boards would need {100 * load:.0f} % of their CAN bus (at most"
            f" {100 * LARGEST_LOAD:.0f} %): give a lower rate, or each arm a bus of its own"
        )
    if load > USUAL_LOAD:
        good_Hz = good_rate_Hz(arms, rate_Hz)
        remedy = f"--rate {good_Hz:.0f}" if good_Hz >= LOWEST_RATE_Hz else "fewer boards, or rarer messages of theirs"
        sys.stderr.write(
            f"armwright: --rate {rate_Hz:g}: the boards need {100 * load:.0f} % of their CAN bus, good is up to"
            f" {100 * USUAL_LOAD:.0f} % ({remedy}): frames may come late, which is a fault\n"
        )
    ports = {placed.name: camera_port(args, placed.arm) for placed in cell.arms}
    serve(cell, ServeOptions(sockets, Path(args.log), 1.0 / rate_Hz, ports))
    return 0


def _cell(args: argparse.Namespace) -> Cell:
    """The cell of the command line. ArmError for an option that is of one arm."""
    for name in OF_ONE_ARM:
        if getattr(args, name) is not None:
            option = name.replace("_", "-")
            raise ArmError(f"--{option}: not together with --cell: ports and buses are in cell.toml and its arms' files")
    return load_cell(args.cell)


def camera_port(args: argparse.Namespace, arm: Arm) -> int | None:
    """The camera's port of the command line, or of the arm's [camera]; None for an arm without a camera."""
    if args.camera_port is not None:
        return int(args.camera_port)
    return arm.camera.port if arm.camera else None


FORMAT = "check/1"


def run_check(args: argparse.Namespace) -> int:
    """Connect, print the boards that answered, disconnect."""
    arm = with_links(load_arm(args.arm), link_options(args))
    connection = connect(arm, MonotonicClock(), 1.0 / arm.usual_rate_Hz, camera_port(args, arm))
    try:
        boards = found_boards(connection)
    finally:
        connection.close()
    remedy = punctuality_remedy()
    rights = remedy or "granted"
    answer(
        args,
        {"format": FORMAT, "arm": arm.name, **boards, "rights": rights},
        f"{described(boards)}\nreal-time rights: {rights}\narm {arm.name}: all boards answer and match arm.toml",
    )
    return 0


def found_boards(connection: Connection) -> dict[str, list[dict[str, Any]]]:
    """Every board that answered, by kind, with its identity."""
    encoders = [
        _entry(encoder.where, encoder_identity, "channels", "encoder_bits")
        for encoder in connection.encoders
        if (encoder_identity := encoder.identity) is not None
    ]
    motors = [
        _entry(motor.where, who, "encoder_counts_per_turn") for motor in connection.motors if (who := motor.identity) is not None
    ]
    others = [{"where": where, "identity": identity} for where, identity in connection.others]
    return {"encoder_boards": encoders, "motor_boards": motors, "boards": others}


def described(boards: dict[str, list[dict[str, Any]]]) -> str:
    """The boards as text, one per line."""
    lines = [
        f"{board['where']}: serial number {board['serial_number']}, firmware {board['firmware']}, {board['channels']} channels,"
        f" {board['encoder_bits']}-bit counters"
        for board in boards["encoder_boards"]
    ]
    lines += [
        f"{board['where']}: serial number {board['serial_number']}, firmware {board['firmware']},"
        f" {board['encoder_counts_per_turn']} counts per turn"
        for board in boards["motor_boards"]
    ]
    lines += [f"{board['where']}: {board['identity']}" for board in boards["boards"]]
    return "\n".join(lines)


def _entry(where: str, identity: Any, *more: str) -> dict[str, Any]:
    firmware = f"{identity.firmware >> 8}.{identity.firmware & 255}"
    known = {"where": where, "serial_number": identity.serial_number, "firmware": firmware}
    return known | {name: getattr(identity, name) for name in more}
