"""How everything outside the loop talks to it: one request at a time, answered at once; waiting is looking again.

A request is a JSON object with the key `do`; the answer is a JSON object with `ok`. The same client runs over the runtime's
socket (a process of its own) and over a runtime in the same process on a stepped clock: the channel is all that differs.
docs/socket.md lists every request.
"""

import socket
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Protocol

import msgspec

from control.errors import ArmError
from control.hardware.averaging import Average

Message = dict[str, Any]
RELAPSE_S = 0.1  # a fault whose cause lasts is found again within some cycles
SETTLE_LIMIT_S = 2.0  # drives that do not come are a fault after half of it
POLL_S = 0.02  # how often a waiting client looks; an operator sees no difference, the loop hardly notices


class RequestRefused(ArmError):
    """The runtime did not take a request; nothing was changed by it."""


class ArmFaulted(ArmError):
    """The arm is in FAULT: it was stopped, and what it says must be acknowledged by hand."""


class MotionStopped(ArmError):
    """Somebody stopped the motion before its end: what was to follow it must not."""


class ArmLate(ArmError):
    """The arm did not get where it was told to within the time that it should take."""


class RuntimeGone(ArmError):
    """No runtime answers on the socket."""


class NoRuntime(RuntimeGone):
    """Nothing listens at the socket."""


class Channel(Protocol):
    """Carries a request to the runtime and its answer back."""

    def request(self, message: Message) -> Message: ...

    def wait(self, duration_s: float) -> None:
        """Let time pass on the runtime's clock."""
        ...

    def close(self) -> None: ...


class SocketChannel:
    """A channel over the runtime's local socket: one JSON object a line, both ways."""

    def __init__(self, path: Path, timeout_s: float = 2.0) -> None:
        self._path = path
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self._socket.settimeout(timeout_s)
        try:
            self._socket.connect(str(path))
        except OSError as error:
            self._socket.close()
            is_none = isinstance(error, FileNotFoundError | ConnectionRefusedError)
            raise (NoRuntime if is_none else RuntimeGone)(
                f"no runtime answers at {path} ({error.strerror or error}): start one with `armwright serve`"
            ) from error
        self._lines = self._socket.makefile("rb")
        self._asked_count = 0

    def request(self, message: Message) -> Message:
        """Send and wait for the answer. RuntimeGone when the runtime went away or does not answer in time.

        An answer to an earlier request, whose asker was interrupted before it came, is passed over: it must not be taken
        for this one's.
        """
        self._asked_count += 1
        try:
            self._socket.sendall(msgspec.json.encode({**message, "id": self._asked_count}) + b"\n")
            while True:
                answer = self._answer()
                if answer.get("id", self._asked_count) == self._asked_count:
                    return answer
        except OSError as error:
            raise RuntimeGone(f"the runtime at {self._path} does not answer ({error})") from error

    def _answer(self) -> Message:
        line = self._lines.readline()
        if not line:
            raise RuntimeGone(f"the runtime at {self._path} closed the connection")
        answer: Message = msgspec.json.decode(line)
        return answer

    def wait(self, duration_s: float) -> None:
        """Wait on the host's clock."""
        import time

        time.sleep(duration_s)

    def close(self) -> None:
        """Hang up. A motion that this connection started is stopped by the runtime."""
        self._lines.close()
        self._socket.close()


class ArmClient:
    """The arm, from outside the loop. Methods that move return when the arm has done it or raise what stopped it."""

    def __init__(self, channel: Channel) -> None:
        """`on_wait`, set from outside, is called with every look at an arm that is waited for (docs/socket.md, `mode`)."""
        self._channel = channel
        self.on_wait: Callable[[Message], None] | None = None

    def ask(self, do: str, **arguments: Any) -> Message:
        """One request. RequestRefused with the runtime's own words when it says no."""
        answer = self._channel.request({"do": do, **arguments})
        if not answer.get("ok"):
            raise RequestRefused(str(answer.get("error", "the runtime refused without a reason")))
        return answer

    def status(self) -> Message:
        """State of the arm: mode, angles, set-points, currents, faults, cycle statistics (docs/socket.md)."""
        return self.ask("status")

    def until(self, modes: Sequence[str], timeout_s: float, is_fault_known: bool = False) -> Message:
        """Wait until the arm is in one of `modes`; returns the status then.

        ArmFaulted when it goes to FAULT instead, unless that `is_fault_known`; ArmLate on time-out. A motion that runs at a
        slower pace, or is paused, has as much more time.
        """
        waited_s = 0.0
        while (mode := (answer := self.ask("mode"))["mode"]) not in modes:
            if mode == "FAULT" and not is_fault_known:
                raise ArmFaulted(fault_text(self.status()))
            if waited_s > timeout_s:
                step = f" ({answer['step']})" if answer["step"] else ""
                raise ArmLate(
                    f"the arm is still {mode} after {waited_s:.1f} s{step}; expected {' or '.join(modes)}"
                )
            if self.on_wait is not None:
                self.on_wait(answer)
            self._channel.wait(POLL_S)
            waited_s += POLL_S * answer["pace"]
        return self.status()

    def enable(self) -> bool:
        """Drives on, holding where the arm stands; False where they were on already, and nothing has changed."""
        if self.ask("enable")["was_enabled"]:
            return False
        self.until(["HOLDING"], 3.0)
        return True

    def home(self, timeout_s: float = 120.0, again: bool = False) -> bool:
        """Find every joint's zero; False where all boards knew theirs and nothing moved. `again`: search all the same."""
        if not self.ask("home", again=again)["homing"]:
            return False
        self.arrive(timeout_s)
        return True

    def move_joints(
        self, q_rad: Sequence[float], speed: float = 1.0, waits: bool = True, as_encoders: bool = False
    ) -> None:
        """Joint move to `q_rad` at a fraction of the joints' limits; returns at rest, or at once where it does not wait.

        `as_encoders`: to encoder angles, without what the arm's model knows between encoders and joints.
        """
        answer = self.ask("move_joints", q_rad=list(q_rad), speed=speed, as_encoders=as_encoders)
        if waits:
            self.arrive(answer["duration_s"] + 5.0)

    def run_path(self, path: Message, waits: bool = True, as_encoders: bool = False) -> None:
        """Run a planned path (PlannedPath.to_message()); the arm must stand at its first point. `as_encoders`: as move_joints."""
        answer = self.ask("run_path", path=path, as_encoders=as_encoders)
        if waits:
            self.arrive(answer["duration_s"] + 5.0)

    def arrive(self, timeout_s: float, modes: Sequence[str] = ("HOLDING",)) -> None:
        """Wait for a motion's end. MotionStopped where it was not its own."""
        if self.until(modes, timeout_s)["was_stopped"]:
            raise MotionStopped("the motion was stopped before its end; the arm holds its position")

    def run_joints(self, path: Message, as_encoders: bool = False) -> None:
        """Run a path of the joints (JointPath.to_message()) from where the arm stands. `as_encoders`: as move_joints."""
        answer = self.ask("run_joints", path=path, as_encoders=as_encoders)
        self.arrive(answer["duration_s"] + 5.0)

    def jog(self, timeout_s: float = 60.0, **step: Any) -> str:
        """A step: `joint` with `by_rad`, or `axis` with `by_m` (docs/socket.md), renewed until it has ended.

        Returns what was in the way, in words; empty: nothing.
        """
        limited = str(self.ask("jog", **step)["limited"])
        waited_s = 0.0
        while (mode := self.ask("mode")["mode"]) == "JOGGING" and waited_s <= timeout_s:
            answer = self._channel.request({"do": "jog_on"})  # refused where it has just ended
            limited = str(answer.get("limited") or limited)
            self._channel.wait(POLL_S)
            waited_s += POLL_S
        if mode == "FAULT":
            raise ArmFaulted(fault_text(self.status()))
        self.until(["HOLDING"], 2.0)
        return limited

    def pause(self) -> None:
        """Slow to rest along the motion and hold on it."""
        self.ask("pause")

    def resume(self) -> None:
        """Go on along the motion."""
        self.ask("resume")

    def override(self, fraction: float) -> None:
        """Pace of motions, of the one that runs and of those to come."""
        self.ask("override", fraction=fraction)

    def stop(self) -> None:
        """Controlled stop; returns when the arm holds."""
        self.ask("stop")
        self.until(["HOLDING", "BRAKED", "OFF", "GUIDING"], 5.0)

    def guide(self, weightless: bool = False) -> None:
        """Let a hand guide the arm: open circuits, somebody must hold it; or `weightless`, the drives carry its own weight."""
        self.ask("guide", weightless=weightless)

    def hold(self) -> None:
        """End hand-guiding: hold where the arm stands."""
        self.ask("hold")
        self.until(["HOLDING"], 3.0)

    def average(self, duration_s: float) -> Average:
        """Average encoders, currents and camera frames over `duration_s`, starting now."""
        self.ask("average", duration_s=duration_s)
        while True:
            self._channel.wait(min(duration_s, POLL_S))
            result = self.ask("average_result")["average"]
            if result is not None:
                return msgspec.convert(result, Average)

    def acknowledge(self) -> None:
        """A human has seen the fault; the arm may be enabled again. ArmFaulted where its cause lasts."""
        try:
            self.ask("acknowledge")
        except RequestRefused as error:
            status = self.status()
            if status["mode"] != "FAULT":
                raise
            raise ArmFaulted(f"not acknowledged: {error}\n{fault_text(status)}") from None
        waited_s, answer = 0.0, self.ask("mode")
        while waited_s < RELAPSE_S or (waited_s < SETTLE_LIMIT_S and not answer["is_settled"]):
            self._channel.wait(POLL_S)
            waited_s += POLL_S
            answer = self.ask("mode")
            if answer["mode"] == "FAULT":
                raise ArmFaulted(f"acknowledged, but the cause persists: {fault_text(self.status())}")

    def off(self, quit_runtime: bool = False, timeout_s: float = 60.0) -> None:
        """Stop, hold, brake until the arm has sunk to rest, drives off; then the runtime ends if it shall."""
        self.ask("off", quit=quit_runtime)
        try:
            self.until(["OFF"], timeout_s, is_fault_known=True)
        except RuntimeGone:
            if not quit_runtime:
                raise

    def wait(self, duration_s: float) -> None:
        """Let time pass on the runtime's clock."""
        self._channel.wait(duration_s)

    def close(self) -> None:
        """Close the connection."""
        self._channel.close()


def fault_text(status: Message) -> str:
    """The faults of a status as an operator should read them."""
    lines = [f"{fault['where']}: {fault['message']}; {fault['remedy']}" for fault in status["faults"]]
    return "the arm is in FAULT" + "".join(f"\n  - {line}" for line in lines)
