"""The hardware of a motor board: its measurements and their noise, the heat of its power stage. What runs on it is a subclass.
Its states and their transitions are a table (docs/motor_board.md).
"""

from __future__ import annotations

import functools
import random
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from typing import NamedTuple, Protocol

_NOISE_VALUES = 4096  # drawn in advance: one draw per reply would double its cost
_WARM_UP_EVERY_S = 0.05
LOWEST_SUPPLY_V, HIGHEST_SUPPLY_V = 9.0, 50.0

Frame = tuple[int, bytes]


class Output(NamedTuple):
    """Output of the bridge: `kind` is open, voltage (V; 0 brakes) or current (A)."""

    kind: str
    value: float


OPEN, BRAKE = Output("open", 0.0), Output("voltage", 0.0)


class Pins(Protocol):
    """Digital pins. `outside` has the levels that the world puts on inputs."""

    outside: int

    @property
    def levels(self) -> int:
        """Levels at the pins."""
        ...


@dataclass(frozen=True, slots=True)
class MotorBoardSetup:
    """Properties of the board: identity, ratings, measurement noise, thermal path of its power stage."""

    node: int
    serial_number: int
    counts_per_turn: int
    rating_mA: int = 8000
    firmware: int = 0x0100
    protocol: int = 1
    current_noise_A: float = 0.0
    current_step_A: float = 0.001
    supply_noise_V: float = 0.0
    ambient_degC: float = 25.0
    thermal_K_W: float = 2.0
    thermal_time_s: float = 60.0
    bridge_ohm: float = 0.02
    rated_degC: float = 90.0
    period_us: int = 1000
    digital_pins: int = 0  # 0: an older board, which does not know them
    reset_cause: int = 1  # power-up
    seed: int = 0


@functools.cache
def _noise_of(node: int, seed: int) -> tuple[float, ...]:
    """Standard normal draws of a board."""
    source = random.Random(f"motor board {node} {seed}")
    return tuple(source.gauss(0.0, 1.0) for _ in range(_NOISE_VALUES))


class MotorBoardHardware(ABC):
    """The board of a joint, without its firmware. `read_shaft` gives the edges counted by its encoder input, without wrap."""

    pins: Pins

    def __init__(self, setup: MotorBoardSetup, read_shaft: Callable[[], int]) -> None:
        self.setup = setup
        self._read_shaft = read_shaft
        self._noise = _noise_of(setup.node, setup.seed)
        self._replies = 0
        self.forced_faults = 0  # persistent causes, set by a fault of the scenario
        self.says: dict[str, float | None] = {}  # values that replies have instead of the measured ones
        self.current_limit_A = setup.rating_mA * 1e-3  # enforced by the bridge in every mode
        self.output = OPEN
        self.power_up()

    def power_up(self) -> None:
        """State after power-up or reset: outputs open, parameters at their defaults, count 0."""
        self._current_A = self._mean_A = 0.0
        self._supply_V = 24.0
        self._is_limited = False  # the bridge was at a limit
        self._above_ambient_K = self._heat_A2s = self._heated_s = 0.0
        self._whole_degC = round(self.setup.ambient_degC)  # as a REPLY has it
        self._last_tick_s: float | None = None
        self.output = OPEN
        self._boot()

    def tick(self, now_s: float, current_A: float, supply_V: float, is_limited: bool) -> list[Frame]:
        """Run one control period: measure, monitor, control. Returns unsolicited frames."""
        self._mean_A = 0.5 * (self._current_A + current_A)
        self._current_A, self._supply_V, self._is_limited = current_A, supply_V, is_limited
        step_s = self.setup.period_us * 1e-6 if self._last_tick_s is None else now_s - self._last_tick_s
        self._last_tick_s = now_s
        self._heat_A2s += current_A * current_A * step_s
        self._heated_s += step_s
        if self._heated_s > _WARM_UP_EVERY_S:
            self._warm_up()
        return self._period(now_s, step_s)

    @property
    @abstractmethod
    def position_count(self) -> int:
        """The board's own count of the motor's encoder, 32 bits, wrapping."""

    @abstractmethod
    def receive(self, can_id: int, payload: bytes, now_s: float) -> list[Frame]:
        """Process a frame from the bus; return the immediate replies."""

    @abstractmethod
    def _boot(self) -> None:
        """Start the firmware at power-up."""

    @abstractmethod
    def _period(self, now_s: float, step_s: float) -> list[Frame]:
        """The firmware's control period."""

    @property
    def _temperature_degC(self) -> float:
        return self.setup.ambient_degC + self._above_ambient_K

    def _warm_up(self) -> None:
        """First-order power stage with the steady temperature rise R_th (R_bridge mean(i^2))."""
        setup = self.setup
        final_K = setup.thermal_K_W * setup.bridge_ohm * self._heat_A2s / self._heated_s
        self._above_ambient_K += (final_K - self._above_ambient_K) * min(1.0, self._heated_s / setup.thermal_time_s)
        self._whole_degC = round(self._temperature_degC)
        self._heat_A2s = self._heated_s = 0.0

    def _readings(self) -> tuple[int, int, int]:
        """What the next REPLY has [mA, mV, degC], with noise, or with what a fault makes the board say."""
        setup, noise, at = self.setup, self._noise, self._replies
        self._replies = (at + 2) % _NOISE_VALUES
        step_A = setup.current_step_A
        steps = round((self._mean_A + setup.current_noise_A * noise[at]) / step_A)
        current_mA = round(steps * step_A * 1e3)
        supply_mV = round((self._supply_V + setup.supply_noise_V * noise[at + 1]) * 1e3)
        temperature_degC = self._whole_degC
        if self.says:
            said = (self.says.get(f"says_{name}") for name in ("current", "supply", "temperature"))
            said_A, said_V, said_degC = said
            current_mA = current_mA if said_A is None else round(said_A * 1e3)
            supply_mV = supply_mV if said_V is None else round(said_V * 1e3)
            temperature_degC = temperature_degC if said_degC is None else round(said_degC)
        if not -32767 <= current_mA <= 32767:
            current_mA = 32767 if current_mA > 0 else -32767
        if not 0 <= supply_mV <= 65535:
            supply_mV = 65535 if supply_mV > 0 else 0
        if not -128 <= temperature_degC <= 127:
            temperature_degC = 127 if temperature_degC > 0 else -128
        return current_mA, supply_mV, temperature_degC


class MotorState(Enum):
    """CiA 402 states; the value is the statusword, without warning and voltage-enabled."""

    NOT_READY = 0x00
    SWITCH_ON_DISABLED = 0x40
    READY = 0x21
    SWITCHED_ON = 0x23
    ENABLED = 0x27
    QUICK_STOP = 0x07
    FAULT_REACTION = 0x0F
    FAULT = 0x08


class Word(Enum):
    """Commands of a controlword."""

    SHUTDOWN = 1
    SWITCH_ON = 2
    ENABLE_OPERATION = 3
    DISABLE_VOLTAGE = 4
    QUICK_STOP = 5
    FAULT_RESET = 6
    NOTHING = 7


NEXT: dict[tuple[MotorState, Word], MotorState] = {
    (MotorState.SWITCH_ON_DISABLED, Word.SHUTDOWN): MotorState.READY,
    (MotorState.READY, Word.SWITCH_ON): MotorState.SWITCHED_ON,
    (MotorState.READY, Word.ENABLE_OPERATION): MotorState.SWITCHED_ON,
    (MotorState.READY, Word.DISABLE_VOLTAGE): MotorState.SWITCH_ON_DISABLED,
    (MotorState.READY, Word.QUICK_STOP): MotorState.SWITCH_ON_DISABLED,
    (MotorState.SWITCHED_ON, Word.SHUTDOWN): MotorState.READY,
    (MotorState.SWITCHED_ON, Word.ENABLE_OPERATION): MotorState.ENABLED,
    (MotorState.SWITCHED_ON, Word.DISABLE_VOLTAGE): MotorState.SWITCH_ON_DISABLED,
    (MotorState.SWITCHED_ON, Word.QUICK_STOP): MotorState.SWITCH_ON_DISABLED,
    (MotorState.ENABLED, Word.SHUTDOWN): MotorState.READY,
    (MotorState.ENABLED, Word.SWITCH_ON): MotorState.SWITCHED_ON,
    (MotorState.ENABLED, Word.DISABLE_VOLTAGE): MotorState.SWITCH_ON_DISABLED,
    (MotorState.ENABLED, Word.QUICK_STOP): MotorState.QUICK_STOP,
    (MotorState.QUICK_STOP, Word.DISABLE_VOLTAGE): MotorState.SWITCH_ON_DISABLED,
    (MotorState.FAULT, Word.FAULT_RESET): MotorState.SWITCH_ON_DISABLED,
}


def word_of(controlword: int, before: int) -> Word:
    """The command in a controlword; fault reset is an edge of bit 7 against the one `before`."""
    if controlword & 0x80:
        return Word.NOTHING if before & 0x80 else Word.FAULT_RESET
    if not controlword & 0x02:
        return Word.DISABLE_VOLTAGE
    if not controlword & 0x04:
        return Word.QUICK_STOP
    if not controlword & 0x01:
        return Word.SHUTDOWN
    return Word.ENABLE_OPERATION if controlword & 0x08 else Word.SWITCH_ON
