"""The Gymnasium environment keeps Gymnasium's interface, and the loop's limits."""

from __future__ import annotations

import importlib
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import armwright
from armwright.environment import ReachEnvironment
from console.visualisation.reading import read_series

PAGE = (Path(__file__).parents[2] / "docs" / "extras.md").read_text("utf-8")
SILENT_BOARD = '[[fault]]\nkind = "silent"\nboard = "motor2"\nat_s = 0.3\n'


@pytest.fixture
def environment() -> Iterator[ReachEnvironment]:
    """Of the arm `right`, with short episodes."""
    made = ReachEnvironment(steps=40)
    yield made
    made.close()


def test_gymnasiums_checker_finds_nothing(environment: ReachEnvironment) -> None:
    check_env(environment, skip_render_check=True)  # its warnings are errors here


def test_an_episode_follows_from_its_seed_and_another_seed_is_another_episode() -> None:
    seen = []
    for seed in (5, 5, 6):
        environment = ReachEnvironment()  # the checker repeats a seed within one environment
        first, _ = environment.reset(seed=seed)
        last, *_ = environment.step(environment.action_space.high)
        environment.close()
        seen.append(np.concatenate([*first.values(), *last.values()]))
    np.testing.assert_array_equal(seen[0], seen[1])
    assert not np.allclose(seen[0], seen[2])


def test_joints_move_at_the_speeds_of_the_action(environment: ReachEnvironment) -> None:
    environment.reset(seed=1)
    wanted = np.array([0.2, -0.1, 0.3])
    for _ in range(8):
        observation, *_ = environment.step(wanted)
    np.testing.assert_allclose(observation["speed_rad_s"], wanted, atol=0.02)


def test_no_action_moves_the_arm_beyond_its_limits(tmp_path: Path) -> None:
    environment = ReachEnvironment(steps=15, folder=tmp_path)
    environment.reset(seed=3)  # near the floor
    limited, ends = set(), False
    while not ends:
        _, _, terminated, ends, info = environment.step([-9.0, -9.0, -9.0])
        limited.add(info["limited"])
        assert not terminated
    environment.close()
    assert limited == {"", "the tip would be below the floor or table"}
    (recording,) = tmp_path.glob("episode-00001/*.armlog")
    series = read_series(recording)
    assert series.arm is not None
    tip_m = armwright.Kinematics(series.arm).forward(series.joint_set_rad)
    floor_m = series.arm.limits.floor_z_m - series.arm.limits.floor_tolerance_m
    assert tip_m[:, 2].min() > floor_m - 1e-3  # two cycles of a jog, until its stop begins
    jogs = series.mode[1:] == series.modes.index("JOGGING")
    speed_rad_s = np.abs(np.diff(series.joint_set_rad, axis=0)[jogs]) / series.period_s
    np.testing.assert_allclose(speed_rad_s.max(axis=0), environment.action_space.high, rtol=1e-3)
    assert "FAULT" not in {series.modes[number] for number in np.unique(series.mode)}


def test_the_target_ends_an_episode_with_success() -> None:
    environment = ReachEnvironment(tolerance_m=5.0)
    _, before = environment.reset(seed=1)
    _, reward, terminated, truncated, info = environment.step([0.0, 0.0, 0.0])
    environment.close()
    assert terminated
    assert not truncated
    assert before["is_success"]
    assert info["is_success"]
    assert reward == pytest.approx(-info["distance_m"])


def test_a_fault_ends_an_episode_and_costs_all_steps_that_were_left(tmp_path: Path) -> None:
    scenario = tmp_path / "silent.toml"
    scenario.write_text(SILENT_BOARD, encoding="utf-8")
    environment = ReachEnvironment(scenario=scenario, steps=100)
    environment.reset(seed=1)
    steps, terminated = 0, False
    while not terminated:
        _, reward, terminated, truncated, info = environment.step([0.1, 0.1, 0.1])
        steps += 1
    *_, after = environment.step([0.1, 0.1, 0.1])
    environment.close()
    assert "the arm is FAULT" in after["limited"]
    assert steps < 10
    assert not truncated
    assert "joint 2: its drive sent no reply" in info["faults"][0]
    assert reward == pytest.approx(-info["distance_m"] * (100 - steps + 1))


def test_the_reward_counts_the_true_tip_and_the_observation_has_the_measured_one() -> None:
    environment = ReachEnvironment(scenario="paper")  # 27 mm of hidden geometry
    observation, info = environment.reset(seed=1)
    true_m = np.linalg.norm(environment.mock.true_tip_m() - observation["target_m"])
    seen_m = np.linalg.norm(observation["tip_m"] - observation["target_m"])
    environment.close()
    assert info["distance_m"] == pytest.approx(true_m)
    assert abs(seen_m - true_m) > 0.002


@pytest.mark.parametrize(
    ("choice", "said"),
    [
        ({"period_s": 0.3}, r"less than \[limits\] jog_silence_s, 0.2 s; got 0.3 s"),
        ({"period_s": float("nan")}, "got nan s"),
        ({"steps": 0}, "steps: expected 1 or more, got 0"),
        ({"tolerance_m": 0.0}, "tolerance_m: expected above 0, got 0"),
        ({"arm": "nobody's"}, "nobody's"),
        ({"scenario": "nowhere"}, "nowhere"),
    ],
)
def test_a_choice_that_cannot_be_is_one_error(choice: dict[str, Any], said: str) -> None:
    with pytest.raises(armwright.ArmwrightError, match=said):
        ReachEnvironment(**choice)


@pytest.mark.parametrize("action", [[0.1, 0.1], [0.1, 0.1, float("nan")]])
def test_an_action_that_is_none_is_one_error_and_takes_no_time(environment: ReachEnvironment, action: list[float]) -> None:
    environment.reset(seed=1)
    with pytest.raises(armwright.BadTarget, match=r"expected 3 finite speeds \[rad/s\], got \[0.1, 0.1"):
        environment.step(action)
    assert environment.mock.status().mode == "HOLDING"


def test_the_example_of_the_page_reaches_its_target() -> None:
    examples = re.findall(r"^```python\n(.*?)^```", PAGE, re.M | re.S)
    (example,) = (one for one in examples if "armwright.environment" in one)
    names: dict[str, Any] = {}
    exec(compile(example, "docs/extras.md", "exec"), names)
    assert names["info"]["is_success"]


def test_without_gymnasium_its_installation_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "gymnasium", None)
    monkeypatch.delitem(sys.modules, "armwright.environment")
    with pytest.raises(ImportError, match=re.escape(".venv/bin/pip install -e '.[gymnasium]'")):
        importlib.import_module("armwright.environment")
