"""Requests to the runtime: a JSON object in, a JSON object out, answered at once. docs/socket.md lists them.

An invalid request is refused before anything changes. First the client's right (`ControlRight`), then the arm's
mode are looked at, and only then the request as a whole.
"""

import base64
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol

from msgspec import UNSET

from control.errors import ArmError
from control.hardware.measurement import Averaging
from control.loop.jogging import JogRequest, JointSpeeds, JointStep, TipStep, TipVelocity
from control.loop.neighbours import Neighbours
from control.loop.runtime import Runtime
from control.model.arm import Arm
from control.model.fingerprint import content_of, fingerprint_of
from control.motion.joint_limits import JointLimits
from control.motion.pace import Limited
from control.motion.setpoint import Motion
from control.safety.modes import CONTROLLED_MODES, TRAVELLING_MODES, Event, IllegalTransition, Mode
from control.server import messages
from control.server.messages import STOPPING, WATCHING, Asked, StartJog, decoded, numbers
from control.server.planned_motions import Planned, PlannedMotions
from control.server.status import gripper_status, status_of, step_of
from firmware_iface.errors import LinkError

Message = dict[str, Any]
BEGINS = {"move_joints": Event.MOVE, "run_path": Event.MOVE, "run_joints": Event.MOVE}  # refused by mode unread
# Served while the arm goes on or off by itself; whatever else is asked then is refused, so that no answer is overtaken.
WHILE_ON_ITS_WAY = messages.WATCHING | messages.STOPPING | {"enable", "hold", "digital", "gripper"}
ADVICE = {
    Mode.OFF: "switch its drives on first (`armwright enable`)",
    Mode.HELD: "it is held by its boards: take it over (`armwright enable`), or let it go (`armwright off`)",
    Mode.BRAKED: "switch position control on first (`armwright enable`)",
    Mode.HOLDING: "it already holds",
    Mode.MOVING: "wait until it has arrived, or stop it (`armwright stop`)",
    Mode.HOMING: "wait until it is homed, or stop it (`armwright stop`)",
    Mode.GUIDING: "end hand guiding first (`armwright hold`)",
    Mode.STOPPING: "wait until it has stopped",
    Mode.JOGGING: "wait until the jog ends, or stop it (`armwright stop`)",
    Mode.PAUSED: "resume the motion (`armwright resume`), or stop it (`armwright stop`)",
    Mode.FAULT: "read the faults (`armwright status`), make the arm safe, then `armwright acknowledge`",
}


class Listener(Protocol):
    """Receives events of clients."""

    def requested(self, do: str, client: int) -> None: ...

    def hung_up(self, client: int) -> None: ...


class Requests:
    """Serves the requests of all clients of one runtime, and knows which of them is in control."""

    def __init__(self, runtime: Runtime, limits: JointLimits, arm: Arm, about: Message) -> None:
        self._runtime = runtime
        self._motions = PlannedMotions(runtime, limits)
        content = content_of(arm)
        self._about: Message = {"arm": arm.name, "fingerprint": fingerprint_of(content), **about}
        self._arm: Message = {"file": str(arm.path.absolute()) if arm.path else "", "content": content}
        self._right = ControlRight()
        self._grips: int | None = None  # the client that moved the gripper last
        self.events: Listener | None = None
        self.beside: Neighbours | None = None
        self._serve: Mapping[str, Callable[[Any, int], Message]] = {
            "status": self._status,
            "arm": lambda request, client: self._arm,
            "mode": self._mode,
            "control": self._control,
            "enable": self._enable,
            "home": self._home,
            "move_joints": self._move,
            "run_path": self._move,
            "run_joints": self._move,
            "jog": self._jog,
            "jog_on": self._jog_on,
            "pause": self._pause,
            "resume": self._resume,
            "override": self._override,
            "stop": self._stop,
            "brake": self._brake,
            "guide": self._guide,
            "hold": self._hold,
            "average": self._average,
            "average_result": self._average_result,
            "payload": self._payload,
            "tool": self._tool,
            "gripper": self._grip,
            "digital": self._set_output,
            "acknowledge": self._acknowledge,
            "fault_cycles": self._fault_cycles,
            "off": self._off,
        }

    @property
    def names(self) -> tuple[str, ...]:
        """The allowed values of `do`."""
        return tuple(self._serve)

    def handle(self, request: Asked, client: int) -> Message:
        """Serve one request of a client; never raises because of the request."""
        do = request.do
        serve = self._serve.get(do)
        if serve is None:
            known = ", ".join(self.names)
            return refused(f"unknown request {do[: messages.SHOWN]!r}: expected `do` to be one of {known}")
        try:
            self._require_this_arm(request.arm)
            mode = self._runtime.monitor.mode
            self._right.require(client, do, mode)
            if do not in WHILE_ON_ITS_WAY:
                self._runtime.require_staying()
            if (event := BEGINS.get(do)) is not None:
                self._runtime.monitor.require(event)
            answer = {"ok": True, **serve(decoded(request), client)}
            if self.events is not None:
                self.events.requested(do, client)
            return answer
        except IllegalTransition as error:
            return refused(_advised(error, do))
        except (ArmError, LinkError) as error:
            return refused(str(error))
        except Exception as error:  # no request may stop the loop
            return refused(f"request {do!r}: {type(error).__name__}: {error}")

    def _require_this_arm(self, name: str) -> None:
        """ArmError if a request names another arm than the one that is served."""
        if name not in ("", self._about["arm"]):
            raise ArmError(f"arm: expected {self._about['arm']!r}, which is served here, got {name[: messages.SHOWN]!r}")

    def on_gone(self, client: int) -> None:
        """A client disconnected: what it began and what still goes on is stopped, a gripper on its way, too."""
        if client == self._grips and self._runtime.parts.gripper is not None:
            self._runtime.parts.gripper.stop()
        was_owner = self._right.owns(client, self._runtime.monitor.mode)
        self._right.gone(client)
        if was_owner:
            self._runtime.stop()
            if self.events is not None:
                self.events.hung_up(client)

    def _own(self, request: messages.Owned, client: int) -> None:
        self._right.own(None if request.detached else client)

    def _status(self, request: Any, client: int) -> Message:
        holder = self._right.holder(self._runtime.monitor.mode)
        return {**self._about, **status_of(self._runtime), "in_control": holder}

    def _mode(self, request: Any, client: int) -> Message:
        runtime = self._runtime
        return {
            "mode": runtime.monitor.mode.name,
            "progress": runtime.progress(),
            "pace": runtime.pace(),
            "was_stopped": runtime.was_stopped,
            "stop_reason": runtime.stop_reason,
            "step": step_of(runtime),
            "is_settled": not runtime.bound.is_hold,
        }

    def _control(self, request: messages.TakeControl, client: int) -> Message:
        mode = self._runtime.monitor.mode
        if request.key is not None:
            self._right.join(client, request.key)
        if request.revoke:
            self._runtime.stop()
            self._right.revoke(client, mode)
        if request.take:
            self._right.take(client, mode)
        elif request.take is not None:
            self._right.release(client)
        return {"client": client, "in_control": self._right.holder(mode)}

    def _enable(self, request: Any, client: int) -> Message:
        was_enabled = self._runtime.monitor.mode in CONTROLLED_MODES
        if was_enabled:
            self._runtime.require_staying()
        else:
            self._runtime.want_hold()
        return {"was_enabled": was_enabled}

    def _home(self, request: messages.StartHoming, client: int) -> Message:
        runtime = self._runtime
        if not request.again and runtime.take_known_zeros():
            return {"homing": False}
        runtime.start_homing()
        self._own(request, client)
        return {"homing": True}

    def require_may_begin(self, do: str, client: int) -> None:
        """ArmError unless this client's right and the mode allow a motion now."""
        self._right.require(client, do, self._runtime.monitor.mode)
        self._runtime.require_staying()
        try:
            self._runtime.monitor.require(Event.MOVE)
        except IllegalTransition as error:
            raise ArmError(_advised(error, do)) from None

    def prepared(self, request: Planned, client: int) -> Motion:
        """The motion of a request, checked against this arm's right, mode and workspace; nothing has begun. ArmError."""
        self.require_may_begin(str(request.__struct_config__.tag), client)
        self._runtime.require_recording()
        return self._motions.prepare(request)

    def begin(self, motion: Motion, request: Planned, client: int, beside: Sequence[Limited]) -> None:
        """Start a prepared motion; `beside`: those of other arms that keep its pace."""
        self._runtime.start(motion, request.as_encoders, beside)
        self._own(request, client)
        if self.events is not None:
            self.events.requested(str(request.__struct_config__.tag), client)

    def _move(self, request: Planned, client: int) -> Message:
        motion = self._motions.prepare(request)
        if self.beside is not None:
            self.beside.require_clear(motion)
        self._runtime.start(motion, request.as_encoders)
        self._own(request, client)
        return {"duration_s": motion.duration_s, "run": self._runtime.run_number}

    def _jog(self, request: messages.StartJog, client: int) -> Message:
        self._runtime.jog(jog_request(request, len(self._runtime.parts.joint_names)))
        self._right.own(client)
        return self._jogged()

    def _jog_on(self, request: Any, client: int) -> Message:
        self._runtime.renew_jog()
        return self._jogged()

    def _jogged(self) -> Message:
        jogging = self._runtime.jogging
        return {"run": self._runtime.run_number, "limited": jogging.limited if jogging is not None else ""}

    def _pause(self, request: Any, client: int) -> Message:
        self._runtime.pause()
        return {}

    def _resume(self, request: Any, client: int) -> Message:
        self._runtime.resume()
        return {}

    def _override(self, request: messages.Override, client: int) -> Message:
        self._runtime.override = request.fraction
        return {}

    def _stop(self, request: Any, client: int) -> Message:
        self._runtime.stop()
        return {}

    def _brake(self, request: Any, client: int) -> Message:
        self._runtime.brake()
        return {}

    def _guide(self, request: messages.Guide, client: int) -> Message:
        self._runtime.guide(request.weightless)
        self._own(request, client)
        return {}

    def _hold(self, request: Any, client: int) -> Message:
        if self._runtime.monitor.mode is Mode.HOLDING:
            self._runtime.require_staying()
        else:
            self._runtime.want_hold()
        return {}

    def _average(self, request: messages.StartAverage, client: int) -> Message:
        self._runtime.averaging = Averaging(self._runtime.now_s, request.duration_s)
        return {}

    def _average_result(self, request: Any, client: int) -> Message:
        averaging = self._runtime.averaging
        if averaging is None:
            raise ArmError("no average is being taken (a fault ends one): send `average` first")
        return {"average": averaging.result}

    def _payload(self, request: messages.SetPayload, client: int) -> Message:
        self._runtime.state_payload(request.mass_kg)
        return {}

    def _tool(self, request: messages.ChangeTool, client: int) -> Message:
        self._runtime.change_tool(request.name)
        return {"tool": request.name}

    def _grip(self, request: messages.Grip, client: int) -> Message:
        if (request.action == "move") is (request.opening_m is None):
            raise ArmError("gripper: `move` needs opening_m, and the other actions have none")
        self._runtime.grip(request.action, request.opening_m, request.force_N)
        self._grips = client
        return {"gripper": gripper_status(self._runtime)}

    def _set_output(self, request: messages.SetOutput, client: int) -> Message:
        self._runtime.set_output(request.name, request.level)
        return {}

    def _acknowledge(self, request: Any, client: int) -> Message:
        return {"acknowledged": [fault.message for fault in self._runtime.acknowledge()]}

    def _fault_cycles(self, request: Any, client: int) -> Message:
        layout = self._runtime.parts.recorder.layout
        rows = base64.b64encode(b"".join(self._runtime.fault_rows)).decode()
        return {"rows": rows, "names": layout.names, "packing": layout.packing.format}

    def _off(self, request: messages.Off, client: int) -> Message:
        self._runtime.go_off(request.quit, request.lets_go)
        return {}


def _advised(error: IllegalTransition, do: str) -> str:
    """Why the mode does not allow a request, and what to do."""
    reason = error.why or ADVICE[error.mode]
    return f"the arm is {error.mode.name}, so it cannot {do.replace('_', ' ')}: {reason}"


def refused(error: str) -> Message:
    """The answer to a request that changed nothing."""
    return {"ok": False, "error": error}


# The jog of a `jog` request: joint speeds, a tip velocity, or a step of one joint or along one axis.
AXES = ("x", "y", "z", "rx", "ry", "rz")
KINDS = ("joint_speed_rad_s", "tip_velocity_m_s", "tip_turn_rad_s", "joint", "axis")
_STILL = (0.0, 0.0, 0.0)


def jog_request(request: StartJog, joint_count: int) -> JogRequest:
    """The jog that is asked for. ArmError says what is wrong; whether the arm can follow is not checked here."""
    kinds = [kind for kind in KINDS if getattr(request, kind) is not UNSET]
    if len(kinds) != 1 and kinds != ["tip_velocity_m_s", "tip_turn_rad_s"]:
        got = " and ".join(kinds) or "none of them"
        raise ArmError(f"request 'jog': expected one of {', '.join(KINDS)}, got {got}")
    if request.joint_speed_rad_s is not UNSET:
        return JointSpeeds(numbers("joint_speed_rad_s", request.joint_speed_rad_s, joint_count))
    if request.tip_velocity_m_s is not UNSET or request.tip_turn_rad_s is not UNSET:
        velocity = _STILL if request.tip_velocity_m_s is UNSET else request.tip_velocity_m_s
        turn = _STILL if request.tip_turn_rad_s is UNSET else request.tip_turn_rad_s
        return TipVelocity(velocity, turn, request.frame == "tip")
    return _joint_step(request, joint_count) if request.joint is not UNSET else _tip_step(request)


def _joint_step(request: StartJog, joint_count: int) -> JointStep:
    if request.joint is UNSET or not 1 <= request.joint <= joint_count:
        raise ArmError(f"request 'jog': expected joint to be a whole number from 1 to {joint_count}, got {request.joint}")
    if request.by_rad is UNSET:
        raise ArmError("request 'jog': expected by_rad with joint, the angle of the step")
    return JointStep(request.joint - 1, request.by_rad, request.speed_rad_s)


def _tip_step(request: StartJog) -> TipStep:
    if request.axis not in AXES:
        raise ArmError(f"request 'jog': expected axis to be one of {', '.join(AXES)}, got {request.axis!r}")
    index, of_tip = AXES.index(request.axis), request.frame == "tip"
    by, key, speed = request.by_m, "by_m", request.speed_m_s
    if index > 2:
        by, key, speed = request.by_rad, "by_rad", request.speed_rad_s
    if by is UNSET or by == 0.0:
        raise ArmError(f"request 'jog': expected {key} with axis {request.axis}, the size of the step, not 0")
    return TipStep(index, by, speed, of_tip)


# Who may command the arm: one client at a time. Everybody may watch, and everybody may stop.
#
# A client is in control as long as something goes on that it began (a motion, a jog, homing, hand guiding), or from `control`
# with `take` until it releases it. Both end with its connection. Connections that gave the same key are one client: the console
# and the commands that it starts.
#
# A client that hangs keeps control as long as its connection stands: it may be a session whose operator thinks. So nothing ends
# it by the clock; somebody else may revoke it, which stops the arm, and the client then commands no more until it connects again.

_GOING_ON = TRAVELLING_MODES | {Mode.GUIDING}
_IN_WORDS = {
    Mode.JOGGING: "another client jogs the arm (client {client}): wait until it ends, or stop it (`armwright stop`)",
    Mode.GUIDING: "client {client} has the arm guided by hand: `armwright hold` or `armwright stop` ends that",
    Mode.PAUSED: (
        "client {client} has control, and its motion is paused: resume it where it was started (Enter), or stop it"
        " (`armwright stop`)"
    ),
}
_MOVES = "client {client} has control, and the arm is {mode}: wait until it has ended, or stop it (`armwright stop`)"
_TAKEN = (
    "client {client} has taken control of the arm: wait until it releases it or ends; `armwright stop` stops the arm,"
    " `armwright stop --take` also ends that client's control"
)
_REVOKED = "somebody has taken control from this client (`armwright stop --take`): start it again when the arm is yours"


class ControlRight:
    """The owner of what goes on, the client that has taken control, and keys of connections that belong together."""

    def __init__(self) -> None:
        self._keys: dict[int, str] = {}
        self._owner: int | None = None
        self._taker: int | None = None
        self._revoked: set[int] = set()

    def join(self, client: int, key: str) -> None:
        """Count the connection with those of the same key."""
        self._keys[client] = key

    def own(self, client: int | None) -> None:
        """What begins now belongs to this connection; None: to nobody (detached)."""
        self._owner = client

    def owns(self, client: int, mode: Mode) -> bool:
        """Whether something goes on that this very connection began, which ends with it."""
        return client == self._owner and mode in _GOING_ON

    def take(self, client: int, mode: Mode) -> None:
        """Keep control until `release` or the end of the connection. ArmError if somebody else has it."""
        self.require(client, "control", mode, is_command=True)
        self._taker = client

    def release(self, client: int) -> None:
        """Give up what `take` took."""
        if self._taker is not None and self._are_one(client, self._taker):
            self._taker = None

    def revoke(self, client: int, mode: Mode) -> None:
        """End the control of another client, and of those that share its key, until they connect again."""
        holder = self.holder(mode)
        if holder is None or self._are_one(client, holder):
            return
        self._revoked |= {holder} | {other for other in self._keys if self._are_one(other, holder)}
        self._owner = self._taker = None

    def holder(self, mode: Mode) -> int | None:
        """The connection in control; None: the next command takes it."""
        if self._taker is not None:
            return self._taker
        return self._owner if mode in _GOING_ON else None

    def require(self, client: int, do: str, mode: Mode, is_command: bool = False) -> None:
        """ArmError if `do` is a command and another client is in control."""
        if not is_command and (do in WATCHING or do in STOPPING or (do == "hold" and mode is Mode.GUIDING)):
            return
        if client in self._revoked:
            raise ArmError(_REVOKED)
        holder = self.holder(mode)
        if holder is None or self._are_one(client, holder):
            return
        text = _TAKEN if self._taker is not None else _IN_WORDS.get(mode, _MOVES)
        raise ArmError(text.format(client=holder, mode=mode.name))

    def gone(self, client: int) -> None:
        """The connection has ended."""
        self._keys.pop(client, None)
        self._revoked.discard(client)
        if client == self._taker:
            self._taker = None
        if client == self._owner:
            self._owner = None

    def _are_one(self, client: int, other: int) -> bool:
        return client == other or (client in self._keys and self._keys[client] == self._keys.get(other))
