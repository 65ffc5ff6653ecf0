"""Motions and recording of the replay: poses approached gently from a given side, and cavities with the tip seated by hand."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from calib.arrays import Array
from calib.points.writer import PointsWriter, Record
from calib.session.plan import Target
from calib.session.sequence import BoardPoint
from calib.session.take import SessionSettings, take
from control.kinematics.inverse import InverseKinematics
from control.model.arm import Arm, Vector3
from control.server.client import ArmClient
from procedures.mock import MockBench
from procedures.ports import HandPort, RuntimePort

APPROACH_rad: Final = 0.06  # last approach of every joint: several times the backlash
# Of the joints' limits, for the approach. At full speed the links' inertia throws the gears onto the other flank when the arm
# brakes, which neither currents nor directions show; at 0.3, link friction brakes harder than the motors.
GENTLE: Final = 0.3
ABOVE_m: Final = 0.06  # an uncalibrated arm is some 3 cm off
DIP_m: Final = 0.02  # below both ends: a path that dips lower goes over the rest pose


@dataclass(frozen=True, slots=True)
class GentlePose:
    """Target encoder angles, and the sign of each joint's last motion."""

    setup: str
    point: str
    q_rad: tuple[float, ...]
    direction: tuple[int, ...]
    repeat: int = 1


class Mover:
    """The bench's arm, commanded in encoder angles: its runtime knows the nominal arm; identified errors are corrected here."""

    def __init__(self, arm: Arm, bench: MockBench, client: ArmClient) -> None:
        self._arm, self._client = arm, client
        self._inverse = InverseKinematics(arm)
        self._port = RuntimePort(client, bench.speed, as_encoders=True)
        self._gentle = RuntimePort(client, GENTLE * bench.speed, as_encoders=True)
        self._hand = HandPort(bench.rig.hand, bench.wait)

    @property
    def q_rad(self) -> tuple[float, ...]:
        """The pose by the encoders."""
        return tuple(self._client.status()["q_rad"])

    def visit(self, poses: Sequence[GentlePose], writer: PointsWriter) -> Iterator[Record]:
        """Approach each pose gently; read encoders, motors and camera."""
        for pose in poses:
            start = inside(self._arm, np.array(pose.q_rad) - APPROACH_rad * np.array(pose.direction))
            self._go(start)
            self._gentle.move_to_q(pose.q_rad)
            yield self._recorded(pose.setup, pose.point, pose.repeat, None, writer)

    def seat(self, points: Sequence[BoardPoint], writer: PointsWriter) -> Iterator[Record]:
        """Each cavity: move above it by the nominal model, then by hand with the drives off, as the authors did."""
        for point in points:
            x, y, z = (p + ABOVE_m * n for p, n in zip(point.tip_m, point.normal, strict=True))
            above = self._inverse.nearest((x, y, z), self.q_rad)
            self._port.move_to_q(above)
            try:
                self._port.release()
                self._hand.seat(point.tip_m)
                self._port.hold()
                record = self._recorded(point.setup, point.point, point.repeat, point.tip_m, writer)
            finally:
                self._port.hold()
                self._hand.let_go()
            self._port.move_to_q(above)
            yield record

    def _go(self, q_rad: Array) -> None:
        """Move quickly; over the rest pose if the straight path in joint angles dips towards the table."""
        here = np.array(self.q_rad)
        way = here + np.linspace(0.0, 1.0, 30)[:, None] * (q_rad - here)
        height_m = self._inverse.kinematics.tips(way)[:, 2]
        if self._arm.rest is not None and height_m.min() < min(height_m[0], height_m[-1]) - DIP_m:
            self._port.move_to_q(self._arm.rest.q_rad)
        self._port.move_to_q(q_rad.tolist())

    def _recorded(
        self, setup: str, point: str, repeat: int, tip_m: Vector3 | None, writer: PointsWriter
    ) -> Record:
        camera = self._port if tip_m is None else None
        record = take(Target(setup, point, repeat), tip_m, self._port, SessionSettings(), camera)
        writer.append(record)
        return record


def inside(arm: Arm, q_rad: Array) -> Array:
    """The angles within the joints' limits."""
    lower, upper = np.array(arm.limits_rad).T
    return np.clip(q_rad, lower, upper)
