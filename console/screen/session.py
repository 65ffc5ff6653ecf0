"""The calibration session on a screen: the board with its points, what each record says, and the result.

The session itself is `armwright session --json` in a process of its own: it has its own connection, asks before anything moves,
and what it has recorded is on the disk, so that whatever happens to this screen it is resumed by opening it again.
"""

import asyncio
import contextlib
import json
import shlex
import signal
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from textual.app import ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import Horizontal, Vertical
from textual.screen import Screen
from textual.widgets import Input, RichLog, Static

from console.screen.child import subcommand
from console.screen.texts import escaped
from console.screen.widgets import CommandBox
from control.files import write_whole

if TYPE_CHECKING:
    from console.screen.app import ConsoleApp

SIGNS = {"done": ("#", "green"), "left": (".", "none"), "skipped": ("-", "yellow"), "bad": ("x", "red"),
         "now": ("O", "b reverse"), "partly": ("+", "cyan")}  # fmt: skip
LEGEND = "[green]#[/] done  [cyan]+[/] some repeats  [b reverse]O[/] now  . left  [yellow]-[/] skipped  [red]x[/] bad"
LEGEND_rows = 2
ODD = 3.0  # standard deviations: yellow; the session itself says what is suspect
HEADING = "[dim]point       model others[/]"
HINTS = "Enter yes  `redo`  `skip`  `bad`  `note TEXT`  `jog z -5`  `quit`   space STOP   escape back"
NEAR_ENDING_S = 5.0


class SessionScreen(Screen[None]):
    """One session: its talk, its board, then its calibration."""

    AUTO_FOCUS = "CommandBox"
    BINDINGS: ClassVar[list[BindingType]] = [Binding("escape", "back", show=False, priority=True)]
    app: "ConsoleApp"

    def __init__(self, line: str, folder: Path) -> None:
        """`line`: the session's options as of the shell; `folder` is its --out."""
        super().__init__()
        self._line, self._folder = line, folder
        self._process: asyncio.subprocess.Process | None = None
        self._board: list[dict[str, Any]] = []
        self._rest = ""  # what an answer means when no session runs
        self._doing: asyncio.Task[None] | None = None

    def compose(self) -> ComposeResult:
        """The board beside the records, the question below."""
        yield Static(id="session_head")
        with Horizontal():
            with Vertical(id="session_left"):
                yield Static(id="board")
                yield Static(LEGEND, id="legend")
            yield RichLog(id="records", wrap=True, markup=True, max_lines=2000, min_width=20)
        yield Static(id="question")
        yield CommandBox("Enter: it is so; or redo, skip, bad, note TEXT, jog z -5, quit")
        yield Static(escaped(HINTS), id="hints")

    def on_mount(self) -> None:
        """Begin or resume."""
        self.query_one("#records", RichLog).can_focus = False
        self._doing = asyncio.create_task(self._conduct())

    # ---- the session's process

    async def _conduct(self) -> None:
        status = await self._run("session", [*shlex.split(self._line), "--json"], self._hear)
        if not self.is_attached:
            return
        if status != 0:
            self._wait_for(
                "resume",
                f"The session ended with status {status}; what was recorded is kept. Enter resumes it.",
            )
        elif (self._folder / "points.csv").exists():
            self._wait_for("calibrate", "Enter calibrates with these points, escape goes back.")

    async def _calibrate(self) -> None:
        out = self._result()
        words = ["--points", str(self._folder / "points.csv"), "--out", str(out), "--arm", self.app.arm_name]
        status = await self._run("calibrate", words, self._write)
        if status == 0:
            self._wait_for("accept", f"Accept the calibrated arm {out / 'arm.toml'}? `y` or `n`")
        else:
            self._wait_for("calibrate", "The calibration failed; Enter tries again, escape goes back.")

    def _result(self) -> Path:
        """A folder for a calibration: none is overwritten."""
        number = 1
        while (folder := self._folder / f"calibrated-{number}").exists():
            number += 1
        return folder

    async def _run(self, command: str, words: Sequence[str], hear: Any) -> int:
        self._rest = ""
        self._process = await subcommand([command, *words], takes_answers=True)
        if self._process.stdout is not None:
            async for row in self._process.stdout:
                if self.is_attached:
                    hear(row.decode(errors="replace").rstrip())
        return await self._process.wait()

    def end(self) -> None:
        """End the process as Ctrl-C would: it holds the arm and keeps what it has."""
        if self._process is not None and self._process.returncode is None:
            with contextlib.suppress(ProcessLookupError):
                self._process.send_signal(signal.SIGINT)

    # ---- what it says

    def _hear(self, row: str) -> None:
        try:
            message = json.loads(row)
        except ValueError:
            self._write(row)
            return
        if "ask" in message:
            self._asked(message)
        elif "kept" in message:
            self._write(recorded_line(message), is_markup=True)
        elif not str(message.get("told", "")).endswith(" >"):
            text = escaped(str(message.get("told", row)))
            self._write(f"[yellow]{text}[/]" if message.get("is_warning") else text, is_markup=True)

    def _asked(self, message: Mapping[str, Any]) -> None:
        if not self._board:  # the first question: only now is it known how wide the panel is
            self._write(HEADING, is_markup=True)
        total = message["done"] + message["left"]
        self._put(
            "session_head",
            f"[b]{message['done']} of {total}[/] recorded, {message['left']} left   setup [b]{message['setup']}[/]"
            f"   session {escaped(str(self._folder))}",
        )
        self._board = message["board"]
        for left in self.query("#session_left"):
            room = left.size
            self._put("board", "\n".join(board_lines(self._board, room.width, room.height - LEGEND_rows)))
        self._put("question", f"[b]{escaped(message['prompt'])}[/]")

    def _write(self, row: str, is_markup: bool = False) -> None:
        for records in self.query("#records").results(RichLog):
            records.write(row if is_markup else escaped(row))

    def _put(self, name: str, text: str) -> None:
        for panel in self.query(f"#{name}").results(Static):  # none is there while the screen closes
            panel.update(text)

    def _wait_for(self, what: str, question: str) -> None:
        self._rest = what
        self._put("question", f"[b]{escaped(question)}[/]")

    # ---- what is answered

    async def on_input_submitted(self, event: Input.Submitted) -> None:
        """An answer to the session, or to what comes after it."""
        event.stop()
        answer = self.query_one(CommandBox).take()
        if self._rest:
            self._answered(answer.lower())
        elif (
            self._process is not None and self._process.stdin is not None and self._process.returncode is None
        ):
            self._process.stdin.write(f"{answer}\n".encode())
            await self._process.stdin.drain()

    def _answered(self, answer: str) -> None:
        if self._rest == "resume":
            self._doing = asyncio.create_task(self._conduct())
        elif self._rest == "calibrate":
            self._doing = asyncio.create_task(self._calibrate())
        elif self._rest == "accept" and answer in ("y", "yes", "n", "no"):
            self._decide(answer.startswith("y"))

    def _decide(self, is_accepted: bool) -> None:
        """Keep the decision beside the result; the arm that runs is another after `armwright serve` with the new file."""
        folders = sorted(self._folder.glob("calibrated-*"), key=lambda f: int(f.name.rpartition("-")[2]))
        decision = {"accepted": is_accepted, "decided_unix_s": round(time.time(), 3)}
        write_whole(folders[-1] / "decision.json", json.dumps(decision) + "\n")
        text = (
            f"Accepted: `armwright serve --arm {folders[-1] / 'arm.toml'}` runs the arm with it."
            if is_accepted
            else "Not accepted; the points are kept. Escape goes back."
        )
        self._wait_for("done", text)

    async def action_back(self) -> None:
        """To the main screen; a session that runs is ended and can be resumed."""
        self.end()
        self.app.pop_screen()
        if self._process is not None and self._process.returncode is None:
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(self._process.wait(), NEAR_ENDING_S)
        self.app.say(f"session {self._folder}: `c` resumes it")


def board_lines(board: Sequence[Mapping[str, Any]], width: int, height: int) -> list[str]:
    """The board from above, its x axis to the right, a character a cavity (one is twice as high as wide)."""
    if not board:
        return ["no cavities in this setup"]
    xs, ys = [p["x_m"] for p in board], [p["y_m"] for p in board]
    span_m = max(max(xs) - min(xs), max(ys) - min(ys), 1e-3)
    columns = max(min(width, 61, 2 * height - 1) - 1, 8)
    rows = round(columns / 2 * (max(ys) - min(ys)) / span_m)
    grid = [[" "] * (columns + 1) for _ in range(rows + 1)]
    for point in board:
        sign, colour = SIGNS.get(str(point["mark"]), ("?", "none"))
        row = round((max(ys) - point["y_m"]) / span_m * columns / 2)
        column = round((point["x_m"] - min(xs)) / span_m * columns)
        grid[row][column] = f"[{colour}]{sign}[/]"
    return ["".join(line).rstrip() for line in grid]


def recorded_line(message: Mapping[str, Any]) -> str:
    """A record, the model's error there, and how far it is from what the others say; a suspect one in red with what to do."""
    if message["is_suspect"]:
        return f"[b red]{escaped(message['text'])}[/]"
    surprise, off_mm, error_mm = message["surprise"], message["off_mm"], message["error_mm"]
    text = f"{escaped(message['kept']):<11}" + (f"{error_mm:6.2f}" if error_mm is not None else "     -")
    if surprise is None or off_mm is None:
        return text
    colour = "yellow" if surprise > ODD else "none"
    return f"{text} {off_mm:6.2f} mm [{colour}]{surprise:4.1f} sd[/]"
