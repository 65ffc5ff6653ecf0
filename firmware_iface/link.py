"""Serial and CAN links, and how they are opened. The only file that imports pyserial and python-can.

A link carries bytes (serial) or frames (CAN) and does not interpret them.
Reading never blocks.
"""

import contextlib
import fcntl
import logging
import os
import select
import termios
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from struct import Struct
from typing import Protocol

import can
import serial
from serial.tools import list_ports

from firmware_iface import slcan
from firmware_iface.can_adapters import INTERFACES, channel_of
from firmware_iface.errors import LinkLost, MisuseError, PortMissing

BY_ID = Path("/dev/serial/by-id")  # of udev: names that stay when devices are plugged in another order
LATENCY_ms = "1"  # of an FTDI adapter's latency timer
_PATIENT_READS = 4  # looks at an empty tty before the kernel is asked to hand over what it holds
_READ_BYTES = 65536  # more than a serial driver buffers
_INT = Struct("i")
_NO_BYTES = _INT.pack(0)
WRITE_TIMEOUT_ms = 200  # requests are about 12 bytes: a line that does not accept them in this time is dead
_SOCKETCAN_BUS_OFF = 0x40  # CAN_ERR_BUSOFF of linux/can/error.h, in the id of an error frame
_ADAPTERS = ("socketcan", "pcan")  # python-can detects these without waiting
_SLCAN_BAUD = 115_200
_ECHO_MEMORY = 64  # our own frames that may be echoed at once
_DATA_BITRATE = 5_000_000  # of FD frames, on adapters that are not set up by the system; moteus needs it
_LONGEST_STANDARD_ID = 0x7FF


class CanFormat(Enum):
    """Which frames a link carries."""

    STANDARD = "classic frames with 11-bit ids"
    EXTENDED = "classic frames with 29-bit ids"
    FD = "CAN FD frames, with 29-bit ids where 11 bits do not suffice"


class ByteLink(Protocol):
    """A full-duplex stream of bytes."""

    @property
    def name(self) -> str:
        """Name in messages: `/dev/ttyUSB0`."""
        ...

    @property
    def baud(self) -> int:
        """Bit rate [1/s]; a byte takes 10 bits. 0 where the link has none (a socket)."""
        ...

    def read(self) -> bytes:
        """Return all bytes received, b"" if none; never blocks. Raises LinkLost."""
        ...

    def write(self, data: bytes) -> None:
        """Send all of `data`. Raises LinkLost."""
        ...

    def close(self) -> None:
        """Close the port; idempotent."""
        ...


class FrameLink(Protocol):
    """A CAN bus: data frames of one CanFormat. Own frames are not received."""

    @property
    def name(self) -> str:
        """Name in messages: `socketcan:can0`."""
        ...

    def send(self, can_id: int, payload: bytes) -> None:
        """Send one frame of 0 to 8 bytes, or of a length that CAN FD has. Raises LinkLost."""
        ...

    def receive(self) -> list[tuple[int, bytes]]:
        """Return all frames received as (id, payload), oldest first; never blocks. Raises LinkLost."""
        ...

    def close(self) -> None:
        """Leave the bus; idempotent."""
        ...


def open_serial(url: str, baud: int, patience: int = _PATIENT_READS) -> ByteLink:
    """Open a serial port by any URL that pyserial takes: /dev/ttyUSB0, COM3, socket://host:port, loop:// ...

    8N1, exclusive, low-latency mode where supported. `patience`: how many empty looks in a row before a tty is read all the
    same, which may wait for the kernel. Raises PortMissing, which lists the available ports.
    """
    if baud <= 0:
        raise MisuseError(f"serial port {url}: baud must be positive, got {baud}")
    try:
        port = serial.serial_for_url(
            url, baudrate=baud, timeout=0, write_timeout=WRITE_TIMEOUT_ms * 1e-3, exclusive=True
        )
    except (serial.SerialException, OSError, ValueError, ImportError) as problem:
        raise PortMissing(f"serial port {url}: cannot open it: {problem}; {_ports_here()}") from None
    if type(port) is serial.Serial and os.name == "posix":
        # Only real UARTs on USB have this mode; a pty answers with an error, and needs none.
        with contextlib.suppress(OSError, ValueError, NotImplementedError, AttributeError):
            port.set_low_latency_mode(True)  # ASYNC_LOW_LATENCY, where the kernel lets this user
        lower_latency(url)
        return _PosixByteLink(port, url, baud, patience)
    if url.startswith("socket:") and os.name == "posix":
        return _SocketByteLink(port, url, 0, patience)
    return _PyserialByteLink(port, url, 0 if url.startswith("socket:") else baud)


@dataclass(frozen=True, slots=True)
class PortHere:
    """A serial port of this machine: its path, the system's description of the device and its stable name ("" if unknown)."""

    path: str
    description: str
    stable: str = ""


def serial_ports(by_id: Path = BY_ID) -> list[PortHere]:
    """List the serial ports of this machine without opening them; `by_id` is the folder of their stable names."""
    stable: dict[str, str] = {}
    with contextlib.suppress(OSError):
        stable = {str(link.resolve()): str(link) for link in sorted(by_id.iterdir())}
    ports = sorted(list_ports.comports(), key=lambda port: port.device)
    return [
        PortHere(
            port.device, "" if port.description == "n/a" else port.description, stable.get(port.device, "")
        )
        for port in ports
    ]


def latency_file(path: str, root: Path = Path("/")) -> Path | None:
    """The file of an FTDI adapter's latency timer [ms]; None for a port that has none. `path` may be a stable name."""
    file = root / "sys/bus/usb-serial/devices" / Path(path).resolve().name / "latency_timer"
    return file if file.is_file() else None


def lower_latency(path: str, root: Path = Path("/")) -> None:
    """Set an FTDI adapter's latency timer to 1 ms, where this user may; it holds short answers for 16 ms by default."""
    file = latency_file(path, root)
    with contextlib.suppress(OSError):
        if file is not None and file.read_text().strip() != LATENCY_ms:
            file.write_text(LATENCY_ms)


def can_buses() -> list[tuple[str, str]]:
    """List interface and channel of the CAN adapters that their drivers can detect, without opening them."""
    with _can_log():
        adapters = can.detect_available_configs([name for name in _ADAPTERS if name in can.VALID_INTERFACES])
    return [(str(bus["interface"]), str(bus["channel"])) for bus in adapters]


def _ports_here() -> str:
    names = sorted(port.device for port in list_ports.comports())
    return (
        f"ports here: {', '.join(names)}"
        if names
        else "no serial ports found: check that the board is plugged in"
    )


class _PosixByteLink:
    """A tty or pty: opened by pyserial, read and written directly (pyserial's layers cost some 20 us a read)."""

    def __init__(self, port: serial.SerialBase, name: str, baud: int, patience: int) -> None:
        self.name = name
        self.baud = baud
        self._port = port
        self._fd = port.fileno()
        os.set_blocking(self._fd, False)
        self._patience = patience
        self._empty_reads = 0
        self._writable = select.poll()
        self._writable.register(self._fd, select.POLLOUT)

    def read(self) -> bytes:
        # Query the number of bytes first, because reading an empty tty may wait: the kernel then flushes pending
        # input in a worker of ordinary priority, and a real-time loop would wait for it. On a busy machine that worker is
        # late by tens of milliseconds, with the board's bytes in its hands: a line that has been empty for some reads is
        # therefore read all the same, so that no board is called silent while its bytes are here.
        try:
            (waiting,) = _INT.unpack(fcntl.ioctl(self._fd, termios.FIONREAD, _NO_BYTES))
            self._empty_reads = 0 if waiting else self._empty_reads + 1
            if self._empty_reads % (self._patience + 1) == self._patience:
                waiting = _READ_BYTES
            return os.read(self._fd, waiting) if waiting else b""
        except BlockingIOError:
            return b""
        except (OSError, ValueError) as problem:  # the port was unplugged, or closed during the call
            raise self._lost(problem) from None

    def write(self, data: bytes) -> None:
        left = data
        while left:
            try:
                left = left[os.write(self._fd, left) :]
            except BlockingIOError:
                if not self._writable.poll(WRITE_TIMEOUT_ms):
                    raise self._lost(f"no byte accepted for {WRITE_TIMEOUT_ms} ms") from None
            except OSError as problem:
                raise self._lost(problem) from None

    def _lost(self, problem: object) -> LinkLost:
        return LinkLost(f"serial port {self.name}: lost: {problem}; check the cable")

    def close(self) -> None:
        self._fd = -1  # the descriptor may be reused
        self._port.close()


class _SocketByteLink(_PosixByteLink):
    """A TCP connection to a serial server or a mock: opened by pyserial, read and written directly."""

    def read(self) -> bytes:
        try:
            received = os.read(self._fd, _READ_BYTES)
        except BlockingIOError:
            return b""
        except OSError as problem:
            raise self._lost(problem) from None
        if not received:
            raise self._lost("the other end closed it")
        return received


class _PyserialByteLink:
    """Any other port that pyserial supports: loop://, RFC 2217, Windows."""

    def __init__(self, port: serial.SerialBase, name: str, baud: int) -> None:
        self.name = name
        self.baud = baud
        self._port = port

    def read(self) -> bytes:
        try:
            # With timeout 0, pyserial returns what is buffered.
            return bytes(self._port.read(_READ_BYTES))
        except (OSError, TypeError) as problem:  # TypeError: closed during the call
            raise self._lost(problem) from None

    def write(self, data: bytes) -> None:
        try:
            self._port.write(data)
        except (OSError, TypeError) as problem:
            raise self._lost(problem) from None

    def _lost(self, problem: object) -> LinkLost:
        return LinkLost(f"serial port {self.name}: lost: {problem}; check the cable")

    def close(self) -> None:
        self._port.close()


def open_can(interface: str, channel: str, bitrate: int = 1_000_000, **options: object) -> FrameLink:
    """Open a CAN bus by any interface of python-can: socketcan, slcan, gs_usb, pcan, udp_multicast, virtual ...

    `options` are passed to python-can unchanged. slcan is our own (slcan.py). Raises PortMissing with the remedy.
    """
    return _open_can(interface, channel, bitrate, CanFormat.STANDARD, options)


def open_extended_can(interface: str, channel: str, bitrate: int = 1_000_000, **options: object) -> FrameLink:
    """As `open_can`, for frames with 29-bit ids instead of 11-bit ones."""
    return _open_can(interface, channel, bitrate, CanFormat.EXTENDED, options)


def open_fd_can(interface: str, channel: str, bitrate: int = 1_000_000, **options: object) -> FrameLink:
    """As `open_can`, for CAN FD frames with a faster data phase (bit rate switch). `bitrate` is that of the arbitration."""
    return _open_can(interface, channel, bitrate, CanFormat.FD, options)


def _open_can(
    interface: str, channel: str, bitrate: int, carried: CanFormat, options: Mapping[str, object]
) -> FrameLink:
    name = f"{interface}:{channel}"
    if interface == "slcan":
        return _open_slcan(name, channel, bitrate, carried, **options)
    arguments: dict[str, object] = {"bitrate": bitrate, "receive_own_messages": False, **options}
    if carried is CanFormat.FD:
        arguments = {"fd": True, "data_bitrate": _DATA_BITRATE, **arguments}
    elif interface == "udp_multicast":
        arguments.setdefault("fd", True)  # it would drop what it finds of others' FD frames one a read
    with _can_log() as log_messages:
        try:
            arguments["channel"] = channel_of(interface, channel)
            bus = can.Bus(interface=interface, ignore_config=True, **arguments)  # type: ignore[arg-type]
        except Exception as problem:  # drivers raise anything: OSError, NameError, their own errors
            reason = "; ".join(dict.fromkeys([str(problem) or type(problem).__name__, *log_messages]))
            remedy = _can_remedy(interface, channel, bitrate)
            raise PortMissing(f"CAN bus {name}: cannot open it: {reason}; {remedy}") from None
    return CanFrameLink(bus, name, carried, hears_itself=interface == "udp_multicast")


def _open_slcan(name: str, channel: str, bitrate: int, carried: CanFormat, **options: object) -> FrameLink:
    """An slcan adapter by its serial port. Most are on USB, where the line's own rate does not matter."""
    if carried is not CanFormat.STANDARD:
        raise PortMissing(
            f"CAN bus {name}: slcan carries {CanFormat.STANDARD.value}, not {carried.value}: use an adapter that SocketCAN knows"
        )
    if strange := sorted(set(options) - set(slcan.OPTIONS)):
        raise PortMissing(
            f"CAN bus {name}: unknown option {strange[0]}; slcan takes {', '.join(slcan.OPTIONS)}"
        )
    if bitrate not in slcan.BITRATE_CODES:
        raise PortMissing(
            f"CAN bus {name}: bitrate {bitrate}: slcan knows {', '.join(map(str, slcan.BITRATE_CODES))}"
        )
    port = open_serial(channel, int(str(options.get("tty_baudrate", _SLCAN_BAUD))))
    return slcan.SlcanLink(port, name, bitrate)


def _can_remedy(interface: str, channel: str, bitrate: int) -> str:
    known = INTERFACES.get(interface)
    if known is not None:
        remedy = known.remedy.format(channel=channel, bitrate=bitrate)
        return "; ".join(part for part in (known.missing(), remedy) if part)
    if interface in can.VALID_INTERFACES:
        return "check that the adapter is plugged in and its driver installed"
    return f"interfaces: {', '.join(sorted(can.VALID_INTERFACES))}"


@contextlib.contextmanager
def _can_log() -> Iterator[list[str]]:
    """Collect python-can's log messages: it reports missing drivers there, not in its errors."""
    messages: list[str] = []
    logger = logging.getLogger("can")
    listener = logging.Handler(logging.WARNING)
    listener.emit = lambda record: messages.append(record.getMessage())  # type: ignore[method-assign]
    if not any(isinstance(handler, logging.NullHandler) for handler in logger.handlers):
        # As libraries should: without it, python-can logs a failure to stderr.
        logger.addHandler(logging.NullHandler())
    logger.addHandler(listener)
    try:
        yield messages
    finally:
        logger.removeHandler(listener)


class _OwnMessage(can.Message):
    """A message for one `send` that is never modified, so it need not be copied.

    python-can's virtual bus deep-copies each message for every receiver, which costs five times the rest.
    """

    __slots__ = ()

    def __deepcopy__(self, memo: object) -> "_OwnMessage":
        return self


def _now(bus: can.BusABC) -> Callable[[], can.Message | None]:
    """A function that returns the next message at once, or None.

    python-can's own `recv(timeout=0)` reads the time of day: where that steps back in between, it waits for as long as the step.
    An interface that has its own `recv` is used as it is. No filters are set, so none are applied.
    """
    if type(bus).recv is not can.BusABC.recv:
        return lambda: bus.recv(timeout=0)
    return lambda: bus._recv_internal(timeout=0)[0]


class CanFrameLink:
    """Any python-can bus: what `open_can` and its like open, but for slcan.

    Frames other than data frames of the wanted format are counted in `rejected`.
    """

    def __init__(self, bus: can.BusABC, name: str, carried: CanFormat, hears_itself: bool) -> None:
        self.name = name
        self.rejected = 0
        self._bus = bus
        self._is_fd = carried is CanFormat.FD
        self._is_extended = carried is CanFormat.EXTENDED
        # Multicast echoes our own frames; each is dropped once.
        self._echoes: deque[tuple[int, bytes]] | None = deque(maxlen=_ECHO_MEMORY) if hears_itself else None
        self._is_open = True
        self._receive = _now(bus)

    def send(self, can_id: int, payload: bytes) -> None:
        message = _OwnMessage(
            arbitration_id=can_id, data=payload, is_extended_id=self._has_long_id(can_id),
            is_fd=self._is_fd, bitrate_switch=self._is_fd, check=False,
        )  # fmt: skip
        try:
            self._bus.send(message)
        except (can.CanError, OSError, ValueError) as problem:
            raise self._lost(problem) from None
        if self._echoes is not None:
            self._echoes.append((can_id, bytes(payload)))

    def receive(self) -> list[tuple[int, bytes]]:
        return [frame for _, frame in self.receive_timed()]

    def receive_timed(self) -> list[tuple[float, tuple[int, bytes]]]:
        """As `receive`, with when each frame came in seconds since 1970, where the interface says so."""
        frames = []
        while (message := self._next()) is not None:
            if message.is_error_frame:
                self._check_bus_off(message)
                self.rejected += 1
            elif message.is_remote_frame or not self._is_wanted(message):
                self.rejected += 1
            elif not self._is_echo(frame := (message.arbitration_id, bytes(message.data))):
                frames.append((message.timestamp, frame))
        return frames

    def _is_wanted(self, message: can.Message) -> bool:
        if self._is_fd or message.is_fd:
            return self._is_fd and message.is_fd
        return message.is_extended_id is self._is_extended

    def _has_long_id(self, can_id: int) -> bool:
        return can_id > _LONGEST_STANDARD_ID if self._is_fd else self._is_extended

    def _next(self) -> can.Message | None:
        while True:
            try:
                return self._receive()
            except can.CanOperationError as problem:
                if "unpack" not in str(problem):
                    raise self._lost(problem) from None
                self.rejected += 1  # a foreign datagram in our multicast group: noise
            except (can.CanError, OSError, ValueError) as problem:
                raise self._lost(problem) from None

    def _check_bus_off(self, message: can.Message) -> None:
        if message.arbitration_id & _SOCKETCAN_BUS_OFF:
            raise self._lost("bus off: wiring, termination (120 ohm at both ends) or bit rate is wrong")

    def _is_echo(self, frame: tuple[int, bytes]) -> bool:
        """Whether it is our own; its memory ends with it."""
        if not self._echoes or frame not in self._echoes:
            return False
        self._echoes.remove(frame)
        return True

    def _lost(self, problem: object) -> LinkLost:
        return LinkLost(f"CAN bus {self.name}: lost: {problem}")

    def close(self) -> None:
        if self._is_open:
            self._is_open = False
            self._bus.shutdown()
