"""Requests to a runtime with several arms: to which arm, what all arms share, and what one arm does not do beside another.

A request is about the arm that it names as `arm`, else about the arm to whose socket it came. `stop` and `brake` are for all
arms. Everything else is served as by the runtime of one arm (control.server.requests).
"""

import copy
from collections.abc import Mapping, Sequence

from control.errors import ArmError
from control.loop.cell import CellRuntime
from control.loop.set_points import limits_of
from control.model.cell import Cell
from control.model.fingerprint import places_of
from control.motion.pace import Stretched
from control.motion.setpoint import Motion
from control.safety.modes import Mode
from control.server.messages import SHOWN, Asked, MoveTogether, decoded
from control.server.planned_motions import Planned
from control.server.requests import Message, Requests, refused

# They wait for boards, and the loop with them: an arm in motion would be without control for some tens of milliseconds.
WAITING = frozenset(("enable", "home", "acknowledge"))
PACING = frozenset(("pause", "resume", "override"))
BEGINNING = frozenset(("home", "move_joints", "run_path", "run_joints", "move_together", "jog", "guide"))
PLANNED = BEGINNING - {"jog", "guide"}  # by jog and by hand, an arm can be brought away from one that is in FAULT


class CellRequests:
    """Serves the requests of all clients; `requests` of each arm by its name."""

    def __init__(self, cell: Cell, runtime: CellRuntime, requests: Mapping[str, Requests]) -> None:
        self._name, self._places = cell.name, places_of(cell)
        self._runtime, self._requests = runtime, requests

    def handle(self, request: Asked, client: int) -> Message:
        """Serve one request of a client; never raises because of the request."""
        try:
            if request.do in ("stop", "brake"):
                return self._stop(request, client)
            if request.do == "move_together":
                return self._move_together(request, client)
            arm = self._named(request.arm)
            if request.do in WAITING | BEGINNING | {"hold"}:
                self._require_possible(arm, request.do)
            if request.do == "off":
                return self._off(request, arm, client)
            if request.do in PACING and len(partners := self._runtime.in_one_motion(arm)) > 1:
                return self._of_all(request, partners, client)
            answer = self._requests[arm].handle(request._replace(arm=arm), client)
        except ArmError as error:
            return refused(str(error))
        if request.do == "status" and answer["ok"]:
            answer["cell"] = {"name": self._name, "arms": self._modes()}
        if request.do == "arm" and answer["ok"]:
            answer["cell"] = self._places
        return answer

    def on_gone(self, client: int) -> None:
        """A client disconnected: what it began, with any arm, is stopped."""
        for requests in self._requests.values():
            requests.on_gone(client)

    def _named(self, name: str) -> str:
        """ArmError lists the arms."""
        if name not in self._requests:
            got = repr(name[:SHOWN]) if name else "none"
            raise ArmError(f"arm: expected one of {', '.join(self._requests)} of cell {self._name!r}, got {got}")
        return name

    def _modes(self) -> dict[str, str]:
        return {name: runtime.monitor.mode.name for name, runtime in self._runtime.runtimes.items()}

    def _stop(self, request: Asked, client: int) -> Message:
        """All arms, whatever arm the request names; one that is off does not hide that the others were braked."""
        answers = self._answers(request, tuple(self._requests), client)
        return next((answer for answer in answers if answer["ok"]), answers[0])

    def _of_all(self, request: Asked, arms: Sequence[str], client: int) -> Message:
        """The same for several arms; the first refusal, if there is one."""
        answers = self._answers(request, arms, client)
        return next((answer for answer in answers if not answer["ok"]), answers[0])

    def _answers(self, request: Asked, arms: Sequence[str], client: int) -> list[Message]:
        return [self._requests[name].handle(request._replace(arm=name), client) for name in arms]

    def _move_together(self, request: Asked, client: int) -> Message:
        """Check the motions of all arms, against each other too; then begin all of them. They take as long as the longest."""
        self._require_two(client)
        asked: MoveTogether = decoded(request)
        if len(asked.moves) < 2:
            raise ArmError(f"move_together: expected moves of two arms or more, got {len(asked.moves)}")
        planned = {self._named(name): move.request(asked.detached) for name, move in asked.moves.items()}
        for name in planned:
            self._require_possible(name, "move_together")
        paces = {self._runtime.runtimes[name].override for name in planned}
        if len(paces) > 1:
            raise ArmError("move_together: expected the same override for all arms: set one for each")
        motions = {name: self._prepared(name, move, client) for name, move in planned.items()}
        duration_s = max(motion.duration_s for motion in motions.values())
        together: dict[str, Motion] = {name: Stretched(motion, duration_s) for name, motion in motions.items()}
        for name, motion in together.items():
            self._runtime.collisions.of_arms[name].require_clear(motion, together)
        for name, motion in together.items():
            others = [
                (copy.copy(move), limits_of(self._runtime.runtimes[other])) for other, move in together.items() if other != name
            ]
            self._requests[name].begin(motion, planned[name], client, others)
        runs = {name: self._runtime.runtimes[name].run_number for name in together}
        self._runtime.joint_motions.append(runs)
        return {"ok": True, "duration_s": duration_s, "runs": runs}

    def _require_two(self, client: int) -> None:
        """ArmError if fewer than two arms may begin a motion: paths are not read before."""
        refusals = []
        for name, requests in self._requests.items():
            try:
                requests.require_may_begin("move_together", client)
            except ArmError as error:
                refusals.append(f"arm {name!r}: {error}")
        if len(self._requests) - len(refusals) < 2:
            raise ArmError(refusals[0])

    def _prepared(self, name: str, planned: Planned, client: int) -> Motion:
        """ArmError says which arm it is about."""
        try:
            return self._requests[name].prepared(planned, client)
        except ArmError as error:
            raise ArmError(f"arm {name!r}: {error}") from None

    def _off(self, request: Asked, arm: str, client: int) -> Message:
        """The drives of one arm; the end of the runtime is the end of all."""
        answer = self._requests[arm].handle(request._replace(arm=arm), client)
        if answer["ok"] and decoded(request).quit:
            self._runtime.go_off(quits=True)
        return answer

    def _require_possible(self, arm: str, do: str) -> None:
        """ArmError says which other arm is in the way of a request."""
        runtimes, what = self._runtime.runtimes, do.replace("_", " ")
        asked = runtimes[arm]
        is_off = asked.monitor.mode in (Mode.OFF, Mode.HELD) or not asked.drives.is_ready
        waits = do in WAITING or (do == "hold" and is_off)
        if waits and (beside := self._runtime.moving_beside(arm)):
            mode = runtimes[beside].monitor.mode.name
            raise ArmError(
                f"arm {beside!r} is {mode}, so arm {arm!r} cannot {what}: it waits for its boards, and the loop with it; try"
                f" again when arm {beside!r} is at rest"
            )
        if do in BEGINNING:
            for beside, runtime in runtimes.items():
                if beside != arm and runtime.monitor.mode is Mode.HOMING:
                    raise ArmError(f"arm {beside!r} is HOMING, so arm {arm!r} cannot {what}: wait until it is homed")
        if do in PLANNED and (beside := self._runtime.in_fault_beside(arm)):
            raise ArmError(
                f"arm {beside!r} is in FAULT, so arm {arm!r} cannot {what}: `armwright acknowledge --arm {beside}` when it is"
                " safe; jogs and hand guiding are free"
            )
