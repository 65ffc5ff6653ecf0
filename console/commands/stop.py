"""`armwright stop`: needs no readable file and reaches every runtime of this user.

A stop must not fail for unrelated reasons: an error in arm.toml or the configuration, or a hanging runtime.
"""

import argparse
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

from control.errors import ArmError
from control.server.channel import NoRuntime, SocketChannel, find_sockets, foreign_folders
from control.server.client import ArmClient, ArmFaulted


def run(args: argparse.Namespace) -> int:
    """Stop; exit status 1 if a runtime did not answer, its arm is in FAULT, or none runs."""
    if (connect := getattr(args, "connect", None)) is not None:  # in a script: only its own runtime
        connect().stop()
        return 0
    return stop_all(_wanted(args), args.take)


def _wanted(args: argparse.Namespace) -> Sequence[Path]:
    """The sockets of the selected arms."""
    if args.socket:
        return [Path(args.socket)]
    for problem in foreign_folders():
        sys.stderr.write(f"armwright: {problem}\n")
    if not args.arm:
        return find_sockets()
    if found := find_sockets(args.arm):  # its name is enough, as for the arms of a cell
        return found
    from control.model.description import load_arm

    try:
        return find_sockets(load_arm(args.arm).name)
    except (ArmError, OSError) as error:
        sys.stderr.write(f"armwright: {error}\narmwright: stopping every runtime of this user instead\n")
        return find_sockets()


def stop_all(paths: Sequence[Path], takes: bool = False) -> int:
    """Ask all runtimes in parallel, so that a hanging one does not delay the others; print a line for each.

    `takes`: end the control of whatever client has it, too.
    """
    with ThreadPoolExecutor(max(1, len(paths))) as pool:
        ends = [end for end in pool.map(partial(_stopped, takes=takes), paths) if end is not None]
    for is_good, text in ends:
        (sys.stdout if is_good else sys.stderr).write(f"{text}\n")
    if not ends:
        sys.stderr.write("armwright: stop: no runtime found (`armwright serve` starts one)\n")
    return 0 if ends and all(is_good for is_good, _ in ends) else 1


def _stopped(path: Path, takes: bool) -> tuple[bool, str] | None:
    """Whether the runtime at a socket stopped its arm, and a message; None if nothing listens."""
    try:
        client = ArmClient(SocketChannel(path))
        try:
            if takes:
                client.ask("control", revoke=True)
            client.stop()
            status = client.status()
            return True, f"arm {status['arm']!r} at {path}: stopped, {status['mode']}"
        finally:
            client.close()
    except NoRuntime:
        return None
    except ArmFaulted as fault:
        return False, f"armwright: {path}: {fault}"
    except ArmError as error:
        return False, f"armwright: {error}"
