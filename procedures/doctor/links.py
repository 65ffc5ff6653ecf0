"""Ports and buses: stable names, latency settings, the state of a CAN interface before it is opened, and its frames after."""

import json
import subprocess
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from control.model.arm import Arm, CanBus
from control.model.board_kinds import KINDS
from firmware_iface.can_adapters import INTERFACES
from firmware_iface.can_link import can_buses
from firmware_iface.link import FrameLink
from firmware_iface.serial_link import LATENCY_ms, PortHere, latency_file, lower_latency, serial_ports
from procedures.doctor.finding import Finding, Level

GROUP = "ports"
LEAST_QUEUE = 50  # frames: a burst of set-up requests must fit
_ASK_LIMIT_S = 5.0
Details = Callable[[str], Mapping[str, Any] | None]


class CountedLink:
    """A CAN bus that counts its frames, to measure the true load."""

    def __init__(self, link: FrameLink) -> None:
        self.name = link.name
        self.frames = 0
        self._link = link

    def send(self, can_id: int, payload: bytes) -> None:
        """Send one frame."""
        self.frames += 1
        self._link.send(can_id, payload)

    def receive(self) -> list[tuple[int, bytes]]:
        """Return all frames received."""
        frames = self._link.receive()
        self.frames += len(frames)
        return frames

    def close(self) -> None:
        """Leave the bus."""
        self._link.close()


def look_at_ports() -> list[Finding]:
    """List ports and buses of this host; nothing is opened."""
    ports = []
    for port in serial_ports():
        known = [said for said in (port.description, port.stable) if said]
        ports.append(f"{port.path} ({', '.join(known)})" if known else port.path)
    buses = [f"{interface}:{channel}" for interface, channel in can_buses()]
    return [
        Finding(Level.OK, GROUP, "serial ports here", ", ".join(ports) or "none"),
        Finding(Level.OK, GROUP, "CAN adapters here", ", ".join(buses) or "none known to the system"),
    ]


def look_at_links(arm: Arm) -> list[Finding]:
    """Check the serial ports and the CAN interface that arm.toml names; nothing is opened."""
    ports = {board.port: f'encoder board "{board.name}"' for board in arm.encoder_boards}
    ports |= {board.port: f'board "{board.name}"' for board in arm.boards if board.port}
    here = serial_ports()
    findings = [found for path, what in ports.items() for found in judge_serial(what, path, here, Path("/"))]
    if arm.can is not None:
        if arm.can.interface == "slcan":
            findings += judge_serial("CAN bus", arm.can.channel, here, Path("/"))
        needs_fd = any(KINDS[board.kind].needs_fd for board in arm.boards)
        findings += judge_can(arm.can, kernel_details, needs_fd)
    return findings


def judge_serial(what: str, path: str, here: list[PortHere], root: Path) -> Iterator[Finding]:
    """Whether a port has a name that stays, and whether its adapter hands bytes over at once."""
    stable = next((port.stable for port in here if port.path == path), "")
    if stable:
        yield Finding(
            Level.WARN, GROUP, f"{what}: name of its port", path, "a name that stays",
            f'the system may number ports anew: write port = "{stable}" in arm.toml',
        )  # fmt: skip
    lower_latency(path, root)
    if (file := latency_file(path, root)) is not None:
        latency_ms = file.read_text().strip()
        is_low = latency_ms == LATENCY_ms
        remedy = (
            f"this user may not set it: `echo {LATENCY_ms} | sudo tee {file}`, or for good with the udev rule in"
            " control/server/system/99-armwright.rules"
        )
        yield Finding(
            Level.OK if is_low else Level.WARN, GROUP, f"{what}: latency timer of its adapter", f"{latency_ms} ms",
            f"{LATENCY_ms} ms", "" if is_low else remedy,
        )  # fmt: skip


def judge_can(can: CanBus, details: Details, needs_fd: bool = False) -> Iterator[Finding]:
    """Whether the interface is known and its driver here; on SocketCAN, its state, bit rate and settings."""
    what = f"CAN interface {can.interface}:{can.channel}"
    known = INTERFACES.get(can.interface)
    if known is None:
        return  # one that nobody has described here; opening it says the rest
    if missing := known.missing():
        yield Finding(Level.BAD, GROUP, what, "its Python package is missing", known.package, missing)
    elif can.interface == "gs_usb":
        yield Finding(Level.WARN, GROUP, what, "waits 1 ms in each cycle", "SocketCAN", known.remedy)
    elif can.interface == "socketcan":
        yield from _judge_socketcan(what, can, details(can.channel), needs_fd)


def _judge_socketcan(
    what: str, can: CanBus, found: Mapping[str, Any] | None, needs_fd: bool
) -> Iterator[Finding]:
    """`found` is what `ip -details -json link show` says of it; None where the machine has no such interface or no ip."""
    data_phase = "dbitrate 5000000 fd on " if needs_fd else ""
    up = f"ip link set {can.channel} up type can bitrate {can.bitrate} {data_phase}restart-ms 100"
    if found is None:
        remedy = f"plug the adapter in; `ip -br link show type can` lists what is here; then `{up}`"
        yield Finding(Level.BAD, GROUP, what, "there is no such interface", can.channel, remedy)
        return
    data = found.get("linkinfo", {}).get("info_data", {})
    state, bitrate = str(data.get("state", "")), data.get("bittiming", {}).get("bitrate")
    is_up = "UP" in found.get("flags", ["UP"])
    measured = ", ".join(part for part in ("up" if is_up else "down", state.lower()) if part)
    again = f"`ip link set {can.channel} down`, then `{up}`"
    if not is_up or state in ("BUS-OFF", "STOPPED"):
        yield Finding(Level.BAD, GROUP, what, measured, "up, error-active", again)
    elif state in ("ERROR-PASSIVE", "ERROR-WARNING"):
        remedy = (
            "frames fail: check termination (120 ohm at both ends), wiring, supply of the boards, bit rate"
        )
        yield Finding(Level.WARN, GROUP, what, measured, "error-active", remedy)
    else:
        yield Finding(Level.OK, GROUP, what, measured)
    if bitrate is not None and bitrate != can.bitrate:
        yield Finding(Level.BAD, GROUP, f"{what}: bit rate", str(bitrate), str(can.bitrate), again)
    if needs_fd and data and "FD" not in data.get("ctrlmode", []):
        yield Finding(Level.BAD, GROUP, f"{what}: CAN FD", "off", "on, for boards of this arm", again)
    if data and not data.get("restart_ms"):
        remedy = f"it stays off the bus after a short circuit: {again}"
        yield Finding(Level.WARN, GROUP, f"{what}: restart after bus-off", "never", "100 ms", remedy)
    if (queue := int(found.get("txqlen", LEAST_QUEUE))) < LEAST_QUEUE:
        remedy = f"`ip link set {can.channel} txqueuelen 100`"
        yield Finding(
            Level.WARN, GROUP, f"{what}: transmit queue", f"{queue} frames", f"{LEAST_QUEUE}", remedy
        )


def kernel_details(channel: str) -> Mapping[str, Any] | None:
    """What `ip` says of a network interface; None if there is no such interface. Needs no rights."""
    if not Path("/sys/class/net", channel).exists():
        return None
    try:
        said = subprocess.run(
            ["ip", "-details", "-json", "link", "show", channel],
            capture_output=True, text=True, timeout=_ASK_LIMIT_S, check=True,
        ).stdout  # fmt: skip
        entries = json.loads(said)
    except (OSError, subprocess.SubprocessError, ValueError):
        return {}
    return entries[0] if entries else {}
