"""An identification problem in which everything is unknown that can be."""

import numpy as np

from benchmarks.calibration.chains import MODIFIED, MODIFIED_DH, REFERENCE, REFERENCE_DH
from calib.arm_problem.arm_model import ArmModel
from calib.arm_problem.observations import Correction, Frame, Observations, rotation_of
from calib.arm_problem.problem import ArmProblem
from tests.calib.arms import arm_of

ARMS = {"reference": (REFERENCE, REFERENCE_DH), "modified": (MODIFIED, MODIFIED_DH)}


def problem_with_everything_free(name: str, rng) -> ArmProblem:
    """Tool, base, two boards and two corrections are unknown beside the DH table."""
    model, dh = ARMS[name]
    m, n = 30, sum(model.joints)
    q = rng.uniform(-1.0, 1.0, (m, n))
    frames = (
        Frame.base(is_free=True),
        Frame("one", rotation_of(rng.normal(size=3)), rng.normal(size=3), is_free=True),
        Frame("kept", rotation_of(rng.normal(size=3)), rng.normal(size=3)),
        Frame("two", rotation_of(rng.normal(size=3)), rng.normal(size=3), is_free=True),
    )
    corrections = (
        Correction("scale1", "", q * np.eye(n)[0], 0.02),
        Correction("backlash2", "rad", -0.5 * np.sign(rng.normal(size=(m, 1))) * np.eye(n)[1], 0.02, 0.001),
    )
    observed = Observations(q, rng.normal(size=(m, 3)), np.arange(m, dtype=np.intp) % 4, frames, corrections=corrections)
    return ArmProblem(ArmModel(arm_of(model, dh)), observed, is_tool_free=True, fixed=("theta1", "one_y"))
