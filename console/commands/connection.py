"""Shared by the client commands: the socket of the selected arm."""

import argparse
from pathlib import Path

from control.errors import ArmError
from control.model.arm import Arm
from control.model.description import load_arm
from control.server.channel import SocketChannel
from control.server.client import ArmClient
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


def in_control_of(given: argparse.Namespace, arm: Arm) -> ArmClient:
    """As `in_control`, for work that records poses of `arm`'s tip. ArmError if the runtime has another tool on."""
    client = in_control(given)
    on = client.status()["tool"]
    if on != arm.tool.name:
        client.close()
        raise ArmError(
            f"tool {on!r} is mounted, but {arm.path} begins with {arm.tool.name!r}: `armwright tool {arm.tool.name}`, or give a"
            " file whose first [[tool]] it is"
        )
    return client


def with_present_tool(arm: Arm, client: ArmClient) -> Arm:
    """The arm with the tool on that the runtime has on, for planning."""
    on = client.status()["tool"]
    return arm.with_tool(on) if on else arm
