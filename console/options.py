"""Options of the command line as data, so that `--help` needs only argparse."""

import argparse
import contextlib
import importlib
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

Command = Callable[[argparse.Namespace], int]


@dataclass(frozen=True, slots=True)
class Option:
    """One argument: its flags (or its name) and the keywords for argparse.

    `unless` names the flag with which a command writes nothing, and only then does it not demand this one.
    """

    flags: tuple[str, ...]
    details: dict[str, Any] = field(default_factory=dict)
    unless: str = ""


@dataclass(frozen=True, slots=True)
class CommandSpec:
    """One subcommand.

    `module` names the module that runs it, if its name differs from the command's: it is in a folder, or shared with
    other commands, which `args.command` distinguishes.
    """

    name: str
    summary: str
    options: tuple[Option, ...] = ()
    more: str = ""
    module: str = ""

    @property
    def module_name(self) -> str:
        """Name of the module in console.commands that runs it."""
        return self.module or self.name.replace("-", "_")

    @property
    def description(self) -> str:
        """The first sentence of `armwright NAME --help`."""
        return f"{self.summary[0].upper()}{self.summary[1:]}. {self.more}".strip()


def runner(module: str, command: str) -> Command:
    """What runs a command: `run_COMMAND` of its module in console.commands, or `run` of one with a table of its own."""
    found = importlib.import_module(f"console.commands.{module}")
    run: Command = getattr(found, f"run_{command.replace('-', '_')}", None) or found.run
    return run


def finite(text: str) -> float:
    """A finite number: argparse's `float` accepts nan and inf."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise argparse.ArgumentTypeError(f"expected a number, got {text!r}")
    return value


def option(usage: str, what: str, **details: Any) -> Option:
    """An option or positional argument as `--help` shows it, such as `--speed F`; without a value, `--json`, it is a flag.

    `what` is its help, `details` are further keywords of argparse.
    """
    words = usage.split()
    flags = tuple(word for word in words if word.startswith("-")) or (words[0],)
    values = tuple(words[len(flags) :])
    if values:
        details["metavar"] = values if len(values) > 1 else values[0]
    elif flags[0].startswith("-") and not details.keys() & {"action", "choices", "nargs"}:
        details["action"] = "store_true"
    return Option(flags, {"help": what, **details})


def settle_arm(args: argparse.Namespace) -> None:
    """Use the user's default arm if none was given; `has_arm` says whether one was. ConfigError.

    An arm by a name that is no file and not supplied may be one that runs, as the arms of a cell: its runtime says its file.
    """
    named: str | None = getattr(args, "arm", None)
    args.has_arm = named not in (None, USERS_ARM)
    if named == USERS_ARM:
        from console.user_config import default_arm

        args.arm = default_arm()
    elif named and Path(named).name == named and args.command not in ("serve", "stop"):
        from control.model.description import arm_names
        from control.server.channel import NoRuntime, SocketChannel, default_path

        socket = getattr(args, "socket", None) or default_path(named)
        if named in arm_names() or Path(named).exists() or not Path(socket).exists():
            return
        with contextlib.suppress(NoRuntime):
            args.arm = SocketChannel(Path(socket)).request({"do": "arm"})["file"] or named
            args.socket = str(socket)


def add(parser: argparse.ArgumentParser, options: Sequence[Option]) -> None:
    """Add the options to an argparse parser."""
    for declared in options:
        parser.add_argument(*declared.flags, **declared.details)


def missing(options: Sequence[Option], args: argparse.Namespace) -> str:
    """What a command demands beyond argparse's `required`, in words; empty if nothing is missing."""
    for declared in options:
        if declared.unless and _value(args, declared.flags[0]) is None and _value(args, declared.unless) in (None, False):
            return f"the following arguments are required: {declared.flags[0]} (only {declared.unless} needs none)"
    return ""


def _value(args: argparse.Namespace, flag: str) -> object:
    return getattr(args, flag.lstrip("-").replace("-", "_"))


USERS_ARM = ""  # default of --arm: the user's own (console.user_config)
ARM = option(
    "--arm A",
    "an arm.toml, or the name of a supplied arm or of one that runs (default: $ARMWRIGHT_ARM, `arm` in"
    " ~/.config/armwright/config.toml, or right)",
    default=USERS_ARM,
)
CELL = option("--cell C", "a cell.toml, or the name of a supplied cell (pair): several arms instead of one (docs/two_arms.md)")
SOCKET = option("--socket PATH", "the runtime's socket (default: chosen by the arm's name)")
OUT = option("--out DIR", "folder for the results; created if missing", required=True)


def out_unless(flag: str) -> Option:
    """As OUT, of a command that writes nothing with `flag`."""
    what = f"folder for the results; created if missing; {flag} needs none"
    return Option(("--out",), {"metavar": "DIR", "help": what}, unless=flag)


JSON = option("--json", "print JSON for another program")
WIRE_AT = option(
    "--wire-at NAME=X,Y,Z", "the fixed point of a wire is known: in m, in the base frame; may be repeated", action="append"
)
FREE_ZERO = option("--free-zero", "identify the zero of each wire, too: its readings count from an unknown length")
BOARDS = option("--boards FILE", "boards.json of `armwright register`: where the board stands in each setup")


def points(what: str, *, is_required: bool = False) -> Option:
    """One or more points.csv."""
    return option("--points P", f"{what}; may be repeated", action="append", required=is_required)


AS_GIVEN = option(
    "--as-given", "the points mean what they say: do not refuse them for what they look like (another unit, another arm)"
)


def payload(what: str, **details: Any) -> Option:
    """A mass at the tip."""
    return option("--payload KG", what, type=finite, **details)


def scenario(**details: Any) -> Option:
    """What the mock arm hides."""
    what = "scenario of the mock arm: a file or a supplied name (default: demo); docs/mock_robot.md"
    return option("--scenario S", what, **details)


RATE = option("--rate HZ", "cycles per second (default: 500, or what the arm's boards carry)", type=finite)
LINKS = (
    option("--encoder URL", "serial port of an encoder board, or any pyserial URL", action="append"),
    option("--can-interface NAME", "python-can's interface: socketcan, slcan, udp_multicast, ..."),
    option("--can-channel CHANNEL", "python-can's channel: can0, /dev/ttyACM1, 239.74.163.2, ..."),
    option("--can-option K=V", "passed to python-can's interface, e.g. port=43113", action="append"),
    option("--camera-port PORT", "UDP port on which camera frames arrive (docs/camera.md)", type=int),
)
