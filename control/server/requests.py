"""Requests to the runtime: a JSON object in, a JSON object out, answered at once. docs/socket.md lists them.

An invalid request is refused before anything changes. The client has planned the motion; here it is only
rebuilt and compared with the arm's position.
"""

import base64
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol

from control.errors import ArmError
from control.hardware.averaging import Averaging
from control.kinematics.kinematics import Kinematics
from control.loop.runtime import Runtime
from control.motion.joint_limits import JointLimits
from control.motion.joint_move import JointMove
from control.motion.joint_path import JointPath
from control.motion.plan import PlannedPath
from control.motion.setpoint import Motion, SetPoint
from control.safety.monitor import IllegalTransition
from control.safety.table import CONTROLLED_MODES, TRAVELLING_MODES, Event, Mode
from control.server.jog_requests import jog_request
from control.server.request_values import flag, number, numbers
from control.server.status import status_of, step_of
from firmware_iface.errors import LinkError

Message = dict[str, Any]
START_TOLERANCE_rad = 5e-3  # around a path's first point: a joint move ends within a few counts of it
LONGEST_AVERAGE_S = 60.0
LEAST_OVERRIDE = 0.01  # slower would be a pause
ADVICE = {
    Mode.OFF: "switch its drives on first (`armwright enable`)",
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
    """Serves the requests of all clients of one runtime, and tracks the owner of the active motion."""

    def __init__(self, runtime: Runtime, limits: JointLimits, kinematics: Kinematics, about: Message) -> None:
        self._runtime = runtime
        self._limits = limits
        self._kinematics = kinematics
        self._about = about
        self._owner: int | None = None
        self.events: Listener | None = None
        self._serve: Mapping[str, Callable[[Message, int], Message]] = {
            "status": self._status,
            "mode": self._mode,
            "enable": self._enable,
            "home": self._home,
            "move_joints": self._move_joints,
            "run_path": self._run_path,
            "run_joints": self._run_joints,
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
            "acknowledge": self._acknowledge,
            "fault_cycles": self._fault_cycles,
            "off": self._off,
        }

    @property
    def names(self) -> tuple[str, ...]:
        """The allowed values of `do`."""
        return tuple(self._serve)

    def handle(self, request: Message, client: int) -> Message:
        """Serve one request of a client; never raises because of the request."""
        serve = self._serve.get(str(request.get("do")))
        if serve is None:
            known = ", ".join(self.names)
            return {
                "ok": False,
                "error": f"unknown request {request.get('do')!r}: expected `do` to be one of {known}",
            }
        try:
            answer = {"ok": True, **serve(request, client)}
            if self.events is not None:
                self.events.requested(request["do"], client)
            return answer
        except IllegalTransition as error:
            return {
                "ok": False,
                "error": f"the arm is {error.mode.name}, so it cannot {request['do'].replace('_', ' ')}:"
                f" {error.why or ADVICE[error.mode]}",
            }
        except (ArmError, LinkError) as error:
            return {"ok": False, "error": str(error)}
        except Exception as error:  # no request may stop the loop
            return {"ok": False, "error": f"request {request.get('do')!r}: {type(error).__name__}: {error}"}

    def on_gone(self, client: int) -> None:
        """Stop the motion of a client that disconnected."""
        if client == self._owner and self._runtime.monitor.mode in TRAVELLING_MODES:
            self._runtime.stop()
            if self.events is not None:
                self.events.hung_up(client)

    def _own(self, request: Message, client: int) -> None:
        self._owner = None if request.get("detached") else client

    def _status(self, request: Message, client: int) -> Message:
        return {**self._about, **status_of(self._runtime, self._kinematics)}

    def _mode(self, request: Message, client: int) -> Message:
        runtime = self._runtime
        return {
            "mode": runtime.monitor.mode.name,
            "progress": runtime.progress(),
            "pace": runtime.pace(),
            "was_stopped": runtime.was_stopped,
            "step": step_of(runtime),
            "is_settled": not runtime.drives.is_awaited,
        }

    def _enable(self, request: Message, client: int) -> Message:
        if self._runtime.monitor.mode in CONTROLLED_MODES:
            return {"was_enabled": True}
        self._runtime.want_hold()
        return {"was_enabled": False}

    def _home(self, request: Message, client: int) -> Message:
        runtime = self._runtime
        if not request.get("again") and runtime.take_known_zeros():
            return {"homing": False}
        runtime.start_homing()
        self._own(request, client)
        return {"homing": True}

    def _move_joints(self, request: Message, client: int) -> Message:
        target = numbers(request, "q_rad", len(self._runtime.parts.joint_names))
        speed = number(request, "speed", 1e-3, 1.0, default=1.0)
        move = JointMove(self._seen(request), target, self._limits.scaled(speed))
        return self._start(move, request, client)

    def _run_path(self, request: Message, client: int) -> Message:
        path = PlannedPath.from_message(request["path"])
        self._require_at(path.q_start_rad, request)
        return self._start(path.motion(self._runtime.parts.inverse, self._kinematics), request, client)

    def _run_joints(self, request: Message, client: int) -> Message:
        path = JointPath.from_message(request["path"])
        path.require_within(self._limits)
        self._require_at(path.knots[0].q_rad, request)
        return self._start(path, request, client)

    def _seen(self, request: Message) -> SetPoint:
        """Start of a motion, as joint angles or, if the motion uses them, encoder angles."""
        return self._runtime.seen(flag(request, "as_encoders"))

    def _require_at(self, first_rad: Sequence[float], request: Message) -> None:
        """Check that the arm holds at a path's first point; the mode is checked first."""
        if self._runtime.monitor.mode is not Mode.HOLDING:
            self._runtime.on(Event.MOVE)
        off_rad = max(abs(a - b) for a, b in zip(first_rad, self._seen(request).q_rad, strict=True))
        if off_rad > START_TOLERANCE_rad:
            raise ArmError(
                f"the arm is {off_rad:.4f} rad away from the path's first point (tolerance {START_TOLERANCE_rad} rad):"
                f" move there first, to {', '.join(f'{q:.4f}' for q in first_rad)} rad"
            )

    def _start(self, motion: Motion, request: Message, client: int) -> Message:
        self._runtime.start(motion, flag(request, "as_encoders"))
        self._own(request, client)
        return {"duration_s": motion.duration_s, "run": self._runtime.run_number}

    def _jog(self, request: Message, client: int) -> Message:
        self._require_own_jog(client)
        self._runtime.jog(jog_request(request, len(self._runtime.parts.joint_names)))
        self._owner = client
        return self._jogged()

    def _jog_on(self, request: Message, client: int) -> Message:
        self._require_own_jog(client)
        self._runtime.renew_jog()
        return self._jogged()

    def _require_own_jog(self, client: int) -> None:
        if self._runtime.monitor.mode is Mode.JOGGING and client != self._owner:
            raise ArmError("another client jogs the arm: wait until it ends, or stop it (`armwright stop`)")

    def _jogged(self) -> Message:
        jogging = self._runtime.jogging
        return {"run": self._runtime.run_number, "limited": jogging.limited if jogging is not None else ""}

    def _pause(self, request: Message, client: int) -> Message:
        self._runtime.pause()
        return {}

    def _resume(self, request: Message, client: int) -> Message:
        self._runtime.resume()
        return {}

    def _override(self, request: Message, client: int) -> Message:
        self._runtime.override = number(request, "fraction", LEAST_OVERRIDE, 1.0)
        return {}

    def _stop(self, request: Message, client: int) -> Message:
        self._runtime.stop()
        return {}

    def _brake(self, request: Message, client: int) -> Message:
        self._runtime.brake()
        return {}

    def _guide(self, request: Message, client: int) -> Message:
        self._runtime.guide(flag(request, "weightless"))
        return {}

    def _hold(self, request: Message, client: int) -> Message:
        if self._runtime.monitor.mode is not Mode.HOLDING:
            self._runtime.want_hold()
        return {}

    def _average(self, request: Message, client: int) -> Message:
        duration_s = number(request, "duration_s", 0.01, LONGEST_AVERAGE_S)
        self._runtime.averaging = Averaging(self._runtime.now_s, duration_s)
        return {}

    def _average_result(self, request: Message, client: int) -> Message:
        averaging = self._runtime.averaging
        if averaging is None:
            raise ArmError("no average was requested: send `average` first")
        return {"average": averaging.result}

    def _payload(self, request: Message, client: int) -> Message:
        self._runtime.parts.servo.torque_model.payload_kg = number(request, "mass_kg", 0.0, 100.0)
        return {}

    def _acknowledge(self, request: Message, client: int) -> Message:
        return {"acknowledged": [fault.message for fault in self._runtime.acknowledge()]}

    def _fault_cycles(self, request: Message, client: int) -> Message:
        layout = self._runtime.parts.recorder.layout
        rows = base64.b64encode(b"".join(self._runtime.fault_rows)).decode()
        return {"rows": rows, "names": layout.names, "packing": layout.packing.format}

    def _off(self, request: Message, client: int) -> Message:
        self._runtime.go_off(flag(request, "quit"))
        return {}
