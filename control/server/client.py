"""The client of the loop: one request at a time, answered at once; waiting is polling.

A request is a JSON object with the key `do`; the answer is a JSON object with `ok`. The same client works over the runtime's
socket (another process) and with a runtime in the same process on a stepped clock: only the channel differs.
docs/socket.md lists every request.
"""

import contextlib
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import msgspec

from control.errors import ArmError
from control.model.arm import Arm
from control.model.fingerprint import fingerprint, require_same
from control.server.channel import Channel, Message, RuntimeGone

if TYPE_CHECKING:
    from control.hardware.measurement import Average
    from control.model.cell import Cell

RELAPSE_S = 0.1  # a fault whose cause persists is detected again within some cycles
AVERAGE_LIMIT_S = 2.0  # an average takes its own time; this much more is a host that was paused
SETTLE_LIMIT_S = 2.0  # drives that do not enable are a fault after half of this time
FOLLOW_GAIN_per_s = 6.0  # of the distance to what is followed: it is halved in 0.12 s
POLL_S = 0.02  # polling period of a waiting client; short for an operator, hardly any load for the loop


class RequestRefused(ArmError):
    """The runtime refused a request; nothing was changed."""


class ArmFaulted(ArmError):
    """The arm is in FAULT: it was stopped, and a person must acknowledge the faults."""


class MotionStopped(ArmError):
    """The motion was stopped before its end; later steps must not run."""


class ArmLate(ArmError):
    """The arm did not reach its goal within the expected time."""


class ArmClient:
    """Client of an arm. Methods that move return when the motion is complete, or raise what stopped it."""

    def __init__(self, channel: Channel) -> None:
        """`on_wait`, if set, is called with every status while waiting (docs/socket.md, `mode`)."""
        self._channel = channel
        self._followed_run: int | None = None  # of the jog that `follow` began
        self.on_wait: Callable[[Message], None] | None = None

    def ask(self, do: str, **arguments: Any) -> Message:
        """Send one request. RequestRefused carries the runtime's reason."""
        answer = self._channel.request({"do": do, **arguments})
        if not answer.get("ok"):
            raise RequestRefused(str(answer.get("error", "the runtime refused without a reason")))
        return answer

    def take_control(self) -> None:
        """Keep control of the arm until the connection closes: others may watch and stop. RequestRefused if another has it."""
        self.ask("control", take=True)

    def require_arm(self, arm: Arm, cell: "Cell | None" = None) -> None:
        """AnotherArm unless the runtime has the same arm, in the same place of the same `cell` if one is given."""
        status = self.status()
        is_placed = cell is not None and "cell" in status
        if status.get("fingerprint") == fingerprint(arm) and not is_placed:
            return
        require_same(arm, self._channel.request({"do": "arm"}), cell)

    def status(self) -> Message:
        """Return the state of the arm: mode, angles, set-points, currents, faults, cycle statistics (docs/socket.md)."""
        return self.ask("status")

    def until(self, modes: Sequence[str], timeout_s: float, is_fault_known: bool = False) -> Message:
        """Wait until the arm is in one of `modes`; returns the status then.

        ArmFaulted if it goes to FAULT instead, unless `is_fault_known`; ArmLate on time-out. A motion at a
        slower pace, or paused, has correspondingly more time.
        """
        waited_s = 0.0
        while (mode := (answer := self.ask("mode"))["mode"]) not in modes:
            if mode == "FAULT" and not is_fault_known:
                raise ArmFaulted(fault_text(self.status()))
            if waited_s > timeout_s:
                step = f" ({answer['step']})" if answer["step"] else ""
                raise ArmLate(f"the arm is still {mode} after {waited_s:.1f} s{step}; expected {' or '.join(modes) or 'its end'}")
            if self.on_wait is not None:
                self.on_wait(answer)
            self._channel.wait(POLL_S)
            waited_s += POLL_S * answer["pace"]
        return self.status()

    def enable(self) -> bool:
        """Enable the drives and hold the present position; False if they were already enabled."""
        if self.ask("enable")["was_enabled"]:
            return False
        self.until(["HOLDING"], 3.0)
        return True

    def home(self, timeout_s: float = 120.0, again: bool = False) -> bool:
        """Home every joint; False if all boards still had their zeros and nothing moved. `again`: home in any case."""
        if not self.ask("home", again=again)["homing"]:
            return False
        self.arrive(timeout_s)
        return True

    def move_joints(self, q_rad: Sequence[float], speed: float = 1.0, waits: bool = True, as_encoders: bool = False) -> None:
        """Move the joints to `q_rad` at a fraction of their limits; returns at rest, or at once without waiting.

        `as_encoders`: `q_rad` are encoder angles, without the modelled effects behind the encoders.
        """
        answer = self.ask("move_joints", q_rad=list(q_rad), speed=speed, as_encoders=as_encoders)
        if waits:
            self.arrive(answer["duration_s"] + 5.0)

    def run_path(self, path: Message, waits: bool = True, as_encoders: bool = False, tool: str | None = None) -> None:
        """Run a planned path (PlannedPath.to_message(), JointPath.to_message()); the arm must stand at its first point.

        `as_encoders`: as move_joints. `tool`: the one whose tip it was planned for, if that is to be checked.
        """
        answer = self.ask("run_path", path=path, as_encoders=as_encoders, tool=tool)
        if waits:
            self.arrive(answer["duration_s"] + 5.0)

    def arrive(self, timeout_s: float, modes: Sequence[str] = ("HOLDING",)) -> None:
        """Wait for the end of the motion. MotionStopped if it ended early."""
        status = self.until(modes, timeout_s)
        if status["was_stopped"]:
            why = f" ({reason})" if (reason := status.get("stop_reason")) else ""
            raise MotionStopped(f"the motion was stopped before its end{why}; the arm holds its position")

    def jog(self, timeout_s: float = 60.0, **step: Any) -> str:
        """Jog by a step: `joint` with `by_rad`, or `axis` with `by_m` (docs/socket.md), renewed until it has ended.

        Returns what limited the step, as text; empty if nothing did.
        """
        limited = str(self.ask("jog", **step)["limited"])
        waited_s = 0.0
        while (mode := self.ask("mode")["mode"]) == "JOGGING" and waited_s <= timeout_s:
            answer = self._channel.request({"do": "jog_on"})  # refused if it has just ended
            limited = str(answer.get("limited") or limited)
            self._channel.wait(POLL_S)
            waited_s += POLL_S
        if mode == "FAULT":
            raise ArmFaulted(fault_text(self.status()))
        self.until(["HOLDING"], 2.0)
        return limited

    def follow(self, q_rad: Sequence[float], speed_rad_s: Sequence[float] | None = None) -> str:
        """Jog once after joint angles that move on, at their speed and what brings the arm nearer; to be renewed as a jog is.

        Returns what limits the jog, as text. MotionStopped if somebody stopped the last one; a silent client may go on.
        """
        status = self.status()
        if status["mode"] == "FAULT":
            raise ArmFaulted(fault_text(status))
        if not status["is_homed"]:
            raise ArmError(f"follow: arm {status['arm']!r} is not homed: home it first")
        if status["was_stopped"] and status["run"] == self._followed_run:
            self._followed_run = None
            raise MotionStopped(f"following has ended: arm {status['arm']!r} was stopped and is {status['mode']}")
        speeds = [0.0] * len(q_rad) if speed_rad_s is None else speed_rad_s
        wanted = [
            speed + FOLLOW_GAIN_per_s * (goal - q) for speed, goal, q in zip(speeds, q_rad, status["joint_set_rad"], strict=True)
        ]
        answer = self.ask("jog", joint_speed_rad_s=wanted)
        self._followed_run = answer["run"]
        return str(answer["limited"])

    def pause(self) -> None:
        """Slow to rest along the motion's path and hold there."""
        self.ask("pause")

    def resume(self) -> None:
        """Resume the motion."""
        self.ask("resume")

    def override(self, fraction: float) -> None:
        """Set the pace of the active and of later motions."""
        self.ask("override", fraction=fraction)

    def stop(self) -> None:
        """Controlled stop; returns when the arm holds."""
        self.ask("stop")
        self.until(["HOLDING", "BRAKED", "OFF", "GUIDING", "HELD"], 5.0)

    def tool(self, name: str) -> None:
        """Another of the arm's tools is on. RequestRefused unless the arm is at rest."""
        self.ask("tool", name=name)

    def grip(self, action: str, opening_m: float | None = None, force_N: float | None = None, waits: bool = True) -> Message:
        """Open, close or move (to `opening_m`) the gripper; returns its state (docs/socket.md) at the end of its motion.

        RequestRefused says why it does not move. ArmFaulted if the arm goes to FAULT meanwhile.
        """
        gripper: Message = self.ask("gripper", action=action, opening_m=opening_m, force_N=force_N)["gripper"]
        number = gripper["number"]
        while waits and gripper["is_moving"] and gripper["number"] == number:
            self._channel.wait(POLL_S)
            status = self.status()
            if status["mode"] == "FAULT":
                raise ArmFaulted(fault_text(status))
            gripper = status["gripper"]
        return gripper

    def set_output(self, name: str, level: bool) -> None:
        """Set a digital output. RequestRefused while the drives are off or the arm is in FAULT."""
        self.ask("digital", name=name, level=level)

    def await_level(self, name: str, level: bool, timeout_s: float) -> bool:
        """Wait until a pin has a level; False on time-out. ArmError if there is no such pin."""
        waited_s = 0.0
        while True:
            pins = self.status()["digital"]
            if name not in pins:
                known = f"expected one of {', '.join(pins)}" if pins else "arm.toml names none with [[digital]]"
                raise ArmError(f"digital: no pin {name!r}: {known}")
            if pins[name]["level"] is level or waited_s >= timeout_s:
                return bool(pins[name]["level"] is level)
            self._channel.wait(POLL_S)
            waited_s += POLL_S

    def guide(self, weightless: bool = False) -> None:
        """Start hand guiding: open circuits, so somebody must hold the arm; or `weightless`, with gravity compensation."""
        self.ask("guide", weightless=weightless)

    def hold(self) -> None:
        """End hand guiding: hold the present position."""
        self.ask("hold")
        self.until(["HOLDING"], 3.0)

    def average(self, duration_s: float) -> "Average":
        """Average encoders, currents and camera frames over `duration_s`, starting now.

        ArmFaulted if a fault comes in between; ArmLate if the runtime gets no values to average.
        """
        from control.hardware.measurement import Average  # most clients average nothing

        self.ask("average", duration_s=duration_s)
        waited_s = 0.0
        while waited_s < duration_s + AVERAGE_LIMIT_S:
            self._channel.wait(step_s := min(duration_s, POLL_S))
            waited_s += step_s
            answer = self._channel.request({"do": "average_result"})
            if answer.get("average") is not None:
                return msgspec.convert(answer["average"], Average)
            if not answer["ok"]:
                break
        status = self.status()
        if status["mode"] == "FAULT":
            raise ArmFaulted(fault_text(status))
        raise ArmLate(f"no average after {waited_s:.1f} s: {answer.get('error', 'the boards sent no values meanwhile')}")

    def acknowledge(self) -> None:
        """Acknowledge the fault on a person's request. ArmFaulted if its cause persists."""
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

    def off(self, quit_runtime: bool = False, timeout_s: float = 60.0, lets_go: bool = False) -> None:
        """Stop, hold, brake until the arm has sunk to rest, drives off; optionally end the runtime, and wait for its end.

        `lets_go`: boards that hold the arm as they were found, too, so somebody must hold it. RequestRefused without it.
        """
        self.ask("off", quit=quit_runtime, lets_go=lets_go)
        if not quit_runtime:
            self.until(["OFF"], timeout_s, is_fault_known=True)
            return
        with contextlib.suppress(RuntimeGone):  # later than OFF: when every drive, of every arm, has confirmed it
            self.until((), timeout_s, is_fault_known=True)

    def wait(self, duration_s: float) -> None:
        """Let time pass on the runtime's clock."""
        self._channel.wait(duration_s)

    def close(self) -> None:
        """Close the connection."""
        self._channel.close()


def fault_text(status: Message) -> str:
    """The faults of a status as text for an operator."""
    lines = [f"{fault['where']}: {fault['message']}; {fault['remedy']}" for fault in status["faults"]]
    return "the arm is in FAULT" + "".join(f"\n  - {line}" for line in lines)
