"""A running arm: a client of `armwright serve` over its local socket."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from armwright.kinematics import Kinematics
from armwright.motion import Trajectory
from control.errors import ArmError, BadTarget
from control.hardware.measurement import Average
from control.model.arm import Arm
from control.model.description import load_arm
from control.server.channel import SocketChannel
from control.server.client import ArmClient, ArmFaulted, fault_text
from control.server.server import default_path
from firmware_iface.link import Closing

Array = NDArray[np.float64]
APPROACH_SPEED = 0.5  # of the joints' limits, for the move to the start of a path


@dataclass(frozen=True, slots=True)
class Status:
    """State of the arm at the loop's time `t_s`.

    `mode`: `armwright status --modes` explains it. joint_rad, encoder_rad (they differ if the arm's file has backlash, compliance
    or encoder errors), speed_rad_s, current_A: (n,). tip_m (3,) and tip_pose (7,), as of `Kinematics.pose`, in the base frame by
    the model, None before homing; camera_m (3,) by the camera, None without a fresh frame. `faults` and `warnings` are sentences.
    """

    mode: str
    t_s: float
    is_homed: bool
    joint_rad: Array
    encoder_rad: Array
    speed_rad_s: Array
    current_A: Array
    tip_m: Array | None
    tip_pose: Array | None
    camera_m: Array | None
    faults: tuple[str, ...]
    warnings: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class GripperState:
    """What the gripper does.

    `state` is one of OFF, HOLDING, MOVING, OPEN, CLOSED, GRIPPED, STOPPED, RELEASED, FAILED; `text` says it in words.
    opening_m: None while unknown. force_N: by the motor's current, without friction. has_lost: what it held, since then.
    """

    state: str
    text: str
    opening_m: float | None
    force_N: float
    has_lost: bool


class RunningArm(Closing):
    """A running arm, from `connect` or `mock_arm`; a context manager that disconnects on exit.

    Methods that move return when the arm is at rest at the target. A motion that this connection started is stopped when the
    connection ends, for whatever reason. They raise:

        RequestRefused: the loop refused the request; nothing has moved.
        ArmFaulted: the arm stopped and is in FAULT; the message says why.
        MotionStopped: the motion was stopped before its end.
        RuntimeGone: the loop does not answer.
    """

    def __init__(self, client: ArmClient, arm: Arm) -> None:
        """`arm`: the description used by the loop."""
        self._arm = arm
        self._client = client

    @property
    def arm(self) -> Arm:
        """The arm, with the tool on that the loop has on now."""
        on = self._client.status()["tool"]
        return self._arm.with_tool(on) if on else self._arm

    def tool(self, name: str) -> None:
        """Another of the arm's tools is on: the tip is its. The arm must be at rest, or RequestRefused."""
        self._client.tool(name)

    def status(self) -> Status:
        """The present state of the arm."""
        now = self._client.status()
        return Status(
            now["mode"],
            now["t_s"],
            now["is_homed"],
            _array(now["joint_rad"]),
            _array(now["q_rad"]),
            _array(now["speed_rad_s"]),
            _array(now["current_A"]),
            None if now["tip_m"] is None else _array(now["tip_m"]),
            None if now["tip_m"] is None else _array([*now["tip_m"], *now["tip_orientation"]]),
            None if now["camera_m"] is None else _array(now["camera_m"]),
            tuple(f"{fault['where']}: {fault['message']}; {fault['remedy']}" for fault in now["faults"]),
            tuple(now["warnings"]),
        )

    @property
    def joint_rad(self) -> Array:
        """Present joint angles (n,) [rad]; valid once the arm is homed."""
        return self.status().joint_rad

    @property
    def tip_m(self) -> Array:
        """Present tip position (3,) [m] in the base frame by the model. ArmError before homing."""
        tip = self.status().tip_m
        if tip is None:
            raise ArmError(f"arm {self._arm.name}: the tip position is unknown before homing: call home()")
        return tip

    @property
    def recording(self) -> Path:
        """The file to which the loop records every cycle; relative to the loop's working directory unless absolute."""
        return Path(self._client.status()["recording"])

    def enable(self) -> None:
        """Switch the drives on; the arm holds its pose."""
        if self._client.status()["mode"] != "HOLDING":
            self._client.enable()

    def home(self, timeout_s: float = 120.0) -> None:
        """Home every joint, one after the other; returns at once if the boards still have their zeros."""
        self._client.home(timeout_s)

    def move_joints(self, joint_rad: Sequence[float] | Array, speed: float = 0.5, *, wait: bool = True) -> None:
        """Move to joint angles (n,) [rad], all joints arriving together; `speed` is a fraction of the joints' limits.

        With `wait=False` it returns at once; `wait_until_holding` then waits for the end.
        """
        self._client.move_joints(_numbers(joint_rad, self._arm.joint_count, "joint_rad"), speed, wait)

    def move_tip(self, tip_m: Sequence[float] | Array, speed: float = 0.5, *, wait: bool = True) -> None:
        """Move the joints so that the tip ends at a position (3,) or pose (7,), as of `Kinematics`; its path is not straight.

        OutOfReach, JointLimitViolated or NearSingular if there is no such pose; nothing has moved then.
        """
        target = Kinematics(self.arm).inverse(tip_m, self._client.status()["joint_rad"])
        self._client.move_joints(_numbers(target, self._arm.joint_count, "tip_m"), speed, wait)

    def run(self, trajectory: Trajectory, *, wait: bool = True) -> None:
        """Move to the start of a planned path at half speed, then run the path; ArmError if it is another arm's or tool's.

        With `wait=False` it returns when the path has started.
        """
        self._client.require_arm(trajectory.arm)
        planned, on = trajectory.arm.tool.name, self._client.status()["tool"]
        if planned != on:
            raise ArmError(f"the path is for the tip of tool {planned!r}, but {on!r} is mounted: plan it again")
        self._client.move_joints(trajectory.start_rad, APPROACH_SPEED)
        self._client.run_path(trajectory.path.to_message(), wait, tool=planned)

    def follow(self, joint_rad: Sequence[float] | Array, speed_rad_s: Sequence[float] | Array | None = None) -> str:
        """Jog after joint angles (n,) [rad] that move on, such as those of another arm or a policy; returns what limited it.

        `speed_rad_s` (n,): how fast they move, if that is known; else the arm lags by a sixth of a second. Call it at 10 Hz or
        faster: without a call for `[limits] jog_silence_s` the arm comes to rest and holds, and the next call goes on.
        MotionStopped if somebody has stopped the arm since the last call; the call after that begins anew.
        """
        count = self._arm.joint_count
        speeds = None if speed_rad_s is None else _numbers(speed_rad_s, count, "speed_rad_s")
        return self._client.follow(_numbers(joint_rad, count, "joint_rad"), speeds)

    def jog_joint(self, joint: int, by_rad: float) -> str:
        """Move one joint (1-based) by an angle; returns what limited the motion as text, or ""."""
        return self._client.jog(joint=joint, by_rad=by_rad)

    def jog_tip(self, axis: Literal["x", "y", "z"], by_m: float) -> str:
        """Move the tip along an axis of the base frame; returns what limited the motion as text, or ""."""
        return self._client.jog(axis=axis, by_m=by_m)

    def grip(
        self,
        action: Literal["open", "close"] | None = None,
        *,
        opening_m: float | None = None,
        force_N: float | None = None,
        wait: bool = True,
    ) -> GripperState:
        """Open or close the gripper, or go to an opening, with a force [N]; by default that of the arm's file.

        Returns its state when it has come to its end or holds something. Without arguments, nothing moves.
        """
        if action is None and opening_m is None:
            return _gripper_state(self._client.status()["gripper"], self._arm)
        if action is not None and opening_m is not None:
            raise BadTarget("grip: give either an action or opening_m")
        return _gripper_state(self._client.grip(action or "move", opening_m, force_N, wait), self._arm)

    def digital(self) -> dict[str, bool | None]:
        """Levels of the named pins; None while a board does not say."""
        return {name: pin["level"] for name, pin in self._client.status()["digital"].items()}

    def set_output(self, name: str, level: bool) -> None:
        """Set a digital output. RequestRefused while the drives are off or the arm is in FAULT."""
        self._client.set_output(name, level)

    def stop(self) -> None:
        """Controlled stop; returns when the arm holds. Not a replacement for an emergency stop."""
        self._client.stop()

    def pause(self) -> None:
        """Slow the motion to rest on its path; `resume` continues it."""
        self._client.pause()

    def resume(self) -> None:
        """Continue after `pause`."""
        self._client.resume()

    def wait_until_holding(self, timeout_s: float = 60.0) -> None:
        """Wait for the end of a motion that was started with `wait=False`. ArmError after `timeout_s`."""
        self._client.arrive(timeout_s)

    def guide(self, *, weightless: bool = False) -> None:
        """Start hand guiding: the drives turn off, so somebody must hold the arm first. `hold` ends it.

        `weightless`: gravity compensation by the model, of an arm that is homed.
        """
        self._client.guide(weightless)

    def hold(self) -> None:
        """End hand guiding; the arm holds its pose."""
        self._client.hold()

    def measure(self, duration_s: float) -> Average:
        """Means over `duration_s` at rest: encoder angles, currents and, with a camera, the tip in the base frame."""
        return self._client.average(duration_s)

    def take_control(self) -> None:
        """Keep control between motions until the connection ends: other clients may only watch and stop meanwhile."""
        self._client.take_control()

    def acknowledge(self) -> None:
        """Confirm the faults after their cause is gone; the arm may be enabled again."""
        self._client.acknowledge()

    def off(self, lets_go: bool = False) -> None:
        """Stop, lower the arm to rest with shorted windings, switch the drives off. The loop keeps running.

        `lets_go`: also of an arm that its boards held when the loop connected; it falls, so somebody must hold it.
        """
        self._client.off(lets_go=lets_go)

    def wait(self, duration_s: float) -> None:
        """Let time pass on the loop's clock; on a stepped mock arm, time passes only during calls."""
        self._client.wait(duration_s)
        status = self._client.status()
        if status["mode"] == "FAULT":
            raise ArmFaulted(fault_text(status))

    def close(self) -> None:
        """Disconnect. A motion that this connection started is stopped; the loop keeps running."""
        self._client.close()


def connect(arm: Arm | str | Path, socket: str | Path | None = None, timeout_s: float = 2.0) -> RunningArm:
    """Connect to the loop that runs `arm`: the same file or name as for `armwright serve --arm`.

    Args:
        arm: an Arm, the path of an arm.toml, or the name of a supplied arm.
        socket: of the loop, if `armwright serve --socket` set another than the default.
        timeout_s: longest wait for an answer.

    Raises:
        RuntimeGone: no loop answers.
        ArmFileError: the file is not usable.
        AnotherArm: the loop runs another arm; the message has the keys and both values.
    """
    described = arm if isinstance(arm, Arm) else load_arm(arm)
    path = Path(socket) if socket is not None else default_path(described.name)
    client = ArmClient(SocketChannel(path, timeout_s))
    try:
        client.require_arm(described)
    except BaseException:
        client.close()
        raise
    return RunningArm(client, described)


def _gripper_state(gripper: dict[str, Any] | None, arm: Arm) -> GripperState:
    if gripper is None:
        raise ArmError(f"arm {arm.name}: its file describes no gripper: add a [gripper]")
    return GripperState(gripper["state"], gripper["text"], gripper["opening_m"], gripper["force_N"], gripper["has_lost"])


def _array(values: Any) -> Array:
    return np.array(values, dtype=np.float64)


def _numbers(values: Sequence[float] | Array, count: int, what: str) -> list[float]:
    """`values` as plain numbers; BadTarget unless they are `count` finite ones."""
    array = np.asarray(values, dtype=np.float64)
    if array.shape != (count,) or not np.isfinite(array).all():
        raise BadTarget(f"{what}: expected {count} finite numbers, got {array.tolist()}")
    return [float(value) for value in array]
