"""Events of the arm as lines with local times, printed by `armwright serve`.

Detected between cycles by comparing a few attributes, so that a cycle without events costs a microsecond. Printed by a process
of its own (control.server.printer), so that a terminal that was stopped with Ctrl-S does not stop the loop.
"""

import time
from collections.abc import Callable

from control.loop.runtime import Runtime
from control.safety.table import CONTROLLED_MODES, TRAVELLING_MODES, Mode
from control.server.status import step_of

Say = Callable[[str], None]
REPEAT_S = 5.0  # of the shutdown's present step: a loaded arm sinks for some tens of seconds
POLLED = frozenset(
    ("status", "mode", "average", "average_result", "fault_cycles", "jog", "jog_on")
)  # requests that are not events: frequent, or without effect
BEGUN = {
    Mode.OFF: "drives off",
    Mode.HELD: "held by its boards: `armwright enable` takes it over, `armwright off` lets it go",
    Mode.BRAKED: "windings shorted",
    Mode.HOLDING: "holding",
    Mode.JOGGING: "jog begun",
    Mode.HOMING: "homing begun",
    Mode.STOPPING: "stopping",
    Mode.PAUSED: "paused",
}
ENDED = {Mode.JOGGING: "jog ended", Mode.STOPPING: "stopped", Mode.HOMING: "homing ended"}


class Events:
    """Compares the runtime with its last state; `say` gets each line, without its time."""

    def __init__(self, runtime: Runtime, say: Say) -> None:
        self._runtime = runtime
        self._say = say
        self._mode, self._run = runtime.monitor.mode, runtime.run_number
        self._faults = runtime.monitor.faults
        self._is_homed = runtime.monitor.is_homed
        self._next_step_s = 0.0
        self._gripper: object = None  # its state
        if self._mode is Mode.HELD:
            say(BEGUN[Mode.HELD])

    def look(self) -> None:
        """Report changes since the last call."""
        runtime, monitor = self._runtime, self._runtime.monitor
        if monitor.mode is not self._mode or runtime.run_number != self._run:
            self._say_mode()
        if monitor.faults is not self._faults:
            self._say_faults()
        if monitor.is_homed is not self._is_homed:
            self._is_homed = monitor.is_homed
            self._say("every joint is homed" if self._is_homed else "not homed: zeros unknown")
        if (gripper := runtime.parts.gripper) is not None and gripper.state is not self._gripper:
            self._gripper = gripper.state
            lost = "; it has lost what it held" if gripper.has_lost else ""
            self._say(f"gripper: {gripper.state.value}{f' ({gripper.why})' if gripper.why else ''}{lost}")
        if runtime.bound.is_off and runtime.now_s >= self._next_step_s:
            self._say_step()

    def requested(self, do: str, client: int) -> None:
        """Report an accepted request."""
        if do not in POLLED:
            self._say(f"client {client}: {do}")

    def hung_up(self, client: int) -> None:
        """Report that the client of the active motion has disconnected."""
        self._say(f"client {client} disconnected: its motion is stopped")

    def _say_mode(self) -> None:
        before, self._mode = self._mode, self._runtime.monitor.mode
        self._run = self._runtime.run_number
        self._next_step_s = 0.0
        self._say(self._change(before, self._mode))

    def _change(self, before: Mode, mode: Mode) -> str:
        motion = self._runtime.motion
        if mode is Mode.MOVING:
            took = f", {motion.duration_s:.1f} s" if motion is not None else ""
            return "resumed" if before is Mode.PAUSED else f"motion {self._run} begun{took}"
        if mode is Mode.GUIDING:
            carried = "the drives carry the arm's weight" if self._runtime.is_weightless else "drives open"
            return f"hand-guiding: {carried}"
        if mode is Mode.FAULT:
            return "FAULT: stopping" if self._runtime.monitor.is_held_fault else "FAULT: windings shorted"
        if mode is Mode.HOLDING and (before in TRAVELLING_MODES or before in ENDED):
            return f"{ENDED.get(before, f'motion {self._run} ended')}: holding"
        is_braked_late = mode is Mode.BRAKED and before in CONTROLLED_MODES
        return "windings shorted: the arm may sink" if is_braked_late else BEGUN[mode]

    def _say_faults(self) -> None:
        known, self._faults = self._faults, self._runtime.monitor.faults
        for fault in self._faults:
            if fault not in known:
                self._say(f"FAULT {fault.where}: {fault.message}; {fault.remedy}")
        if known and not self._faults:
            self._say("faults acknowledged")

    def _say_step(self) -> None:
        self._next_step_s = self._runtime.now_s + REPEAT_S
        if step := step_of(self._runtime):
            self._say(f"shutdown: {step}")


def with_time(text: str) -> str:
    """Format a line for printing, with the local time first."""
    return f"{time.strftime('%H:%M:%S')}  {text}\n"
