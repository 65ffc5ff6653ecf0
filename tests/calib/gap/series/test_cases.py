"""Cases of the score are what they say, however many are made at once."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.gap.dynamic.cases import Asked, Case, Conditions, made
from benchmarks.gap.dynamic.score import GROUPS, arm_of, log_of, plan
from control.kinematics.kinematics import ForwardKinematics

SHORT = Conditions(seconds=0.3)


@pytest.fixture(scope="module")
def together() -> list[Case]:
    asked = [Asked(1, "encoder_scale", 1), Asked(2, "encoder_eccentricity", 2), Asked(3, "backlash", 3)]
    return list(made(asked, SHORT))


def test_a_case_is_the_same_beside_others_as_alone(together: list[Case]) -> None:
    alone = next(iter(made([Asked(1, "encoder_scale", 1)], SHORT)))
    for one, other in zip(alone.runs, together[0].runs, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-6)


def test_a_hidden_encoder_scale_turns_the_joint_further_than_it_says(together: list[Case]) -> None:
    """The ramps begin 0.3 rad from zero: the tip is off by the scale times that, times the arm."""
    case = together[0]
    run = log_of(case).runs[5]
    seen = np.isfinite(run.tip_m[:, 0])
    scale = case.truth[0]["parameters"]["scale"]
    turned = np.array(run.q_rad[seen])
    turned[:, 0] *= 1.0 + scale
    kinematics = ForwardKinematics(arm_of(case.arm_toml))
    off = np.sqrt(np.mean((kinematics.tips(turned) - run.tip_m[seen]) ** 2))
    assert off == pytest.approx(0.00014, rel=0.25)  # the camera's noise alone


def test_no_seed_is_used_twice() -> None:
    seeds = [one.seed for group in GROUPS for one in plan(group, 2000)]
    assert len(seeds) == len(set(seeds))
