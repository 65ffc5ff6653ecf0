"""A mock motor board whose firmware is firmware_iface/firmware: the mock is the hardware around it.

The mock's plant holds currents by itself, so the firmware's fast loop (aw_current.c) does not run here.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable

from hil_mocks.devices.motor_inputs import (
    HIGHEST_SUPPLY_V,
    LOWEST_SUPPLY_V,
    OPEN,
    Frame,
    MotorBoardHardware,
    MotorBoardSetup,
    Output,
)
from hil_mocks.devices.motor_states import MotorState
from hil_mocks.firmware.library import PROTOCOL, library, require_size, size_of

_COMMAND, _REPLY, _ANSWER = 0x100, 0x180, 0x280
_PROTOCOL_VERSION, _SERIAL_NUMBER, _COUNTS_PER_TURN = 0, 1, 3
_BYTES = 8
_U32 = 0xFFFFFFFF
_IS_VOLTAGE, _IS_CURRENT = 1, 2


class _Setup(ctypes.Structure):
    """aw_motor_setup_t."""

    _fields_ = (
        ("serial_number", ctypes.c_uint32),
        ("counts_per_turn", ctypes.c_int32),
        ("rating_mA", ctypes.c_int32),
        ("lowest_supply_mV", ctypes.c_int32),
        ("highest_supply_mV", ctypes.c_int32),
        ("rated_mdegC", ctypes.c_int32),
        ("firmware", ctypes.c_uint16),
        ("period_us", ctypes.c_uint16),
        ("node", ctypes.c_uint8),
        ("digital_pins", ctypes.c_uint8),
        ("reset_cause", ctypes.c_uint8),
    )


class _Inputs(ctypes.Structure):
    """aw_motor_inputs_t."""

    _fields_ = (
        ("time_us", ctypes.c_uint32),
        ("counter", ctypes.c_uint32),
        ("current_mA", ctypes.c_int32),
        ("mean_mA", ctypes.c_int32),
        ("supply_mV", ctypes.c_int32),
        ("temperature_mdegC", ctypes.c_int32),
        ("causes", ctypes.c_uint8),
        ("pin_levels", ctypes.c_uint8),
        ("is_limited", ctypes.c_bool),
    )


class _CanFrame(ctypes.Structure):
    """aw_can_frame_t."""

    _fields_ = (("id", ctypes.c_uint16), ("size", ctypes.c_uint8), ("data", ctypes.c_uint8 * _BYTES))


class _Pins:
    """The digital pins, as the firmware drives them."""

    def __init__(self, board: ctypes.Array[ctypes.c_char], count: int) -> None:
        self.outside = 0
        self._board, self._pins = board, (1 << count) - 1

    @property
    def levels(self) -> int:
        """Levels at the pins."""
        outputs = int(library().aw_motor_pin_outputs(self._board))
        return int(library().aw_motor_pin_levels(self._board)) | self.outside & ~outputs & self._pins


class MotorBoardFirmware(MotorBoardHardware):
    """A motor board that runs the firmware in C. Faults that falsify what it says are made on its frames."""

    def __init__(self, setup: MotorBoardSetup, read_shaft: Callable[[], int]) -> None:
        self._code = library()
        for what, mirror in (("motor_setup", _Setup), ("motor_inputs", _Inputs), ("can_frame", _CanFrame)):
            require_size(what, mirror)
        self._board = ctypes.create_string_buffer(size_of("motor_board"))
        self.pins: _Pins = _Pins(self._board, setup.digital_pins)
        self._inputs, self._heard, self._said = _Inputs(), _CanFrame(), _CanFrame()
        self._obeyed = (0, 0)  # kind and value of the output: open
        self._at = [ctypes.byref(part) for part in (self._inputs, self._heard, self._said)]
        super().__init__(setup, read_shaft)

    @property
    def position_count(self) -> int:
        """The board's own count of the motor's encoder, 32 bits, wrapping."""
        return int(self._code.aw_motor_count(self._board, self._read_shaft() & _U32))

    @property
    def state(self) -> MotorState:
        """State of CiA 402."""
        return MotorState(self._code.aw_motor_state(self._board))

    @property
    def faults(self) -> int:
        """Bits of a REPLY."""
        return int(self._code.aw_motor_faults(self._board))

    def receive(self, can_id: int, payload: bytes, now_s: float) -> list[Frame]:
        """Process a frame from the bus; return the immediate replies."""
        heard, inputs = self._heard, self._inputs
        heard.id, heard.size = can_id, len(payload)
        heard.data[:] = payload.ljust(_BYTES, b"\0")
        self._look(now_s)
        if can_id == _COMMAND + self.setup.node and len(payload) == _BYTES:
            inputs.mean_mA, inputs.supply_mV, temperature_degC = self._readings()
            inputs.temperature_mdegC = 1000 * temperature_degC
        is_answered = self._code.aw_motor_receive(self._board, self._at[1], self._at[0], self._at[2])
        self._obey()
        return [self._sent()] if is_answered else []

    def _boot(self) -> None:
        self._built = setup = self.setup
        given = _Setup(
            setup.serial_number,
            setup.counts_per_turn,
            setup.rating_mA,
            round(LOWEST_SUPPLY_V * 1e3),
            round(HIGHEST_SUPPLY_V * 1e3),
            round(setup.rated_degC * 1e3),
            setup.firmware,
            setup.period_us,
            setup.node,
            setup.digital_pins,
            setup.reset_cause,
        )
        self._look(0.0)
        self._code.aw_motor_init(self._board, ctypes.byref(given), self._at[0])
        self._obey()

    def _period(self, now_s: float, step_s: float) -> list[Frame]:
        self._look(now_s)
        is_announced = self._code.aw_motor_tick(self._board, self._at[0], self._at[2])
        self._obey()
        return [self._sent()] if is_announced else []

    def _look(self, now_s: float) -> None:
        """What the hardware has now."""
        inputs = self._inputs
        inputs.time_us = round(now_s * 1e6) & _U32
        inputs.counter = self._read_shaft() & _U32
        inputs.current_mA = round(self._current_A * 1e3)
        inputs.supply_mV = round(self._supply_V * 1e3)
        inputs.temperature_mdegC = round(self._temperature_degC * 1e3)
        inputs.causes = self.forced_faults
        inputs.pin_levels = self.pins.outside
        inputs.is_limited = self._is_limited

    def _obey(self) -> None:
        """The bridge does what the firmware says; the same object while nothing changes."""
        wanted = self._code.aw_motor_output(self._board)
        kind, value = wanted.kind, wanted.value
        if (kind, value) != self._obeyed:
            self._obeyed = kind, value
            if kind == _IS_VOLTAGE:
                self.output = Output("voltage", value / 1e6)
            elif kind == _IS_CURRENT:
                self.output = Output("current", value / 1e3)
            else:
                self.output = OPEN
        self.current_limit_A = self._code.aw_motor_current_limit_mA(self._board) * 1e-3

    def _sent(self) -> Frame:
        return self._said.id, self._falsified(self._said.id, bytes(self._said.data))

    def _falsified(self, can_id: int, payload: bytes) -> bytes:
        """The payload as a scenario's fault leaves it."""
        is_true = self.setup is self._built and self.setup.protocol == PROTOCOL
        if is_true or can_id != _ANSWER + self.setup.node or payload[0] != 0:
            return payload
        value = {
            _PROTOCOL_VERSION: self.setup.protocol,
            _SERIAL_NUMBER: self.setup.serial_number,
            _COUNTS_PER_TURN: self.setup.counts_per_turn,
        }.get(payload[1])
        return payload if value is None else payload[:4] + value.to_bytes(4, "little")
