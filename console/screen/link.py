"""The console's connection to the runtime on asyncio: requests, status polling, and automatic reconnection.

Requests are sent at once, in order; answers are matched by number. Motions of this connection end with it, so
a console that dies or loses its link leaves no moving arm; the runtime ensures that.
"""

import asyncio
import contextlib
import os
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import msgspec

from control.model.arm import Arm
from control.model.fingerprint import AnotherArm, fingerprint, require_same
from control.server.channel import CONTROL_KEY
from control.server.messages import STOPPING, WATCHING
from control.server.sockets import ForeignRuntime, require_own_runtime

Message = dict[str, Any]
POLL_S = 0.05
ANSWER_S = 1.0  # the link is lost if the loop does not answer within this time
RETRY_S = 0.5
_LONGEST_LINE_bytes = 1 << 20


class RuntimeLost(Exception):
    """No answer; the text is the message for the operator."""


class RuntimeLink:
    """A runtime's socket on an event loop. `on_status(status or None)` is called after every poll; None: lost.

    A runtime that has another arm than `arm` is watched and stopped, but not commanded; its status warns of it.
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

    @property
    def is_up(self) -> bool:
        """Whether the runtime answered just now."""
        return self.status is not None

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
            reader, self._writer = await asyncio.open_unix_connection(
                str(self.path), limit=_LONGEST_LINE_bytes
            )
        except OSError as error:
            raise RuntimeLost(
                f"no runtime at {self.path} ({error.strerror or error}); `armwright serve` starts one"
            ) from None
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
