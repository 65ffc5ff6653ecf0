"""What the client commands share: the socket of the arm that is meant."""

import argparse
from pathlib import Path

from control.model.arm import Arm
from control.model.description import load_arm
from control.server.client import ArmClient, SocketChannel
from control.server.sockets import default_path


def socket_path(given: argparse.Namespace, arm: Arm) -> Path:
    """The socket that the command line says, or the place of the arm's name."""
    return Path(given.socket) if given.socket else default_path(arm.name)


def connected(given: argparse.Namespace) -> ArmClient:
    """A client of the runtime; of a script, its own. RuntimeGone says how to start one."""
    if (connect := getattr(given, "connect", None)) is not None:
        client: ArmClient = connect()
        return client
    return ArmClient(SocketChannel(socket_path(given, load_arm(given.arm))))
