"""Walks a journey: a page whose commands are typed in a folder of its own, with real processes, and whose words must come.

An indented line with `$ ` is a command for the shell, one with `> ` what is typed while it runs; the other indented lines
under it are words that it says, in this order (`...`: anything); `> ^C` interrupts it when it has said those before it. A
command that ends with `&` runs on once it has said them, and is ended with the journey. `# status 1` is the exit status where
it is not 0. `{NAME}` in a command is a word of the arm (arms.toml), or one that a command has said where `{NAME}` stands among
its words.
"""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
import time
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

HERE = Path(__file__).parent
ARMS: dict[str, dict[str, str]] = tomllib.loads((HERE / "arms.toml").read_text(encoding="utf-8"))
LIMIT_s = 900.0  # of one command, on a busy machine
NO_DECISION = {f"--{word}" for word in ["arm", "out", "yes", "mock", "points", "log", "against", "json", "scenario", "quit"]}


class Stumble(AssertionError):
    """A command of the journey did not do, or did not say, what the page says."""


@dataclass
class Step:
    """A command with what is typed and said; `line` of the page."""

    line: int
    command: str
    typed: list[str] = field(default_factory=list)
    says: list[str] = field(default_factory=list)
    says_first: list[str] = field(default_factory=list)  # until it is interrupted


@dataclass(frozen=True)
class Journey:
    """A page of this folder."""

    page: Path

    @property
    def title(self) -> str:
        """Its heading."""
        return self.page.read_text(encoding="utf-8").partition("\n")[0].lstrip("# ")

    def arms(self, when: str = "Walked by") -> list[str]:
        """Who walks it, by its own line `Walked by: ...`, or `At each change: ...` for `make test`."""
        found = re.search(rf"^{when}: (.*)\.$", self.page.read_text(encoding="utf-8"), re.MULTILINE)
        named = [] if found is None else found[1].split(", ")
        return [arm for arm, words in ARMS.items() if arm in named or ("all" in named and "ONLY_NAMED" not in words)]

    def steps(self) -> Iterator[Step]:
        """Its commands in order."""
        step: Step | None = None
        for number, line in enumerate(self.page.read_text(encoding="utf-8").splitlines(), 1):
            if line.startswith("    $ "):
                if step:
                    yield step
                step = Step(number, line[6:])
            elif step and line == "    > ^C":
                step.says_first, step.says = step.says, []
            elif step and line.startswith("    > "):
                step.typed.append(line[6:])
            elif step and line.startswith("    "):
                step.says.append(line.strip())
        if step:
            yield step


JOURNEYS = {page.stem: Journey(page) for page in sorted(HERE.glob("*.md"))}


@dataclass
class Walk:
    """What a journey took: minutes, and what the user had to decide."""

    minutes: float = 0.0
    options: list[str] = field(default_factory=list)
    answers: int = 0


def walk(journey: Journey, arm: str, folder: Path) -> Walk:
    """Walk it in an empty folder with the words and files of an arm. Stumble names the line of the page."""
    begun_s, done, words = time.monotonic(), Walk(), dict(ARMS[arm])
    shutil.copytree(HERE / "files", folder, dirs_exist_ok=True)
    run = folder / "run"
    run.mkdir(mode=0o700)
    path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    around = os.environ | {"PATH": path, "PYTHONPATH": str(HERE.parents[1]), "HOME": str(folder), "XDG_RUNTIME_DIR": str(run)}
    around["ARMWRIGHT_RUNTIME_DIR"] = str(run / "armwright")
    running: list[subprocess.Popen[bytes]] = []
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # in a background job, and what bash begins would ignore it, too
        signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        for step in journey.steps():
            command = re.sub(r"\{([A-Z_]+)\}", lambda name: words[name[1]], step.command)
            if "armwright" in command:
                done.options += [word for word in re.findall(r" (--[a-z-]+)", command) if word not in NO_DECISION]
            done.answers += len(step.typed)
            step.command = command
            _take(step, f"{journey.page.name}:{step.line}", folder, around, words, running)
    finally:
        for process in reversed(running):
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGINT)
                process.wait(LIMIT_s)
    done.minutes = (time.monotonic() - begun_s) / 60.0
    return done


def _take(
    step: Step, where: str, folder: Path, around: dict[str, str], words: dict[str, str], running: list[subprocess.Popen[bytes]]
) -> None:
    command, _, remark = step.command.partition(" # ")
    status = int(remark.removeprefix("status ")) if remark.startswith("status ") else 0
    said = folder / f"said-{where.rpartition(':')[2]}.txt"
    with said.open("wb") as out:
        process = subprocess.Popen(
            command.removesuffix("&"),
            shell=True,
            executable="/bin/bash",
            cwd=folder,
            env=around,
            stdin=subprocess.PIPE,
            stdout=out,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )
    if process.stdin:
        process.stdin.write("".join(f"{line}\n" for line in step.typed).encode())
        process.stdin.close()
    if command.endswith("&"):
        running.append(process)
        _hear(step.says, said, words, process)
        status = process.poll() or 0
    else:
        if step.says_first and _hear(step.says_first, said, words, process):
            os.killpg(process.pid, signal.SIGINT)
        try:
            process.wait(LIMIT_s)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
    says = step.says_first + step.says
    if (process.poll() or 0) != status or not _found(says, said, words):
        wanted = "\n".join(says)
        got = said.read_text(encoding="utf-8", errors="replace")[-4000:]
        raise Stumble(f"{where}: $ {command}\nstatus {process.poll()}, expected {status} and the words\n{wanted}\ngot\n{got}")


def _hear(says: list[str], said: Path, words: dict[str, str], process: subprocess.Popen[bytes]) -> bool:
    """Wait for words while the process runs; whether they came."""
    end_s = time.monotonic() + LIMIT_s
    while not _found(says, said, words):
        if process.poll() is not None or time.monotonic() > end_s:
            return False
        time.sleep(0.05)
    return True


def _found(says: list[str], said: Path, words: dict[str, str]) -> bool:
    """Whether all words were said, in order; those that the journey names are taken up."""
    pattern = r".*?".join(_pattern(line, words) for line in says)
    match = re.search(pattern, said.read_text(encoding="utf-8", errors="replace"), re.DOTALL)
    if match:
        words.update(match.groupdict())
    return match is not None


def _pattern(line: str, words: dict[str, str]) -> str:
    parts = re.split(r"(\.\.\.|\{[A-Z_]+\})", line)
    known = {"...": r".*?"} | {f"{{{name}}}": re.escape(word) for name, word in words.items()}
    return "".join(known.get(part) or (rf"(?P<{part[1:-1]}>\S+)" if part.startswith("{") else re.escape(part)) for part in parts)
