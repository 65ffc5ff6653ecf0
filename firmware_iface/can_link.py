"""CAN links and adapters. The only file that imports python-can.

CAN adapters on a serial line speak slcan (Lawicel): CANable with slcan firmware, CANUSB and alike. python-can has this, too,
but its reading waits a millisecond, ends at the adapter's acknowledgement of a frame that was sent (so that replies pile up
behind), and costs 6 us a byte. Lines end with CR; BELL says that a command failed.

    C, Sn, O            close, bit rate, open
    tiiildd..           a data frame: 11-bit id in three hex digits, length, bytes in hex. T, r, R: other sorts
"""

import contextlib
import logging
import re
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from typing import Protocol

import can

from firmware_iface.claims import Claim, claim_can
from firmware_iface.errors import LinkLost, PortMissing
from firmware_iface.link import CanFormat, FrameLink
from firmware_iface.serial_link import open_serial


@dataclass(frozen=True, slots=True)
class CanInterface:
    """One interface of python-can (slcan is our own). `module` is what `pip install PACKAGE` brings."""

    name: str
    channel: str  # an example
    has_number: bool = False  # its channel is a number
    module: str = ""
    package: str = ""
    remedy: str = "check that the adapter is plugged in and its driver installed"

    def missing(self) -> str:
        """What to install for it; "" if nothing is missing as far as this machine can say."""
        return f"pip install {self.package}" if self.module and find_spec(self.module.partition(".")[0]) is None else ""


_ON_LINUX = '; on Linux its kernel driver is better: interface = "socketcan", channel = "can0"'
_WAITS = "; its driver waits 1 ms in each cycle when nothing comes: use it for set-up, not for 500 Hz"

INTERFACES = {
    one.name: one
    for one in (
        CanInterface("socketcan", "can0", remedy="try: ip link set {channel} up type can bitrate {bitrate} restart-ms 100"),
        CanInterface("slcan", "/dev/serial/by-id/usb-..."),
        CanInterface(
            "gs_usb", "0", True, "gs_usb", "gs_usb pyusb", remedy="the channel counts the adapters from 0" + _WAITS + _ON_LINUX
        ),
        CanInterface("pcan", "PCAN_USBBUS1", remedy="install PEAK's PCAN-Basic library" + _ON_LINUX),
        CanInterface("kvaser", "0", True, remedy="no driver installed: get Kvaser's CANlib" + _ON_LINUX),
        CanInterface("ixxat", "0", True, remedy="install HMS's VCI driver; it is for Windows" + _ON_LINUX),
        CanInterface("vector", "0", True, remedy="install Vector's XL driver; it is for Windows"),
        CanInterface("cantact", "0", True, "cantact", "cantact", remedy="the channel counts from 0" + _ON_LINUX),
        CanInterface("seeedstudio", "/dev/ttyUSB0", remedy="the channel is its serial port; bitrate is the bus's"),
        CanInterface("robotell", "/dev/ttyUSB0", remedy="the channel is its serial port"),
        CanInterface(
            "udp_multicast",
            "239.74.163.2",
            remedy="the channel is a multicast address such as 239.74.163.2, and msgpack must be installed",
        ),
        CanInterface("virtual", "any", remedy="any name is valid for a virtual bus"),
    )
}


def channel_of(interface: str, channel: str) -> str | int:
    """A channel as the interface's driver takes it: a number where it counts its channels."""
    known = INTERFACES.get(interface)
    return int(channel) if known is not None and known.has_number and channel.isdecimal() else channel


_SOCKETCAN_BUS_OFF = 0x40  # CAN_ERR_BUSOFF of linux/can/error.h, in the id of an error frame
_ADAPTERS = ("socketcan", "pcan")  # python-can detects these without waiting
_SLCAN_BAUD = 115_200
_ECHO_MEMORY = 64  # our own frames that may be echoed at once
_DATA_BITRATE = 5_000_000  # of FD frames, on adapters that are not set up by the system; moteus needs it
_LONGEST_STANDARD_ID = 0x7FF


def can_buses() -> list[tuple[str, str]]:
    """List interface and channel of the CAN adapters that their drivers can detect, without opening them."""
    with _can_log():
        adapters = can.detect_available_configs([name for name in _ADAPTERS if name in can.VALID_INTERFACES])
    return [(str(bus["interface"]), str(bus["channel"])) for bus in adapters]


def open_can(interface: str, channel: str, bitrate: int = 1_000_000, **options: object) -> FrameLink:
    """Open a CAN bus by any interface of python-can: socketcan, slcan, gs_usb, pcan, udp_multicast, virtual ...

    `options` are passed to python-can unchanged. slcan is our own (`SlcanLink`). Raises PortMissing with the remedy; PortInUse.
    """
    return _as_host(interface, channel, bitrate, CanFormat.STANDARD, options)


def open_extended_can(interface: str, channel: str, bitrate: int = 1_000_000, **options: object) -> FrameLink:
    """As `open_can`, for frames with 29-bit ids instead of 11-bit ones."""
    return _as_host(interface, channel, bitrate, CanFormat.EXTENDED, options)


def open_fd_can(interface: str, channel: str, bitrate: int = 1_000_000, **options: object) -> FrameLink:
    """As `open_can`, for CAN FD frames with a faster data phase (bit rate switch). `bitrate` is that of the arbitration."""
    return _as_host(interface, channel, bitrate, CanFormat.FD, options)


def _as_host(interface: str, channel: str, bitrate: int, carried: CanFormat, options: Mapping[str, object]) -> FrameLink:
    """The bus, which is ours until it is closed; that of an slcan adapter is its serial port's."""
    claim = None if interface == "slcan" else claim_can(interface, channel, options.get("port", ""))
    link = join_can(interface, channel, bitrate, carried, **options)
    if isinstance(link, CanFrameLink):
        link.claim = claim
    return link


def join_can(
    interface: str, channel: str, bitrate: int = 1_000_000, carried: CanFormat = CanFormat.STANDARD, **options: object
) -> FrameLink:
    """As `open_can`, as a device on the bus beside its host: for mocks."""
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
    if strange := sorted(set(options) - set(OPTIONS)):
        raise PortMissing(f"CAN bus {name}: unknown option {strange[0]}; slcan takes {', '.join(OPTIONS)}")
    if bitrate not in BITRATE_CODES:
        raise PortMissing(f"CAN bus {name}: bitrate {bitrate}: slcan knows {', '.join(map(str, BITRATE_CODES))}")
    port = open_serial(channel, int(str(options.get("tty_baudrate", _SLCAN_BAUD))))
    return SlcanLink(port, name, bitrate)


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
    """A data frame for one `send`, never modified.

    So it need not be copied: python-can's virtual bus deep-copies each message for every receiver, which costs five times the
    rest. Nor need what is known be asked, which is half of python-can's own constructor: each cycle sends one to every board.
    """

    __slots__ = ()

    def __init__(self, can_id: int, payload: bytes, is_extended: bool, is_fd: bool) -> None:
        self.timestamp, self.arbitration_id, self.channel = 0.0, can_id, None
        self.is_extended_id, self.is_fd, self.bitrate_switch, self.is_rx = is_extended, is_fd, is_fd, True
        self.is_remote_frame = self.is_error_frame = self.error_state_indicator = False
        self.data, self.dlc = bytearray(payload), len(payload)

    def __deepcopy__(self, memo: object) -> "_OwnMessage":
        return self


def _now(bus: can.BusABC) -> Callable[[], can.Message | None]:
    """A function that returns the next message at once, or None.

    python-can's own `recv(timeout=0)` reads the time of day: where that steps back in between, it waits for as long as the step.
    An interface that has its own `recv` is used as it is. No filters are set, so none are applied.
    """
    if type(bus).recv is not can.BusABC.recv:
        return partial(bus.recv, 0)
    return lambda: bus._recv_internal(timeout=0)[0]


class CanFrameLink:
    """Any python-can bus: what `open_can` and its like open, but for slcan.

    Frames other than data frames of the wanted format are counted in `rejected`.
    """

    def __init__(self, bus: can.BusABC, name: str, carried: CanFormat, hears_itself: bool) -> None:
        self.name = name
        self.rejected = 0
        self.claim: Claim | None = None  # of a host
        self._bus = bus
        self._is_fd = carried is CanFormat.FD
        self._is_extended = carried is CanFormat.EXTENDED
        # Multicast echoes our own frames; each is dropped once.
        self._echoes: deque[tuple[int, bytes]] | None = deque(maxlen=_ECHO_MEMORY) if hears_itself else None
        self._is_open = True
        self._receive = _now(bus)

    def send(self, can_id: int, payload: bytes) -> None:
        # CAN FD carries ids of both lengths here, classic frames those of one.
        is_extended = can_id > _LONGEST_STANDARD_ID if self._is_fd else self._is_extended
        try:
            self._bus.send(_OwnMessage(can_id, payload, is_extended, self._is_fd))
        except (can.CanError, OSError, ValueError) as problem:
            raise self._lost(problem) from None
        if self._echoes is not None:
            self._echoes.append((can_id, bytes(payload)))

    def receive(self) -> list[tuple[int, bytes]]:
        return [frame for _, frame in self.receive_timed()]

    def receive_timed(self) -> list[tuple[float, tuple[int, bytes]]]:
        """As `receive`, with when each frame came in seconds since 1970, where the interface says so."""
        frames: list[tuple[float, tuple[int, bytes]]] = []
        receive, echoes, is_fd = self._receive, self._echoes, self._is_fd
        while True:
            try:
                message = receive()
            except can.CanOperationError as problem:
                if "unpack" not in str(problem):
                    raise self._lost(problem) from None
                self.rejected += 1  # a foreign datagram in our multicast group: noise
                continue
            except (can.CanError, OSError, ValueError) as problem:
                raise self._lost(problem) from None
            if message is None:
                return frames
            if message.is_error_frame:
                self._check_bus_off(message)
                self.rejected += 1
            elif (
                message.is_remote_frame
                or message.is_fd is not is_fd
                or not (is_fd or message.is_extended_id is self._is_extended)
            ):
                self.rejected += 1
            else:
                frame = (message.arbitration_id, bytes(message.data))
                if not echoes or not self._is_echo(frame):
                    frames.append((message.timestamp, frame))

    def _check_bus_off(self, message: can.Message) -> None:
        if message.arbitration_id & _SOCKETCAN_BUS_OFF:
            raise self._lost("bus off: wiring, termination (120 ohm at both ends) or bit rate is wrong")

    def _is_echo(self, frame: tuple[int, bytes]) -> bool:
        """Whether it is our own; its memory ends with it."""
        if self._echoes is None or frame not in self._echoes:
            return False
        self._echoes.remove(frame)
        return True

    def _lost(self, problem: object) -> LinkLost:
        return LinkLost(f"CAN bus {self.name}: lost: {problem}")

    def close(self) -> None:
        if self._is_open:
            self._is_open = False
            self._bus.shutdown()
            self.claim = None


BITRATE_CODES = {
    10_000: "S0",
    20_000: "S1",
    50_000: "S2",
    100_000: "S3",
    125_000: "S4",
    250_000: "S5",
    500_000: "S6",
    800_000: "S7",
    1_000_000: "S8",
}
OPTIONS = ("tty_baudrate",)
_FRAME = re.compile(rb"t([0-7][0-9A-Fa-f]{2})([0-8])([0-9A-Fa-f]*)")
_OTHER_FRAMES = (b"T", b"r", b"R", b"d", b"D", b"b", b"B")
_ENDS = re.compile(rb"[\r\a]")
_LONGEST_LINE = 64  # a data frame has 26 characters with a time stamp


class Port(Protocol):
    """The serial line to the adapter."""

    @property
    def name(self) -> str: ...
    def read(self) -> bytes: ...
    def write(self, data: bytes) -> None: ...
    def close(self) -> None: ...


class SlcanLink:
    """A CAN bus behind an slcan adapter, which is opened here. `rejected` counts what is no classic data frame."""

    def __init__(self, port: Port, name: str, bitrate: int) -> None:
        """`bitrate` is one of BITRATE_CODES. Raises LinkLost."""
        self.name = name
        self.rejected = 0
        self._port = port
        self._rest = b""
        self._is_open = True
        port.write(f"\r\rC\r{BITRATE_CODES[bitrate]}\rO\r".encode())

    def send(self, can_id: int, payload: bytes) -> None:
        """Send one frame of 0 to 8 bytes. Raises LinkLost."""
        self._port.write(b"t%03X%d%s\r" % (can_id, len(payload), payload.hex().upper().encode()))

    def receive(self) -> list[tuple[int, bytes]]:
        """Return all frames received as (id, payload), oldest first; never blocks. Raises LinkLost."""
        *lines, self._rest = _ENDS.split(self._rest + self._port.read())
        if len(self._rest) > _LONGEST_LINE:
            self._rest = self._rest[-_LONGEST_LINE:]  # not an slcan adapter; the next CR begins anew
        return [frame for line in lines if (frame := self._frame(line)) is not None]

    def _frame(self, line: bytes) -> tuple[int, bytes] | None:
        matched = _FRAME.match(line)
        if matched is None:
            self.rejected += line.startswith(_OTHER_FRAMES) or line.startswith(b"t")
            return None
        digits = 2 * int(matched[2])
        if len(matched[3]) < digits:
            self.rejected += 1
            return None
        return int(matched[1], 16), bytes.fromhex(matched[3][:digits].decode())

    def close(self) -> None:
        """Leave the bus; idempotent."""
        if self._is_open:
            self._is_open = False
            try:
                self._port.write(b"C\r")
            finally:
                self._port.close()
