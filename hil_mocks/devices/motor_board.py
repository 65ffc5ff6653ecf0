"""The motor board's firmware in Python: states, modes, position PID, watchdog, faults; written from docs/motor_board.md.
Its parameters are a table: index, name, range, access, value at power-up.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

from hil_mocks.devices.motor_inputs import (
    BRAKE,
    HIGHEST_SUPPLY_V,
    LOWEST_SUPPLY_V,
    NEXT,
    OPEN,
    Frame,
    MotorBoardHardware,
    MotorBoardSetup,
    MotorState,
    Output,
    Word,
    word_of,
)

_PIN_COMMAND = struct.Struct("<BBB5x")
_PIN_REPLY = struct.Struct("<BBBB4x")


class DigitalPinsMock:
    """Pins of one board. `outside` has the levels that the world puts on inputs; `is_enabled` is the drive's."""

    def __init__(self, count: int) -> None:
        self.count = count
        self.outside = 0
        self._directions = self._safe_levels = self._keep = 0
        self._driven = 0
        self.is_enabled = False

    def reset(self) -> None:
        """Power-up: every pin is an input, and no level was ever set."""
        self._directions = self._safe_levels = self._keep = self._driven = 0
        self.is_enabled = False

    def configure(self, directions: int, safe_levels: int, keep: int) -> None:
        """The parameters have changed."""
        self._directions, self._safe_levels, self._keep = directions, safe_levels, keep
        self._go_safe()

    def follow(self, is_enabled: bool) -> None:
        """The drive is in OPERATION ENABLED, or not."""
        if self.is_enabled and not is_enabled:
            self._go_safe()
        self.is_enabled = is_enabled

    def command(self, payload: bytes) -> bytes:
        """Answer a DIGITAL_COMMAND."""
        sequence, mask, levels = _PIN_COMMAND.unpack(payload)
        if self.is_enabled:
            mask &= self._directions
            self._driven = self._driven & ~mask | levels & mask
        return _PIN_REPLY.pack(sequence, self.levels, self.outputs, not self.is_enabled)

    @property
    def outputs(self) -> int:
        """Levels that the board drives."""
        return self._driven & self._directions

    @property
    def levels(self) -> int:
        """Levels at the pins."""
        return self.outputs | self.outside & ~self._directions & ((1 << self.count) - 1)

    def _go_safe(self) -> None:
        self._driven = self._driven & self._keep | self._safe_levels & ~self._keep


HOLD = 4  # mode
COMMAND, REPLY, REQUEST, ANSWER, DIGITAL_COMMAND, DIGITAL_REPLY = 0x100, 0x180, 0x200, 0x280, 0x300, 0x380
OVER_CURRENT, OVER_TEMPERATURE, UNDER_VOLTAGE, OVER_VOLTAGE = 1, 2, 4, 8
WATCHDOG, ENCODER, BAD_COMMAND, EMERGENCY_STOP = 16, 32, 64, 128

_COMMAND = struct.Struct("<BBih")
_REPLY = struct.Struct("<BBhHbB")
_REQUEST = struct.Struct("<BBBBi")
_OVER_CURRENT_RATIO = 1.5
_TRIP_S = 1e-3 - 1e-9  # an over-current that lasts as long is a fault
_VOLTAGE_ENABLED, _WARNING = 0x10, 0x80
# Members of an enumeration are slow to look up in Python 3.11, and a period looks at the state twice.
_NOT_READY, _ENABLED, _FAULT_REACTION = MotorState.NOT_READY, MotorState.ENABLED, MotorState.FAULT_REACTION


class OwnStop(NamedTuple):
    """A stop without the host: when and where it began, at what speed."""

    since_s: float
    from_count: int
    counts_s: float


class MotorBoardMock(MotorBoardHardware):
    """A motor board whose firmware is this class."""

    def __init__(self, setup: MotorBoardSetup, read_shaft: Callable[[], int]) -> None:
        self._rows = writable(setup.rating_mA, setup.digital_pins)
        self._rated_K = setup.rated_degC - setup.ambient_degC
        self._command_id, self._reply_id = COMMAND + setup.node, REPLY + setup.node
        self.pins: DigitalPinsMock = DigitalPinsMock(setup.digital_pins)
        super().__init__(setup, read_shaft)

    def _boot(self) -> None:
        self.pins.reset()
        self._enter(MotorState.NOT_READY)
        self.faults = 0
        self.values = {index: row.at_power_up for index, row in self._rows.items()}
        self._take_values()
        self._count_offset = self._count_before = self._read_shaft()
        self._before = 0x80
        self._mode = self._setpoint = self._feedforward_mV = 0
        self._integral_mV = self._speed = 0.0
        self._holds = False  # the PID runs, whatever the mode is
        self._stop: OwnStop | None = None  # without the host
        self._last_command_s = 0.0
        self._over_current_since_s: float | None = None
        self._now_s = 0.0
        self._is_cut = False  # the set-point was beyond a limit

    @property
    def position_count(self) -> int:
        """The board's own count of the motor's encoder, 32 bits, wrapping."""
        return _wrapped(self._read_shaft() - self._count_offset)

    def receive(self, can_id: int, payload: bytes, now_s: float) -> list[Frame]:
        """Process a frame from the bus; return the immediate replies."""
        self._now_s = now_s
        if can_id == 0:
            self._fault(EMERGENCY_STOP)
            return []
        if len(payload) != 8:
            return []
        if can_id == self._command_id:
            return [(self._reply_id, self._command(payload, now_s))]
        if can_id == REQUEST + self.setup.node:
            return [(ANSWER + self.setup.node, self._parameter(payload))]
        if can_id == DIGITAL_COMMAND + self.setup.node and self.setup.digital_pins:
            return [(DIGITAL_REPLY + self.setup.node, self.pins.command(payload))]
        return []

    def _period(self, now_s: float, step_s: float) -> list[Frame]:
        self._now_s, trip_A = now_s, self._trip_A
        is_over_current = not -trip_A <= self._current_A <= trip_A
        if not is_over_current:
            self._over_current_since_s = None
        elif self._over_current_since_s is None:
            self._over_current_since_s = now_s
        # The filtered speed [counts/s], whatever the state is.
        shaft_count = self._read_shaft()
        if step_s > 0.0:
            rate = (shaft_count - self._count_before) / step_s
            self._speed += (rate - self._speed) * step_s / (step_s + self._filter_s)
        self._count_before = shaft_count
        state = self.state
        if state is _ENABLED:
            if (silent_s := now_s - self._last_command_s) > self._soonest_s:
                if silent_s > self._watchdog_s:
                    self._expire()
                elif self._stop is None and self._mode in (1, 2):
                    self._begin_stop(now_s)
        elif state is _NOT_READY:
            self._enter(MotorState.SWITCH_ON_DISABLED)
            self._apply()
            return [(ANSWER + self.setup.node, _REQUEST.pack(0, 0, 0, 0, self.setup.protocol))]
        elif state is _FAULT_REACTION:
            self._enter(MotorState.FAULT)
        if (
            is_over_current
            or self.forced_faults != 0
            or not LOWEST_SUPPLY_V <= self._supply_V <= HIGHEST_SUPPLY_V
            or self._above_ambient_K > self._rated_K
        ) and (causes := self._causes() & ~self.faults):
            self._fault(causes)
        if self._holds or (self._mode == 3 and self.state is _ENABLED):
            self._control(step_s)
        return []

    def _enter(self, state: MotorState) -> None:
        """Change the state: the statusword of the replies and the pins follow it."""
        self.state, self._statusword = state, state.value
        self.pins.follow(state is _ENABLED)

    def _causes(self) -> int:
        """Faults with a present cause; an over-current must last."""
        causes, since_s, supply_V = self.forced_faults, self._over_current_since_s, self._supply_V
        if since_s is not None and self._now_s - since_s > _TRIP_S:
            causes |= OVER_CURRENT
        if self._above_ambient_K > self._rated_K:
            causes |= OVER_TEMPERATURE
        if supply_V < LOWEST_SUPPLY_V and self.state is _ENABLED:
            causes |= UNDER_VOLTAGE
        if supply_V > HIGHEST_SUPPLY_V:
            causes |= OVER_VOLTAGE
        return causes

    def _take_values(self) -> None:
        """Update the values of each period from the parameters."""
        values = self.values
        self.current_limit_A = values[CURRENT_LIMIT_MA] * 1e-3
        self._trip_A = _OVER_CURRENT_RATIO * self.current_limit_A
        self._voltage_limit_mV = float(values[VOLTAGE_LIMIT_MV])
        self._filter_s = values[DERIVATIVE_FILTER_US] * 1e-6
        watchdog_ms = values[WATCHDOG_MS]
        self._watchdog_s = watchdog_ms * 1e-3 - 1e-9 if watchdog_ms else math.inf
        stop_ms = values[STOP_AFTER_MS]
        self._soonest_s = min(self._watchdog_s, stop_ms * 1e-3 - 1e-9 if stop_ms else math.inf)

    def _fault(self, bits: int) -> None:
        first = self.state not in (MotorState.FAULT, MotorState.FAULT_REACTION)
        self.faults |= bits
        if first or bits & EMERGENCY_STOP:
            self._enter(MotorState.FAULT_REACTION)
        if bits & OVER_CURRENT:
            self._put(OPEN)
        elif (bits & EMERGENCY_STOP and not self.faults & OVER_CURRENT) or first:
            self._put(BRAKE)

    def _put(self, output: Output) -> None:
        self._holds, self._stop, self._is_cut, self.output = False, None, False, output

    def _expire(self) -> None:
        """The watchdog expired: its action, then FAULT, which keeps that output."""
        action, stop = self.values[WATCHDOG_ACTION], self._stop
        self._fault(WATCHDOG)
        if action == 0:
            self.output = OPEN
        elif action == 2 and self.values[KP] > 0 and stop is not None:
            self._holds, self._stop = True, stop
        elif action == 2 and self.values[KP] > 0:
            self._holds = True
            self._setpoint, self._feedforward_mV, self._integral_mV = self.position_count, 0, 0.0
        # else: brake, as for every fault

    def _begin_stop(self, now_s: float) -> None:
        """Come to rest and hold: no COMMAND for `stop_after_ms`, or one of mode 4."""
        if self.values[KP] == 0:
            self.output, self._is_cut = BRAKE, False
        else:
            kind, voltage_V = self.output
            self._stop = OwnStop(now_s, self.position_count, self._speed)
            kv = self.values[SPEED_FEEDFORWARD] * 1e-6
            self._integral_mV = voltage_V * 1e3 - kv * self._speed if kind == "voltage" else 0.0
            self._feedforward_mV, self._holds = 0, True

    def _end_stop(self) -> None:
        self._stop, self._holds, self._integral_mV = None, False, 0.0

    def _stopping_point(self) -> tuple[int, float]:
        """Set-point in counts, and its speed, during a stop without the host."""
        stop = self._stop
        if stop is None or self._last_tick_s is None:
            return self._setpoint, 0.0
        whole_s = self.values[STOP_TIME_MS] * 1e-3
        since_s = min(self._last_tick_s - stop.since_s, whole_s)
        way = stop.counts_s * (since_s - 0.5 * since_s * since_s / whole_s)
        return _wrapped(stop.from_count + round(way)), stop.counts_s * (1.0 - since_s / whole_s)

    def _command(self, payload: bytes, now_s: float) -> bytes:
        controlword, mode_and_sequence, setpoint, feedforward_mV = _COMMAND.unpack(payload)
        self._last_command_s = now_s
        mode = mode_and_sequence & 7
        if mode > HOLD:
            self._before = controlword
            if self.state is not MotorState.NOT_READY:
                self._fault(BAD_COMMAND)
            return self._reply(mode_and_sequence)
        if controlword != 0x0F or self.state is not _ENABLED or self._before != 0x0F:
            self._transition(controlword)
        if self.state is _ENABLED and mode == HOLD:
            if self._mode != HOLD and self._stop is None:
                self._begin_stop(now_s)
            self._mode = mode
        elif self.state is _ENABLED:
            if self._stop is not None:
                self._end_stop()
            if mode != self._mode:
                self._integral_mV = 0.0
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
        self._enter(new)
        self._mode, self._integral_mV = 0, 0.0
        self._apply()

    def _apply(self) -> None:
        """Apply the output of state and mode; position mode computes one now, then at every tick."""
        self._is_cut = False
        if self.state is _ENABLED:
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
        elif self.state is MotorState.QUICK_STOP:
            self.output = BRAKE
        elif self.state not in (MotorState.FAULT, MotorState.FAULT_REACTION):
            self.output = BRAKE if self.values[DISABLED_OUTPUT] else OPEN

    def _control(self, step_s: float) -> None:
        """Position PID on the board's own count; derivative of the measurement, conditional integration."""
        values = self.values
        shaft_count = self._read_shaft()
        setpoint, set_speed = self._stopping_point()
        error = _wrapped(setpoint - shaft_count + self._count_offset)
        wanted_mV = (
            values[KP] * 1e-3 * error
            + self._integral_mV
            + values[KD] * 1e-6 * (set_speed - self._speed)
            + values[SPEED_FEEDFORWARD] * 1e-6 * set_speed
            + self._feedforward_mV
        )
        output_mV = self._clamped_mV(wanted_mV)
        change_mV = values[KI] * 1e-3 * error * step_s
        if (wanted_mV - output_mV) * change_mV <= 0.0:
            limit_mV = float(values[INTEGRAL_LIMIT_MV])
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

    def _reply(self, mode_and_sequence: int) -> bytes:
        status = self._statusword
        if LOWEST_SUPPLY_V <= self._supply_V <= HIGHEST_SUPPLY_V:
            status |= _VOLTAGE_ENABLED
        if self._is_limited or self._is_cut:
            status |= _WARNING
        return _REPLY.pack(status, mode_and_sequence, *self._readings(), self.faults)

    def _parameter(self, payload: bytes) -> bytes:
        operation, index, sequence, _, value = _REQUEST.unpack(payload)
        result = DONE
        if operation == 1:
            result = self._write(index, value)
        elif operation != 0:
            result = OUT_OF_RANGE
        known = self._read(index)
        if known is None:
            result = UNKNOWN_INDEX
        return _REQUEST.pack(result, index, sequence, 0, _wrapped(known or 0))

    def _read(self, index: int) -> int | None:
        setup = self.setup
        fixed = {
            0: setup.protocol,
            1: setup.serial_number,
            2: setup.firmware,
            3: setup.counts_per_turn,
            5: setup.period_us,
            6: setup.reset_cause,
        }
        if index == POSITION_COUNT:
            return self.position_count
        if index == DIGITAL_PINS:
            return setup.digital_pins or None
        return fixed.get(index, self.values.get(index))

    def _write(self, index: int, value: int) -> int:
        result = refusal(self._rows, index, value)
        if result != DONE:
            return result
        if self.state not in (MotorState.SWITCH_ON_DISABLED, MotorState.READY, MotorState.SWITCHED_ON):
            return NOT_IN_THIS_STATE
        if index == WATCHDOG_MS and value == 0 and self.state is not MotorState.SWITCH_ON_DISABLED:
            return NOT_IN_THIS_STATE
        if index == POSITION_COUNT:
            self._count_offset = self._read_shaft() - value
        else:
            self.values[index] = value
            self._take_values()
            if index in (DIGITAL_OUTPUTS, DIGITAL_SAFE_LEVELS, DIGITAL_SAFE_KEEP):
                self.pins.configure(*(self.values[k] for k in range(49, 52)))
        self._apply()
        return DONE


def _wrapped(value: int) -> int:
    return (value + 0x80000000 & 0xFFFFFFFF) - 0x80000000


_I32 = (-(1 << 31), (1 << 31) - 1)
DONE, UNKNOWN_INDEX, READ_ONLY, OUT_OF_RANGE, NOT_IN_THIS_STATE = 0, 1, 2, 3, 4

POSITION_COUNT, KP, KI, KD, DERIVATIVE_FILTER_US = 4, 16, 17, 18, 19
CURRENT_LIMIT_MA, VOLTAGE_LIMIT_MV, INTEGRAL_LIMIT_MV, SPEED_FEEDFORWARD = 20, 21, 22, 23
WATCHDOG_MS, WATCHDOG_ACTION, DISABLED_OUTPUT = 32, 33, 34
STOP_AFTER_MS, STOP_TIME_MS = 35, 36
DIGITAL_PINS, DIGITAL_OUTPUTS, DIGITAL_SAFE_LEVELS, DIGITAL_SAFE_KEEP = 48, 49, 50, 51


@dataclass(frozen=True, slots=True)
class ParameterRange:
    """One writable parameter."""

    lowest: int
    highest: int
    at_power_up: int


def writable(rating_mA: int, digital_pins: int = 0) -> dict[int, ParameterRange]:
    """All writable parameters; `rating_mA` and `digital_pins` are the board's."""
    pins = ParameterRange(0, (1 << digital_pins) - 1, 0)
    digital = (DIGITAL_OUTPUTS, DIGITAL_SAFE_LEVELS, DIGITAL_SAFE_KEEP) if digital_pins else ()
    return {
        **dict.fromkeys(digital, pins),
        POSITION_COUNT: ParameterRange(*_I32, 0),
        KP: ParameterRange(0, _I32[1], 0),
        KI: ParameterRange(0, _I32[1], 0),
        KD: ParameterRange(0, _I32[1], 0),
        DERIVATIVE_FILTER_US: ParameterRange(0, 1_000_000, 1000),
        CURRENT_LIMIT_MA: ParameterRange(1, min(rating_mA, 21_000), rating_mA),
        VOLTAGE_LIMIT_MV: ParameterRange(0, 60_000, 24_000),
        INTEGRAL_LIMIT_MV: ParameterRange(0, 60_000, 0),
        SPEED_FEEDFORWARD: ParameterRange(0, _I32[1], 0),
        WATCHDOG_MS: ParameterRange(0, 10_000, 200),
        WATCHDOG_ACTION: ParameterRange(0, 2, 1),
        DISABLED_OUTPUT: ParameterRange(0, 1, 1),
        STOP_AFTER_MS: ParameterRange(0, 10_000, 0),
        STOP_TIME_MS: ParameterRange(1, 10_000, 100),
    }


def refusal(rows: dict[int, ParameterRange], index: int, value: int) -> int:
    """DONE if the value is allowed at the index, else UNKNOWN_INDEX, READ_ONLY or OUT_OF_RANGE."""
    if index not in rows:
        is_read_only = index <= 6 or (index == DIGITAL_PINS and DIGITAL_OUTPUTS in rows)
        return READ_ONLY if is_read_only else UNKNOWN_INDEX
    row = rows[index]
    if not row.lowest <= value <= row.highest or (index in (WATCHDOG_MS, STOP_AFTER_MS) and 0 < value < 5):
        return OUT_OF_RANGE
    return DONE
