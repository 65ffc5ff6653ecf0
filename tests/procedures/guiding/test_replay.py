"""A hand-guided motion as a path: from rest to rest, within limits, along the same way."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from control.errors import ArmError, MotionError
from control.kinematics.kinematics import ForwardKinematics
from control.motion.joint_limits import JointLimits
from control.safety.modes import Mode
from procedures.guiding import Guided, guided_motion, replayed
from tests.cell import RIGHT, STRETCHED, holding_cell
from tests.recordings import write_recording

LIMITS = JointLimits.of(RIGHT)
WAY = np.array([0.5, 0.3, -0.4])


def shown(duration_s: float, tremor_rad: float = 5e-4, reach: float = 1.0) -> Guided:
    """A hand stands, guides the arm out and half back, and stands, with a tremor of 9 Hz."""
    t = np.arange(0.0, duration_s + 1.0, 0.002)
    share = np.clip((t - 0.5) / duration_s, 0.0, 1.0)
    out = np.sin(0.75 * np.pi * (share - np.sin(2 * np.pi * share) / (2 * np.pi)))
    tremor = tremor_rad * np.sin(2 * np.pi * 9.0 * t)
    return Guided(3, t, np.array(STRETCHED) + np.outer(out, reach * WAY) + tremor[:, None])


def sampled(path: object, step_s: float = 0.002) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    times = np.arange(0.0, path.duration_s + step_s, step_s)  # type: ignore[attr-defined]
    points = [path.at(t) for t in times.tolist()]  # type: ignore[attr-defined]
    q, v, a = (np.array([point[k] for point in points]) for k in range(3))
    return q, v, a


@pytest.mark.parametrize(("duration_s", "speed"), [(4.0, 1.0), (0.5, 1.0), (2.0, 0.3)])
def test_the_path_begins_and_ends_at_rest_and_keeps_every_limit(duration_s: float, speed: float) -> None:
    planned = replayed(shown(duration_s), RIGHT, speed)
    q, v, a = sampled(planned.path)
    scaled = LIMITS.scaled(speed)
    assert not np.any(v[[0, -1]])
    assert not np.any(a[[0, -1]])
    assert (np.abs(v).max(axis=0) <= scaled.speed_rad_s).all()
    assert (np.abs(a).max(axis=0) <= scaled.acceleration_rad_s2).all()
    tips = ForwardKinematics(RIGHT).tips(q)
    assert np.linalg.norm(np.diff(tips, axis=0), axis=1).max() / 0.002 <= speed * RIGHT.limits.tip_speed_m_s
    assert bool(planned.limit) is (planned.slowdown > 1.0) is (duration_s < 4.0)


def test_the_tip_goes_the_way_that_the_hand_has_shown() -> None:
    guided = shown(4.0)
    q, _, _ = sampled(replayed(guided, RIGHT).path, 0.02)
    kinematics = ForwardKinematics(RIGHT)
    ways = kinematics.tips(guided.q_rad[::10])
    off_m = [np.linalg.norm(ways - tip, axis=1).min() for tip in kinematics.tips(q)]
    assert max(off_m) < 4e-3  # the tremor, and corners that smoothing cuts


def test_the_arm_runs_it() -> None:
    path = replayed(shown(1.0, reach=0.5), RIGHT).path
    with holding_cell() as cell:
        cell.client.move_joints(path.knots[0].q_rad)
        cell.client.run_path(path.to_message())
        assert cell.rig.joint_rad() == pytest.approx(path.knots[-1].q_rad, abs=2e-3)


def test_a_pose_outside_of_the_range_and_an_arm_that_hardly_moved_are_refused() -> None:
    with pytest.raises(ArmError, match=r"run 3: joint \d was guided to .* rad, outside of its range"):
        replayed(shown(4.0, reach=8.0), RIGHT)
    with pytest.raises(ArmError, match="hardly moved by hand"):
        replayed(shown(4.0, reach=0.0), RIGHT)


def test_a_way_below_the_floor_is_refused_before_the_arm_moves_to_its_beginning() -> None:
    guided = shown(4.0, reach=-1.0)
    heights = ForwardKinematics(RIGHT).tips(guided.q_rad)[:, 2]
    floor_m = 0.5 * float(heights[0] + heights.min())
    with pytest.raises(MotionError, match=r"below the floor .* mm deeper than allowed.*; nothing was moved"):
        replayed(guided, replace(RIGHT, table=None, limits=replace(RIGHT.limits, floor_z_m=floor_m)))


def recorded(folder: Path, modes: list[tuple[int, Mode]]) -> Path:
    """A recording of one row a cycle: run and mode."""
    rows = {k: {"run": run, "mode": list(Mode).index(mode), "q1_rad": 0.001 * k} for k, (run, mode) in enumerate(modes)}
    return write_recording(folder / f"{len(modes)}.armlog", len(modes), changes=rows)


def test_the_last_guided_run_is_taken_unless_another_is_named(tmp_path: Path) -> None:
    file = recorded(tmp_path, [(1, Mode.GUIDING)] * 5 + [(2, Mode.HOLDING)] * 5 + [(3, Mode.GUIDING)] * 7 + [(4, Mode.HOLDING)])
    assert len(guided_motion(file, RIGHT).times_s) == 7
    assert guided_motion(file, RIGHT, 1).q_rad[:, 0] == pytest.approx([0.0, 0.001, 0.002, 0.003, 0.004])
    with pytest.raises(ArmError, match="no hand-guided run 2: it has hand-guided runs 1, 3"):
        guided_motion(file, RIGHT, 2)
    with pytest.raises(ArmError, match="no hand-guided run: nothing in it was guided by hand"):
        guided_motion(recorded(tmp_path, [(1, Mode.HOLDING)] * 3), RIGHT)
