"""Points without noise, of the very effects that are identified, lead to these effects and leave nothing."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from benchmarks.arms import FIVE
from benchmarks.calibration.chains import deviations
from benchmarks.gap.static.cases import Design, Hidden, designed
from calib.arm_problem.assembly import Choice
from calib.calibration import CalibrationPlan, calibrated_arm, identified
from calib.identify.objective import LeastSquares
from calib.points.points import Points, make_points
from calib.validation.verify import errors_of, predicted_tips
from control.model.arm import Arm, Effect, Tool
from tests.thirds import third_of

SOFT, SCALED = (Effect("joint_compliance", 2, {"stiffness_Nm_rad": 600.0}), Effect("encoder_scale", 1, {"scale": 0.006}))
BENT = Effect("link_flexure", 2, {"EI_Nm2": 140.0})
TURNED = Effect("encoder_eccentricity", 3, {"amplitude_rad": 0.005, "phase_rad": 0.4})
EXACT = Design(rig="six", free=40, visits=5, noise_m=0.0)

Case = tuple[Arm, Points, tuple[Effect, ...]]


def soft_and_scaled() -> Case:
    """Six joints by physics of their own, seen by a tracker that stands anywhere: gravity's direction is found, too."""
    hidden = Hidden("joint_compliance", 2, 600.0), Hidden("encoder_scale", 1, 0.006)
    return *designed(64, hidden, EXACT), (SOFT, SCALED)


def bent_with_a_tool_that_nobody_knows() -> Case:
    """Six joints, a link that gives way by 30 mm, a tool 70 mm from where it is thought to be."""
    arm, points = designed(48, (), EXACT)
    off = np.random.default_rng(3)
    true = dataclasses.replace(
        arm.with_dh(arm.dh + deviations(off, len(arm.links))), effects=(BENT,), tool=Tool((0.03, -0.02, 0.06))
    )
    return dataclasses.replace(arm, tool=Tool((0.0, 0.0, 0.0), known=False)), _seen(true, points), (BENT,)


def five_joints_soft_and_eccentric() -> Case:
    """Other joints, other masses, off their drawing."""
    off, arm = np.random.default_rng(4), dataclasses.replace(FIVE, table=None)
    q = off.uniform(-1.2, 1.2, (120, 5))
    kg = np.where(np.arange(120) % 2, 0.5, 0.0)
    names = [f"p{k}" for k in range(120)]
    points = make_points(
        ["free"] * 120, names, [1] * 120, q, np.zeros((120, 3)), np.sign(off.normal(size=q.shape)), payload_kg=kg
    )
    true = dataclasses.replace(arm.with_dh(arm.dh + deviations(off, len(arm.links))), effects=(SOFT, TURNED))
    return arm, _seen(true, points), (SOFT, TURNED)


def _seen(true: Arm, points: Points) -> Points:
    return dataclasses.replace(points, tip_m=predicted_tips(true, points))


@pytest.mark.parametrize(
    "case", third_of([soft_and_scaled, bent_with_a_tool_that_nobody_knows, five_joints_soft_and_eccentric], 2)
)
def test_what_acts_is_identified_to_a_millionth_where_nothing_scatters(case) -> None:
    arm, points, effects = case()
    keys = tuple(f"{effect.effect}:{effect.joint}" for effect in effects)
    plan = CalibrationPlan(Choice(effects=keys).for_points(arm, points), LeastSquares(), starts_count=1)
    made = calibrated_arm(arm, identified(arm, points, plan)[1], points)
    found = {(effect.effect, effect.joint): effect.parameters for effect in made.effects}
    for effect in effects:
        assert found[effect.effect, effect.joint] == pytest.approx(effect.parameters, rel=1e-6)
    assert np.abs(errors_of(made, points)).max() < 2e-7
