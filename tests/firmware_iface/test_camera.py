"""Camera frames: golden bytes, what is dropped, and the receiver on a real port."""

import socket
import struct

import pytest

from firmware_iface.camera import CameraFrame, CameraReceiver, unpack
from firmware_iface.errors import LinkLost, PortMissing
from tests.places import ROOT

FRAME = CameraFrame(7, 12.5, (0.5, -0.25, 0.125))


def golden() -> bytes:
    line = (ROOT / "tests/golden/camera.txt").read_text().splitlines()[-1]
    return bytes.fromhex(line.split("|")[1])


def datagram_of(frame: CameraFrame) -> bytes:
    numbers = (frame.is_visible, frame.source, frame.sequence, frame.time_s, *frame.position_m)
    return struct.pack("<4sBBHIdddd", b"AWCM", 1, *numbers)


def test_the_golden_frame_unpacks_and_is_quoted() -> None:
    assert datagram_of(FRAME) == golden()
    assert unpack(golden()) == FRAME
    assert f"`{golden().hex(' ')}`" in (ROOT / "docs/camera.md").read_text()


@pytest.mark.parametrize("is_visible", [True, False])
@pytest.mark.parametrize(("source", "sequence"), [(0, 0), (65535, 2**32 - 1)])
def test_frames_survive(is_visible: bool, source: int, sequence: int) -> None:
    frame = CameraFrame(sequence, 1e9, (1.0, 2.0, 3.0), is_visible, source)
    assert unpack(datagram_of(frame)) == frame


@pytest.mark.parametrize(
    "datagram",
    [
        b"",
        golden()[:-1],
        golden() + b"\x00",
        b"AWCN" + golden()[4:],
        golden()[:4] + b"\x02" + golden()[5:],
        golden()[:5] + b"\x03" + golden()[6:],
        golden()[:20] + b"\x00\x00\x00\x00\x00\x00\xf8\x7f" + golden()[28:],
    ],
)
def test_what_is_no_frame_is_dropped(datagram: bytes) -> None:
    assert unpack(datagram) is None


def test_the_receiver_gives_all_frames_and_counts_noise() -> None:
    receiver = CameraReceiver(port=0)
    assert receiver.receive() == []
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        for datagram in (golden(), b"noise", golden()):
            sender.sendto(datagram, ("127.0.0.1", receiver.port))
    frames: list[CameraFrame] = []
    for _ in range(100_000):
        frames += receiver.receive()
        if len(frames) == 2:
            break
    assert frames == [FRAME, FRAME]
    assert receiver.rejected == 1
    receiver.close()
    with pytest.raises(LinkLost):
        receiver.receive()


def test_a_port_that_is_taken_is_one_message() -> None:
    receiver = CameraReceiver(port=0)
    with pytest.raises(PortMissing, match=f"UDP port {receiver.port} .*choose another port"):
        CameraReceiver(port=receiver.port)
    receiver.close()
    with pytest.raises(PortMissing):
        CameraReceiver(port=70_000)
