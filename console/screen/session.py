"""The calibration session on a screen: the board with its points, the residual of each record, and the result.

The session is `armwright session --json` in a separate process: it has its own connection, asks before anything moves,
and saves each record, so that opening this screen again resumes it.
"""

import asyncio
import contextlib
import json
import shlex
import signal
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

from textual.app import ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import Horizontal, Vertical
from textual.screen import Screen
from textual.widgets import Input

from console.screen.dashboard import CommandBox
from console.screen.drawing import EventLog, Panel, Row, Span, row, wrapped
from console.screen.operator import subcommand
from control.files import write_whole

HINTS = "Enter yes  redo  skip  bad  note TEXT  jog z -5  quit  space STOP  esc back"
NEAR_ENDING_S = 5.0


class SessionScreen(Screen[None]):
    """The screen of one session: dialogue, board, then calibration."""

    AUTO_FOCUS = "CommandBox"
    BINDINGS: ClassVar[list[BindingType]] = [Binding("escape", "back", show=False, priority=True)]

    def __init__(self, line: str, folder: Path, arm_name: str, say: Callable[[str], None]) -> None:
        """`line`: the session's options as in the shell; `folder` is its --out; `say` writes to the main screen's log."""
        super().__init__()
        self._line, self._folder, self._arm_name, self._say = line, folder, arm_name, say
        self._process: asyncio.subprocess.Process | None = None
        self._board: list[dict[str, Any]] = []
        self._rest = ""  # meaning of an answer when no session runs
        self._doing: asyncio.Task[None] | None = None

    def compose(self) -> ComposeResult:
        """The board beside the records, the question below."""
        yield Panel("session_head")
        with Horizontal(id="session"):
            with Vertical(id="session_left"):
                yield Panel("board")
                yield Panel("legend")
            with Vertical(id="session_right"):
                yield Panel("heading")
                yield EventLog("records", "")
        yield Panel("question", "Question")
        answers = "Enter: yes; or redo, skip, bad, note TEXT, jog z -5, quit"
        yield CommandBox(answers, answers)
        yield Panel("hints")

    def on_mount(self) -> None:
        """Start or resume the session."""
        self.query_one("#session_left").border_title = "Board"
        self.query_one("#session_right").border_title = "Records"
        self._put("heading", [row((HEADING, "muted"))])
        self._put("hints", [row((HINTS, "muted"))])
        self._doing = asyncio.create_task(self._conduct())

    # ---- the session's process

    async def _conduct(self) -> None:
        status = await self._run("session", [*shlex.split(self._line), "--json"], self._hear)
        if not self.is_attached:
            return
        if status != 0:
            self._wait_for("resume", f"The session ended with status {status}; all records are saved. Enter resumes it.")
        elif (self._folder / "points.csv").exists():
            self._wait_for("calibrate", "Enter calibrates with these points, escape goes back.")

    async def _calibrate(self) -> None:
        out = self._result()
        words = ["--points", str(self._folder / "points.csv"), "--out", str(out), "--arm", self._arm_name]
        status = await self._run("calibrate", words, self._write)
        if status == 0:
            self._wait_for("accept", f"Accept the calibrated arm {out / 'arm.toml'}? `y` or `n`")
        else:
            self._wait_for("calibrate", "The calibration failed; Enter tries again, escape goes back.")

    def _result(self) -> Path:
        """A new folder for a calibration."""
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
        """End the process as Ctrl-C would: it holds the arm, and its records are saved."""
        if self._process is not None and self._process.returncode is None:
            with contextlib.suppress(ProcessLookupError):
                self._process.send_signal(signal.SIGINT)

    # ---- messages of the session

    def _hear(self, line: str) -> None:
        try:
            message = json.loads(line)
        except ValueError:
            self._write(line)
            return
        if "ask" in message:
            self._asked(message)
        elif "recorded" in message:
            self._write(*record_text(message))
        elif not str(message.get("message", "")).endswith(" >"):
            self._write(str(message.get("message", line)), "warning" if message.get("is_warning") else "plain")

    def _asked(self, message: Mapping[str, Any]) -> None:
        total = message["done"] + message["left"]
        counted = row((f" {message['done']} of {total} ", "badge"), f"  recorded, {message['left']} left   setup ")
        self._put("session_head", [(*counted, (message["setup"], "strong"), (f"   {self._folder}", "muted"))])
        self._board = message["board"]
        self._draw_board()
        self._ask(message["prompt"])

    def _draw_board(self) -> None:
        if not self._board:
            return
        for panel in self.query("#session_left"):
            legend = legend_rows(panel.size.width)
            self._put("legend", legend)
            self._put("board", board_rows(self._board, panel.size.width, panel.size.height - len(legend)))

    def on_resize(self) -> None:
        """The board fills its panel."""
        self.call_after_refresh(self._draw_board)

    def _write(self, text: str, look: str = "plain") -> None:
        for records in self.query("#records").results(EventLog):
            records.add(text, look)

    def _ask(self, question: str) -> None:
        self._put("question", wrapped(question, "strong", self.size.width - 4))

    def _put(self, name: str, rows: Sequence[Row]) -> None:
        for panel in self.query(f"#{name}").results(Panel):  # no panel while the screen closes
            panel.show(rows)

    def _wait_for(self, what: str, question: str) -> None:
        self._rest = what
        self._ask(question)

    # ---- answers

    async def on_input_submitted(self, event: Input.Submitted) -> None:
        """An answer to the session, or to the calibration after it."""
        event.stop()
        answer = event.value
        if self._rest:
            self._answered(answer.lower())
        elif self._process is not None and self._process.stdin is not None and self._process.returncode is None:
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
        """Save the decision beside the result; the new arm is used after `armwright serve` with its file."""
        folders = sorted(self._folder.glob("calibrated-*"), key=lambda f: int(f.name.rpartition("-")[2]))
        decision = {"accepted": is_accepted, "decided_unix_s": round(time.time(), 3)}
        write_whole(folders[-1] / "decision.json", json.dumps(decision) + "\n")
        text = (
            f"Accepted: `armwright serve --arm {shlex.quote(str(folders[-1] / 'arm.toml'))}` runs the arm with it."
            if is_accepted
            else "Not accepted; the points are kept. Escape goes back."
        )
        self._wait_for("done", text)

    async def action_back(self) -> None:
        """Return to the main screen; a running session ends and can be resumed."""
        self.end()
        self.app.pop_screen()
        if self._process is not None and self._process.returncode is None:
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(self._process.wait(), NEAR_ENDING_S)
        is_over = self._process is None or self._process.returncode is not None
        self._say(f"session {self._folder}: {'' if is_over else 'still ending; then '}`c` resumes it")


# Rows of the session's screen: the board with its cavities, and each record with its residuals.
SIGNS: Mapping[str, Span] = {
    "done": ("#", "accent"),
    "partly": ("+", "accent"),
    "now": ("O", "chosen"),
    "left": (".", "plain"),
    "skipped": ("-", "warning"),
    "bad": ("x", "error"),
}
MEANINGS = {"done": "done", "partly": "some repeats", "now": "now", "left": "left", "skipped": "skipped", "bad": "bad"}
ODD = 3.0  # standard deviations: a warning; the session itself decides what is suspect
HEADING = f"{'point':<12}{'model mm':>9}{'others mm':>11}{'in sd':>7}"


def legend_rows(width: int) -> list[Row]:
    """The legend of the board, wrapped."""
    rows: list[Row] = []
    column = width
    for mark, meaning in MEANINGS.items():
        spans = row(SIGNS[mark], (f" {meaning}  ", "muted"))
        if column + len(meaning) + 4 > width + 2:
            rows.append(())
            column = 0
        rows[-1] += spans
        column += len(meaning) + 4
    return rows


def board_rows(board: Sequence[Mapping[str, Any]], width: int, height: int) -> list[Row]:
    """The board from above, its x axis to the right, one character per cavity (twice as high as wide)."""
    if not board:
        return [row("no cavities in this setup")]
    xs, ys = [p["x_m"] for p in board], [p["y_m"] for p in board]
    span_m = max(max(xs) - min(xs), max(ys) - min(ys), 1e-3)
    columns = max(min(width, 61, 2 * height - 1) - 1, 8)
    rows = round(columns / 2 * (max(ys) - min(ys)) / span_m)
    grid: list[list[Span]] = [[(" ", "plain")] * (columns + 1) for _ in range(rows + 1)]
    for point in board:
        at_row = round((max(ys) - point["y_m"]) / span_m * columns / 2)
        column = round((point["x_m"] - min(xs)) / span_m * columns)
        grid[at_row][column] = SIGNS.get(str(point["mark"]), ("?", "plain"))
    return [tuple(spans) for spans in grid]


def record_text(message: Mapping[str, Any]) -> Span:
    """A record, the model's error, and its deviation from the other records; a suspect one with the remedy."""
    if message["is_suspect"]:
        return message["text"], "error"
    sd, deviation_mm, error_mm = message["deviation_sd"], message["deviation_mm"], message["error_mm"]
    text = f"{message['recorded']:<12}" + (f"{error_mm:9.2f}" if error_mm is not None else f"{'-':>9}")
    if sd is None or deviation_mm is None:
        return text, "plain"
    return (f"{text}{deviation_mm:11.2f}{sd:7.1f}{' ~' if sd > ODD else ''}", "warning" if sd > ODD else "plain")
