"""The model's effects between encoder and joint against the mock arm's physics, which share nothing with them."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from calib.arm_problem.joint_effects import corrections
from calib.points.points import Points, read_points
from calib.points.writer import PointsWriter
from control.dynamics.static_pose import resting
from control.errors import MissingModel
from control.model.description import load_arm
from procedures.demo.paper_models import GentlePose, Mover
from procedures.mock import SteppedBench

ARM = load_arm("right")
FRICTION = "".join(
    f'[[effect]]\neffect = "coulomb_friction"\njoint = {j}\nparameters = {{ torque_Nm = {torque} }}\n'
    for j, torque in ((1, 1.5), (2, 1.8), (3, 1.0))
)
BARE = "[plant]\ntimestep_s = 0.001\n[start]\nhomed = true\n"
PLAY = {"backlash1": 0.005, "backlash2": 0.003, "backlash3": 0.006}
OTHERS = {"encoder_scale1": 0.004, "compliance2": 1.0 / 900.0, "belt_coupling": 0.012}
# Gravity pulls joint 2 one way, then the other.
ANGLES_rad = ((0.5, -0.9, 0.2), (-0.6, 0.5, 0.9))


def effect(name: str, joint: int | None, **parameters: float) -> str:
    """One [[effect]] of a scenario."""
    values = ", ".join(f"{key} = {value!r}" for key, value in parameters.items())
    place = "" if joint is None else f"joint = {joint}\n"
    return f'[[effect]]\neffect = "{name}"\n{place}parameters = {{ {values} }}\n'


def recorded(tmp_path: Path, hidden: str) -> tuple[Points, np.ndarray]:
    """Points of poses that are approached from both sides, and how far the joints (m, n) really are ahead of the encoders."""
    scenario = tmp_path / "scenario.toml"
    scenario.write_text(BARE + FRICTION + hidden, encoding="utf-8")
    bench = SteppedBench(ARM, scenario, tmp_path / "log")
    try:
        client = bench.start(ARM)
        client.enable()
        poses = [GentlePose("free", f"{k}", q, (side,) * 3, 1 + (side < 0)) for k, q in enumerate(ANGLES_rad) for side in (1, -1)]
        with PointsWriter(tmp_path / "points.csv", 3) as writer:
            # a stop is told before it is taken: the joints stand where the one before it was recorded
            joint_rad = [bench.rig.joint_rad() for _ in Mover(ARM, bench, client).visit(poses, writer)][1:]
            joint_rad.append(bench.rig.joint_rad())
        bench.stop()
    finally:
        bench.close()
    points, _ = read_points(tmp_path / "points.csv", 3)
    return points, np.array(joint_rad) - points.q_rad


def test_play_lies_on_the_flank_that_gravity_friction_and_currents_say(tmp_path: Path) -> None:
    hidden = "".join(effect("backlash", j, width_rad=PLAY[f"backlash{j}"]) for j in (1, 2, 3))
    points, ahead = recorded(tmp_path, hidden)
    state = resting(ARM, points.q_rad, points.direction, points.current_A)
    assert not state.is_led.any()
    assert all({-1.0, 1.0} <= set(column) for column in state.flank[:, :2].T.tolist())
    told = state.flank != 0.0
    width = np.array([PLAY[f"backlash{j}"] for j in (1, 2, 3)])
    assert told.mean() > 0.6
    assert np.allclose((ahead + 0.5 * width * state.flank)[told], 0.0, atol=1.5e-4)  # a count is 0.03 mrad
    # Where it is not told, friction and gravity are against each other, and the gear does lie on one flank or the other.
    assert np.allclose(np.abs(ahead[~told]), (0.5 * width * np.ones(ahead.shape))[~told], atol=1.5e-4)


def test_scale_compliance_and_coupling_add_up_to_where_the_joints_are(tmp_path: Path) -> None:
    hidden = (
        effect("encoder_scale", 1, scale=OTHERS["encoder_scale1"])
        + effect("joint_compliance", 2, stiffness_Nm_rad=900.0, damping_Nm_s_rad=5.0)
        + effect("belt_coupling", None, ratio=OTHERS["belt_coupling"])
    )
    points, ahead = recorded(tmp_path, hidden)
    found = {c.name: c.slope_rad for c in corrections(ARM, points, ["encoder_scale:1", "joint_compliance:2", "belt_coupling"])}
    # Half of the friction is on the links, as docs/mock_robot.md says.
    values = OTHERS | {"compliance2_held": 0.5 * OTHERS["compliance2"]}
    expected = sum(value * found[name] for name, value in values.items())
    assert np.abs(ahead).max() > 3e-3
    assert np.allclose(ahead, expected, atol=2e-4)


def test_a_flank_needs_masses_and_no_drives() -> None:
    unweighed = tuple(dataclasses.replace(link, mass_kg=None) for link in ARM.links)
    with pytest.raises(MissingModel, match="mass_kg"):
        resting(dataclasses.replace(ARM, links=unweighed), [[0.0, -0.5, 0.2]], [[1, 1, 1]])
    lying = resting(dataclasses.replace(ARM, drives=()), [[0.0, -0.5, 0.2]], [[1, 1, 1]])
    assert lying.flank.tolist() == [[0.0, 1.0, 1.0]]  # by their weight; nothing weighs on joint 1
