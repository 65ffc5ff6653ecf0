"""The stepped rig through the product's own drivers: real bytes, one clock, the same bytes for the same seed; faults."""

from __future__ import annotations

import itertools
import math
import struct
from collections.abc import Iterator
from dataclasses import dataclass

import msgspec
import pytest

from control.model.description import load_arm
from firmware_iface.camera import CameraFrame, CameraReceiver
from firmware_iface.can_link import open_can
from firmware_iface.encoder.board import EncoderBoard
from firmware_iface.encoder.wire import ChannelFlag
from firmware_iface.link import ByteLink, FrameLink
from firmware_iface.serial_link import open_serial
from hil_mocks.devices.encoder_board import frame
from hil_mocks.errors import ScenarioError
from hil_mocks.faults import KINDS, kinds_of
from hil_mocks.rig import SteppedRig
from hil_mocks.scenario import FaultTable, Scenario, Start, load_scenario

RIGHT = load_arm("right")
REST = (0.1, -0.6, 0.2)
COUNTS_PER_RAD = [ratio * 2048 / (2 * math.pi) for ratio in (100.0, 120.0, 100.0)]


def at_rest(name: str = "ideal", **changed: object) -> Scenario:
    return msgspec.structs.replace(load_scenario(name), start=Start(q_rad=REST), **changed)


@dataclass
class Host:
    """A rig and the plain links of a host that speaks for itself."""

    rig: SteppedRig
    serial: ByteLink
    can: FrameLink
    sequence: int = 0

    def wait(self, duration_s: float) -> None:
        self.rig.clock.wait_until_s(self.rig.clock.now_s() + duration_s)

    def command(self, node: int, word: int, mode: int = 0, setpoint: int = 0) -> None:
        self.sequence = (self.sequence + 1) % 32
        self.can.send(0x100 + node, struct.pack("<BBih", word, mode | self.sequence << 3, setpoint, 0))

    def enable(self, *nodes: int) -> None:
        for word in (0x06, 0x07, 0x0F):
            for node in nodes:
                self.command(node, word)
        self.wait(0.002)
        self.can.receive()

    def close(self) -> None:
        self.serial.close()
        self.can.close()
        self.rig.close()


def plug_in(scenario: Scenario) -> Host:
    rig = SteppedRig(RIGHT, scenario)
    return Host(rig, open_serial(rig.encoder_urls[0], 1_000_000), open_can(rig.can_interface, rig.can_channel))


@pytest.fixture
def host() -> Iterator[Host]:
    plugged = plug_in(at_rest())
    yield plugged
    plugged.close()


def test_the_clock_advances_by_waiting_and_by_nothing_else(host: Host) -> None:
    clock = host.rig.clock
    assert clock.now_s() == 0.0
    clock.wait_until_s(0.0305)
    assert clock.now_s() == pytest.approx(0.031)
    clock.wait_until_s(0.01)
    assert clock.now_s() == pytest.approx(0.031)


def test_the_products_encoder_board_reads_identity_counts_and_a_zero(host: Host) -> None:
    board = EncoderBoard(host.serial, host.rig.clock, "enc0")
    assert board.identify(0.1).counts_per_turn == (2048, 2048, 2048)
    board.set_zero(1, 5000)
    board.stream(0.002)
    host.wait(0.01)
    board.update()
    assert board.latest is not None
    # Boards start at count 0 where the arm stands; the drives brake, so it sinks by some counts only.
    assert board.latest.counts[1] == pytest.approx(5000, abs=150)
    assert board.latest.flags[1] & ChannelFlag.ZERO_SET


def test_a_voltage_moves_the_joint_and_the_count_follows(host: Host) -> None:
    host.enable(1)
    board = EncoderBoard(host.serial, host.rig.clock, "enc0")
    board.stream(0.001)
    before = host.rig.joint_rad()[0]
    for _ in range(50):
        host.command(1, 0x0F, 1, 2000)
        host.wait(0.002)
        board.update()
    moved_rad = host.rig.joint_rad()[0] - before
    assert moved_rad == pytest.approx(2.0 / 3.02 * (0.1 - 0.009), rel=0.15)
    assert board.latest is not None
    # The last report is a millisecond old when the arm does 0.66 rad/s.
    assert board.latest.counts[0] == pytest.approx(moved_rad * COUNTS_PER_RAD[0], abs=50)


def test_position_mode_holds_against_gravity(host: Host) -> None:
    for index, value in ((16, 6135), (18, 153_400), (17, 100_000), (22, 10_000)):
        host.can.send(0x202, struct.pack("<BBBBi", 1, index, 1, 0, value))
    host.wait(0.002)
    host.enable(2)
    for _ in range(500):
        host.command(2, 0x0F, 3, 400)
        host.wait(0.002)
    _, payload = host.can.receive()[-1]
    assert payload[0] & 0x6F == 0x27
    count = host.rig.robot.motor_boards[1].position_count
    assert count == pytest.approx(400, abs=3)


def test_the_camera_sees_the_tip_at_its_rate_with_its_noise() -> None:
    rig = SteppedRig(RIGHT, at_rest())
    receiver = CameraReceiver(rig.camera_port)
    rig.hand.seat(rig.tip_m())
    frames: list[CameraFrame] = []
    for k in range(1, 41):
        rig.clock.wait_until_s(0.01 * k)
        frames += receiver.receive()
    receiver.close()
    tip = rig.tip_m()
    rig.close()
    assert len(frames) == pytest.approx(40, abs=1)
    assert [b.sequence - a.sequence for a, b in itertools.pairwise(frames)] == [1] * (len(frames) - 1)
    off_m = [abs(seen.position_m[0] - tip[0]) for seen in frames]
    assert max(off_m) < 1e-3
    assert 0.00008 < sum(off_m) / len(off_m) < 0.00016  # mean of |noise| is 0.8 of 0.14 mm


def session(scenario: Scenario) -> tuple[bytes, list[tuple[int, bytes]], tuple[float, ...]]:
    """All bytes of a short session with a moving arm."""
    host = plug_in(scenario)
    host.serial.write(frame(b"\x02\x01" + struct.pack("<I", 2000)))
    host.enable(1, 2, 3)
    serial, can = b"", []
    for k in range(100):
        for node in (1, 2, 3):
            host.command(node, 0x0F, 1, 300 * (k % 7 - 3))
        host.wait(0.002)
        serial += host.serial.read()
        can += host.can.receive()
    end = host.rig.joint_rad()
    host.close()
    return serial, can, end


def test_the_same_seed_gives_the_same_bytes_and_another_seed_others() -> None:
    noisy = FaultTable("corrupt_frames", "encoder", probability=0.2)
    first = session(at_rest("demo", fault=(noisy,)))
    assert session(at_rest("demo", fault=(noisy,))) == first
    assert session(at_rest("demo", fault=(noisy,), seed=99))[:2] != first[:2]


def test_a_wait_longer_than_the_ports_buffer_leaves_the_newest_reports(host: Host) -> None:
    host.serial.write(frame(b"\x02\x01" + struct.pack("<I", 1000)))
    host.wait(5.0)
    board = EncoderBoard(host.serial, host.rig.clock, "enc0")
    board.update()
    assert board.latest is not None
    assert board.latest.board_time_us > 4_990_000


def reports(scenario: Scenario, duration_s: float = 0.4) -> EncoderBoard:
    """A host's encoder board after streaming for a while."""
    host = plug_in(scenario)
    board = EncoderBoard(host.serial, host.rig.clock, "enc0")
    host.serial.write(frame(b"\x02\x01" + struct.pack("<I", 2000)))
    for _ in range(round(duration_s / 0.01)):
        host.wait(0.01)
        board.update()
    host.close()
    return board


@pytest.mark.parametrize(("kind", "counter"), [("drop_frames", "lost"), ("corrupt_frames", "lost")])
def test_faults_of_the_line_are_counted_by_the_host(kind: str, counter: str) -> None:
    board = reports(at_rest(fault=(FaultTable(kind, "encoder", at_s=0.05, probability=0.3),)))
    assert 30 < getattr(board, counter) < 80
    assert board.reports > 100


def test_two_faults_at_once_each_act_and_each_end() -> None:
    both = (
        FaultTable("drop_frames", "encoder", at_s=0.05, until_s=0.2, probability=0.5),
        FaultTable("stuck_encoder", "encoder", channel=1, at_s=0.0),
    )
    board = reports(at_rest(fault=both))
    assert 20 < board.lost < 55
    assert board.latest is not None
    assert board.latest.counts[1] == 0


def test_a_silent_board_says_nothing_and_hears_nothing(host: Host) -> None:
    host.enable(1)
    host.rig.inject(FaultTable("silent", "motor1"))
    host.command(1, 0x0F, 1, 1000)
    host.wait(0.3)
    assert host.can.receive() == []
    host.rig.clear_faults()
    host.command(1, 0x0F, 1, 1000)
    host.wait(0.002)
    ((_, payload),) = host.can.receive()
    assert payload[7] == 16  # its watchdog has tripped meanwhile


def test_swapped_polarity_turns_the_joint_the_other_way() -> None:
    host = plug_in(at_rest(fault=(FaultTable("swapped_polarity", "motor1"),)))
    host.enable(1)
    for _ in range(30):
        host.command(1, 0x0F, 1, 2000)
        host.wait(0.002)
    assert host.rig.joint_rad()[0] < REST[0] - 0.01
    host.close()


def test_swapped_channels_count_each_others_joint() -> None:
    host = plug_in(at_rest(fault=(FaultTable("swapped_channels", "encoder", channel=0, value=2.0),)))
    host.enable(1)
    for _ in range(30):
        host.command(1, 0x0F, 1, 2000)
        host.wait(0.002)
    board = host.rig.robot.encoder_boards[0]
    assert abs(board.count(0)) < 100 < 500 < board.count(2)
    host.close()


@pytest.mark.parametrize(
    ("kind", "value", "field", "expected"),
    [
        ("wrong_identity", 4711.0, "serial_number", 4711),
        ("wrong_protocol", 9.0, "protocol", 9),
        ("wrong_counts", 4096.0, "counts_per_turn", (4096, 2048, 2048)),
    ],
)
def test_a_wrong_board_says_so_in_its_identity(kind: str, value: float, field: str, expected: object) -> None:
    scenario = at_rest(fault=(FaultTable(kind, "encoder", value=value),))
    rig = SteppedRig(RIGHT, scenario)
    assert getattr(rig.robot.encoder_boards[0].setup, field) == expected
    rig.close()


def test_a_board_reset_loses_zero_and_power_of_the_drive(host: Host) -> None:
    host.enable(1)
    host.rig.inject(FaultTable("board_reset", "motor1"))
    host.rig.inject(FaultTable("board_reset", "encoder"))
    host.wait(0.002)
    assert (0x281, bytes.fromhex("0000000001000000")) in host.can.receive()
    assert b"\x82" in host.serial.read()
    host.command(1, 0x0F, 1, 2000)
    host.wait(0.002)
    ((_, payload),) = host.can.receive()
    assert payload[0] & 0x6F == 0x40


@pytest.mark.parametrize("kind", sorted(kinds_of("motor") | kinds_of("encoder")))
def test_every_kind_of_fault_can_be_switched_on_and_off(kind: str) -> None:
    board = "motor2" if kind in kinds_of("motor") else "encoder"
    value = {"swapped_channels": 1.0, "swapped_motors": 1.0, "supply": 6.0}.get(kind, 7.0)
    late = 0.0 if KINDS[kind].is_built_in else 0.01
    rig = SteppedRig(RIGHT, at_rest(fault=(FaultTable(kind, board, at_s=late, until_s=0.02, value=value),)))
    rig.clock.wait_until_s(0.04)
    rig.close()


@pytest.mark.parametrize(
    ("fault", "message"),
    [
        (FaultTable("silnt", "encoder"), 'fault "silnt": expected one of backwards_encoder'),
        (FaultTable("silent", "motor7"), 'no board "motor7"; there are encoder, motor1, motor2, motor3, camera'),
        (FaultTable("delay_frames", "motor1"), 'needs "value"'),
        (FaultTable("silent", "motor1", at_s=2.0, until_s=1.0), "until_s = 1 is not after at_s = 2"),
        (FaultTable("wrong_counts", "encoder", at_s=1.0, value=1.0), "at_s must be 0, got 1"),
    ],
)
def test_a_fault_that_cannot_be_is_refused(host: Host, fault: FaultTable, message: str) -> None:
    with pytest.raises(ScenarioError, match=message):
        host.rig.inject(fault)


def test_a_homed_start_says_where_the_joints_are() -> None:
    scenario = msgspec.structs.replace(load_scenario("ideal"), start=Start(q_rad=REST, homed=True))
    board = reports(scenario, 0.02)
    assert board.latest is not None
    for count, q_rad, scale in zip(board.latest.counts, REST, COUNTS_PER_RAD, strict=True):
        assert count == pytest.approx(q_rad * scale, abs=200)
    assert all(flags & ChannelFlag.ZERO_SET for flags in board.latest.flags)


def test_the_hand_seats_the_tip_while_the_drives_brake(host: Host) -> None:
    x, y, z = host.rig.tip_m()
    goal = (x + 0.05, y - 0.03, z - 0.02)
    host.wait(host.rig.hand.seat(goal) + 0.1)
    assert host.rig.hand.state == "holding"
    assert math.dist(host.rig.tip_m(), goal) < 2e-5
    host.rig.hand.let_go()
    assert host.rig.hand.state == "away"
