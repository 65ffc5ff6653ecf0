"""`armwright completion SHELL`: a script that completes subcommands, options, choices, arms and files."""

import argparse
import sys
from typing import Any, Final

from console import main
from control.model.description import arm_names
from hil_mocks.scenario import shipped_scenarios

FOLDERS: Final = ("DIR",)
FILES: Final = (
    "FILE",
    "LOG",
    "P",
    "L",
    "M",
    "B",
    "SCRIPT",
    "PATH",
    "URL",
    "DIR|FILE",
    "FILE|DIR",
    "N|FILE",
    "FILE.rrd",
    "NEW.toml",
)
ARM, SCENARIO = "A", "S"
WHERE: Final = {
    "bash": "armwright completion bash > ~/.local/share/bash-completion/completions/armwright",
    "zsh": "armwright completion zsh > FOLDER/_armwright, with FOLDER in $fpath before compinit",
    "fish": "armwright completion fish > ~/.config/fish/completions/armwright.fish",
    "tcsh": "armwright completion tcsh > ~/.armwright.tcsh, and `source ~/.armwright.tcsh` in ~/.tcshrc",
}


def run(args: argparse.Namespace) -> int:
    """Print the script; on a terminal, also how to install it."""
    sys.stdout.write(script(args.shell))
    if sys.stdout.isatty():
        sys.stderr.write(f"\nTo install: {WHERE[args.shell]}\n")
    return 0


def script(shell: str) -> str:
    """The completion script of the whole command line for bash, zsh, fish or tcsh."""
    import shtab

    parser = main.parser()
    for action in _actions(parser):
        if (completes := _completion(action)) is not None:
            action.complete = completes  # type: ignore[attr-defined]  # shtab reads it
    text: str = shtab.complete(parser, shell=shell, preamble={"bash": _named_in_bash()}.get(shell, ""))
    return text


def _actions(parser: argparse.ArgumentParser) -> list[argparse.Action]:
    actions = []
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for sub in action.choices.values():
                actions += _actions(sub)
        elif action.nargs != 0 and not action.choices and action.type is None:
            actions.append(action)
    return actions


def _completion(action: argparse.Action) -> dict[str, Any] | None:
    """The completion of a value, chosen by its metavar; None if there is none."""
    import shtab

    kind = str(action.metavar)
    if kind in FOLDERS:
        return dict(shtab.DIRECTORY)
    if kind == ARM:
        return {**shtab.FILE, "bash": "_armwright_arms"}
    if kind == SCENARIO:
        return {**shtab.FILE, "bash": "_armwright_scenarios"}
    return dict(shtab.FILE) if kind in FILES else None


def _named_in_bash() -> str:
    """Functions that complete supplied names and files."""
    return "".join(
        f'{function}() {{\n  compgen -W "{" ".join(names)}" -- "$1"\n  compgen -f -- "$1"\n}}\n'
        for function, names in (("_armwright_arms", arm_names()), ("_armwright_scenarios", shipped_scenarios()))
    )
