"""The running arms of a cell: a client for each, at its usual socket."""

import argparse
from collections.abc import Iterator, Mapping
from contextlib import contextmanager

from control.errors import ArmError
from control.model.cell import Cell, load_cell
from control.server.channel import SocketChannel
from control.server.client import ArmClient
from control.server.sockets import default_path


@contextmanager
def connected_arms(given: argparse.Namespace, names: tuple[str, ...]) -> Iterator[Mapping[str, ArmClient]]:
    """Clients of some arms of the command's cell. ArmError if they are not on one runtime."""
    cell = load_cell(given.cell)
    clients: dict[str, ArmClient] = {}
    try:
        for name in names:
            clients[name] = ArmClient(SocketChannel(default_path(cell.placed(name).name)))
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
