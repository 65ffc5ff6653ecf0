"""What lies ahead on a motion is looked at once, in order, early enough to rest before it."""

import copy

from control.motion.joint_limits import JointLimits
from control.motion.joint_move import JointMove
from control.motion.joint_path import JointPath
from control.motion.pace import Stretched
from control.motion.setpoint import AHEAD_s, Lookout, STEP_s, at_rest
from tests.cell import RIGHT

MOVE = JointMove((0.0, 0.0, 0.0), (2.0, 0.5, 0.5), JointLimits.of(RIGHT))


def test_every_part_of_a_motion_is_looked_at_once_and_before_the_arm_could_not_stop_ahead_of_it() -> None:
    lookout, seen, cycle = Lookout(MOVE), [], 0
    while (time_s := cycle * 0.002) < MOVE.duration_s:
        new = lookout.poses(time_s)
        assert len(new) <= 2
        seen += new
        if time_s > 0.04:  # two poses a cycle have got there
            assert len(seen) * STEP_s >= min(time_s + AHEAD_s, MOVE.duration_s) - 1e-9
        cycle += 1
    expected = [MOVE.at(STEP_s * k) for k in range(1, len(seen))]
    assert all(abs(a.q_rad[0] - b.q_rad[0]) < 1e-9 for a, b in zip(seen, expected, strict=False))
    assert seen[-1] == MOVE.at(MOVE.duration_s)
    assert lookout.poses(MOVE.duration_s) == []


def test_at_10_m_s2_no_tip_departs_further_from_the_chord_between_two_poses_than_a_fifth_of_a_millimetre() -> None:
    assert Lookout(MOVE).poses(0.0) == [MOVE.at(STEP_s), MOVE.at(2.0 * STEP_s)]
    assert 10.0 * STEP_s**2 / 8.0 < 0.2e-3


def test_looking_ahead_leaves_the_motion_of_the_arm_alone_a_stretched_one_too() -> None:
    """A path goes on from its last pose, so who looks ahead needs one of his own."""
    ends = [at_rest((0.1 * k,) * 3) for k in range(9)]
    path = JointPath((0.1 * k for k in range(9)), ends)
    motion = Stretched(path, 2.0 * path.duration_s)
    motion.at(0.0)
    before = copy.copy(path)
    Lookout(motion).poses(1.0)
    assert path._at == before._at
