"""Arms that `armwright serve` runs, for LeRobot: a Robot and, guided by hand, a Teleoperator (docs/extras.md).

Values are those of LeRobot's own arms, so that a leader of the one kind leads a follower of the other: `<joint>.pos` is the
joint's angle in degrees, `gripper.pos` the opening in per cent of the travel. The loop keeps its limits, its watch and its
recording; what it refuses or stops is raised here.
"""

import contextlib
import math
from dataclasses import dataclass, field
from typing import Any

from lerobot.cameras import CameraConfig
from lerobot.cameras.utils import make_cameras_from_configs
from lerobot.robots import Robot, RobotConfig
from lerobot.teleoperators import Teleoperator, TeleoperatorConfig
from lerobot.utils.errors import DeviceAlreadyConnectedError, DeviceNotConnectedError

import armwright

GRIPPER = "gripper.pos"
GRIPPER_STEP_percent = 1.0  # less than this is no new request: the gripper notices nothing thinner, either
Values = dict[str, float]


@RobotConfig.register_subclass("armwright")
@dataclass(kw_only=True)
class ArmwrightConfig(RobotConfig):  # type: ignore[misc]
    """`arm` and `socket`: as of `armwright serve`. `cameras`: LeRobot's, read by LeRobot."""

    arm: str
    socket: str | None = None
    cameras: dict[str, CameraConfig] = field(default_factory=dict)


@TeleoperatorConfig.register_subclass("armwright")
@dataclass(kw_only=True)
class ArmwrightLeaderConfig(TeleoperatorConfig):  # type: ignore[misc]
    """`weightless`: the loop bears the arm's weight; otherwise the drives are off, and the arm falls if nobody holds it."""

    arm: str
    socket: str | None = None
    weightless: bool = False


class _Connection:
    """What robot and teleoperator share: the arm's names and values, and the connection to its loop."""

    def __init__(self, config: ArmwrightConfig | ArmwrightLeaderConfig) -> None:
        self._config = config
        self.arm = armwright.load_arm(config.arm)
        self.names = [f"{name.replace(' ', '')}.pos" for name in self.arm.joint_names]
        self.features = dict.fromkeys([*self.names, *([GRIPPER] if self.arm.gripper else [])], float)
        self._running: armwright.RunningArm | None = None

    @property
    def is_open(self) -> bool:
        return self._running is not None

    @property
    def running(self) -> armwright.RunningArm:
        if self._running is None:
            raise DeviceNotConnectedError(f"arm {self.arm.name!r} is not connected: call connect() first")
        return self._running

    def open(self) -> None:
        """Take control of an arm that is homed, and hold it where it stands. ArmwrightError if that is not to be had."""
        if self.is_open:
            raise DeviceAlreadyConnectedError(f"arm {self.arm.name!r} is connected already")
        running = armwright.connect(self._config.arm, self._config.socket)
        try:
            running.take_control()
            running.enable()  # the boards say then whether they know their zeros
            status = running.status()
            _require_sound(status, self.arm.name)
            if not status.is_homed:
                raise armwright.ArmError(
                    f"arm {self.arm.name!r} is not homed: find its zeros with `armwright home --arm {self._config.arm}`"
                )
            if self.arm.gripper and running.grip().opening_m is None:
                raise armwright.ArmError(
                    f"arm {self.arm.name!r}: the gripper's opening is not known yet: open it once with"
                    f" `armwright gripper open --arm {self._config.arm}`"
                )
        except BaseException:
            running.close()
            raise
        self._running = running

    def read(self, status: armwright.Status) -> Values:
        values = dict(zip(self.names, map(math.degrees, status.joint_rad), strict=True))
        if (gripper := self.arm.gripper) is not None:
            opening_m = self.running.grip().opening_m
            values[GRIPPER] = math.nan if opening_m is None else 100.0 * opening_m / gripper.travel_m
        return values

    def close(self) -> None:
        """Let the arm hold where it is, and disconnect; also from a loop that is gone."""
        running, self._running = self.running, None
        with contextlib.closing(running), contextlib.suppress(armwright.ArmwrightError):  # then it rests already
            if running.status().mode == "GUIDING":
                running.hold()
            else:
                running.stop()


class _CalibratedByLoop:
    """What LeRobot asks of its own arms, and the loop of this one has done."""

    @property
    def is_calibrated(self) -> bool:
        """Always: the loop has zeros and calibration, and `connect` refuses an arm that is not homed."""
        return True

    def calibrate(self) -> None:
        """Nothing: `armwright home` and `armwright calibrate` do."""

    def configure(self) -> None:
        """Nothing: arm.toml does."""


class Armwright(_CalibratedByLoop, Robot):  # type: ignore[misc]
    """A follower: joints go after the actions within the limits of jogs, and come to rest when actions cease."""

    config_class = ArmwrightConfig
    name = "armwright"

    def __init__(self, config: ArmwrightConfig) -> None:
        super().__init__(config)
        self._connection = _Connection(config)
        self._range_rad = self._connection.arm.limits_rad
        self._gripper_percent = math.inf  # that was asked for last
        self.cameras = make_cameras_from_configs(config.cameras)

    @property
    def observation_features(self) -> dict[str, Any]:
        """Joints, gripper and pictures."""
        pictures = {name: (camera.height, camera.width, 3) for name, camera in self.cameras.items()}
        return {**self._connection.features, **pictures}

    @property
    def action_features(self) -> dict[str, Any]:
        """Joints and gripper."""
        return dict(self._connection.features)

    @property
    def is_connected(self) -> bool:
        """Whether `connect` has been called."""
        return self._connection.is_open and all(camera.is_connected for camera in self.cameras.values())

    def connect(self, calibrate: bool = True) -> None:
        """Take the arm over as the loop has it, and hold it where it stands; nothing moves."""
        self._connection.open()
        self._gripper_percent = math.inf
        try:
            for camera in self.cameras.values():
                camera.connect()
        except BaseException:
            self.disconnect()
            raise

    def get_observation(self) -> dict[str, Any]:
        """Measured angles and opening, newest pictures. ArmFaulted, RuntimeGone."""
        status = self._connection.running.status()
        _require_sound(status, self._connection.arm.name)
        pictures = {name: camera.read_latest() for name, camera in self.cameras.items()}
        return {**self._connection.read(status), **pictures}

    def send_action(self, action: dict[str, Any]) -> dict[str, Any]:
        """Go after these angles and this opening; what is returned is within the ranges.

        To be called at 10 Hz or faster; after a pause the arm goes on. MotionStopped if somebody stopped it, ArmFaulted,
        RequestRefused, RuntimeGone.
        """
        names = self._connection.names
        goal_rad = [
            min(max(math.radians(action[name]), lower), upper)
            for name, (lower, upper) in zip(names, self._range_rad, strict=True)
        ]
        running = self._connection.running
        running.follow(goal_rad)
        sent = dict(zip(names, map(math.degrees, goal_rad), strict=True))
        if (gripper := self._connection.arm.gripper) is not None:
            percent = min(max(float(action[GRIPPER]), 0.0), 100.0)
            if abs(percent - self._gripper_percent) >= GRIPPER_STEP_percent:
                running.grip(opening_m=0.01 * percent * gripper.travel_m, wait=False)
                self._gripper_percent = percent
            sent[GRIPPER] = percent
        return sent

    def disconnect(self) -> None:
        """The arm stops and holds; `armwright off` lowers it."""
        try:
            self._connection.close()
        finally:
            for camera in self.cameras.values():
                if camera.is_connected:
                    camera.disconnect()


class ArmwrightLeader(_CalibratedByLoop, Teleoperator):  # type: ignore[misc]
    """A leader: a hand guides the arm, its angles are the actions."""

    config_class = ArmwrightLeaderConfig
    name = "armwright"

    def __init__(self, config: ArmwrightLeaderConfig) -> None:
        super().__init__(config)
        self._weightless = config.weightless
        self._connection = _Connection(config)

    @property
    def action_features(self) -> dict[str, Any]:
        """Joints and gripper."""
        return dict(self._connection.features)

    @property
    def feedback_features(self) -> dict[str, Any]:
        """None."""
        return {}

    @property
    def is_connected(self) -> bool:
        """Whether `connect` has been called."""
        return self._connection.is_open

    def connect(self, calibrate: bool = True) -> None:
        """Take the arm over and let a hand guide it; unless `weightless`, somebody must hold it."""
        self._connection.open()
        try:
            self._connection.running.guide(weightless=self._weightless)
        except BaseException:
            self.disconnect()
            raise

    def get_action(self) -> dict[str, Any]:
        """Measured angles and opening. MotionStopped if hand guiding has ended, ArmFaulted, RuntimeGone."""
        status = self._connection.running.status()
        _require_sound(status, self._connection.arm.name)
        if status.mode != "GUIDING":
            raise armwright.MotionStopped(
                f"hand guiding of arm {self._connection.arm.name!r} has ended: it is {status.mode}; connect again"
            )
        return self._connection.read(status)

    def send_feedback(self, feedback: dict[str, Any]) -> None:
        """Nothing is felt."""

    def disconnect(self) -> None:
        """The arm holds where it is; `armwright off` lowers it."""
        self._connection.close()


def _require_sound(status: armwright.Status, arm: str) -> None:
    if status.mode == "FAULT":
        raise armwright.ArmFaulted(
            f"arm {arm!r} is in FAULT: {'; '.join(status.faults)}; then `armwright acknowledge` and connect again"
        )
