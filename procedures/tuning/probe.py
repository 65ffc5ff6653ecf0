"""A probe between loop and boards: adds a known signal to one joint's output, and records commands and counts."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from control.hardware.interface import Attended, EndBoards, Feedback, Hardware, OutputMode
from control.hardware.words import Wanted
from firmware_iface.clock import Clock


@dataclass(slots=True)
class Trace:
    """One joint, a value per cycle: time, count, commanded output (V or A), added signal."""

    t_s: list[float] = field(default_factory=list)
    count: list[int] = field(default_factory=list)
    output: list[float] = field(default_factory=list)
    added: list[float] = field(default_factory=list)


class Probe:
    """`control.hardware.interface.Hardware` that forwards all calls and adds the signal."""

    def __init__(self, hardware: Hardware, clock: Clock) -> None:
        self.feedback: Feedback = hardware.feedback
        self.offers = hardware.offers
        self.end: EndBoards = hardware.end
        self.trace = Trace()
        self._hardware, self._clock = hardware, clock
        self._joint: int | None = None
        self._signal: Sequence[float] = (0.0,)
        self._limit = 0.0
        self._on_cycle: Callable[[int], None] = lambda cycle: None

    def watch(
        self, joint: int, signal: Sequence[float], limit: float, on_cycle: Callable[[int], None]
    ) -> None:
        """Start a trace of a joint (0-based), with a signal applied once, clamped to the output limit.

        `on_cycle` is called at the end of each cycle with its number, from 0.
        """
        self.trace = Trace()
        self._joint, self._signal, self._limit, self._on_cycle = joint, signal, limit, on_cycle

    def rest(self) -> Trace:
        """End the trace."""
        self._joint = None
        return self.trace

    @property
    def gone(self) -> str:
        """Why a link is gone; empty while all are there."""
        return self._hardware.gone

    @property
    def is_polled(self) -> bool:
        """Whether some of its boards speak only when they are asked."""
        return self._hardware.is_polled

    def attend(self, until_s: float, beside: Sequence[Hardware] = ()) -> None:
        """As the hardware."""
        self._hardware.attend(until_s, beside)

    def polled_lines(self) -> Sequence[Attended]:
        """As the hardware."""
        return self._hardware.polled_lines()

    def read(self) -> Feedback:
        """As the hardware."""
        return self._hardware.read()

    def write(
        self, wanted: Wanted, modes: Sequence[OutputMode], output: Sequence[float], feedforward_V: Sequence[float]
    ) -> None:  # fmt: skip
        """As the hardware, with the signal added to one joint while the loop controls it."""
        joint = self._joint
        if joint is None:
            self._hardware.write(wanted, modes, output, feedforward_V)
            return
        trace = self.trace
        cycle = len(trace.t_s)
        added = (
            self._signal[cycle] if cycle < len(self._signal) and modes[joint] is not OutputMode.OFF else 0.0
        )
        outputs = list(output)
        outputs[joint] = min(max(outputs[joint] + added, -self._limit), self._limit)
        trace.t_s.append(self._clock.now_s())
        trace.count.append(self.feedback.count[joint])
        trace.output.append(outputs[joint])
        trace.added.append(outputs[joint] - output[joint])
        self._hardware.write(wanted, modes, outputs, feedforward_V)
        self._on_cycle(cycle)

    def has_torque(self) -> bool:
        """As the hardware."""
        return self._hardware.has_torque()

    def prepare(self) -> None:
        """As the hardware."""
        self._hardware.prepare()

    def watch_indices(self, is_wanted: bool) -> None:
        """As the hardware."""
        self._hardware.watch_indices(is_wanted)

    def await_counts(self, made_s: float, until_s: float) -> float:
        """As the hardware."""
        return self._hardware.await_counts(made_s, until_s)

    def passed_indices(self) -> list[tuple[int, int]]:
        """As the hardware."""
        return self._hardware.passed_indices()

    def reset_drive_faults(self) -> None:
        """As the hardware."""
        self._hardware.reset_drive_faults()

    def reset_gripper(self) -> None:
        """As the hardware."""
        self._hardware.reset_gripper()

    def emergency_stop(self) -> None:
        """As the hardware."""
        self._hardware.emergency_stop()

    def arm_index(self, joint: int) -> None:
        """As the hardware."""
        self._hardware.arm_index(joint)

    def index_count(self, joint: int) -> int | None:
        """As the hardware."""
        return self._hardware.index_count(joint)

    def shift_count(self, joint: int, counts: int) -> None:
        """As the hardware."""
        self._hardware.shift_count(joint, counts)
