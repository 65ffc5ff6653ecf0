"""A mock encoder board whose firmware is firmware_iface/firmware: the mock is the hardware around it."""

from __future__ import annotations

import ctypes
import re
from collections.abc import Sequence

from hil_mocks.devices.encoder_inputs import EncoderBoardHardware, Latched
from hil_mocks.devices.framing import deframe, frame
from hil_mocks.firmware.library import PROTOCOL, library, require_size, size_of

_CHANNELS = 3
_WIRE_MOST = 29
_REPORT, _IDENTITY = 0x81, 0x82
_SET_ZERO = 0x03
_PRESET_SEQUENCE = 255  # of the SET_ZEROs of an earlier host
_U32 = 0xFFFFFFFF


class _Setup(ctypes.Structure):
    """aw_encoder_setup_t."""

    _fields_ = (
        ("serial_number", ctypes.c_uint32),
        ("baud", ctypes.c_uint32),
        ("counts_per_turn", ctypes.c_uint32 * _CHANNELS),
        ("firmware", ctypes.c_uint16),
        ("channels", ctypes.c_uint8),
        ("encoder_bits", ctypes.c_uint8),
    )


class _Inputs(ctypes.Structure):
    """aw_encoder_inputs_t."""

    _fields_ = (
        ("time_us", ctypes.c_uint32),
        ("counter", ctypes.c_uint32 * _CHANNELS),
        ("flags", ctypes.c_uint8 * _CHANNELS),
    )


class EncoderBoardFirmware(EncoderBoardHardware):
    """An encoder board that runs the firmware in C. Faults that falsify what it says are made on its frames."""

    def _boot(self, now_s: float) -> None:
        self._code = library()
        require_size("encoder_setup", _Setup)
        require_size("encoder_inputs", _Inputs)
        self._board = ctypes.create_string_buffer(size_of("encoder_board"))
        self._wire = ctypes.create_string_buffer(_WIRE_MOST)
        self._built = setup = self.setup
        self.is_line_blocked = False  # nothing leaves the board: frames wait in its queue
        channels = len(setup.counts_per_turn)
        given = _Setup(
            setup.serial_number,
            setup.baud,
            (*setup.counts_per_turn,),
            setup.firmware,
            channels,
            setup.encoder_bits,
        )
        self._code.aw_encoder_init(self._board, ctypes.byref(given), self._inputs(0, self._latched()))
        self._take(0, now_s)

    def receive(self, received: bytes, now_s: float) -> None:
        """Process bytes from the host, which take effect at once."""
        now_us = self._board_us(now_s)
        inputs = self._inputs(now_us, self._latched())
        for part in re.findall(
            b"[^\0]*\0|[^\0]+", received
        ):  # the line carries answers away between two frames
            self._code.aw_encoder_receive(self._board, part, len(part), inputs)
            self._take(now_us, now_s)

    def preset(self, counts: Sequence[int], is_zero_set: bool) -> None:
        """Set the counters of a board that was powered, and perhaps zeroed, before the simulation started."""
        if not is_zero_set:
            for at, count in enumerate(counts):
                self._shift[at] += count - self.count(at)
            return
        inputs, sent = self._inputs(0, self._latched()), self.outgoing[:]
        for at, count in enumerate(counts):
            body = bytes((at,)) + (count & _U32).to_bytes(4, "little")
            request = frame(bytes((_SET_ZERO, _PRESET_SEQUENCE)) + body)
            self._code.aw_encoder_receive(self._board, request, len(request), inputs)
            self._take(0, self._started_s)
        self.outgoing[:] = sent  # those answers went to the earlier host

    def count(self, at: int) -> int:
        """The count of a channel as reported by the board."""
        counters, _ = self._latched()
        return int(self._code.aw_encoder_count(self._board, at, counters[at] & _U32))

    def _report(self, due_us: int, latched: Latched, start_s: float) -> None:
        self._code.aw_encoder_stream(self._board, self._inputs(due_us, latched))
        self._take(due_us, start_s)

    def _index(self, at: int, time_us: int, counter: int, now_s: float) -> None:
        self._code.aw_encoder_index(self._board, at, time_us & _U32, counter & _U32)
        self._take(self._board_us(now_s), now_s)

    def _illegal_transition(self, at: int) -> None:
        self._code.aw_encoder_quadrature_error(self._board, at)

    def _inputs(self, time_us: int, latched: Latched) -> object:
        counters, flags = latched
        low = (ctypes.c_uint32 * _CHANNELS)(*(counter & _U32 for counter in counters))
        return ctypes.byref(_Inputs(time_us & _U32, low, (ctypes.c_uint8 * _CHANNELS)(*flags)))

    def _take(self, now_us: int, now_s: float) -> None:
        """Put what the firmware sends on the line; see what it waits for."""
        while not self.is_line_blocked and (size := self._code.aw_encoder_take(self._board, self._wire)):
            wire = self._wire.raw[:size]
            if wire[0] == 0:
                self._put(b"\0", now_s)
                wire = wire[1:]
            self._put(self._falsified(wire), now_s)
        armed = self._code.aw_encoder_armed(self._board)
        self._armed = [at for at in range(_CHANNELS) if armed >> at & 1]
        due_us = ctypes.c_uint32()
        is_streaming = self._code.aw_encoder_next_report(self._board, ctypes.byref(due_us))
        ahead_us = (due_us.value - now_us + 0x80000000 & _U32) - 0x80000000
        self._due_us = now_us + ahead_us if is_streaming else None

    def _falsified(self, wire: bytes) -> bytes:
        """The frame as a scenario's fault leaves it."""
        is_true = self.setup is self._built and self.setup.protocol == PROTOCOL
        if is_true and not self.has_frozen_clock:
            return wire
        content = deframe(wire[:-1]) or b""
        if self.has_frozen_clock and content[0] == _REPORT:
            return frame(content[:2] + (self._frozen_us & _U32).to_bytes(4, "little") + content[6:])
        if content[0] == _IDENTITY:
            serial = self.setup.serial_number.to_bytes(4, "little")
            return frame(content[:2] + bytes((self.setup.protocol,)) + content[3:6] + serial + content[10:])
        return wire
