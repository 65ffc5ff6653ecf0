"""The exported Python function: it runs without packages, and the tip goes where the published model has it."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest

from calib.errors import CalibrationError
from calib.export.formats import omitted, python_text
from console.main import main
from control.kinematics.kinematics import ForwardKinematics
from control.model.arm import Arm, Effect, Tool
from control.model.description import load_arm, save_arm


def run(text: str) -> Any:
    """`commanded` of the file; nothing but math can be imported."""
    imports = [line for line in text.splitlines() if "import" in line]
    assert imports == ["from math import cos, sin"]
    names: dict[str, Any] = {}
    exec(compile(text, "mine.py", "exec"), names)
    return names["commanded"]


def off(published: Arm, seed: int) -> Arm:
    random = np.random.default_rng(seed)
    deviations = random.uniform(-1.0, 1.0, published.dh.shape) * (0.002, 0.03, 0.002, 0.02)
    return dataclasses.replace(published.with_dh(published.dh + deviations), tool=Tool((0.004, -0.002, 0.003)))


def poses(arm: Arm, count: int) -> np.ndarray:
    lower, upper = np.array(arm.limits_rad).T
    middle = 0.5 * (lower + upper)
    return middle + 0.35 * (upper - lower) * np.random.default_rng(0).uniform(-1.0, 1.0, (count, len(middle)))


@pytest.mark.parametrize("name", ["so101", "so100", "koch", "widowx250", "right"])
def test_the_tip_is_where_the_published_model_has_it(name: str) -> None:
    published = load_arm(name)
    arm = off(published, 7)
    commanded = run(python_text(arm, published))
    wanted = poses(published, 40)
    joints = np.array([commanded(q) for q in wanted.tolist()])
    target, plain = ForwardKinematics(published).tips(wanted), ForwardKinematics(arm).tips(wanted)
    error_m = np.linalg.norm(ForwardKinematics(arm).tips(joints) - target, axis=1)
    assert np.linalg.norm(plain - target, axis=1).mean() > 0.003
    assert np.quantile(error_m, 0.9) < 1e-5
    assert np.abs(joints - wanted).max() < 0.2 + 1e-9  # in singular poses, too


def test_an_encoder_that_says_something_else_is_asked_for_that() -> None:
    published = load_arm("so101")
    scale, amplitude, phase = 0.01, 0.02, 0.7
    effects = (
        Effect("encoder_scale", 2, {"scale": scale}),
        Effect("encoder_eccentricity", 2, {"amplitude_rad": amplitude, "phase_rad": phase}),
        Effect("backlash", 3, {"width_rad": 0.02}),
    )
    arm = dataclasses.replace(published, effects=effects)
    (said,) = omitted(arm, published)
    assert said.endswith("not backlash")
    with_board = dataclasses.replace(arm, tool=Tool((0.004, -0.006, 0.01)))
    assert (
        "(4.0, -6.0, 10.0) mm from the last link's frame, and that of so101 (0.0, 0.0, 0.0) mm"
        in omitted(with_board, published)[-1]
    )
    for wanted in poses(published, 10).tolist():
        encoder = run(python_text(arm, published))(wanted)
        joint = (1.0 + scale) * encoder[1] + amplitude * math.sin(encoder[1] + phase)
        assert joint == pytest.approx(wanted[1], abs=1e-9)
        assert encoder[2] == pytest.approx(wanted[2], abs=1e-9)


@pytest.mark.parametrize("convention", ["standard", "modified"])
def test_its_tips_and_their_derivatives_are_those_of_the_arm(convention: Literal["standard", "modified"]) -> None:
    arm = dataclasses.replace(off(load_arm("so101"), 3), dh_convention=convention)
    names = run(python_text(arm, arm)).__globals__
    for q in poses(arm, 10).tolist():
        tip, columns = names["_tip"](names["ARM"], names["TOOL_m"], names["IS_MODIFIED"], q)
        assert tip == pytest.approx(ForwardKinematics(arm).tips(np.array([q]))[0].tolist(), abs=1e-12)
        expected = ForwardKinematics(arm).jacobians(np.array([q]))[0]
        assert np.abs(np.array(columns).T - expected).max() < 1e-12


def test_the_command_writes_it_and_asks_for_the_published_arm(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    mine, out = tmp_path / "mine.toml", tmp_path / "mine.py"
    save_arm(dataclasses.replace(off(load_arm("koch"), 1), name='my """ arm'), mine)
    export = ["export-arm", "--arm", str(mine), "--export", "python", "--out", str(out)]
    assert main(export) == 2
    assert "such as --generic so101" in capsys.readouterr().err
    assert main([*export, "--generic", "koch"]) == 0
    assert "not viscous_friction" in capsys.readouterr().out
    assert len(run(out.read_text(encoding="utf-8"))([0.0] * 5)) == 5
    with pytest.raises(CalibrationError, match="3 joints instead of 5"):
        python_text(load_arm(mine), load_arm("right"))
