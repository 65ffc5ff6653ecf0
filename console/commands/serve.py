"""`armwright serve`: runs the loop in this process until it is stopped."""

import argparse
import sys
from pathlib import Path

from console.commands.connection import socket_path
from control.errors import ArmError
from control.hardware.connect import with_links
from control.model.arm import Arm
from control.model.can_bus import USUAL_LOAD, bus_load, good_rate_Hz, usual_rate_Hz
from control.model.cell import Cell, cell_of_one, load_cell
from control.model.description import load_arm
from control.server.process import ServeOptions, serve
from control.server.sockets import default_path
from procedures.link_options import link_options

LOWEST_RATE_Hz, HIGHEST_RATE_Hz = 50.0, 1200.0  # three boards at 1 Mbit/s end at 1234 Hz
LARGEST_LOAD = 0.95  # of a CAN bus that several arms share
OF_ONE_ARM = ("socket", "encoder", "can_interface", "can_channel", "can_option", "camera_port")


def run(given: argparse.Namespace) -> int:
    """Connect and serve."""
    if given.rate is not None and not LOWEST_RATE_Hz <= given.rate <= HIGHEST_RATE_Hz:
        raise ArmError(f"--rate: expected {LOWEST_RATE_Hz:g} to {HIGHEST_RATE_Hz:g} Hz, got {given.rate:g}")
    if given.cell is not None:
        cell = _cell(given)
        sockets = {name: default_path(name) for name in cell.names}
    else:
        arm = with_links(load_arm(given.arm), link_options(given))
        cell, sockets = cell_of_one(arm), {arm.name: socket_path(given, arm)}
    arms = [placed.arm for placed in cell.arms]
    rate_Hz = given.rate or usual_rate_Hz(arms)
    load = bus_load(arms, rate_Hz)
    if given.cell is not None and load > LARGEST_LOAD:
        raise ArmError(
            f"--rate: at {rate_Hz:g} Hz the arms' boards would need {100 * load:.0f} % of their CAN bus (at most"
            f" {100 * LARGEST_LOAD:.0f} %): give a lower rate, or each arm a bus of its own"
        )
    if load > USUAL_LOAD:
        good_Hz = good_rate_Hz(arms, rate_Hz)
        remedy = (
            f"--rate {good_Hz:.0f}"
            if good_Hz >= LOWEST_RATE_Hz
            else "fewer boards, or rarer messages of theirs"
        )
        sys.stderr.write(
            f"armwright: --rate {rate_Hz:g}: the boards need {100 * load:.0f} % of their CAN bus, good is up to"
            f" {100 * USUAL_LOAD:.0f} % ({remedy}): frames may come late, which is a fault\n"
        )
    ports = {placed.name: camera_port(given, placed.arm) for placed in cell.arms}
    serve(cell, ServeOptions(sockets, Path(given.log), 1.0 / rate_Hz, ports))
    return 0


def _cell(given: argparse.Namespace) -> Cell:
    """The cell of the command line. ArmError for an option that is of one arm."""
    for name in OF_ONE_ARM:
        if getattr(given, name) is not None:
            option = name.replace("_", "-")
            raise ArmError(
                f"--{option}: not together with --cell: ports and buses are in cell.toml and its arms' files"
            )
    return load_cell(given.cell)


def camera_port(given: argparse.Namespace, arm: Arm) -> int | None:
    """The camera's port of the command line, or of the arm's [camera]; None for an arm without a camera."""
    if given.camera_port is not None:
        return int(given.camera_port)
    return arm.camera.port if arm.camera else None
