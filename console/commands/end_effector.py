"""Commands for what is at the end of the arm: tool, gripper, digital pins."""

import argparse
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from console.commands.connection import connected
from console.commands.progress import answer
from control.errors import ArmError
from control.server.client import ArmClient

STOPS = ("STOPPED", "FAILED", "RELEASED")  # a gripper that did not get where it was to go


@dataclass(frozen=True, slots=True)
class Answer:
    """What a command found: as JSON, as lines, and whether that is a failure."""

    content: dict[str, Any]
    lines: list[str]
    is_failure: bool = False


def run(args: argparse.Namespace) -> int:
    """Send the command's request, wait for its end, and print what has become of it."""
    outcome = COMMANDS[args.command](connected(args), args)
    if args.json or outcome.lines:
        answer(args, outcome.content, "\n".join(outcome.lines))
    return 1 if outcome.is_failure else 0


def _tool(client: ArmClient, args: argparse.Namespace) -> Answer:
    if args.name is not None:
        client.tool(args.name)
    status = client.status()
    on, names, held_kg = status["tool"], status["tools"], status["payload_kg"]
    lines = [f"{'*' if name == on else ' '} {name}" for name in names]
    if args.name is not None:
        lines = [f"tool {on} is on" + (f"; the stated payload is still {held_kg:g} kg" if held_kg else "")]
    elif not names:
        lines = ["one tool without a name; [[tool]] of arm.toml names several"]
    return Answer({"tool": on, "tools": names, "payload_kg": held_kg}, lines)


def _gripper(client: ArmClient, args: argparse.Namespace) -> Answer:
    if args.action is not None and args.to is not None:
        raise ArmError("gripper: give either open, close, stop, or --to")
    if args.action is None and args.to is None:
        if args.force is not None or args.must_hold:
            raise ArmError("gripper: --force and --must-hold need open, close or --to")
        state = client.status()["gripper"]
        if state is None:
            raise ArmError("gripper: arm.toml describes none: add a [gripper]")
    else:
        state = client.grip(args.action or "move", args.to, args.force)
    is_empty = args.must_hold and state["state"] != "GRIPPED"
    return Answer(state, [gripper_text(state)], is_empty or (state["state"] in STOPS and args.action != "stop"))


def gripper_text(state: Mapping[str, Any]) -> str:
    """One line: what the gripper does, its opening and its force."""
    opening = "" if state["opening_m"] is None else f", {1e3 * state['opening_m']:.1f} mm"
    force = f" with {state['force_N']:.0f} N" if state["state"] == "GRIPPED" else ""
    lost = "; it has lost what it held" if state["has_lost"] else ""
    return f"gripper {state['text']}{opening}{force}{lost}"


def _digital(client: ArmClient, args: argparse.Namespace) -> Answer:
    if args.level is not None and args.until is not None:
        raise ArmError("digital: give either a level, or --until")
    if args.until is not None and args.name is None:
        raise ArmError("digital: --until needs the NAME of a pin")
    is_late = False
    if args.level is not None:
        client.set_output(args.name, args.level == "on")
        return Answer({args.name: args.level == "on"}, [])
    if args.until is not None:
        is_late = not client.await_level(args.name, args.until == "on", args.timeout)
    pins = client.status()["digital"]
    if args.name is not None and args.name not in pins:
        raise ArmError(f"digital: no pin {args.name!r}: expected one of {', '.join(pins) or 'none'}")
    if not pins:
        return Answer({}, ["no pins; [[digital]] of arm.toml names them"])
    chosen = {args.name: pins[args.name]} if args.name is not None else pins
    return Answer(chosen, [pin_text(name, pin) for name, pin in chosen.items()], is_late)


def pin_text(name: str, pin: Mapping[str, Any]) -> str:
    """One line: name, direction, level."""
    level = "unknown: its board does not say" if pin["level"] is None else "on" if pin["level"] else "off"
    return f"{name} ({pin['direction']}): {level}"


COMMANDS: Mapping[str, Callable[[ArmClient, argparse.Namespace], Answer]] = {
    "digital": _digital,
    "gripper": _gripper,
    "tool": _tool,
}
