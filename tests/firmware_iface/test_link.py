"""What real drivers do now and then: error frames, bus off, strange frames, a port that takes no more bytes."""

import os
import pty
import tty
from collections.abc import Callable, Iterator
from pathlib import Path

import can
import pytest
from serial.tools.list_ports_common import ListPortInfo

from firmware_iface.can_link import channel_of, open_can, open_extended_can, open_fd_can
from firmware_iface.errors import LinkLost, PortMissing
from firmware_iface.link import FrameLink
from firmware_iface.serial_link import PortHere, latency_file, lower_latency, open_serial, serial_ports

ERROR_PASSIVE, BUS_OFF = 0x04, 0x40


@pytest.fixture
def ends() -> Iterator[tuple[FrameLink, can.BusABC]]:
    channel = f"drivers-{os.getpid()}"
    link = open_can("virtual", channel)
    far = can.Bus(interface="virtual", channel=channel, ignore_config=True)
    yield link, far
    link.close()
    far.shutdown()


@pytest.mark.parametrize(
    "odd",
    [
        can.Message(arbitration_id=0x181, is_extended_id=True, data=bytes(8)),
        can.Message(arbitration_id=0x181, is_extended_id=False, is_remote_frame=True, dlc=8),
        can.Message(arbitration_id=0x181, is_extended_id=False, is_fd=True, data=bytes(8)),
        can.Message(arbitration_id=ERROR_PASSIVE, is_extended_id=False, is_error_frame=True, data=bytes(8)),
    ],
)
def test_what_is_no_classic_data_frame_is_dropped(ends: tuple[FrameLink, can.BusABC], odd: can.Message) -> None:
    link, far = ends
    far.send(odd)
    far.send(can.Message(arbitration_id=0x182, is_extended_id=False, data=b"ok"))
    assert link.receive() == [(0x182, b"ok")]


@pytest.mark.parametrize(("can_id", "is_long"), [(0x100, False), (0x8005, True)])
def test_fd_frames_have_up_to_64_bytes_switch_the_bit_rate_and_take_the_id_that_suffices(
    ends: tuple[FrameLink, can.BusABC], can_id: int, is_long: bool
) -> None:
    classic, far = ends
    link = open_fd_can("virtual", str(far.channel_id))  # type: ignore[attr-defined]
    link.send(can_id, bytes(range(64)))
    heard = far.recv(0)
    assert heard is not None
    assert (heard.arbitration_id, heard.is_extended_id, bytes(heard.data)) == (can_id, is_long, bytes(range(64)))
    assert (heard.is_fd, heard.bitrate_switch) == (True, True)
    for is_extended in (False, True):
        far.send(can.Message(arbitration_id=0x300, is_extended_id=is_extended, is_fd=True, data=bytes(12)))
    far.send(can.Message(arbitration_id=0x300, is_extended_id=False, data=bytes(8)))
    assert link.receive() == [(0x300, bytes(12))] * 2
    assert classic.receive() == [(0x300, bytes(8))]
    link.close()


@pytest.mark.parametrize("opener", [open_extended_can, open_fd_can])
def test_slcan_is_refused_for_frames_that_it_would_cut_short(opener: Callable[..., FrameLink]) -> None:
    with pytest.raises(PortMissing, match=r"slcan carries classic frames with 11-bit ids, not .*: use an adapter"):
        opener("slcan", "/dev/there-is-no-such-port")


def test_bus_off_is_a_lost_link_that_says_where_to_look(ends: tuple[FrameLink, can.BusABC]) -> None:
    link, far = ends
    far.send(can.Message(arbitration_id=BUS_OFF, is_extended_id=False, is_error_frame=True, data=bytes(8)))
    with pytest.raises(LinkLost, match=r"bus off: .*termination.*bit rate"):
        link.receive()


def test_a_port_that_takes_no_more_bytes_is_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("firmware_iface.serial_link.WRITE_TIMEOUT_ms", 1)
    master, slave = pty.openpty()
    tty.setraw(master)
    link = open_serial(os.ttyname(slave), 1_000_000)
    with pytest.raises(LinkLost, match="no byte accepted"):
        link.write(bytes(1 << 20))
    link.close()
    os.close(master)
    os.close(slave)


def test_an_adapter_that_counts_its_channels_gets_a_number() -> None:
    assert channel_of("gs_usb", "0") == 0
    assert channel_of("kvaser", "1") == 1
    assert channel_of("socketcan", "can0") == "can0"
    assert channel_of("virtual", "7") == "7"


def test_a_latency_timer_is_found_by_any_name_of_its_port_and_lowered(tmp_path: Path) -> None:
    file = tmp_path / "sys/bus/usb-serial/devices/ttyUSB3/latency_timer"
    file.parent.mkdir(parents=True)
    file.write_text("16\n")
    named = tmp_path / "by-id"
    named.symlink_to(tmp_path / "ttyUSB3")
    assert latency_file(str(named), tmp_path) == file
    assert latency_file("/dev/ttyACM0", tmp_path) is None
    lower_latency("/dev/ttyACM0", tmp_path)
    lower_latency(str(named), tmp_path)
    assert file.read_text() == "1"


def test_ports_have_the_stable_names_that_the_system_links_to_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    device = tmp_path / "ttyUSB0"
    device.touch()
    folder = tmp_path / "by-id"
    folder.mkdir()
    (folder / "usb-Basicmicro-if00").symlink_to(device)
    info = ListPortInfo(str(device))
    monkeypatch.setattr("firmware_iface.serial_link.list_ports.comports", lambda: [info])
    assert serial_ports(folder) == [PortHere(str(device), "", str(folder / "usb-Basicmicro-if00"))]
    assert serial_ports(tmp_path / "none") == [PortHere(str(device), "")]
