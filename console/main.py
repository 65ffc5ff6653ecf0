"""`armwright`: parses the command line and runs the module of the subcommand.

Only argparse is imported before the subcommand is known, so that `--help` is fast; a command's own module is imported
when it runs. Exit status: 0 done, 1 the arm or a check failed, 2 wrong input and nothing moved, 130 interrupted.
"""

import argparse
import os
import sys
from collections.abc import Sequence
from typing import Any, ClassVar

from console import options
from console.specs.table import COMMANDS, FOR_TASKS, GROUPS
from control.plain_text import folded, prepare_streams
from firmware_iface import interrupts

_OPTIONS = {command.name: command.options for command in COMMANDS}


class _CommandLine(argparse.ArgumentParser):
    """Answers an unknown command with those for that task, or spelt like it, not with all sixty."""

    def _check_value(self, action: argparse.Action, value: str) -> None:
        if isinstance(action, argparse._SubParsersAction) and value not in action.choices:
            from difflib import get_close_matches

            words = FOR_TASKS | {name: (name,) for name in action.choices}
            word = value.lower()
            alike = [word] if word in words else get_close_matches(word, words, 2)
            near = " or ".join(dict.fromkeys(command for each in alike for command in words[each]))
            meant = f" (did you mean {near}?)" if near else ""
            raise argparse.ArgumentError(action, f"no command {value!r}{meant}; `armwright --help` lists them")
        super()._check_value(action, value)


class _ByJob(argparse.HelpFormatter):
    """Lists the commands under their jobs."""

    _titles: ClassVar = {group[0].name: title for title, group in GROUPS.items()}

    def _format_action(self, action: argparse.Action) -> str:
        title = self._titles.get(str(action.metavar)) if not action.option_strings else None
        return (f"\n  {title}:\n" if title else "") + super()._format_action(action)


class _Subcommand(argparse.ArgumentParser):
    """Is made when something is asked of it: all of them would be most of the time that a short command takes."""

    def __init__(self, spec: options.CommandSpec, **keys: Any) -> None:
        self._spec = spec
        self._keys = keys

    @property
    def is_made(self) -> bool:
        return "_keys" not in self.__dict__

    def __getattr__(self, name: str) -> Any:
        keys = self.__dict__.pop("_keys", None)
        if keys is None:
            raise AttributeError(f"{type(self).__name__} has no {name!r}")
        super().__init__(**keys)
        options.add(self, self._spec.options)
        self.set_defaults(module=self._spec.module_name)
        return getattr(self, name)


def parser() -> argparse.ArgumentParser:
    """The whole command line."""
    top = _CommandLine(
        prog="armwright",
        description="Control runtime, mock robot and calibration for a self-built robot arm.",
        formatter_class=_ByJob,
        epilog="`armwright demo` shows the full workflow on a mock arm. Every command has its own --help.",
    )
    top.add_argument("--version", action="store_true", help="print the version and exit")
    commands = top.add_subparsers(dest="command", metavar="COMMAND", title="commands", parser_class=_Subcommand)
    for command in COMMANDS:
        commands.add_parser(command.name, help=command.summary, description=command.description, spec=command)
    return top


def _usage_of(top: argparse.ArgumentParser, command: str | None) -> argparse.ArgumentParser:
    """The parser whose usage to print: that of the command, if there is one."""
    for action in top._actions:
        if isinstance(action, argparse._SubParsersAction) and command in action.choices:
            found: argparse.ArgumentParser = action.choices[command]
            return found
    return top


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit status."""
    try:
        chosen = _chosen(arguments)
        if isinstance(chosen, int):
            return chosen
        with interrupts.heard():
            return run(*chosen)
    except KeyboardInterrupt:
        return fail("interrupted", interrupts.STATUS)


def _chosen(arguments: Sequence[str] | None) -> int | tuple["options.Command", argparse.Namespace]:
    """The command to run and its arguments, or an exit status where there is none to run."""
    prepare_streams()
    top = parser()
    args, unknown = top.parse_known_args(arguments)
    if unknown:
        is_arm = "arm" in args and any(word.endswith(".toml") for word in unknown)
        remedy = ": the arm's file follows --arm" if is_arm else ""
        _usage_of(top, args.command).error(f"unrecognized arguments: {' '.join(unknown)}{remedy}")
    if lack := options.missing(_OPTIONS.get(args.command, ()), args):
        _usage_of(top, args.command).error(lack)
    if args.version:
        from importlib.metadata import version

        sys.stdout.write(f"armwright {version('armwright')}\n")
        return 0
    if args.command is None:
        top.print_help()
        return 2
    # The matrices are small: with OpenBLAS threads, an identification takes three times as long on a busy machine.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    return options.runner(args.module, args.command), args


def run(command: "options.Command", args: argparse.Namespace) -> int:
    """Run a command and convert exceptions to a message and an exit status."""
    from calib.errors import CalibrationError
    from control.errors import ArmError
    from control.files import NO_ROOM, WRONG_PLACE, NotWritten
    from control.server.client import ArmFaulted, ArmLate, MotionStopped
    from firmware_iface.errors import LinkError
    from hil_mocks.errors import MockError

    try:
        options.settle_arm(args)
        return command(args)
    except (ArmFaulted, ArmLate, MotionStopped) as fault:
        return fail(str(fault), 1)
    except (ArmError, CalibrationError, LinkError, MockError) as error:
        return fail(str(error), 2)
    except KeyboardInterrupt:
        return fail("interrupted", 130)
    except BrokenPipeError:
        sys.stderr.close()
        return 1
    except NotWritten as error:
        return fail(str(error), 2 if error.errno in WRONG_PLACE else 1)
    except UnicodeEncodeError as error:
        return fail(f"{error.object!r} cannot be written in {error.encoding}: set a UTF-8 locale (LC_ALL=C.UTF-8)", 2)
    except OSError as error:  # e.g. a folder that cannot be created, a file that cannot be read
        return fail(f"{error.filename or 'the system'}: {error.strerror or error}", 1 if error.errno in NO_ROOM else 2)


def fail(message: str, status: int) -> int:
    """Print an error on standard error; returns `status`."""
    sys.stderr.write(folded(f"armwright: {message}\n", sys.stderr))
    return status


if __name__ == "__main__":
    sys.exit(main())
