"""`armwright script FILE`: runs operator lines from a file until the end or the first failure.
`armwright replay`: repeats a motion that a hand has guided, from a recording.
"""

import argparse
import sys
from pathlib import Path

from calib.results import entries
from console.commands.connection import connected, in_control, with_present_tool
from console.commands.progress import Progress, answer, say, shown
from console.lines import Grammar, LineError, LineOutcome, parse_lines, replay
from console.specs.table import COMMANDS
from control.files import read_text
from control.model.arm import Arm
from control.model.description import load_arm
from control.server.client import ArmClient
from procedures.guiding import Replay, guided_motion, replayed


def run_script(args: argparse.Namespace) -> int:
    """Parse the whole file first; then run it."""
    grammar = Grammar(COMMANDS, {"arm": args.arm, "socket": args.socket})
    try:
        lines = parse_lines(_text(args.file).splitlines(), grammar)
    except LineError as error:
        raise LineError(f"{args.file}: {error}; nothing was run") from None
    if args.check:
        sys.stdout.write("".join(f"{number}: {line.text}\n" for number, line in lines))
        return 0
    outcomes: list[LineOutcome] = []
    shown_at: list[Progress] = []
    terminal, screen = sys.stdout, sys.stderr

    def connect() -> ArmClient:
        client = in_control(args)
        if screen.isatty():  # Enter resumes what another terminal has paused
            client.on_wait = progress = Progress("script", client.resume, screen)
            shown_at.append(progress)
        return client

    def tell(outcome: LineOutcome) -> None:
        outcomes.append(outcome)
        for progress in shown_at:
            progress.close()
        if not args.json:
            terminal.write(_described(outcome))
            terminal.flush()

    status = replay(lines, connect, tell)
    if args.json:
        answer(args, {"status": status, "lines": [_message(outcome) for outcome in outcomes]}, "")
    return status


def _text(file: str) -> str:
    if file == "-":
        return sys.stdin.read()
    try:
        return read_text(Path(file))
    except UnicodeDecodeError as error:
        raise LineError(f"not UTF-8 text (byte {error.start})") from None
    except OSError as error:
        raise LineError(f"cannot read operator lines: {error.strerror}") from None


def _described(outcome: LineOutcome) -> str:
    took = f"{outcome.took_s:.1f} s"
    done = (
        f"done in {took}"
        if outcome.status == 0
        else f"failed with status {outcome.status} after {took}; the remaining lines were not run"
    )
    return f"{outcome.number}: {outcome.line}\n{_indented(outcome.output)}  {done}\n"


def _indented(text: str) -> str:
    return "".join(f"  {line}\n" for line in text.splitlines())


def _message(outcome: LineOutcome) -> dict[str, object]:
    return entries(outcome, "number", "line", "status", "transcript") | {"took_s": round(outcome.took_s, 3)}


TO_START_SPEED = 0.3  # of the joints' limits, to where the motion begins


def run_replay(args: argparse.Namespace) -> int:
    """Read, smooth and check the motion; then move to its beginning and run it."""
    arm = load_arm(args.arm)
    if args.plan_only:
        _planned(args, arm)
        return 0
    client = connected(args)
    planned = _planned(args, with_present_tool(arm, client))
    with shown(client, args, "replay: to the beginning"):
        client.move_joints(planned.path.knots[0].q_rad, TO_START_SPEED)
    with shown(client, args):
        client.run_path(planned.path.to_message())
    return 0


def _planned(args: argparse.Namespace, arm: Arm) -> Replay:
    guided = guided_motion(Path(args.file), arm, args.run)
    planned = replayed(guided, arm, args.speed)
    slowed = f", {planned.slowdown:.2f} times as long because of {planned.limit}" if planned.limit else ""
    angles = ", ".join(f"{q:z.4f}" for q in planned.path.knots[0].q_rad)
    say(
        f"run {guided.run}: guided for {guided.times_s[-1]:.2f} s; the motion takes {planned.path.duration_s:.2f} s{slowed};"
        f" begins at {angles} rad"
    )
    sys.stdout.flush()
    return planned
