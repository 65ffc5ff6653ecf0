"""The operator's side of `armwright session`: where answers come from, where messages go, what is said first and last."""

from __future__ import annotations

import sys
import time
from argparse import Namespace
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from calib.errors import SessionError
from calib.session.conversation import Talk
from calib.session.folder import POINTS, SessionFolder
from calib.session.plan import Mark
from control.errors import ArmError
from control.server.channel import Message
from control.server.client import ArmClient, ArmFaulted, fault_text
from procedures.session.operator import Reporter, SessionOperator, Words, tell

SPEED = 0.5  # of the joints' limits, for moves near people


@dataclass(frozen=True, slots=True)
class Interface:
    """The source of answers, the output and its form."""

    lines: Iterator[str]
    say: Callable[[str], None]
    operator: type[SessionOperator]

    @staticmethod
    def of(given: Namespace) -> Interface:
        """By the options --json and --replay."""
        say, operator = (tell, Reporter) if given.json else (_say, SessionOperator)
        lines = _replayed(Path(given.replay), say) if given.replay else _typed()
        return Interface(lines, say, operator)

    def introduce(self, folder: SessionFolder, how: str) -> None:
        """Say what session this is; `how`: of its board and seating."""
        plan, state = folder.plan, folder.state
        what = "resumed" if folder.is_resumed else "begun"
        self.say(
            f"session {folder.path} {what}: {len(plan.targets)} points, {state.count(Mark.DONE)} recorded; {how}; `help`"
            " lists the commands"
        )
        for warning in folder.warnings:
            self.say(f"! {warning}")

    def conduct(self, folder: SessionFolder, words: Words, talk: Talk, may_auto: bool) -> None:
        """The whole dialogue, then how many points there are."""
        self.operator(folder, words, self.lines, self.say, may_auto).run(talk)
        done, left = folder.state.count(Mark.DONE), folder.state.count(Mark.LEFT)
        self.say(f"{done} points recorded, {left} left: {folder.path / POINTS}")


def ready(client: ArmClient, name: str = "") -> Message:
    """Status of the homed and holding arm. ArmFaulted or ArmError say what is missing."""
    status, option = client.status(), f" --arm {name}" if name else ""
    if status["mode"] == "FAULT":
        raise ArmFaulted(fault_text(status))
    if not status["is_homed"]:
        raise ArmError(
            f"the arm {name}{' ' if name else ''}is not homed, so its joint angles are unknown: run `armwright enable{option}`,"
            f" then `armwright home{option}`"
        )
    if status["mode"] in ("GUIDING", "BRAKED"):  # a session was killed during hand guiding
        client.hold()
    elif status["mode"] != "HOLDING":
        raise ArmError(
            f"the arm {name}{' ' if name else ''}is {status['mode']}, expected HOLDING: run `armwright enable{option}`"
        )
    return status


def since_start_s(folder: SessionFolder, status: Message) -> float:
    """What to add to the runtime's clock, so that times count from the start of the session, by the host's clock."""
    return time.time() - datetime.fromisoformat(folder.started).timestamp() - float(status["t_s"])


def last_s(folder: SessionFolder) -> float:
    """When the last record was taken: a mock arm's clock restarts."""
    points = folder.points()
    return float(points.t_s.max()) if points is not None else 0.0


def require_same(folder: SessionFolder, fingerprint: str) -> None:
    """SessionError if the session belongs to other arm files."""
    if folder.plan.arm_sha256 != fingerprint:
        raise SessionError(
            f"{folder.path}: this session was started with arm {folder.plan.arm!r} and another version of its file:"
            " give that file with --arm, or --cell for two arms in contact"
        )


def _typed() -> Iterator[str]:
    """Lines from a terminal or a pipe."""
    while line := sys.stdin.readline():
        yield line


def _replayed(script: Path, say: Callable[[str], None]) -> Iterator[str]:
    """Lines of a script, echoed as they are used; `#` starts a comment."""
    try:
        text = script.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise SessionError(f"{script}: not UTF-8 text (byte {error.start})") from None
    return (_echoed(line, say) for line in text.splitlines() if not line.lstrip().startswith("#"))


def _echoed(line: str, say: Callable[[str], None]) -> str:
    if line.strip():
        say(f"  < {line.strip()}")
    return line


def _say(text: str) -> None:
    sys.stdout.write(text if text.endswith("\n") else f"{text}\n")
    sys.stdout.flush()
