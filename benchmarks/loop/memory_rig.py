"""A mock arm on links in memory with all bytes recorded, so that a second run can replay the boards.

The first run has the physics and the mock boards behind the links; later ones only replay what those sent, at the same
times. A host that behaves identically gets identical data, and the boards cost nothing during the measurement.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from benchmarks.loop.memory_link import MemoryBus, MemoryByteLink, MemoryFrameLink, byte_pair
from control.hardware.boards import BoardHardware, Opened
from control.hardware.connect import add_reference
from control.model.arm import Arm
from firmware_iface.clock import Clock
from firmware_iface.encoder.board import EncoderBoard
from firmware_iface.motor.board import MotorBoard
from firmware_iface.motor.bus import MotorBus
from hil_mocks.robot import MockRobot
from hil_mocks.scenario import Scenario

SLACK_S = 1e-9  # rounding of sums of ticks


@dataclass(frozen=True, slots=True)
class Delivery:
    """Data sent by the boards by a given time."""

    at_s: float
    serial: bytes
    frames: tuple[tuple[int, bytes], ...]


class LiveClock:
    """Waiting advances the mock arm, and records what it sends in `script`."""

    def __init__(self, robot: MockRobot, serial: MemoryByteLink, can: MemoryFrameLink) -> None:
        self.script: list[Delivery] = []
        self._robot, self._serial, self._can = robot, serial, can

    def now_s(self) -> float:
        """Simulated time."""
        return self._robot.now_s

    def wait_until_s(self, t: float) -> None:
        """Process the host's bytes, advance to `t`, deliver what was sent."""
        robot = self._robot
        received = self._serial.read()
        if received:
            robot.from_host_serial(0, received)
        for can_id, payload in self._can.receive():
            robot.from_host_can(can_id, payload)
        while robot.now_s < t - SLACK_S:
            robot.tick()
        sent = Delivery(robot.now_s, robot.serial_outgoing(0), tuple(robot.can_outgoing))
        robot.can_outgoing.clear()
        robot.camera_outgoing.clear()
        self.script.append(sent)
        _deliver(sent, self._serial, self._can)


class ScriptClock:
    """Waiting delivers the next entry of a script; the host's output is ignored."""

    def __init__(self, script: Sequence[Delivery], serial: MemoryByteLink, can: MemoryFrameLink) -> None:
        self._script: Iterator[Delivery] = iter(script)
        self._serial, self._can = serial, can
        self._now_s = 0.0

    def now_s(self) -> float:
        """Time of the last delivery."""
        return self._now_s

    def wait_until_s(self, t: float) -> None:
        """Advance to the next delivery."""
        self._serial.read()
        self._can.receive()
        sent = next(self._script)
        self._now_s = sent.at_s
        _deliver(sent, self._serial, self._can)


def _deliver(sent: Delivery, serial: MemoryByteLink, can: MemoryFrameLink) -> None:
    if sent.serial:
        serial.write(sent.serial)
    for can_id, payload in sent.frames:
        can.send(can_id, payload)


class MemoryRig:
    """The host's ends of the wires to an arm: simulated, or from a script."""

    def __init__(self, arm: Arm, scenario: Scenario, period_s: float, script: Sequence[Delivery] | None = None) -> None:
        bus = MemoryBus()
        self._serial, theirs = byte_pair()
        self._can, their_can = bus.join(), bus.join()
        live = LiveClock(MockRobot(arm, scenario), theirs, their_can) if script is None else None
        self.clock: Clock = live or ScriptClock(script or (), theirs, their_can)
        self.script: Sequence[Delivery] = live.script if live is not None else script or ()
        self.hardware = self._connected(arm, period_s)

    def _connected(self, arm: Arm, period_s: float) -> BoardHardware:
        """The hosts' drivers on the links, as control.hardware.connect makes them on ports."""
        encoder = EncoderBoard(self._serial, self.clock)
        encoder.identify()
        encoder.stream(0.5 * period_s)
        bus = MotorBus(self._can, self.clock)
        motors = [MotorBoard(bus, drive.motor_node) for drive in arm.drives]
        for motor in motors:
            motor.identify()
        opened = Opened(arm, self.clock, period_s)
        add_reference([encoder], [(bus, motor) for motor in motors], opened)
        return BoardHardware(opened)
