"""The CAN interfaces by name: how a channel is written, which package or system a driver needs, what to do when it is missing."""

from dataclasses import dataclass
from importlib.util import find_spec


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
        return (
            f"pip install {self.package}"
            if self.module and find_spec(self.module.partition(".")[0]) is None
            else ""
        )


_ON_LINUX = "; on Linux its kernel driver is better: interface = \"socketcan\", channel = \"can0\""  # fmt: skip
_WAITS = "; its driver waits 1 ms in each cycle when nothing comes: use it for set-up, not for 500 Hz"

INTERFACES = {
    one.name: one
    for one in (
        CanInterface("socketcan", "can0", remedy="try: ip link set {channel} up type can bitrate {bitrate} restart-ms 100"),
        CanInterface("slcan", "/dev/serial/by-id/usb-..."),
        CanInterface(
            "gs_usb", "0", True, "gs_usb", "gs_usb pyusb",
            remedy="the channel counts the adapters from 0" + _WAITS + _ON_LINUX,
        ),
        CanInterface("pcan", "PCAN_USBBUS1", remedy="install PEAK's PCAN-Basic library" + _ON_LINUX),
        CanInterface("kvaser", "0", True, remedy="no driver installed: get Kvaser's CANlib" + _ON_LINUX),
        CanInterface("ixxat", "0", True, remedy="install HMS's VCI driver; it is for Windows" + _ON_LINUX),
        CanInterface("vector", "0", True, remedy="install Vector's XL driver; it is for Windows"),
        CanInterface("cantact", "0", True, "cantact", "cantact", remedy="the channel counts from 0" + _ON_LINUX),
        CanInterface("seeedstudio", "/dev/ttyUSB0", remedy="the channel is its serial port; bitrate is the bus's"),
        CanInterface("robotell", "/dev/ttyUSB0", remedy="the channel is its serial port"),
        CanInterface(
            "udp_multicast", "239.74.163.2",
            remedy="the channel is a multicast address such as 239.74.163.2, and msgpack must be installed",
        ),
        CanInterface("virtual", "any", remedy="any name is valid for a virtual bus"),
    )
}  # fmt: skip


def channel_of(interface: str, channel: str) -> str | int:
    """A channel as the interface's driver takes it: a number where it counts its channels."""
    known = INTERFACES.get(interface)
    return int(channel) if known is not None and known.has_number and channel.isdecimal() else channel
