"""A Gymnasium environment: the tip of a mock arm is to reach a target (docs/extras.md). Needs the extra `gymnasium`.

Nothing of the runtime is left out: each step is a jog request to the real loop, which moves the simulated arm through the
boards' bytes within its limits of range, speed, acceleration, jerk and workspace, and goes to FAULT as on a real arm.
"""

from __future__ import annotations

import contextlib
import dataclasses
import math
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import msgspec
import numpy as np
from numpy.typing import ArrayLike, NDArray

from armwright.mock import MockArm
from control.errors import ArmError, BadTarget
from control.kinematics.kinematics import ForwardKinematics
from control.model.arm import Arm
from control.model.description import load_arm
from control.motion.guard import Guard
from control.motion.joint_limits import JogLimits, JointLimits, reach_m
from control.server.client import RequestRefused
from hil_mocks.scenario import load_scenario
from procedures.folders import free_folder
from procedures.mock import SteppedBench

try:
    import gymnasium
    from gymnasium.spaces import Box, Dict
except ImportError as error:
    raise ImportError(
        "armwright.environment: gymnasium, an extra, is not installed: in the clone, .venv/bin/pip install -e '.[gymnasium]'"
    ) from error

Array = NDArray[np.float32]
Observation = dict[str, Any]  # of Array, as Gymnasium's Dict has it
RANGE_SHARE: Final = 0.8  # of each joint's range, for starts and targets: away from the ends
CLEARANCE_m: Final = 0.03  # of starts and targets, from floor and base: the arm sinks by 10 mm until its drives are on
DRAWS_MOST: Final = 1000
SPEED_MARGIN: Final = 1.5  # beyond the joint's speed limit, where the loop takes a joint for a runaway


class ReachEnvironment(gymnasium.Env[Observation, Array]):
    """Bring the tip of a mock arm within `tolerance_m` of a target; n joints.

    Action (n,): joint speeds [rad/s], at most those of a jog. Observation, float32: `joint_rad`, `speed_rad_s`, `current_A`
    (n,) and `tip_m` (3,) in the base frame, all as measured, and `target_m` (3,). Values beyond their space are clipped.

    Reward: minus the true distance of tip and target [m]. An episode terminates at the target, truncates after `steps`, and
    terminates when the arm faults, with the reward of standing there for all steps that were left: a fault never pays.

    `info`: `distance_m` and `is_success`; `limited`, the reason why the loop slowed or refused the motion, or ""; `faults`.
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012  as Gymnasium declares it

    def __init__(
        self,
        arm: Arm | str | Path = "right",
        scenario: str | Path = "ideal",
        *,
        period_s: float = 0.05,
        steps: int = 200,
        tolerance_m: float = 0.005,
        folder: str | Path | None = None,
    ) -> None:
        """Nothing runs before `reset`.

        Args:
            arm: an Arm, the path of an arm.toml, or the name of a supplied arm.
            scenario: what the mock hides from the loop, as of `mock_arm`.
            period_s: of a step; below `[limits] jog_silence_s`, after which the loop ends a jog by itself.
            steps: of an episode.
            tolerance_m: distance at which the target counts as reached.
            folder: for recordings, one subfolder an episode; without it they are deleted.

        Raises:
            ArmFileError, ArmError, MockError: arm, choice or scenario is not usable.
        """
        self._arm = arm if isinstance(arm, Arm) else load_arm(arm)
        _require_usable(self._arm, period_s, steps, tolerance_m)
        self._scenario = load_scenario(scenario)
        self._period_s, self._steps, self._tolerance_m = period_s, steps, tolerance_m
        self._folder = Path(folder) if folder is not None else None
        self._limits, self._kinematics = JointLimits.of(self._arm), ForwardKinematics(self._arm)
        self._guard = Guard(_with_clearance(self._arm), self._limits)
        speed = np.array(JogLimits.of(self._arm).joints.speed_rad_s, dtype=np.float32)
        self.action_space = Box(-speed, speed, dtype=np.float32)
        self._boxes = _observed(self._arm, self._limits)
        self.observation_space = Dict(dict(self._boxes))
        self._stack = contextlib.ExitStack()
        self._episode = self._taken = 0

    @property
    def mock(self) -> MockArm:
        """The mock arm of this episode: its true state, its payload."""
        return self._mock

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Observation, dict[str, Any]]:
        """Power a new mock arm up at a random pose and switch its drives on; `options` are not used.

        An episode follows from its seed and its actions alone.
        """
        super().reset(seed=seed)
        self.close()
        self._episode, self._taken = self._episode + 1, 0
        start_rad, (self._target_m,) = self._free_pose(), self._kinematics.tips([self._free_pose()])
        self._power_up(start_rad)
        return self._seen("")[:2]

    def step(self, action: ArrayLike) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Move the joints at these speeds for one period. BadTarget unless they are n finite numbers."""
        speeds = np.asarray(action, dtype=np.float64)
        if speeds.shape != self.action_space.shape or not np.isfinite(speeds).all():
            raise BadTarget(f"action: expected {self._arm.joint_count} finite speeds [rad/s], got {np.asarray(action).tolist()}")
        try:
            limited = str(self._client.ask("jog", joint_speed_rad_s=speeds.tolist())["limited"])
        except RequestRefused as refused:  # nothing moves
            limited = str(refused)
        self._client.wait(self._period_s)
        self._taken += 1
        observation, info, is_faulted = self._seen(limited)
        remaining_steps = max(1, self._steps - self._taken + 1) if is_faulted else 1
        ends = is_faulted or info["is_success"]
        return observation, -remaining_steps * info["distance_m"], ends, self._taken >= self._steps and not ends, info

    def close(self) -> None:
        """Cut the mock arm's power and end its recording."""
        self._stack.close()

    def _power_up(self, start_rad: Sequence[float]) -> None:
        start = msgspec.structs.replace(self._scenario.start, q_rad=tuple(start_rad), homed=True)
        scenario = msgspec.structs.replace(self._scenario, start=start)
        if self._folder is None:
            log = Path(self._stack.enter_context(tempfile.TemporaryDirectory(prefix="armwright-episode-")))
        else:
            log = free_folder(self._folder / f"episode-{self._episode:05d}")
        bench = SteppedBench(self._arm, scenario, log)
        self._stack.callback(bench.close)
        self._client = bench.start(self._arm)
        self._mock = MockArm(self._client, self._arm, bench.rig)
        self._mock.enable()
        self._mock.home()

    def _seen(self, limited: str) -> tuple[Observation, dict[str, Any], bool]:
        """Observation, info, and whether the arm is in FAULT."""
        status = self._mock.status()
        values = {
            "joint_rad": status.joint_rad,
            "speed_rad_s": status.speed_rad_s,
            "current_A": status.current_A,
            "tip_m": status.tip_m,
            "target_m": self._target_m,
        }
        observation = {
            name: np.clip(np.asarray(values[name], dtype=np.float32), box.low, box.high) for name, box in self._boxes.items()
        }
        distance_m = math.dist(self._mock.true_tip_m(), self._target_m)
        info = {
            "distance_m": distance_m,
            "is_success": distance_m <= self._tolerance_m,
            "limited": limited,
            "faults": status.faults,
        }
        return observation, info, status.mode == "FAULT"

    def _free_pose(self) -> tuple[float, ...]:
        """Random joint angles (n,) [rad] clear of floor, table and own base."""
        lower = np.clip(self._limits.lower_rad, -math.pi, None)
        upper = np.clip(self._limits.upper_rad, None, math.pi)
        middle, half = 0.5 * (lower + upper), 0.5 * RANGE_SHARE * (upper - lower)
        for _ in range(DRAWS_MOST):
            pose = tuple(self.np_random.uniform(middle - half, middle + half).tolist())
            if self._guard.clearance(pose).distance_m >= 0.0:
                return pose
        raise ArmError(
            f"arm {self._arm.name}: none of {DRAWS_MOST} random poses is clear of floor, table and base:"
            " check [limits] and [table] of arm.toml"
        )


def _require_usable(arm: Arm, period_s: float, steps: int, tolerance_m: float) -> None:
    silence_s = arm.limits.jog_silence_s
    if not 1.0 / arm.usual_rate_Hz <= period_s < silence_s:
        raise ArmError(
            f"period_s: expected at least a cycle and less than [limits] jog_silence_s, {silence_s:g} s; got {period_s:g} s"
        )
    if steps < 1:
        raise ArmError(f"steps: expected 1 or more, got {steps}")
    if not tolerance_m > 0.0:
        raise ArmError(f"tolerance_m: expected above 0, got {tolerance_m:g}")


def _with_clearance(arm: Arm) -> Arm:
    """The arm with a smaller workspace."""
    limits = dataclasses.replace(
        arm.limits,
        floor_clearance_m=arm.limits.floor_clearance_m + CLEARANCE_m,
        floor_tolerance_m=0.0,
        base_radius_m=arm.limits.base_radius_m + CLEARANCE_m,
    )
    return dataclasses.replace(arm, limits=limits)


def _observed(arm: Arm, limits: JointLimits) -> dict[str, Box]:
    """The space of each part of an observation, in SI units: what the arm can have without a fault."""
    speed = SPEED_MARGIN * np.array(limits.speed_rad_s)
    current = np.array([arm.drive(joint).current_limit_A for joint in range(1, arm.joint_count + 1)])
    reach = np.full(3, reach_m(arm))
    return {
        "joint_rad": _box(limits.lower_rad, limits.upper_rad),
        "speed_rad_s": _box(-speed, speed),
        "current_A": _box(-current, current),
        "tip_m": _box(-reach, reach),
        "target_m": _box(-reach, reach),
    }


def _box(lower: ArrayLike, upper: ArrayLike) -> Box:
    return Box(np.asarray(lower, dtype=np.float32), np.asarray(upper, dtype=np.float32), dtype=np.float32)
