"""The DC-motor board: states, modes, position PID, watchdog, faults; written from docs/motor_board.md.

A state machine without I/O: `receive` frames, `tick` once per control period with the measurements, and read `output`.
"""

from __future__ import annotations

import math
import random
import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

from hil_mocks.devices import motor_parameters as parameter
from hil_mocks.devices.digital_pins import DigitalPinsMock
from hil_mocks.devices.motor_states import NEXT, State, Word, word_of

HOLD = 4  # mode
COMMAND, REPLY, REQUEST, ANSWER, DIGITAL_COMMAND, DIGITAL_REPLY = 0x100, 0x180, 0x200, 0x280, 0x300, 0x380
OVER_CURRENT, OVER_TEMPERATURE, UNDER_VOLTAGE, OVER_VOLTAGE = 1, 2, 4, 8
WATCHDOG, ENCODER, BAD_COMMAND, EMERGENCY_STOP = 16, 32, 64, 128

_COMMAND = struct.Struct("<BBih")
_REPLY = struct.Struct("<BBhHbB")
_REQUEST = struct.Struct("<BBBBi")
_LOWEST_SUPPLY_V, _HIGHEST_SUPPLY_V = 9.0, 50.0
_OVER_CURRENT_RATIO = 1.5
_NOISE_VALUES = 4096  # drawn in advance: one draw per reply would double its cost
_WARM_UP_EVERY_S = 0.05
_VOLTAGE_ENABLED, _WARNING = 0x10, 0x80

Frame = tuple[int, bytes]


class Output(NamedTuple):
    """Output of the bridge: `kind` is open, voltage (V; 0 brakes) or current (A)."""

    kind: str
    value: float


class Stop(NamedTuple):
    """A stop without the host: when and where it began, at what speed."""

    since_s: float
    from_count: int
    counts_s: float


OPEN, BRAKE = Output("open", 0.0), Output("voltage", 0.0)


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
    seed: int = 0


class MotorBoardMock:
    """The board of a joint. `read_shaft` gives the edges counted by its encoder input, without wrap."""

    def __init__(self, setup: MotorBoardSetup, read_shaft: Callable[[], int]) -> None:
        self.setup = setup
        self._read_shaft = read_shaft
        self._rows = parameter.writable(setup.rating_mA, setup.digital_pins)
        self.pins = DigitalPinsMock(setup.digital_pins)
        source = random.Random(f"motor board {setup.node} {setup.seed}")
        self._noise = [source.gauss(0.0, 1.0) for _ in range(_NOISE_VALUES)]
        self._replies = 0
        self.forced_faults = 0  # persistent causes, set by a fault of the scenario
        self.says: dict[str, float | None] = {}  # values that replies have instead of the measured ones
        self.power_up()

    def power_up(self) -> None:
        """State after power-up or reset: outputs open, parameters at their defaults, count 0."""
        self.state = State.NOT_READY
        self.pins.reset()
        self.output = OPEN
        self.faults = 0
        self.values = {index: row.at_power_up for index, row in self._rows.items()}
        self._take_values()
        self._current_A = self._mean_A = 0.0
        self._supply_V = 24.0
        self._is_limited = False  # the bridge was at a limit
        self._count_offset = self._count_before = self._read_shaft()
        self._before = 0x80
        self._mode = self._setpoint = self._feedforward_mV = 0
        self._integral_mV = self._speed = 0.0
        self._holds = False  # the position, since the watchdog expired
        self._stop: Stop | None = None  # without the host
        self._last_command_s = 0.0
        self._over_current_ticks = 0
        self._above_ambient_K = self._heat_A2s = self._heated_s = 0.0
        self._temperature_degC = round(self.setup.ambient_degC)
        self._is_cut = False  # the set-point was beyond a limit
        self._last_tick_s: float | None = None

    @property
    def position_count(self) -> int:
        """The board's own count of the motor's encoder, 32 bits, wrapping."""
        return _wrapped(self._read_shaft() - self._count_offset)

    def receive(self, can_id: int, payload: bytes, now_s: float) -> list[Frame]:
        """Process a frame from the bus; return the immediate replies."""
        if can_id == 0:
            self._fault(EMERGENCY_STOP)
            return []
        if len(payload) != 8:
            return []
        if can_id == COMMAND + self.setup.node:
            return [(REPLY + self.setup.node, self._command(payload, now_s))]
        if can_id == REQUEST + self.setup.node:
            return [(ANSWER + self.setup.node, self._parameter(payload))]
        if can_id == DIGITAL_COMMAND + self.setup.node and self.setup.digital_pins:
            self.pins.follow(self.state is State.ENABLED)
            return [(DIGITAL_REPLY + self.setup.node, self.pins.command(payload))]
        return []

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
        state = self.state
        if state is State.NOT_READY:
            self.state = State.SWITCH_ON_DISABLED
            self._apply()
            return [(ANSWER + self.setup.node, _REQUEST.pack(0, 0, 0, 0, self.setup.protocol))]
        if state is State.FAULT_REACTION:
            self.state = State.FAULT
        elif state is State.ENABLED and now_s - self._last_command_s > self._soonest_s:
            if now_s - self._last_command_s > self._watchdog_s:
                self._expire()
            elif self._stop is None and self._mode in (1, 2):
                self._begin_stop(now_s)
        if (
            self.forced_faults
            or not -self._trip_A <= current_A <= self._trip_A
            or not _LOWEST_SUPPLY_V <= supply_V <= _HIGHEST_SUPPLY_V
            or self._above_ambient_K > self.setup.rated_degC - self.setup.ambient_degC
        ):
            causes = self._causes()
            if causes & ~self.faults:
                self._fault(causes)
        else:
            self._over_current_ticks = 0
        if (self._mode == 3 and self.state is State.ENABLED) or self._holds:
            self._control(step_s)
        elif self._is_measuring_speed:
            self._measure_speed(step_s)
        if self.setup.digital_pins:
            self.pins.follow(self.state is State.ENABLED)
        return []

    def _causes(self) -> int:
        """Faults with a present cause; an over-current must last a period."""
        causes = self.forced_faults
        if abs(self._current_A) > self._trip_A:
            self._over_current_ticks += 1
            if self._over_current_ticks > 1:
                causes |= OVER_CURRENT
        if self._above_ambient_K > self.setup.rated_degC - self.setup.ambient_degC:
            causes |= OVER_TEMPERATURE
        if self._supply_V < _LOWEST_SUPPLY_V and self.state is State.ENABLED:
            causes |= UNDER_VOLTAGE
        if self._supply_V > _HIGHEST_SUPPLY_V:
            causes |= OVER_VOLTAGE
        return causes

    def _take_values(self) -> None:
        """Update the values of each period from the parameters."""
        values = self.values
        self.current_limit_A = (
            values[parameter.CURRENT_LIMIT_MA] * 1e-3
        )  # enforced by the bridge in every mode
        self._trip_A = _OVER_CURRENT_RATIO * self.current_limit_A
        self._voltage_limit_mV = float(values[parameter.VOLTAGE_LIMIT_MV])
        watchdog_ms = values[parameter.WATCHDOG_MS]
        self._watchdog_s = watchdog_ms * 1e-3 - 1e-9 if watchdog_ms else math.inf
        stop_ms = values[parameter.STOP_AFTER_MS]
        self._is_measuring_speed = stop_ms > 0
        self._soonest_s = min(self._watchdog_s, stop_ms * 1e-3 - 1e-9 if stop_ms else math.inf)

    def _fault(self, bits: int) -> None:
        first = self.state not in (State.FAULT, State.FAULT_REACTION)
        self.faults |= bits
        if first or bits & EMERGENCY_STOP:
            self.state = State.FAULT_REACTION
        if bits & OVER_CURRENT:
            self._holds, self._stop, self.output = False, None, OPEN
        elif (bits & EMERGENCY_STOP and not self.faults & OVER_CURRENT) or first:
            self._holds, self._stop, self.output = False, None, BRAKE

    def _expire(self) -> None:
        """The watchdog expired: its action, then FAULT, which keeps that output."""
        action, stop = self.values[parameter.WATCHDOG_ACTION], self._stop
        self._fault(WATCHDOG)
        if action == 0:
            self.output = OPEN
        elif action == 2 and self.values[parameter.KP] > 0 and stop is not None:
            self._holds, self._stop = True, stop
        elif action == 2 and self.values[parameter.KP] > 0:
            self._holds = True
            self._setpoint, self._feedforward_mV, self._integral_mV = self.position_count, 0, 0.0
            self._count_before, self._speed = self._read_shaft(), 0.0
        # else: brake, as for every fault

    def _begin_stop(self, now_s: float) -> None:
        """Come to rest and hold: no COMMAND for `stop_after_ms`, or one of mode 4."""
        if self.values[parameter.KP] == 0:
            self.output = BRAKE
        else:
            kind, voltage_V = self.output
            self._stop = Stop(now_s, self.position_count, self._speed)
            kv = self.values[parameter.SPEED_FEEDFORWARD] * 1e-6
            self._integral_mV = voltage_V * 1e3 - kv * self._speed if kind == "voltage" else 0.0
            self._feedforward_mV, self._holds = 0, True

    def _end_stop(self) -> None:
        if self._stop is not None:
            self._stop, self._holds, self._integral_mV = None, False, 0.0

    def _measure_speed(self, step_s: float) -> None:
        """Filtered speed [counts/s], for a stop that may begin at any time."""
        shaft_count = self._read_shaft()
        if step_s > 0.0:
            rate = (shaft_count - self._count_before) / step_s
            filter_s = self.values[parameter.DERIVATIVE_FILTER_US] * 1e-6
            self._speed += (rate - self._speed) * step_s / (step_s + filter_s)
        self._count_before = shaft_count

    def _stopping_point(self) -> tuple[int, float]:
        """Set-point in counts, and its speed, during a stop without the host."""
        stop = self._stop
        if stop is None or self._last_tick_s is None:
            return self._setpoint, 0.0
        whole_s = self.values[parameter.STOP_TIME_MS] * 1e-3
        since_s = min(self._last_tick_s - stop.since_s, whole_s)
        way = stop.counts_s * (since_s - 0.5 * since_s * since_s / whole_s)
        return _wrapped(stop.from_count + round(way)), stop.counts_s * (1.0 - since_s / whole_s)

    def _command(self, payload: bytes, now_s: float) -> bytes:
        controlword, mode_and_sequence, setpoint, feedforward_mV = _COMMAND.unpack(payload)
        self._last_command_s = now_s
        mode = mode_and_sequence & 7
        if mode > HOLD:
            self._before = controlword
            if self.state is not State.NOT_READY:
                self._fault(BAD_COMMAND)
            return self._reply(mode_and_sequence)
        if controlword != 0x0F or self.state is not State.ENABLED or self._before != 0x0F:
            self._transition(controlword)
        if self.state is State.ENABLED and mode == HOLD:
            if self._mode != HOLD and self._stop is None:
                self._begin_stop(now_s)
            self._mode = mode
        elif self.state is State.ENABLED:
            self._end_stop()
            if mode != self._mode:
                self._integral_mV = self._speed = 0.0
                self._count_before = self._read_shaft()
            self._mode, self._setpoint, self._feedforward_mV = mode, setpoint, feedforward_mV
            self._apply()
        return self._reply(mode_and_sequence)

    def _transition(self, controlword: int) -> None:
        word = word_of(controlword, self._before)
        self._before = controlword
        new = NEXT.get((self.state, word))
        if new is None:
            return
        if word is Word.FAULT_RESET:
            lasting = self._causes()
            self.faults = lasting
            if lasting:
                return
            self._holds, self._stop = False, None
        if new is State.ENABLED:
            self._integral_mV, self._speed = 0.0, 0.0
            self._count_before = self._read_shaft()
        self.state = new
        self._mode = 0
        self._apply()

    def _apply(self) -> None:
        """Apply the output of state and mode; position mode computes one now, then at every tick."""
        self._is_cut = False
        if self.state is State.ENABLED:
            if self._mode == 0:
                self.output = OPEN
            elif self._mode == 1:
                self.output = Output("voltage", self._clamped_mV(self._setpoint) * 1e-3)
            elif self._mode == 2:
                limit_A, wanted_A = self.current_limit_A, self._setpoint * 1e-3
                self._is_cut = abs(wanted_A) > limit_A
                self.output = Output("current", min(max(wanted_A, -limit_A), limit_A))
            else:
                self._control(0.0)
        elif self.state is State.QUICK_STOP:
            self.output = BRAKE
        elif self.state not in (State.FAULT, State.FAULT_REACTION):
            self.output = BRAKE if self.values[parameter.DISABLED_OUTPUT] else OPEN

    def _control(self, step_s: float) -> None:
        """Position PID on the board's own count; derivative of the measurement, conditional integration."""
        values = self.values
        shaft_count = self._read_shaft()
        setpoint, set_speed = self._stopping_point()
        error = _wrapped(setpoint - shaft_count + self._count_offset)
        if step_s > 0.0:
            rate = (shaft_count - self._count_before) / step_s
            self._count_before = shaft_count
            filter_s = values[parameter.DERIVATIVE_FILTER_US] * 1e-6
            self._speed += (rate - self._speed) * step_s / (step_s + filter_s)
        wanted_mV = (
            values[parameter.KP] * 1e-3 * error
            + self._integral_mV
            + values[parameter.KD] * 1e-6 * (set_speed - self._speed)
            + values[parameter.SPEED_FEEDFORWARD] * 1e-6 * set_speed
            + self._feedforward_mV
        )
        output_mV = self._clamped_mV(wanted_mV)
        change_mV = values[parameter.KI] * 1e-3 * error * step_s
        if (wanted_mV - output_mV) * change_mV <= 0.0:
            limit_mV = float(values[parameter.INTEGRAL_LIMIT_MV])
            self._integral_mV = min(max(self._integral_mV + change_mV, -limit_mV), limit_mV)
        self.output = Output("voltage", output_mV * 1e-3)

    def _clamped_mV(self, wanted_mV: float) -> float:
        limit_mV = self._voltage_limit_mV
        if limit_mV > self._supply_V * 1e3:
            limit_mV = self._supply_V * 1e3
        self._is_cut = not -limit_mV <= wanted_mV <= limit_mV
        if self._is_cut:
            return limit_mV if wanted_mV > 0.0 else -limit_mV
        return wanted_mV

    def _warm_up(self) -> None:
        """First-order power stage with the steady temperature rise R_th (R_bridge mean(i^2))."""
        setup = self.setup
        final_K = setup.thermal_K_W * setup.bridge_ohm * self._heat_A2s / self._heated_s
        self._above_ambient_K += (final_K - self._above_ambient_K) * min(
            1.0, self._heated_s / setup.thermal_time_s
        )
        self._heat_A2s = self._heated_s = 0.0
        self._temperature_degC = min(round(setup.ambient_degC + self._above_ambient_K), 127)

    def _reply(self, mode_and_sequence: int) -> bytes:
        setup, noise, at = self.setup, self._noise, self._replies
        self._replies = (at + 2) % _NOISE_VALUES
        status, supply_V = self.state.value, self._supply_V
        if _LOWEST_SUPPLY_V <= supply_V <= _HIGHEST_SUPPLY_V:
            status |= _VOLTAGE_ENABLED
        if self._is_limited or self._is_cut:
            status |= _WARNING
        steps = round((self._mean_A + setup.current_noise_A * noise[at]) / setup.current_step_A)
        current_mA = round(steps * setup.current_step_A * 1e3)
        supply_mV = round((supply_V + setup.supply_noise_V * noise[at + 1]) * 1e3)
        temperature_degC = self._temperature_degC
        if self.says:
            said = (self.says.get(f"says_{name}") for name in ("current", "supply", "temperature"))
            said_A, said_V, said_degC = said
            current_mA = current_mA if said_A is None else round(said_A * 1e3)
            supply_mV = supply_mV if said_V is None else round(said_V * 1e3)
            temperature_degC = temperature_degC if said_degC is None else round(said_degC)
        if not -32767 <= current_mA <= 32767:
            current_mA = 32767 if current_mA > 0 else -32767
        return _REPLY.pack(
            status, mode_and_sequence, current_mA, max(supply_mV, 0), temperature_degC, self.faults
        )

    def _parameter(self, payload: bytes) -> bytes:
        operation, index, sequence, _, value = _REQUEST.unpack(payload)
        result = parameter.DONE
        if operation == 1:
            result = self._write(index, value)
        elif operation != 0:
            result = parameter.OUT_OF_RANGE
        known = self._read(index)
        if known is None:
            result = parameter.UNKNOWN_INDEX
        return _REQUEST.pack(result, index, sequence, 0, _wrapped(known or 0))

    def _read(self, index: int) -> int | None:
        setup = self.setup
        fixed = {
            0: setup.protocol,
            1: setup.serial_number,
            2: setup.firmware,
            3: setup.counts_per_turn,
            5: setup.period_us,
        }
        if index == parameter.POSITION_COUNT:
            return self.position_count
        if index == parameter.DIGITAL_PINS:
            return setup.digital_pins or None
        return fixed.get(index, self.values.get(index))

    def _write(self, index: int, value: int) -> int:
        result = parameter.refusal(self._rows, index, value)
        if result != parameter.DONE:
            return result
        if self.state not in (State.SWITCH_ON_DISABLED, State.READY, State.SWITCHED_ON):
            return parameter.NOT_IN_THIS_STATE
        if index == parameter.WATCHDOG_MS and value == 0 and self.state is not State.SWITCH_ON_DISABLED:
            return parameter.NOT_IN_THIS_STATE
        if index == parameter.POSITION_COUNT:
            self._count_offset = self._read_shaft() - value
        else:
            self.values[index] = value
            self._take_values()
            if index in (
                parameter.DIGITAL_OUTPUTS,
                parameter.DIGITAL_SAFE_LEVELS,
                parameter.DIGITAL_SAFE_KEEP,
            ):
                self.pins.configure(*(self.values[k] for k in range(49, 52)))
        self._apply()
        return parameter.DONE


def _wrapped(value: int) -> int:
    return (value + 0x80000000 & 0xFFFFFFFF) - 0x80000000
