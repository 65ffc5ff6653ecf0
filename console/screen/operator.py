"""The operator's actions without a screen: lines, jogs and the stop, over the console's connection to the runtime.

Requests that the runtime answers at once go over the link; every other line is a subcommand in a separate process, one at a
time, so that planning, homing or a session never delays the space bar. The stop also ends that process: what would follow the
motion must not run.
"""

import asyncio
import contextlib
import os
import shlex
import signal
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec

from console.lines import Grammar, LineError, ParsedLine
from control.files import open_to_append, utf_8
from control.model.arm import Arm
from control.model.fingerprint import AnotherArm, fingerprint, require_same
from control.server.channel import CONTROL_KEY, ForeignRuntime, require_own_runtime
from control.server.messages import STOPPING, WATCHING
from firmware_iface.installation import command
from firmware_iface.interrupts import ends_with_parent

Message = dict[str, Any]
POLL_S = 0.05
ANSWER_S = 1.0  # the link is lost if the loop does not answer within this time
RETRY_S = 0.5
_LONGEST_LINE_bytes = 1 << 20


class RuntimeLost(Exception):
    """No answer; the text is the message for the operator."""


class RuntimeLink:
    """A runtime's socket on an event loop. `on_status(status or None)` is called after every poll; None: lost.

    A runtime that has another arm than `arm` is watched and stopped, but not commanded; its status warns of it. One with
    another number of joints is a lost link.
    """

    def __init__(self, path: Path, arm: Arm, on_status: Callable[[Message | None], Awaitable[None]]) -> None:
        self.path = path
        self._arm, self._another = arm, ""
        self.status: Message | None = None
        self.why_lost = "not connected yet"
        self.answer_s = ANSWER_S
        self._on_status = on_status
        self._writer: asyncio.StreamWriter | None = None
        self._waiting: dict[int, asyncio.Future[Message]] = {}
        self._numbers = 0

    async def run(self) -> None:
        """Connect, poll, and reconnect when lost, until cancelled."""
        while True:
            try:
                await self._session()
            except Exception as error:  # after any error, try again
                self.why_lost = str(error) or type(error).__name__
            finally:
                self._hang_up()
            with contextlib.suppress(RuntimeLost):  # nobody to report to
                await self._on_status(None)
            await asyncio.sleep(RETRY_S)

    async def ask(self, do: str, **arguments: Any) -> Message:
        """Send one request and return its answer, which may be a refusal (`ok` false, `error`). Raises LinkLost."""
        writer = self._writer
        if writer is None:
            raise RuntimeLost(self.why_lost)
        if self._another and do not in STOPPING | WATCHING:
            return {"ok": False, "error": self._another}
        self._numbers += 1
        number = self._numbers
        future: asyncio.Future[Message] = asyncio.get_running_loop().create_future()
        self._waiting[number] = future
        try:
            writer.write(msgspec.json.encode({"do": do, **arguments, "id": number}) + b"\n")
            async with asyncio.timeout(self.answer_s):
                return await future
        except TimeoutError:
            raise RuntimeLost(f"the runtime does not answer within {self.answer_s:g} s") from None
        finally:
            self._waiting.pop(number, None)

    async def _session(self) -> None:
        try:
            reader, self._writer = await asyncio.open_unix_connection(str(self.path), limit=_LONGEST_LINE_bytes)
        except OSError as error:
            raise RuntimeLost(f"no runtime at {self.path} ({error.strerror or error}); `armwright serve` starts one") from None
        try:
            require_own_runtime(self._writer.get_extra_info("socket"), self.path)
        except ForeignRuntime as error:
            raise RuntimeLost(str(error)) from None
        answers = asyncio.create_task(self._read(reader))
        try:
            if key := os.environ.get(CONTROL_KEY):
                await self.ask("control", key=key)
            self._another = await self._compared()
            while True:
                begun_s = asyncio.get_running_loop().time()
                answer = await self.ask("status")
                if self._another and len(answer["q_rad"]) != self._arm.joint_count:
                    raise RuntimeLost(self._another)  # no panel has its joints
                if self._another:
                    answer["warnings"] = [self._another, *answer["warnings"]]
                self.status = answer
                await self._on_status(answer)
                elapsed_s = asyncio.get_running_loop().time() - begun_s
                await asyncio.sleep(max(POLL_S - elapsed_s, 0.005))
        finally:
            answers.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await answers

    async def _compared(self) -> str:
        """What makes the runtime's arm another one than ours, as one sentence; empty: nothing."""
        if (await self.ask("status")).get("fingerprint") == fingerprint(self._arm):
            return ""
        theirs = await self.ask("arm")
        try:
            require_same(self._arm, theirs)
        except AnotherArm as error:
            return " ".join(str(error).split())
        return ""

    async def _read(self, reader: asyncio.StreamReader) -> None:
        self.why_lost = "the runtime closed the connection"
        try:
            while line := await reader.readline():
                answer: Message = msgspec.json.decode(line)
                future = self._waiting.get(int(answer.get("id", 0)))
                if future is not None and not future.done():
                    future.set_result(answer)
        except ConnectionError:  # reset: it was closed with a request unread
            pass
        finally:
            self._close()  # pending answers cannot arrive

    def _fail(self, error: RuntimeLost) -> None:
        for future in self._waiting.values():
            if not future.done():
                future.set_exception(error)

    def _hang_up(self) -> None:
        self.status = None
        self._close()

    def _close(self) -> None:
        if self._writer is not None:
            self._writer.close()
            self._writer = None
        self._fail(RuntimeLost(self.why_lost))


RENEW_S = 0.05  # of a step, which ends by itself
QUICK = ("enable", "hold", "guide", "stop", "acknowledge", "pause", "resume", "override", "off")
OF_QUICK = {"override": ("fraction",), "guide": ("weightless",)}
MOVING = ("MOVING", "HOMING", "JOGGING", "PAUSED", "STOPPING", "GUIDING")


@dataclass(frozen=True, slots=True)
class JogTarget:
    """Target of a jog: a joint (1-based), or along (x, y, z) or about (rx, ry, rz) an axis of the base or of the tip."""

    joint: int | None
    axis: str | None
    of_tip: bool = False

    @property
    def name(self) -> str:
        """Name on the screen: J1 ... or X, Y, Z, RX, RY, RZ."""
        return f"J{self.joint}" if self.joint is not None else str(self.axis).upper()

    @property
    def is_angle(self) -> bool:
        """Whether it is jogged in radians."""
        return self.joint is not None or str(self.axis).startswith("r")


class ScreenOperator:
    """Reports with `say(text, is_error)`; writes every executed line to `record_file`, for replay."""

    def __init__(
        self,
        link: RuntimeLink,
        grammar: Grammar,
        shared: list[str],
        say: Callable[[str, bool], None],
        record_file: Path | None = None,
    ) -> None:
        """`shared`: options of every subcommand (--arm, --socket)."""
        self.link = link
        self.running = ""  # the line of the running process
        self._grammar = grammar
        self._shared = shared
        self._say = say
        self._record_file = record_file
        self._process: asyncio.subprocess.Process | None = None
        self._stepping: asyncio.Task[None] | None = None

    async def line(self, text: str) -> bool:
        """Execute a line; return whether it was started (a process) or done."""
        try:
            line = self._grammar.line(text)
        except LineError as error:
            self._say(str(error), True)
            return False
        if line is None:
            return False
        if line.command == "jog":
            return await self._step_line(line)
        if line.command in QUICK and not getattr(line.given, "quit", False):
            arguments = {key: getattr(line.given, key) for key in OF_QUICK.get(line.command, ())}
            done = await self.ask(line.command, **arguments)
            if done:
                self.record(line.text)
            return done
        return await self._begin(line)

    async def ask(self, do: str, **arguments: Any) -> bool:
        """Send one request; report a refusal or a lost link. Returns whether it was accepted."""
        return await self._asked(do, **arguments) is not None

    async def stop(self) -> None:
        """Stop the arm and the running line; always legal."""
        stopping = asyncio.ensure_future(self.ask("stop"))
        if self._stepping is not None:
            self._stepping.cancel()
        self.end_line()
        await stopping

    def end_line(self) -> None:
        """End the line's process as Ctrl-C would; its motion ends with its connection."""
        if self._process is not None and self._process.returncode is None:
            with contextlib.suppress(ProcessLookupError):
                self._process.send_signal(signal.SIGINT)

    # ---- jogging

    async def jog(self, target: JogTarget, speed: float, joint_count: int) -> int | None:
        """Request a signed speed (rad/s or m/s) until the runtime's dead man's switch ends it; the run, or None if refused."""
        answer = await self._asked("jog", **_velocity(target, speed, joint_count))
        if answer is None:
            return None
        if answer["limited"]:
            self._say(str(answer["limited"]), True)
        return int(answer["run"])

    async def let_go(self, target: JogTarget, joint_count: int) -> None:
        """End the jog: come to rest now."""
        status = self.link.status
        if status is not None and status["mode"] == "JOGGING":
            with contextlib.suppress(RuntimeLost):
                await self.link.ask("jog", **_velocity(target, 0.0, joint_count))

    def step(self, target: JogTarget, by: float, speed: float) -> None:
        """Jog one step, renewed until it has ended; only one at a time."""
        if self._stepping is None or self._stepping.done():
            self._stepping = asyncio.create_task(self._step(_step_of(target, by, speed), _step_line(target, by, speed)))

    async def _step(self, request: Message, text: str) -> None:
        answer = await self._asked("jog", **request)
        if answer is None:
            return
        limited = str(answer["limited"])
        with contextlib.suppress(RuntimeLost):
            while (answer := await self.link.ask("jog_on"))["ok"]:
                limited = str(answer["limited"]) or limited
                await asyncio.sleep(RENEW_S)
        if limited:
            self._say(limited, True)
        self.record(text)

    async def _step_line(self, line: ParsedLine) -> bool:
        args = line.given
        if (args.joint is None) == (args.axis is None):
            self._say("jog: give either --joint or --axis", True)
            return False
        self.step(JogTarget(args.joint, args.axis, args.frame == "tip"), args.by, args.speed or 0.0)
        return True

    # ---- processes

    async def _begin(self, line: ParsedLine) -> bool:
        if self.running:
            self._say(f"`{self.running}` still runs; space stops it", True)
            return False
        self.running = line.text
        try:
            self._process = await subcommand([line.command, *_words(line), *self._options(line)])
        except OSError as error:
            self.running = ""
            self._say(f"{line.command}: {error}", True)
            return False
        self._say(f"> {line.text}", False)
        self._follower = asyncio.create_task(self._follow(line, self._process))
        return True

    def _options(self, line: ParsedLine) -> list[str]:
        known = vars(line.given)
        pairs = zip(self._shared[::2], self._shared[1::2], strict=True)
        return [word for flag, value in pairs if flag.lstrip("-") in known for word in (flag, value)]

    async def _follow(self, line: ParsedLine, process: asyncio.subprocess.Process) -> None:
        if process.stdout is not None:
            async for row in process.stdout:
                self._say(f"  {row.decode(errors='replace').rstrip()}", False)
        status = await process.wait()
        self.running = ""
        if status == 0:
            self.record(line.text)
        self._say(f"  {line.command}: {'done' if status == 0 else f'ended with status {status}'}", status != 0)

    async def wait(self) -> None:
        """Wait until the line's process and the step have ended."""
        if self._process is not None:
            await self._follower
        if self._stepping is not None:
            await asyncio.wait([self._stepping])

    # ---- requests and the record

    def record(self, text: str) -> None:
        """Add a line to the file that `armwright script` replays."""
        if self._record_file is not None:
            with open_to_append(self._record_file) as file:
                file.write(utf_8(f"{text}\n"))

    async def _asked(self, do: str, **arguments: Any) -> Message | None:
        try:
            answer = await self.link.ask(do, **arguments)
        except RuntimeLost as error:
            self._say(f"{do}: {error}", True)
            return None
        if not answer["ok"]:
            self._say(str(answer["error"]), True)
            return None
        return answer


def _velocity(target: JogTarget, speed: float, joint_count: int) -> Message:
    if target.joint is not None:
        return {"joint_speed_rad_s": [speed if j + 1 == target.joint else 0.0 for j in range(joint_count)]}
    rate = [speed if axis == str(target.axis)[-1] else 0.0 for axis in ("x", "y", "z")]
    return {"tip_turn_rad_s" if target.is_angle else "tip_velocity_m_s": rate, **_frame(target)}


def _frame(target: JogTarget) -> Message:
    return {"frame": "tip"} if target.of_tip else {}


def _step_of(target: JogTarget, by: float, speed: float) -> Message:
    unit = "rad" if target.is_angle else "m"
    what: Message = {"axis": target.axis, **_frame(target)} if target.joint is None else {"joint": target.joint}
    return {**what, f"by_{unit}": by, **({f"speed_{unit}_s": speed} if speed else {})}


def _step_line(target: JogTarget, by: float, speed: float) -> str:
    what = f"--joint {target.joint}" if target.joint is not None else f"--axis {target.axis}"
    frame = " --frame tip" if target.of_tip else ""
    return f"jog {what}{frame} --by {by:g}" + (f" --speed {speed:g}" if speed else "")


def _words(line: ParsedLine) -> list[str]:
    """The line's own words, without its command."""
    words = shlex.split(line.text)
    return words[1:-1] if words[-1] == "&" else words[1:]


# A subcommand in a separate process that ends with the console.
#
# Its motion ends with its connection, so a killed console leaves no moving arm.


async def subcommand(words: Sequence[str], takes_answers: bool = False) -> asyncio.subprocess.Process:
    """Start `armwright WORDS` with piped stdout. OSError if the process cannot be started."""
    return await asyncio.create_subprocess_exec(
        *command("console.main", *words),
        stdin=asyncio.subprocess.PIPE if takes_answers else asyncio.subprocess.DEVNULL,
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.STDOUT,
        start_new_session=True,  # the terminal's Ctrl-C is the console's
        preexec_fn=ends_with_parent(signal.SIGINT),
    )
