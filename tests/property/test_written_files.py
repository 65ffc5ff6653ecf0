"""Whatever a command writes, every command reads: random arms of two to seven joints, boards of every kind, both conventions."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import armwright
from calib.points.points import make_points, read_points
from calib.points.writer import write_points
from console.main import main
from control.kinematics.kinematics import ForwardKinematics
from control.model.arm import Arm, Camera, Effect
from control.model.board_kinds import KINDS, bus_conflict
from control.model.description import load_arm, save_arm
from procedures.new_arm.answers import USUAL_AXES
from procedures.on_boards import REFERENCE

AT_EACH_CHANGE, AT_NIGHT = 7, 300
NAMES = ("a", "7", "left-arm_2", "Z" * 64, "x.y", "my arm", "Größe µ", "名", "a'b\"c", "100%", "{x}", "a:b", "<b>&")
LENGTHS_lg_m = (-3.0, 0.5)  # from a millimetre to three metres


def drawn(seed: int, folder: Path) -> Arm:
    """An arm from `armwright new`, with every answer at random."""
    random = np.random.default_rng(seed)
    joints = int(random.integers(2, 8))
    axes = USUAL_AXES[joints] if random.random() < 0.3 else "z" + "".join(random.choice([*"xyz"], joints - 2)) + "y"
    kinds = [str(kind) for kind in random.choice([REFERENCE, *KINDS], joints if random.random() < 0.5 else 1)]
    on_can = {"" if kind == REFERENCE else kind for kind in kinds if kind == REFERENCE or KINDS[kind].line == "can"}
    if bus_conflict(on_can):
        kinds = kinds[:1]
    lengths = [f"{length:.6g}" for length in 10.0 ** random.uniform(*LENGTHS_lg_m, joints)]
    out = folder / "new.toml"
    options = ["--joints", str(joints), "--axes", axes, "--lengths", *lengths, "--boards", *kinds]
    options += ["--convention", str(random.choice(["standard", "modified"])), "--name", str(random.choice(NAMES))]
    options += ["--home", str(random.choice(["yes", "no"]))] if REFERENCE in kinds else []
    assert main(["new", "--out", str(out), *options, "--yes"]) == 0, options
    return load_arm(out)


def brought_up_and_tuned(arm: Arm, random: np.random.Generator) -> Arm:
    """What `bringup` and `tune` write: other directions, home places and limits, friction, gains."""
    drives = []
    for drive in arm.drives:
        shrunk = 0.2 * random.random() * (drive.joint_upper_rad - drive.joint_lower_rad)
        home = drive.home and replace(drive.home, switch_rad=round(drive.home.switch_rad, 7))
        kp, ki, kd = (10.0 ** random.uniform(-1.0, 4.0, 3)).tolist()
        gains = replace(drive.pid, kp=kp, ki=ki, kd=kd)
        sign = int(random.choice([-1, 1]))
        limits = {"joint_lower_rad": drive.joint_lower_rad, "joint_upper_rad": round(drive.joint_upper_rad - shrunk, 3)}
        is_free = home is None and arm.rest is not None and arm.rest.q_rad[drive.joint - 1] < limits["joint_upper_rad"]
        drives.append(
            replace(drive, home=home, pid=gains, encoder_direction=sign, motor_direction=sign, **(limits if is_free else {}))
        )
    friction = tuple(
        Effect(f"{name}_friction", drive.joint, {key: round(float(random.uniform(0.0, 2.0)), 4)})
        for drive in arm.drives
        for name, key in (("coulomb", "torque_Nm"), ("viscous", "coefficient_Nm_s_rad"))
    )
    return replace(arm, drives=tuple(drives), effects=friction, camera=Camera(position_noise_m=2e-4))


def read_by_every_command(file: Path, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """`arm` reads it, and its exports are read as the same arm."""
    arm = load_arm(file)
    capsys.readouterr()
    assert main(["arm", str(file), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["joints"] == arm.joint_count
    lower, upper = np.array(arm.limits_rad).T
    q_rad = np.random.default_rng(0).uniform(lower, upper, (20, arm.joint_count))
    json_file = folder / f"{file.stem}.json"
    assert main(["export-arm", "--arm", str(file), "--export", "json", "--out", str(json_file)]) == 0
    assert json.loads(json_file.read_text(encoding="utf-8"))["name"] == arm.name
    for form in ("urdf", "mjcf"):
        model, again = folder / f"{file.stem}.{form}", folder / f"{file.stem}-{form}.toml"
        assert main(["export-arm", "--arm", str(file), "--export", form, "--out", str(model)]) == 0
        assert main(["arm", f"--from-{form}", str(model), "--out", str(again)]) == 0, capsys.readouterr().err
        tips_m = [ForwardKinematics(one).tips(q_rad) for one in (arm, load_arm(again))]
        np.testing.assert_allclose(tips_m[1], tips_m[0], atol=1e-6)


def measured(arm: Arm, folder: Path, random: np.random.Generator) -> None:
    """points.csv and others.csv of an arm that is somewhat different."""
    true = arm.with_dh(np.array(arm.dh) + random.uniform(-0.003, 0.003, np.array(arm.dh).shape))
    lower, upper = np.array(arm.limits_rad).T
    for name, m in (("points", 40), ("others", 15)):
        q_rad = random.uniform(lower, upper, (m, arm.joint_count))
        tips_m = ForwardKinematics(true).tips(q_rad) + random.normal(0.0, 1e-4, (m, 3))
        names = [f"p{k}" for k in range(m)]
        write_points(folder / f"{name}.csv", make_points(["free"] * m, names, [1] * m, q_rad, tips_m))


def used_by_every_command(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """What `calibrate`, `gap` and Python's `save` write of tuned.toml and points.csv is taken by all that takes such files."""
    nominal, points, others = (str(folder / name) for name in ("tuned.toml", "points.csv", "others.csv"))
    arm = str(folder / "calibrate" / "arm.toml")
    for line in (
        ["calibrate", "--arm", nominal, "--points", points],
        ["verify", "--arm", arm, "--against", nominal, "--points", others],
        ["trust", "--arm", arm, "--points", points],
        ["check-up", "--arm", arm, "--points", points, "--recorded", others],
        ["plan-poses", "--arm", arm, "--points", points, "--free", "4", "--only", "free"],
        ["calibrate", "--arm", arm, "--points", others, "--out", str(folder / "again")],
        ["gap", "--arm", arm, "--points", points],
    ):
        out = [] if "--out" in line else ["--out", str(folder / line[0])]
        status, said = main([*line, *out]), capsys.readouterr().err
        # One of 28, eight centimetres high, has no free pose that may be planned: it is read, and told so.
        assert status in (0, 1) or "no pose is left to plan" in said, (line, said[-500:])
    armwright.calibrate(load_arm(Path(nominal)), read_points(Path(points))[0]).save(folder / "saved")
    for file in (Path(arm), folder / "again" / "arm.toml", folder / "gap" / "arm.toml", folder / "saved" / "arm.toml"):
        if file.exists() or file.parent.name != "gap":  # which writes one only if it has found something
            read_by_every_command(file, file.parent, capsys)


def walk(seed: int, folder: Path, capsys: pytest.CaptureFixture[str], with_calibration: bool) -> None:
    random = np.random.default_rng(seed)
    arm = drawn(seed, folder)
    read_by_every_command(folder / "new.toml", folder, capsys)
    save_arm(brought_up_and_tuned(arm, random), folder / "tuned.toml")
    tuned = load_arm(folder / "tuned.toml")
    save_arm(tuned, folder / "again.toml")
    assert replace(load_arm(folder / "again.toml"), path="") == replace(tuned, path="")
    if with_calibration:
        measured(tuned, folder, random)
        used_by_every_command(folder, capsys)


@pytest.mark.parametrize("seed", range(AT_EACH_CHANGE))
def test_whatever_is_written_of_a_random_arm_is_read(seed: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    walk(seed, tmp_path, capsys, with_calibration=False)


@pytest.mark.nightly
@pytest.mark.parametrize("seed", range(AT_EACH_CHANGE, AT_NIGHT))
def test_whatever_is_written_of_a_random_arm_is_read_at_night(
    seed: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    walk(seed, tmp_path, capsys, with_calibration=seed % 10 == 0)
