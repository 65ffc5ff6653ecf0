"""`armwright console`: the operator's screen."""

import argparse
import os
import secrets
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from console.commands.connection import socket_path
from control.errors import ArmError
from control.model.cell import load_cell
from control.model.description import load_arm
from control.server.channel import CONTROL_KEY, default_path

if TYPE_CHECKING:
    from console.screen.app import ArmAtDesk


def run(args: argparse.Namespace) -> int:
    """Run the screen until ctrl+q; the arm is held then."""
    if not (sys.stdin.isatty() and sys.stdout.isatty()):
        raise ArmError("console: needs a terminal; `armwright script` runs files of commands")
    from console.screen.app import ConsoleApp

    os.environ.setdefault(CONTROL_KEY, secrets.token_hex(16))  # the commands that it starts are this operator's, too
    ConsoleApp(_of_cell(args) if args.cell is not None else [_of_arm(args)]).run()
    return 0


def _of_arm(args: argparse.Namespace) -> "ArmAtDesk":
    from console.screen.app import ArmAtDesk
    from console.screen.operating import Files

    arm = load_arm(args.arm)
    socket = socket_path(args, arm)
    files = Files(Path(args.places), Path(args.teach), Path(args.keep) if args.keep else None, Path(args.sessions))
    return ArmAtDesk(arm, socket, files, {"--arm": args.arm, "--socket": str(socket)})


def _of_cell(args: argparse.Namespace) -> "list[ArmAtDesk]":
    """A station an arm. Each has files of its own: a place of one arm is another place for the next."""
    from console.screen.app import ArmAtDesk
    from console.screen.operating import Files

    if args.socket is not None:
        raise ArmError("--socket: not together with --cell: every arm of a cell has its own")
    stations = []
    for placed in load_cell(args.cell).arms:
        name, socket = placed.name, default_path(placed.name)
        places, taught, sessions = (_own(path, name) for path in (args.places, args.teach, args.sessions))
        files = Files(places, taught, _own(args.keep, name) if args.keep else None, sessions)
        shared = {"--arm": str(placed.arm.path or name), "--socket": str(socket)}
        stations.append(ArmAtDesk(placed.arm, socket, files, shared))
    return stations


def _own(path: str, arm: str) -> Path:
    """places.toml of arm `left`: places-left.toml."""
    whole = Path(path)
    return whole.with_name(f"{whole.stem}-{arm}{whole.suffix}")
