"""Every command that takes points refuses the same wrong ones, in the same words, before it writes anything."""

import json
from pathlib import Path

import numpy as np
import pytest

from calib.arm_problem.arm_model import ArmModel
from calib.points.points import Points, make_points
from calib.points.writer import write_points
from console.main import main
from control.model.description import load_arm

RIGHT, LEFT = load_arm("right"), load_arm("left")


def poses_of(arm) -> Points:
    """Sixty poses with measured tips of an arm that is built as drawn."""
    rng = np.random.default_rng(1)
    q = rng.uniform([-0.6, -1.2, -0.6], [0.6, -0.6, 0.6], (60, 3))
    tips = ArmModel(arm).tips(arm.dh, q) + rng.normal(0.0, 0.0002, (60, 3))
    return make_points(["free"] * 60, [f"p{k}" for k in range(60)], [1] * 60, q, tips)


OURS = poses_of(RIGHT)
SAME = (OURS.setup, OURS.point, OURS.repeat)
WRONG = {
    "degrees": (make_points(*SAME, np.degrees(OURS.q_rad), OURS.tip_m), "the joint angles look like degrees"),
    "millimetres": (make_points(*SAME, OURS.q_rad, 1e3 * OURS.tip_m), "the positions look like millimetres"),
    "the other arm": (poses_of(LEFT), "these points fit the arm left far better than arm right"),
}
COMMANDS = {
    "calibrate": ["calibrate", "--arm", "right"],
    "gap": ["gap", "--arm", "right"],
    "verify": ["verify", "--arm", "right", "--against", "right"],
    "iso9283": ["iso9283", "--arm", "right"],
    "plan-poses": ["plan-poses", "--arm", "right"],
    "trust": ["trust", "--arm", "right"],
}


@pytest.mark.parametrize("what", WRONG)
@pytest.mark.parametrize("command", COMMANDS)
def test_wrong_points_are_refused_by_every_command(command, what, tmp_path, capsys) -> None:
    points, says = WRONG[what]
    write_points(tmp_path / "points.csv", points)
    out = tmp_path / "out"
    assert main([*COMMANDS[command], "--points", str(tmp_path / "points.csv"), "--out", str(out)]) == 2
    assert says in capsys.readouterr().err
    assert not out.exists()


@pytest.mark.parametrize("command", COMMANDS)
def test_points_that_a_session_recorded_of_another_arm_are_refused(command, tmp_path, capsys) -> None:
    write_points(tmp_path / "points.csv", OURS)
    (tmp_path / "session.json").write_text(json.dumps({"arm": "left"}))
    out = tmp_path / "out"
    assert main([*COMMANDS[command], "--points", str(tmp_path / "points.csv"), "--out", str(out)]) == 2
    assert 'expected points of arm "right", got points of "left" according to session.json beside it' in capsys.readouterr().err


@pytest.mark.parametrize(("mark", "name"), [(";", "semicolons"), ("\t", "tabs")])
@pytest.mark.parametrize("kind", ["--points", "--log"])
def test_another_separator_is_called_by_its_name(kind, mark, name, tmp_path, capsys) -> None:
    file = tmp_path / "recorded.csv"
    first = "setup,point,repeat" if kind == "--points" else "run,t_s"
    Path(file).write_text(f"{first},q1_rad,q2_rad,q3_rad\n".replace(",", mark))
    assert main(["gap", "--arm", "right", kind, str(file), "--out", str(tmp_path / "out")]) == 2
    assert f"separated by {name}, expected commas" in capsys.readouterr().err
