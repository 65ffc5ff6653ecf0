"""Mock encoder and motor boards whose firmware is firmware_iface/firmware: the mock is the hardware around it.

The machine's C compiler builds the firmware once for each version of it, as a shared library. The plant holds currents by itself,
so the firmware's fast loop (aw_current.c) does not run here. A scenario or a variable of the environment chooses between these
boards and those in Python.
"""

from __future__ import annotations

import ctypes
import functools
import hashlib
import os
import re
import shlex
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

from firmware_iface.installation import ROOT
from hil_mocks.devices import motor_inputs
from hil_mocks.devices.encoder_board import EncoderBoardHardware, EncoderBoardMock, Latched, deframe, frame
from hil_mocks.devices.motor_board import MotorBoardMock
from hil_mocks.errors import MockError, ScenarioError
from hil_mocks.scenario import Scenario

SOURCES = ROOT / "firmware_iface" / "firmware"
FLAGS = ("-std=c99", "-O2", "-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Werror")
PROTOCOL = 1  # that the firmware speaks
_BUILD_LIMIT_S = 120.0
_COMPILERS = ("cc", "gcc", "clang")


class OutputStructure(ctypes.Structure):
    """aw_output_t."""

    _fields_ = (("kind", ctypes.c_int), ("value", ctypes.c_int32))


_POINTER, _SIZE = ctypes.c_void_p, ctypes.c_size_t
# name: (type of its result, types of its arguments)
_SIGNATURES: dict[str, tuple[type | None, ...]] = {
    "aw_size_of_encoder_board": (_SIZE,),
    "aw_size_of_encoder_setup": (_SIZE,),
    "aw_size_of_encoder_inputs": (_SIZE,),
    "aw_size_of_motor_board": (_SIZE,),
    "aw_size_of_motor_setup": (_SIZE,),
    "aw_size_of_motor_inputs": (_SIZE,),
    "aw_size_of_can_frame": (_SIZE,),
    "aw_motor_init": (None, _POINTER, _POINTER, _POINTER),
    "aw_motor_receive": (ctypes.c_bool, _POINTER, _POINTER, _POINTER, _POINTER),
    "aw_motor_tick": (ctypes.c_bool, _POINTER, _POINTER, _POINTER),
    "aw_motor_state": (ctypes.c_int, _POINTER),
    "aw_motor_faults": (ctypes.c_uint8, _POINTER),
    "aw_motor_count": (ctypes.c_int32, _POINTER, ctypes.c_uint32),
    "aw_motor_output": (OutputStructure, _POINTER),
    "aw_motor_current_limit_mA": (ctypes.c_int32, _POINTER),
    "aw_motor_pin_outputs": (ctypes.c_uint8, _POINTER),
    "aw_motor_pin_levels": (ctypes.c_uint8, _POINTER),
    "aw_current_init": (None, _POINTER, _POINTER),
    "aw_current_step": (ctypes.c_int32, _POINTER, OutputStructure, ctypes.c_int32, ctypes.c_int32, ctypes.c_int32),
    "aw_size_of_current": (_SIZE,),
    "aw_encoder_init": (None, _POINTER, _POINTER, _POINTER),
    "aw_encoder_receive": (None, _POINTER, ctypes.c_char_p, _SIZE, _POINTER),
    "aw_encoder_armed": (ctypes.c_uint8, _POINTER),
    "aw_encoder_index": (None, _POINTER, ctypes.c_uint8, ctypes.c_uint32, ctypes.c_uint32),
    "aw_encoder_count": (ctypes.c_int32, _POINTER, ctypes.c_uint8, ctypes.c_uint32),
    "aw_encoder_quadrature_error": (None, _POINTER, ctypes.c_uint8),
    "aw_encoder_next_report": (ctypes.c_bool, _POINTER, _POINTER),
    "aw_encoder_stream": (None, _POINTER, _POINTER),
    "aw_encoder_take": (_SIZE, _POINTER, _POINTER),
}


class FirmwareError(MockError):
    """The firmware cannot be built on this machine."""


def compiler() -> list[str] | None:
    """The command of the C compiler: $CC, else cc, gcc or clang; None if there is none."""
    if chosen := shlex.split(os.environ.get("CC", "")):
        return chosen if shutil.which(chosen[0]) else None
    return next(([name] for name in _COMPILERS if shutil.which(name)), None)


@functools.cache
def library() -> ctypes.CDLL:
    """The firmware, built if need be. FirmwareError says what is missing."""
    command = compiler()
    if command is None:
        raise FirmwareError(
            "the firmware in C needs a C compiler to run on the mock's boards, and this machine has none: apt-get install"
            " gcc, or leave out --firmware c"
        )
    built = _folder() / f"firmware-{_version(command)}.so"
    if not built.exists():
        _build(command, built)
    loaded = ctypes.CDLL(str(built))
    for name, (result, *arguments) in _SIGNATURES.items():
        function = getattr(loaded, name)
        function.restype, function.argtypes = result, arguments
    return loaded


def size_of(what: str) -> int:
    """The size in bytes of a structure of the firmware, `encoder_board` for aw_encoder_board_t."""
    return int(getattr(library(), f"aw_size_of_{what}")())


def require_size(what: str, mirror: type[ctypes.Structure]) -> None:
    """FirmwareError unless Python's mirror of a structure has the size of the original."""
    if (size := size_of(what)) != ctypes.sizeof(mirror):
        raise FirmwareError(
            f"the firmware in C: aw_{what}_t has {size} bytes, its mirror {ctypes.sizeof(mirror)}: change both together"
        )


def build(target: Path, *flags: str, sources: tuple[Path, ...] = ()) -> None:
    """Compile the firmware and `sources` to `target`. FirmwareError with the compiler's words."""
    command = compiler() or ["cc"]
    files = [*sorted((SOURCES / "src").glob("*.c")), *(sources or sorted((SOURCES / "host").glob("*.c")))]
    line = [*command, *FLAGS, *flags, f"-I{SOURCES / 'include'}", *map(str, files), "-o", str(target)]
    try:
        ended = subprocess.run(line, capture_output=True, text=True, timeout=_BUILD_LIMIT_S, check=False)
    except (OSError, subprocess.TimeoutExpired) as problem:
        raise FirmwareError(f"the firmware in C cannot be built: {problem}") from None
    if ended.returncode != 0:
        words = (ended.stderr.strip() or f"exit status {ended.returncode}").splitlines()
        raise FirmwareError(f"the firmware in C cannot be built: {shlex.join(command)}: {words[0]}")


def _build(command: list[str], built: Path) -> None:
    """Build beside the target and rename: another process may do the same."""
    handle, made = tempfile.mkstemp(suffix=".so", dir=built.parent)
    os.close(handle)
    try:
        build(Path(made), "-shared", "-fPIC")
        Path(made).replace(built)
    finally:
        Path(made).unlink(missing_ok=True)


def _version(command: list[str]) -> str:
    digest = hashlib.sha256(shlex.join([*command, *FLAGS]).encode())
    for file in sorted((*SOURCES.glob("*/*.c"), *SOURCES.glob("*/*.h"))):
        digest.update(file.name.encode() + b"\0" + file.read_bytes())
    return digest.hexdigest()[:16]


@functools.cache
def _folder() -> Path:
    """Where libraries are kept: the user's cache, or a folder of this process where that is not writable or not the user's."""
    base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    folder = base / "armwright"
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        if folder.stat().st_uid == os.getuid() and os.access(folder, os.W_OK):
            return folder
    except (OSError, RuntimeError):
        pass
    return Path(tempfile.mkdtemp(prefix="armwright-firmware-"))


VARIABLE = "ARMWRIGHT_MOCK_FIRMWARE"  # for every mock of a process and its children: drills, demos, tests
CHOICES = ("python", "c")


def choose(firmware: str | None) -> None:
    """Choose for every mock of this process and of its children; None leaves it as it is. FirmwareError if it cannot run."""
    if firmware == "c":
        library()
    if firmware is not None:
        os.environ[VARIABLE] = firmware


def encoder_board_class(scenario: Scenario) -> type[EncoderBoardMock | EncoderBoardFirmware]:
    """The encoder boards of a mock arm."""
    return EncoderBoardFirmware if _is_in_c(scenario) else EncoderBoardMock


def motor_board_class(scenario: Scenario) -> type[MotorBoardMock | MotorBoardFirmware]:
    """The motor boards of a mock arm."""
    return MotorBoardFirmware if _is_in_c(scenario) else MotorBoardMock


def _is_in_c(scenario: Scenario) -> bool:
    """Whether the boards run firmware_iface/firmware. ScenarioError for an unknown value of the variable."""
    chosen = scenario.firmware or os.environ.get(VARIABLE) or "python"
    if chosen not in CHOICES:
        raise ScenarioError(f"${VARIABLE}: expected {' or '.join(CHOICES)}, got {chosen!r}.")
    return chosen == "c"


_CHANNELS = 3
_WIRE_MOST = 29
_REPORT, _IDENTITY = 0x81, 0x82
_SET_ZERO = 0x03
_PRESET_SEQUENCE = 255  # of the SET_ZEROs of an earlier host
_U32 = 0xFFFFFFFF


class _EncoderSetup(ctypes.Structure):
    """aw_encoder_setup_t."""

    _fields_ = (
        ("serial_number", ctypes.c_uint32),
        ("baud", ctypes.c_uint32),
        ("counts_per_turn", ctypes.c_uint32 * _CHANNELS),
        ("firmware", ctypes.c_uint16),
        ("channels", ctypes.c_uint8),
        ("encoder_bits", ctypes.c_uint8),
    )


class _EncoderInputs(ctypes.Structure):
    """aw_encoder_inputs_t."""

    _fields_ = (("time_us", ctypes.c_uint32), ("counter", ctypes.c_uint32 * _CHANNELS), ("flags", ctypes.c_uint8 * _CHANNELS))


class EncoderBoardFirmware(EncoderBoardHardware):
    """An encoder board that runs the firmware in C. Faults that falsify what it says are made on its frames."""

    def _boot(self, now_s: float) -> None:
        self._code = library()
        require_size("encoder_setup", _EncoderSetup)
        require_size("encoder_inputs", _EncoderInputs)
        self._board = ctypes.create_string_buffer(size_of("encoder_board"))
        self._wire = ctypes.create_string_buffer(_WIRE_MOST)
        self._built = setup = self.setup
        self.is_line_blocked = False  # nothing leaves the board: frames wait in its queue
        channels = len(setup.counts_per_turn)
        c_setup = _EncoderSetup(
            setup.serial_number, setup.baud, (*setup.counts_per_turn,), setup.firmware, channels, setup.encoder_bits
        )
        self._code.aw_encoder_init(self._board, ctypes.byref(c_setup), self._inputs(0, self._latched()))
        self._take(0, now_s)

    def receive(self, received: bytes, now_s: float) -> None:
        """Process bytes from the host, which take effect at once."""
        now_us = self._board_us(now_s)
        inputs = self._inputs(now_us, self._latched())
        for part in re.findall(b"[^\0]*\0|[^\0]+", received):  # the line carries answers away between two frames
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
        return ctypes.byref(_EncoderInputs(time_us & _U32, low, (ctypes.c_uint8 * _CHANNELS)(*flags)))

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


_COMMAND, _REPLY, _ANSWER = 0x100, 0x180, 0x280
_PROTOCOL_VERSION, _SERIAL_NUMBER, _COUNTS_PER_TURN = 0, 1, 3
_BYTES = 8
_IS_VOLTAGE, _IS_CURRENT = 1, 2


class _MotorSetup(ctypes.Structure):
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


class _MotorInputs(ctypes.Structure):
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


class MotorBoardFirmware(motor_inputs.MotorBoardHardware):
    """A motor board that runs the firmware in C. Faults that falsify what it says are made on its frames."""

    def __init__(self, setup: motor_inputs.MotorBoardSetup, read_shaft: Callable[[], int]) -> None:
        self._code = library()
        for what, mirror in (("motor_setup", _MotorSetup), ("motor_inputs", _MotorInputs), ("can_frame", _CanFrame)):
            require_size(what, mirror)
        self._board = ctypes.create_string_buffer(size_of("motor_board"))
        self.pins: _Pins = _Pins(self._board, setup.digital_pins)
        self._inputs, self._heard, self._said = _MotorInputs(), _CanFrame(), _CanFrame()
        self._obeyed = (0, 0)  # kind and value of the output: open
        self._at = [ctypes.byref(part) for part in (self._inputs, self._heard, self._said)]
        super().__init__(setup, read_shaft)

    @property
    def position_count(self) -> int:
        """The board's own count of the motor's encoder, 32 bits, wrapping."""
        return int(self._code.aw_motor_count(self._board, self._read_shaft() & _U32))

    @property
    def state(self) -> motor_inputs.MotorState:
        """State of CiA 402."""
        return motor_inputs.MotorState(self._code.aw_motor_state(self._board))

    @property
    def faults(self) -> int:
        """Bits of a REPLY."""
        return int(self._code.aw_motor_faults(self._board))

    def receive(self, can_id: int, payload: bytes, now_s: float) -> list[motor_inputs.Frame]:
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
        c_setup = _MotorSetup(
            setup.serial_number,
            setup.counts_per_turn,
            setup.rating_mA,
            round(motor_inputs.LOWEST_SUPPLY_V * 1e3),
            round(motor_inputs.HIGHEST_SUPPLY_V * 1e3),
            round(setup.rated_degC * 1e3),
            setup.firmware,
            setup.period_us,
            setup.node,
            setup.digital_pins,
            setup.reset_cause,
        )
        self._look(0.0)
        self._code.aw_motor_init(self._board, ctypes.byref(c_setup), self._at[0])
        self._obey()

    def _period(self, now_s: float, step_s: float) -> list[motor_inputs.Frame]:
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
                self.output = motor_inputs.Output("voltage", value / 1e6)
            elif kind == _IS_CURRENT:
                self.output = motor_inputs.Output("current", value / 1e3)
            else:
                self.output = motor_inputs.OPEN
        self.current_limit_A = self._code.aw_motor_current_limit_mA(self._board) * 1e-3

    def _sent(self) -> motor_inputs.Frame:
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
