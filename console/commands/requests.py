"""Commands that send a single request to the runtime: each is an entry of `REQUESTS`."""

import argparse
import sys
from collections.abc import Callable, Mapping

from console.commands.connection import listening
from console.commands.progress import has_line, say, shown
from control.errors import ArmError
from control.server.client import ArmClient, ArmFaulted, fault_text

# Sends the request and waits until it is done; returns a message for the operator.
Request = Callable[[ArmClient, argparse.Namespace], str | None]
LONGEST_WAIT_S = 24 * 3600.0
GUIDING_POLL_S = 0.05
RESTING = ("HOLDING", "BRAKED", "OFF", "GUIDING", "HELD")
GUIDES = "The drives will turn off and the arm will drop."
GUIDES_WEIGHTLESS = "The drives will compensate gravity only as well as the masses are known."
RELEASES = "The arm is held by its boards, as they were found. They will let go and it will drop."


def run(args: argparse.Namespace) -> int:
    """Send the command's request of the table. ArmError, or the error that stopped the arm."""
    client = listening(args)
    if args.command == "guide":
        _require_consent(args, GUIDES_WEIGHTLESS if args.weightless else GUIDES)
    with shown(client, args):
        result = REQUESTS[args.command](client, args)
    if result:
        say(result)
    return 0


def _enable(client: ArmClient, args: argparse.Namespace) -> str | None:
    return None if client.enable() else "the drives are already on; nothing changed"


def _home(client: ArmClient, args: argparse.Namespace) -> str | None:
    if client.home(again=args.again):
        return None
    return "already homed: the boards know their zeros; `armwright home --again` homes again"


def _wait(client: ArmClient, args: argparse.Namespace) -> None:
    if args.seconds is None:
        if getattr(args, "connect", None) is not None and client.ask("mode")["mode"] == "PAUSED":
            raise ArmError("wait: the motion is paused, and nobody but this script can resume it: write `resume` before")
        client.arrive(LONGEST_WAIT_S, RESTING)
        return
    if not 0.0 <= args.seconds <= LONGEST_WAIT_S:
        raise ArmError(f"wait: expected 0 to {LONGEST_WAIT_S:g} s, got {args.seconds:g}")
    client.wait(args.seconds)


def _guide(client: ArmClient, args: argparse.Namespace) -> str | None:
    """Guide until the operator ends it here, or another command does; a script goes on with its next line."""
    client.guide(args.weightless)
    if getattr(args, "connect", None) is not None:
        return None
    hint = "Enter holds the arm where it is; " if sys.stdin.isatty() else ""
    sys.stderr.write(f"guided by hand: {hint}`armwright hold` or `stop` from elsewhere; Ctrl-C brakes\n")
    while client.ask("mode")["mode"] == "GUIDING":
        if has_line():
            client.hold()
            return "holding"
        client.wait(GUIDING_POLL_S)
    if (status := client.status())["mode"] == "FAULT":
        raise ArmFaulted(fault_text(status))
    return f"hand-guiding has ended: {status['mode']}"


def _off(client: ArmClient, args: argparse.Namespace) -> None:
    """Switch off; somebody must hold an arm that its boards hold as they were found."""
    status = client.status()
    is_held = status["mode"] == "HELD" or status["drives"] == "AS_FOUND"
    if is_held:
        _require_consent(args, RELEASES)
    client.off(args.quit, lets_go=is_held)


REQUESTS: Mapping[str, Request] = {
    "acknowledge": lambda client, args: client.acknowledge(),
    "enable": _enable,
    "guide": _guide,
    "hold": lambda client, args: client.hold(),
    "home": _home,
    "off": _off,
    "override": lambda client, args: client.override(args.fraction),
    "pause": lambda client, args: client.pause(),
    "resume": lambda client, args: client.resume(),
    "wait": _wait,
}


def _require_consent(args: argparse.Namespace, what: str) -> None:
    """ArmError unless --yes is given or the operator confirms the release. `what`: happens then."""
    if args.yes:
        return
    if not (sys.stdin.isatty() and sys.stderr.isatty()):
        raise ArmError(f"{args.command}: releases the arm, and there is no terminal to confirm it: give --yes")
    sys.stderr.write(f"{what} Is somebody holding the arm? [y/N] ")
    sys.stderr.flush()
    if sys.stdin.readline().strip().lower() not in ("y", "yes"):
        raise ArmError(f"{args.command}: not confirmed; nothing changed")
