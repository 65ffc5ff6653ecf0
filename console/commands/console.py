"""`armwright console`: the operator's screen."""

import argparse
import os
import secrets
import sys
from pathlib import Path

from console.commands.connection import socket_path
from control.errors import ArmError
from control.model.description import load_arm
from control.server.client import CONTROL_KEY


def run(given: argparse.Namespace) -> int:
    """Run the screen until ctrl+q; the arm is held then."""
    if not (sys.stdin.isatty() and sys.stdout.isatty()):
        raise ArmError("console: needs a terminal; `armwright script` runs files of commands")
    from console.screen.app import ConsoleApp, Files

    os.environ.setdefault(
        CONTROL_KEY, secrets.token_hex(16)
    )  # the commands that it starts are this operator's, too
    arm = load_arm(given.arm)
    socket = socket_path(given, arm)
    files = Files(
        Path(given.places), Path(given.teach), Path(given.keep) if given.keep else None, Path(given.sessions)
    )
    ConsoleApp(arm, socket, files, {"--arm": given.arm, "--socket": str(socket)}).run()
    return 0
