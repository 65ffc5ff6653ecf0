"""Shared by the client commands: the socket of the selected arm."""

import argparse
from pathlib import Path

from control.model.arm import Arm
from control.model.description import load_arm
from control.server.client import ArmClient, SocketChannel
from control.server.sockets import default_path


def socket_path(given: argparse.Namespace, arm: Arm) -> Path:
    """The socket of the command line, or the default socket of the arm."""
    return Path(given.socket) if given.socket else default_path(arm.name)


def connected(given: argparse.Namespace) -> ArmClient:
    """A client of the runtime; within a script, the script's own. RuntimeGone names the command that starts one."""
    if (connect := getattr(given, "connect", None)) is not None:
        client: ArmClient = connect()
        return client
    return ArmClient(SocketChannel(socket_path(given, load_arm(given.arm))))


def in_control(given: argparse.Namespace) -> ArmClient:
    """As `connected`, for work of many steps: others may only watch and stop. RequestRefused if another has it."""
    client = connected(given)
    client.take_control()
    return client
