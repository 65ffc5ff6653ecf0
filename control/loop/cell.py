"""Several arms in one loop: one clock, one stop for all, and a fault of one stops the others.

Each arm has a runtime of its own, with its modes, limits, faults and recording. What waits for an answer of a board stops
the whole loop for some milliseconds, so it is done only while no other arm moves (control.server.cell_requests).
"""

from collections.abc import Mapping, Sequence
from typing import Protocol

from control.hardware.interface import Hardware
from control.loop.neighbours import CollisionWatch
from control.loop.runtime import Runtime
from control.model.cell import Cell
from control.safety.modes import TRAVELLING_MODES, Mode

MOVING_MODES = TRAVELLING_MODES | {Mode.STOPPING, Mode.GUIDING}  # in which an arm may be in motion


class Looped(Protocol):
    """What a loop in real time, or a client's own process, runs cycle after cycle: an arm, or several."""

    @property
    def period_s(self) -> float: ...

    @property
    def hardware(self) -> Hardware:
        """Of the arm whose encoder reports the cycles follow."""
        ...

    def attend(self, until_s: float) -> None:
        """Wait until then, and serve the lines of boards that must be asked."""
        ...

    def cycle(self, now_s: float, late_s: float, missed: int, missed_in_row: int) -> bool:
        """Run one cycle; False once all has been shut down."""
        ...

    def go_off(self, quits: bool) -> None:
        """Start the shutdown."""
        ...

    def ended_wait(self, now_s: float) -> bool:
        """Whether the loop has waited for boards since its last cycle."""
        ...

    def stands(self) -> bool:
        """Whether no arm is under control, and none moves."""
        ...

    def is_off(self) -> bool:
        """Whether the drives of all arms are off."""
        ...


class CellRuntime:
    """The runtimes of a cell's arms by name, cycled together. `now_s` of all is that of the cycle's beginning."""

    def __init__(self, cell: Cell, runtimes: Mapping[str, Runtime]) -> None:
        self.runtimes = runtimes
        self.collisions = CollisionWatch(cell, runtimes)
        self._all: Sequence[Runtime] = tuple(runtimes.values())
        self.joint_motions: list[Mapping[str, int]] = []  # of each: the arms that began it, and their run then
        self._in_fault: set[str] = set()
        polled = [runtime.parts.hardware for runtime in self._all if runtime.parts.hardware.is_polled]
        self._attended = polled or [self._all[0].parts.hardware]

    @property
    def period_s(self) -> float:
        """Period of the loop."""
        return self._all[0].parts.period_s

    @property
    def hardware(self) -> Hardware:
        """Of the first arm."""
        return self._all[0].parts.hardware

    def attend(self, until_s: float) -> None:
        """Wait until then; the lines of all arms whose boards must be asked are served at once."""
        first, *others = self._attended
        first.attend(until_s, others)

    def cycle(self, now_s: float, late_s: float, missed: int, missed_in_row: int) -> bool:
        """Run one cycle of every arm; False once all of them have been shut down."""
        goes_on = [runtime.cycle(now_s, late_s, missed, missed_in_row) for runtime in self._all]
        self.collisions.look()
        self._stop_beside_a_fault()
        self._end_together()
        return any(goes_on)

    def go_off(self, quits: bool) -> None:
        """Start the shutdown of every arm."""
        for runtime in self._all:
            runtime.go_off(quits)

    def stop(self, why: str = "") -> None:
        """Stop every arm."""
        for runtime in self._all:
            runtime.stop(why)

    def brake(self) -> None:
        """Short the windings of every arm now."""
        for runtime in self._all:
            runtime.brake()

    def ended_wait(self, now_s: float) -> bool:
        """Whether the loop has waited for boards of any arm; what was not read meanwhile has not aged for any."""
        have_waited = [runtime.ended_wait(now_s) for runtime in self._all]
        if not any(have_waited):
            return False
        for runtime, has_waited in zip(self._all, have_waited, strict=True):
            if not has_waited:
                runtime.note_wait(now_s)
        return True

    def stands(self) -> bool:
        """Whether no arm is under control, and none moves."""
        return all(runtime.stands() for runtime in self._all)

    def is_off(self) -> bool:
        """Whether the drives of all arms are off."""
        return all(runtime.is_off() for runtime in self._all)

    def moving_beside(self, name: str) -> str:
        """The first other arm that may be in motion; empty if none is."""
        return next(
            (other for other, runtime in self.runtimes.items() if other != name and runtime.monitor.mode in MOVING_MODES), ""
        )

    def in_fault_beside(self, name: str) -> str:
        """The first other arm in FAULT; empty if none is."""
        return next(
            (other for other, runtime in self.runtimes.items() if other != name and runtime.monitor.mode is Mode.FAULT), ""
        )

    def in_one_motion(self, arm: str) -> tuple[str, ...]:
        """The arms that are still in the motion that they began together with this one; else this one alone."""
        all_going = map(self._going, self.joint_motions)
        return next((going for going in all_going if arm in going), (arm,))

    def _going(self, began: Mapping[str, int]) -> tuple[str, ...]:
        return tuple(
            name
            for name, run in began.items()
            if self.runtimes[name].run_number == run and self.runtimes[name].monitor.mode in (Mode.MOVING, Mode.PAUSED)
        )

    def _end_together(self) -> None:
        """Whatever ends a joint motion for one arm before its end, ends it for all: each stops on its path."""
        if self.joint_motions:
            self.joint_motions = [began for began in self.joint_motions if self._goes_on(began)]

    def _goes_on(self, began: Mapping[str, int]) -> bool:
        going = self._going(began)
        for name, run in began.items():
            if name not in going and (self.runtimes[name].run_number != run or self.runtimes[name].was_stopped):
                for other in going:
                    self.runtimes[other].stop(f"arm {name!r}, which moves with it, was stopped")
                return False
        return bool(going)

    def _stop_beside_a_fault(self) -> None:
        """An arm that has gone to FAULT stops all others, each on its path; those that hold go on holding."""
        for name, runtime in self.runtimes.items():
            if runtime.monitor.mode is not Mode.FAULT:
                self._in_fault.discard(name)
            elif name not in self._in_fault:
                self._in_fault.add(name)
                why = f"arm {name!r} is in FAULT: {runtime.monitor.faults[0].message}"
                for neighbour in self._all:
                    if neighbour is not runtime and neighbour.monitor.mode in MOVING_MODES:
                        neighbour.stop(why)
