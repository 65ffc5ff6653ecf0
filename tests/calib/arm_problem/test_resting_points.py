"""Loads act at the joints' angles of the arm as it is, not at the encoders' angles of the arm as it was drawn."""

import dataclasses

import numpy as np

from benchmarks.gap.static.cases import Design, designed
from calib.arm_problem.joint_effects import known_corrections, resting_points
from control.dynamics.static_pose import gravity_Nm
from control.model.arm import Effect


def test_loads_are_those_at_the_joints_angles_that_the_arms_effects_give() -> None:
    arm, points = designed(61, (), Design(rig="six", free=12, visits=2, has_payload=False))
    soft = Effect("joint_compliance", 2, {"stiffness_Nm_rad": 400.0})
    arm = dataclasses.replace(arm, effects=(Effect("encoder_scale", 2, {"scale": 0.02}), soft))
    q = np.array(points.q_rad)
    for _ in range(40):  # the load that turns a joint is that where it has come to rest
        q[:, 1] = 1.02 * points.q_rad[:, 1] - gravity_Nm(arm, q)[:, 1] / 400.0
    at = resting_points(arm, points)
    np.testing.assert_allclose(at.joint_rad, q, atol=1e-10)
    np.testing.assert_allclose(at.gravity_Nm(2), gravity_Nm(arm, q)[:, 1], atol=1e-8)
    assert np.abs(at.gravity_Nm(2) - gravity_Nm(arm, points.q_rad)[:, 1]).max() > 0.5
    softened = known_corrections(arm, points)[:, 1] - 0.02 * points.q_rad[:, 1]
    np.testing.assert_allclose(softened, -at.gravity_Nm(2) / 400.0, atol=1e-10)
