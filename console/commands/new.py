"""`armwright new` writes a first arm.toml from a few answers; `armwright arm --from-urdf` from a model, without questions."""

import argparse
import dataclasses
import re
import sys
from pathlib import Path
from typing import Final

import tomli_w

from calib.arm_import import SerialArm, read_arm
from console.commands.progress import say, to_type
from control.errors import ArmError, ArmFileError
from control.files import write_whole
from control.model.description import parse_arm, supplied_text
from control.model.plausible import OVERRIDE
from control.model.rules import LONGEST_NAME, is_file_name
from procedures.folders import require_writable
from procedures.new_arm.answers import Asker, Given, answers_for, ask_shape
from procedures.new_arm.composing import NewArm, commented_text, compose
from procedures.new_arm.motors import stretched_arm

NAME: Final = re.compile(r'^name = ".*?"', re.MULTILINE)
PORT: Final = re.compile(r'^port = "(.*?)"', re.MULTILINE)
ANSWERS: Final = ("joints", "axes", "lengths", "boards", "gears", "counts", "encoders", "ports", "can", "home")
NOT_LIKE: Final = (*(answer for answer in ANSWERS if answer != "ports"), "from_urdf", "from_mjcf", "base", "tip", "as_given")


class Terminal:
    """Asks on standard output and reads standard input; at its end, the remaining questions take their defaults."""

    def ask(self, question: str, default: str) -> str:
        """A line of standard input."""
        sys.stdout.write(f"{question} [{default}]: ")
        sys.stdout.flush()
        line = sys.stdin.readline()
        if not line.endswith("\n"):
            sys.stdout.write("\n")
        return line.strip() or default

    def say(self, text: str) -> None:
        """Print it."""
        say(text)


class Defaults:
    """Takes every default, and says which."""

    def ask(self, question: str, default: str) -> str:
        """The default."""
        say(f"{question}: {default}")
        return default

    def say(self, text: str) -> None:
        """An error in a default is one of ours."""
        raise ArmError(text)


def run(args: argparse.Namespace) -> int:
    """Ask, write the file, and say what to do next."""
    out = Path(args.out)
    if out.exists():
        raise ArmError(f"{out}: already exists and is not overwritten; name another file")
    require_writable(out.parent)  # before somebody has answered every question
    if args.like:
        return _like(args, out)
    options = Given(**{key: getattr(args, key, None) for key in ANSWERS})
    asker: Asker = Defaults() if args.yes else Terminal()
    model = _model(args)
    serial = model if model else stretched_arm(ask_shape(options, asker))
    name = args.name or _name_of(out)
    answers = answers_for(serial, name, args.convention, options, asker)
    new = compose(serial, answers)
    source = args.from_urdf or args.from_mjcf
    origin = f"from {Path(source).name}" if source else "from the answers to `armwright new`"
    arm = dataclasses.replace(new.arm, as_given=bool(args.as_given), placeholders=("motors",) if model else ("masses", "motors"))
    new = dataclasses.replace(new, arm=arm)
    text = commented_text(new, origin)
    _require_readable(text, out, new, source)
    write_whole(out, text, is_new=True)
    say(f"\n{out}: arm {name}, {len(serial.joints)} joints, tip {serial.tip}")
    for note in new.notes:
        say(f"  {note}")
    say(f"Next:\n  {to_type('arm', out)}\n  {to_type('mock', '--arm', out)}")
    return 0


def _like(args: argparse.Namespace, out: Path) -> int:
    """Copy a supplied arm, comments and all, under another name and to other ports."""
    useless = [f"--{key.replace('_', '-')}" for key in NOT_LIKE if getattr(args, key, None)]
    if useless:
        raise ArmError(f"--like {args.like} copies a whole arm: leave {', '.join(useless)} out")
    text, name = supplied_text(args.like), args.name or _name_of(out)
    ports = list(dict.fromkeys(PORT.findall(text)))
    if args.ports and len(args.ports) != len(ports):
        raise ArmError(f"--ports: expected {len(ports)}, as {args.like} has ({', '.join(ports)}), got {len(args.ports)}")
    new_port = dict(zip(ports, args.ports or ports, strict=True))
    text = PORT.sub(lambda found: _line("port", new_port[found[1]]), NAME.sub(lambda _: _line("name", name), text, count=1))
    arm = parse_arm(text, out)
    write_whole(out, text, is_new=True)
    say(f"{out}: arm {name}, {arm.joint_count} joints, like {args.like}")
    say(f"Next:\n  {to_type('arm', out)}\n  {to_type('mock', '--arm', out)}")
    return 0


def _line(key: str, value: str) -> str:
    return tomli_w.dumps({key: value}).rstrip()


def _model(args: argparse.Namespace) -> SerialArm | None:
    if args.from_urdf and args.from_mjcf:
        raise ArmError("--from-urdf and --from-mjcf: give one of them")
    for form, path in (("urdf", args.from_urdf), ("mjcf", args.from_mjcf)):
        if path:
            return read_arm(Path(path), form, args.base, args.tip)
    if args.base or args.tip:
        raise ArmError("--base and --tip name links of a model: give --from-urdf or --from-mjcf, too")
    return None


def _require_readable(text: str, out: Path, new: NewArm, source: str | None) -> None:
    """What is written is read back. An error about what a model says names its place there: the arm.toml is not written."""
    try:
        parse_arm(text, out)
    except ArmFileError as error:
        found = re.fullmatch(r"(\w+)(?:\[\d+\])? of \[\[(\w+)\]\] (\d+)", error.key)
        place = new.place_of(found[2], int(found[3]) - 1, found[1]) if found and source else ""
        if not source:
            raise
        where = f"{source}, {place}" if place else source
        hint = error.hint.replace(OVERRIDE, "give --as-given")
        raise ArmFileError(where, None, error.key, error.expected, error.got, hint) from None


def _name_of(out: Path) -> str:
    name = out.stem[:LONGEST_NAME]
    return name if is_file_name(name) else "my_arm"
