"""Scenario files are read strictly; what they draw depends on their seed alone."""

from __future__ import annotations

import math
import re
from pathlib import Path

import pytest

from control.kinematics.inverse import InverseKinematics
from control.model.description import load_arm
from control.model.effects import EFFECTS
from hil_mocks.assembly import effects_of
from hil_mocks.errors import ScenarioError
from hil_mocks.plant.effects import KNOWN
from hil_mocks.plant.parts import parts_of
from hil_mocks.plant.plant import Plant
from hil_mocks.scenario import load_scenario, parse_scenario, shipped_scenarios

RIGHT = load_arm("right")


@pytest.mark.parametrize("name", ["ideal", "demo", "paper"])
def test_the_shipped_scenarios_build_a_plant(name: str) -> None:
    assert name in shipped_scenarios()
    scenario = load_scenario(name)
    subject = Plant(parts_of(RIGHT), effects_of(RIGHT, scenario), (0.0, -0.5, 0.0))
    subject.step(10)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("sed = 1", "scenario s.toml: unknown key `sed`."),
        ("[camera]\nrate_hz = 5.0", "scenario s.toml: [camera] unknown key `rate_hz`."),
        ("[camera]\nrate_Hz = 0.0", "rate_Hz"),
        ("[camera]\nnoise_m = nan", "scenario s.toml: camera.noise_m must be finite, got nan."),
        ("[[effect]]\njoint = 1", "missing key `effect`"),
        ("seed = 'x'", "seed"),
        ("seed = ", "scenario s.toml: not valid TOML"),
    ],
)
def test_what_cannot_be_understood_names_file_and_key(text: str, message: str) -> None:
    with pytest.raises(ScenarioError, match=re.escape(message)):
        parse_scenario(text, "s.toml")


def test_a_missing_file_names_what_there_is(tmp_path: Path) -> None:
    with pytest.raises(ScenarioError, match="there is no such file; expected a file or one of demo, ideal, paper"):
        load_scenario(tmp_path / "none.toml")


@pytest.mark.parametrize(
    ("effect", "message"),
    [
        ('effect = "bakclash"\njoint = 1', 'effect "bakclash" is unknown; known are asymmetric_friction'),
        ('effect = "backlash"\njoint = 4\nparameters = {width_rad = 0.1}', "joint number 1 to 3, got 4"),
        ('effect = "backlash"\njoint = 1\nparameters = {width = 0.1}', 'unknown parameter "width"; expected width_rad'),
        ('effect = "backlash"\njoint = 1', 'parameter "width_rad" is missing'),
        ('effect = "backlash"\njoint = 1\nparameters = {width_rad = -0.1}', "must be positive, or 0"),
    ],
)
def test_effects_are_checked_by_name_joint_and_parameter(effect: str, message: str) -> None:
    with pytest.raises(ScenarioError, match=re.escape(message)):
        effects_of(RIGHT, parse_scenario(f"[[effect]]\n{effect}", "s.toml"))


def test_every_effect_that_a_model_can_have_has_physics() -> None:
    assert set(KNOWN) == set(EFFECTS)


def test_drawn_deviations_follow_the_seed_and_stay_within_their_sizes() -> None:
    text = "seed = {}\n[true_dh]\nd_m = 0.004\ntheta_rad = 0.02\n[true_dh.deviations]\nlink2_L_m = 0.001"
    first, again, other = (parse_scenario(text.format(seed), "s").drawn_deviations(4) for seed in (1, 1, 2))
    assert first == again
    assert first != other
    assert set(first) == {f"link{i}_{key}" for i in range(1, 5) for key in ("d_m", "theta_rad")} | {"link2_L_m"}
    assert all(abs(value) <= (0.004 if name.endswith("_m") else 0.02) for name, value in first.items())


@pytest.mark.parametrize(("name", "error_m"), [("demo", 0.0237), ("paper", 0.0269)])
def test_hidden_geometry_costs_as_much_at_the_table_as_the_scenario_says(name: str, error_m: float) -> None:
    """Mean tip error over the table's cavities, at the nominal joint angles."""
    inverse = InverseKinematics(RIGHT)
    angles = [0.3 * k for k in range(21)]
    cavities = [(0.5 + 0.09 * math.cos(a), 0.09 * math.sin(a), 0.0) for a in angles]
    errors = []
    for cavity in cavities:
        q = next(solution.q for solution in inverse.branches(cavity) if solution.within_limits)
        subject = Plant(parts_of(RIGHT), effects_of(RIGHT, load_scenario(name)), q)
        errors.append(math.dist(subject.tip_m(), cavity))
    assert sum(errors) / len(errors) == pytest.approx(error_m, abs=0.0005)
