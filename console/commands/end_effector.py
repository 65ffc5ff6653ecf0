"""Commands for what is at the end of the arm: its tool."""

import argparse
import json
import sys
from collections.abc import Callable, Mapping
from typing import Any

from console.commands.connection import connected
from control.server.client import ArmClient


def run(given: argparse.Namespace) -> int:
    """Send the command's request, and print what has become of it."""
    client = connected(given)
    found = COMMANDS[given.command](client, given)
    if isinstance(found, str):
        sys.stdout.write(f"{found}\n")
    elif given.json:
        sys.stdout.write(json.dumps(found, indent=2) + "\n")
    else:
        sys.stdout.write("".join(f"{line}\n" for line in LISTS[given.command](found)))
    return 0


def _tool(client: ArmClient, given: argparse.Namespace) -> str | dict[str, Any]:
    if given.name is None:
        status = client.status()
        return {"tool": status["tool"], "tools": status["tools"], "payload_kg": status["payload_kg"]}
    client.tool(given.name)
    status = client.status()
    held = f"; the stated payload is still {status['payload_kg']:g} kg" if status["payload_kg"] else ""
    return f"tool {given.name} is on{held}"


def _tool_lines(found: dict[str, Any]) -> list[str]:
    if not found["tools"]:
        return ["one tool without a name; [[tool]] of arm.toml names several"]
    return [f"{'*' if name == found['tool'] else ' '} {name}" for name in found["tools"]]


COMMANDS: Mapping[str, Callable[[ArmClient, argparse.Namespace], str | dict[str, Any]]] = {"tool": _tool}
LISTS: Mapping[str, Callable[[dict[str, Any]], list[str]]] = {"tool": _tool_lines}
