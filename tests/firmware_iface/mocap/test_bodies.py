"""Streams of motion capture systems: golden bytes, what is refused, bodies that leap, a body that stands still."""

import math
import random
import socket
import struct

import numpy as np
import pytest

from control.kinematics.rotation import matrices
from firmware_iface.errors import PortMissing
from firmware_iface.mocap import vicon
from firmware_iface.mocap.bodies import (
    BodyFrame,
    LeapWatch,
    LONGEST_GAP_frames,
    RigidPose,
    SeenBody,
    SteadyPose,
    angle_rad,
    compose,
    inverse,
    opposite,
    product,
    turned,
    unit,
)

UPRIGHT = (1.0, 0.0, 0.0, 0.0)
# Frame 7, one object "tool" at (500, -250, 125) mm, turned by (0.5, 0, 0) rad: written out by hand.
VICON = bytes.fromhex(
    "07000000 01 00 4800 746f6f6c 0000000000000000000000000000000000000000"
    "0000000000407f40 0000000000406fc0 0000000000405f40 000000000000e03f 0000000000000000 0000000000000000"
)
_NUMBERS = 32  # offset of the first object's translation


def test_the_golden_object_of_vicon_is_read_in_metres() -> None:
    frame = vicon.unpack(VICON)
    assert frame is not None
    (body,) = frame.bodies
    assert (frame.number, body.name, body.pose.position_m) == (7, "tool", (0.5, -0.25, 0.125))
    assert body.pose.quaternion == pytest.approx((math.cos(0.25), math.sin(0.25), 0.0, 0.0))
    assert frame.time_s is None


def test_viconss_angles_are_about_x_then_the_new_y_then_the_new_z() -> None:
    def about(axis: int, angle: float) -> np.ndarray:
        c, s, i, j = math.cos(angle), math.sin(angle), (axis + 1) % 3, (axis + 2) % 3
        turn = np.eye(3)
        turn[i, i] = turn[j, j] = c
        turn[i, j], turn[j, i] = -s, s
        return turn

    x, y, z = 0.4, -0.7, 1.9
    (found,) = matrices(np.array([vicon.from_euler_xyz(x, y, z)]))
    np.testing.assert_allclose(found, about(0, x) @ about(1, y) @ about(2, z), atol=1e-12)


@pytest.mark.parametrize("length", vicon.PADDED_bytes)
def test_padded_packets_are_read(length: int) -> None:
    assert vicon.unpack(VICON.ljust(length, b"\xa5")) == vicon.unpack(VICON)


def test_an_object_of_zeros_is_hidden_and_items_of_other_kinds_are_passed_over() -> None:
    hidden = vicon.unpack(VICON[:_NUMBERS] + bytes(48))
    assert hidden is not None
    assert not hidden.bodies[0].is_visible
    other = VICON[:4] + b"\x02" + b"\x01\x03\x00abc" + VICON[5:]
    assert vicon.unpack(other) == vicon.unpack(VICON)


@pytest.mark.parametrize(
    "datagram",
    [
        b"",
        VICON[:-1],
        VICON + b"\0",
        VICON[:4] + b"\x02" + VICON[5:],
        VICON[:6] + b"\x47\x00" + VICON[8:],
        VICON[:8] + bytes(24) + VICON[_NUMBERS:],
        VICON[:8] + b"\xff" + VICON[9:],
        VICON[:4] + b"\x02" + VICON[5:] + VICON[5:],
        VICON[:_NUMBERS] + struct.pack("<d", math.nan) + VICON[_NUMBERS + 8 :],
        VICON[:_NUMBERS] + struct.pack("<d", 1e9) + VICON[_NUMBERS + 8 :],
        VICON[:-8] + struct.pack("<d", 7.0),
    ],
    ids=["empty", "short", "long", "too few items", "size", "no name", "no text", "one name twice", "NaN", "far", "degrees"],
)
def test_what_is_no_object_stream_is_refused(datagram: bytes) -> None:
    assert vicon.unpack(datagram) is None


def test_the_stream_takes_the_packets_of_its_host_and_counts_the_others() -> None:
    stream = vicon.ViconStream("127.0.0.1", 0)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        for datagram in (VICON, b"noise"):
            sender.sendto(datagram, ("127.0.0.1", stream.port))
    assert [frame.number for frame in stream.receive()] == [7]
    assert stream.rejected == 1
    with pytest.raises(PortMissing, match=f"Vicon: .*{stream.port}.*choose another port"):
        vicon.ViconStream("127.0.0.1", stream.port)
    stream.close()
    with pytest.raises(PortMissing, match="no-such-host"):
        vicon.ViconStream("no-such-host.invalid", 0)


def test_poses_compose_and_invert() -> None:
    source = random.Random(1)
    first, second = (
        RigidPose(tuple(source.uniform(-1, 1) for _ in range(3)), vicon.from_euler_xyz(*source.choices((0.3, -1.2), k=3)))
        for _ in range(2)
    )
    back = compose(inverse(first), compose(first, second))
    assert back.position_m == pytest.approx(second.position_m)
    assert angle_rad(back.quaternion, second.quaternion) == pytest.approx(0.0, abs=1e-7)
    q = first.quaternion
    assert turned(product(q, opposite(q)), (1.0, 2.0, 3.0)) == pytest.approx((1.0, 2.0, 3.0))
    assert unit((1.0, 0.0, 0.0, 0.1)) is None
    assert unit((math.nan, 0.0, 0.0, 0.0)) is None


def frame(number: int, **at_m: tuple[float, float, float] | None) -> BodyFrame:
    """Bodies by name; None: hidden."""
    return BodyFrame(
        number,
        tuple(SeenBody(name, RigidPose(place or (0.0, 0.0, 0.0), UPRIGHT), place is not None) for name, place in at_m.items()),
    )


@pytest.mark.parametrize("apart_m", [0.03, 0.5])
def test_bodies_that_exchange_their_names_are_not_believed_until_they_change_back(apart_m: float) -> None:
    watch = LeapWatch()
    here, there = (0.0, 0.0, 0.0), (apart_m, 0.0, 0.0)
    for number in range(3):
        watch.look(frame(number, tool=here, wand=there))
    for number in range(3, 6):
        watch.look(frame(number, tool=there, wand=here))
    assert "body tool and wand exchanged their names at frame 3" in watch.problem("tool")
    assert watch.problem("wand")
    watch.look(frame(6, tool=here, wand=there))
    assert not watch.problem("tool")
    assert not watch.problem("wand")


def test_a_body_that_leapt_is_believed_again_once_it_was_hidden() -> None:
    watch = LeapWatch()
    watch.look(frame(1, tool=(0.0, 0.0, 0.0)))
    watch.look(frame(2, tool=(0.0, 0.3, 0.0)))
    watch.look(frame(3, tool=(0.0, 0.31, 0.0)))
    assert "leapt by 300 mm at frame 2" in watch.problem("tool")
    watch.look(frame(4, tool=None))
    watch.look(frame(5, tool=(0.0, 0.31, 0.0)))
    assert not watch.problem("tool")


def test_fast_motion_lost_frames_and_long_gaps_are_no_leaps() -> None:
    watch = LeapWatch()
    for number, y_m in ((0, 0.0), (1, 0.09), (4, 0.36), (4 + LONGEST_GAP_frames + 1, 3.0)):
        watch.look(frame(number, tool=(0.0, y_m, 0.0), wand=(0.5, y_m, 0.0)))
        assert not watch.problem("tool")


def test_a_turn_by_a_right_angle_in_one_frame_is_a_leap() -> None:
    watch = LeapWatch()
    watch.look(frame(1, tool=(0.0, 0.0, 0.0)))
    quarter = RigidPose((0.0, 0.0, 0.0), (math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5)))
    watch.look(BodyFrame(2, (SeenBody("tool", quarter),)))
    assert watch.problem("tool")


def test_a_body_that_stands_still_is_averaged_and_one_that_was_moved_is_not() -> None:
    source, steady = random.Random(2), SteadyPose()
    for _ in range(400):
        noise = [source.gauss(0.0, 1e-3) for _ in range(3)]
        mean = steady.after(RigidPose(tuple(noise), unit((1.0, *(0.5 * v for v in noise))) or UPRIGHT))
    assert math.hypot(*mean.position_m) < 2e-4
    assert angle_rad(mean.quaternion, UPRIGHT) < 2e-4
    moved = RigidPose((0.1, 0.0, 0.0), (-1.0, 0.0, 0.0, 0.0))  # the same orientation, written the other way
    assert steady.after(moved).position_m == (0.1, 0.0, 0.0)
