"""Serial links and ports. The only file that imports pyserial."""

import contextlib
import errno
import fcntl
import os
import select
import termios
from dataclasses import dataclass
from pathlib import Path
from struct import Struct

import serial
from serial.tools import list_ports

from firmware_iface.claims import Claim, claim_serial
from firmware_iface.errors import LinkLost, MisuseError, PortMissing
from firmware_iface.link import ByteLink

BY_ID = Path("/dev/serial/by-id")  # of udev: names that stay when devices are plugged in another order
LATENCY_ms = "1"  # of an FTDI adapter's latency timer
_PATIENT_READS = 4  # looks at an empty tty before the kernel is asked to hand over what it holds
_READ_BYTES = 65536  # more than a serial driver buffers
_INT = Struct("i")
_NO_BYTES = _INT.pack(0)
WRITE_TIMEOUT_ms = 200  # requests are about 12 bytes: a line that does not accept them in this time is dead


def open_serial(url: str, baud: int, patience: int = _PATIENT_READS) -> ByteLink:
    """Open a serial port by any URL that pyserial takes: /dev/ttyUSB0, COM3, socket://host:port, loop:// ...

    8N1, low-latency mode where supported; no other program has it (firmware_iface.claims). `patience`: how many empty
    looks in a row before a tty is read all the same, which may wait for the kernel. Raises PortMissing, which lists the
    available ports; PortInUse.
    """
    if baud <= 0:
        raise MisuseError(f"serial port {url}: baud must be positive, got {baud}")
    try:
        port = serial.serial_for_url(
            url, baudrate=baud, timeout=0, write_timeout=WRITE_TIMEOUT_ms * 1e-3, exclusive=True, do_not_open=True
        )
        claim = claim_serial(url, port.port if isinstance(port, serial.Serial) else None)
        port.open()
    except (serial.SerialException, OSError, ValueError, ImportError) as problem:
        reason = next((part for part in problem.args if isinstance(part, str)), str(problem))
        if isinstance(number := getattr(problem, "errno", None), int):
            known = {errno.ENOENT: "there is no such port", errno.EAGAIN: "another program has locked it"}
            reason = known.get(number) or os.strerror(number)
        raise PortMissing(f"serial port {url}: cannot open it: {reason}; {_ports_here()}") from None
    if type(port) is serial.Serial and os.name == "posix":
        # Only real UARTs on USB have this mode; a pty answers with an error, and needs none.
        with contextlib.suppress(OSError, ValueError, NotImplementedError, AttributeError):
            port.set_low_latency_mode(True)  # ASYNC_LOW_LATENCY, where the kernel lets this user
        lower_latency(url)
        return _PosixByteLink(port, claim, url, baud, patience)
    if url.startswith("socket:") and os.name == "posix":
        return _SocketByteLink(port, claim, url, 0, patience)
    return _PyserialByteLink(port, claim, url, 0 if url.startswith("socket:") else baud)


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
        PortHere(port.device, "" if port.description == "n/a" else port.description, stable.get(port.device, ""))
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


def _ports_here() -> str:
    names = sorted(port.device for port in list_ports.comports())
    return f"ports here: {', '.join(names)}" if names else "no serial ports found: check that the board is plugged in"


class _PosixByteLink:
    """A tty or pty: opened by pyserial, read and written directly (pyserial's layers cost some 20 us a read)."""

    def __init__(self, port: serial.SerialBase, claim: Claim | None, name: str, baud: int, patience: int) -> None:
        self.name = name
        self.baud = baud
        self._claim = claim
        self._port = port
        self._fd = port.fileno()
        os.set_blocking(self._fd, False)
        self._patience = patience
        self._empty_reads = 0
        self._writable = select.poll()
        self._writable.register(self._fd, select.POLLOUT)
        self._arrivals: select.epoll | None = None

    def wait(self, limit_s: float) -> bool:
        # Asking a tty whether it is readable may wait for the kernel's worker, as reading it does (see `read`), for longer than
        # the limit. So only its wake-ups are waited for, by edges, and the number of bytes tells whether there are any.
        try:
            if self._arrivals is None:
                self._arrivals = select.epoll()
                self._arrivals.register(self._fd, select.EPOLLIN | select.EPOLLET)
            if not (waiting := self._waiting_bytes()) and limit_s > 0.0 and select.select([self._arrivals], [], [], limit_s)[0]:
                waiting = self._waiting_bytes()
            if waiting:
                self._arrivals.poll(0)  # this edge is done
            return waiting > 0
        except (OSError, ValueError):  # unplugged, or closed: reading says so
            return True

    def _waiting_bytes(self) -> int:
        return int(_INT.unpack(fcntl.ioctl(self._fd, termios.FIONREAD, _NO_BYTES))[0])

    def read(self) -> bytes:
        # Query the number of bytes first, because reading an empty tty may wait: the kernel then flushes pending
        # input in a worker of ordinary priority, and a real-time loop would wait for it. On a busy machine that worker is
        # late by tens of milliseconds, with the board's bytes in its hands: a line that has been empty for some reads is
        # therefore read all the same, so that no board is called silent while its bytes are here.
        try:
            waiting = self._waiting_bytes()
            self._empty_reads = 0 if waiting else self._empty_reads + 1
            if self._empty_reads % (self._patience + 1) == self._patience:
                waiting = _READ_BYTES
            return os.read(self._fd, waiting) if waiting else b""
        except BlockingIOError:
            return b""
        except (OSError, ValueError) as problem:  # the port was unplugged, or closed during the call
            raise self._lost(problem) from None

    def write(self, data: bytes) -> None:
        rest = data
        while rest:
            try:
                rest = rest[os.write(self._fd, rest) :]
            except BlockingIOError:
                if not self._writable.poll(WRITE_TIMEOUT_ms):
                    raise self._lost(f"no byte accepted for {WRITE_TIMEOUT_ms} ms") from None
            except OSError as problem:
                raise self._lost(problem) from None

    def _lost(self, problem: object) -> LinkLost:
        return LinkLost(f"serial port {self.name}: lost: {problem}")

    def close(self) -> None:
        self._fd = -1  # the descriptor may be reused
        if self._arrivals is not None:
            self._arrivals.close()
        self._port.close()
        self._claim = None


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

    def __init__(self, port: serial.SerialBase, claim: Claim | None, name: str, baud: int) -> None:
        self.name = name
        self.baud = baud
        self._claim = claim
        self._port = port

    def read(self) -> bytes:
        try:
            # With timeout 0, pyserial returns what is buffered.
            return bytes(self._port.read(_READ_BYTES))
        except (OSError, TypeError) as problem:  # TypeError: closed during the call
            raise self._lost(problem) from None

    def wait(self, limit_s: float) -> bool:
        try:
            return bool(self._port.in_waiting)  # type: ignore[attr-defined]  # every port of pyserial has it
        except (OSError, TypeError):  # reading says why
            return True

    def write(self, data: bytes) -> None:
        try:
            self._port.write(data)
        except (OSError, TypeError) as problem:
            raise self._lost(problem) from None

    def _lost(self, problem: object) -> LinkLost:
        return LinkLost(f"serial port {self.name}: lost: {problem}")

    def close(self) -> None:
        self._port.close()
        self._claim = None
