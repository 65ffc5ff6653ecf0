"""Shared by the client commands: the socket of the selected arm."""

import argparse
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from console.commands.progress import to_type
from control.errors import ArmError
from control.model.arm import Arm
from control.model.cell import Cell, load_cell
from control.model.description import load_arm
from control.model.fingerprint import fingerprint
from control.server.channel import SocketChannel, default_path
from control.server.client import ArmClient


def socket_path(args: argparse.Namespace, arm: Arm) -> Path:
    """The socket of the command line, or the default socket of the arm."""
    return Path(args.socket) if args.socket else default_path(arm.name)


def listening(args: argparse.Namespace) -> ArmClient:
    """A client of the runtime, whatever arm it has; within a script, the script's own. RuntimeGone names what starts one."""
    if (connect := getattr(args, "connect", None)) is not None:
        client: ArmClient = connect()
        return client
    if args.socket:
        return ArmClient(SocketChannel(Path(args.socket)))
    served_by = to_type("serve", "--arm", args.arm)
    return ArmClient(SocketChannel(default_path(load_arm(args.arm).name), served_by=served_by))


def connected(args: argparse.Namespace) -> ArmClient:
    """As `listening`, for what depends on the arm of the command line. AnotherArm if the runtime has another."""
    client = listening(args)
    client.require_arm(load_arm(args.arm))
    return client


def in_control(args: argparse.Namespace) -> ArmClient:
    """As `connected`, for work of many steps: others may only watch and stop. RequestRefused if another has it."""
    client = connected(args)
    client.take_control()
    return client


def in_control_of(args: argparse.Namespace, *arms: Arm) -> ArmClient:
    """As `in_control`, for work that records poses of the tip of one of `arms`. ArmError if the runtime has another tool on."""
    client = listening(args)
    status = client.status()
    arm = next((arm for arm in arms if fingerprint(arm) == status.get("fingerprint")), arms[0])
    client.require_arm(arm)
    client.take_control()
    on = status["tool"]
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


@contextmanager
def connected_arms(args: argparse.Namespace, names: tuple[str, ...]) -> Iterator[Mapping[str, ArmClient]]:
    """Clients of some arms of the command's cell. ArmError if they are not on one runtime."""
    cell = load_cell(args.cell)
    clients: dict[str, ArmClient] = {}
    served_by = to_type("serve", "--cell", args.cell)
    try:
        for name in names:
            clients[name] = ArmClient(SocketChannel(default_path(cell.placed(name).name), served_by=served_by))
        _require_one_runtime(clients, cell)
        for name, client in clients.items():
            client.require_arm(cell.placed(name).arm, cell)
        yield clients
    finally:
        for client in clients.values():
            client.close()


def _require_one_runtime(clients: Mapping[str, ArmClient], cell: Cell) -> None:
    for name, client in clients.items():
        served = client.status().get("cell")
        if served is None or not set(clients) <= set(served["arms"]):
            raise ArmError(
                f"arm {name!r} is served alone: stop its runtime (`armwright off --quit --arm {name}`) and start one for all"
                f" arms (`armwright serve --cell {cell.path or cell.name}`)"
            )
