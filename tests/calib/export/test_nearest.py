"""What programs get that know rigid trees only: the rigid arm that is nearest to the file's with its effects."""

from __future__ import annotations

import dataclasses
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calib.arm_problem.arm_model import dh_names
from calib.export import FORMS, export_text, exported
from calib.export.formats import CORRECTED, python_text
from calib.export.rigid import nearest_rigid, nearest_zeros
from calib.points.points import Points, make_points
from calib.validation.verify import predicted_orientations, predicted_tips
from console.main import main
from control.kinematics.rotation import logarithms
from control.model.arm import Arm, Effect
from control.model.description import load_arm, save_arm
from control.model.maps import CorrectionMap
from tests.calib.export.test_export_arm import json_tips

PLAY_rad = 0.02
PUBLISHED = load_arm("so101")


def with_play(arm: Arm) -> Arm:
    """Play in every gear."""
    loose = [Effect("backlash", joint, {"width_rad": PLAY_rad}) for joint in range(1, arm.joint_count + 1)]
    return replace(arm, effects=(*arm.effects, *loose))


def rigid_of(arm: Arm) -> Arm:
    return replace(arm, effects=(), maps=())


def other_poses(arm: Arm, count: int = 300) -> Points:
    """Poses that nothing was fitted to, above the floor, come to from either side."""
    draw = np.random.default_rng(3)
    lower, upper = np.clip(np.array(arm.limits_rad), -3.0, 3.0).T
    q = draw.uniform(lower, upper, (10 * count, arm.joint_count))
    nowhere = np.full((len(q), 3), np.nan)
    points = make_points(["free"] * len(q), [""] * len(q), [1] * len(q), q, nowhere, draw.choice((-1.0, 1.0), q.shape))
    return points.chosen(np.flatnonzero(predicted_tips(arm, points)[:, 2] > 0.05)[:count])


def off(arm: Arm, truth: Arm, points: Points) -> tuple[float, float]:
    """Mean error of tips [m] and of last links [rad]."""
    tips = predicted_tips(arm, points) - predicted_tips(truth, points)
    turns = predicted_orientations(arm, points) @ np.swapaxes(predicted_orientations(truth, points), 1, 2)
    return float(np.linalg.norm(tips, axis=1).mean()), float(np.linalg.norm(logarithms(turns), axis=1).mean())


@pytest.mark.parametrize("name", ["so101", "koch", "widowx250", "right"])
def test_a_file_without_effects_on_the_pose_is_exported_as_it_is(name: str) -> None:
    arm = load_arm(name)
    rubbing = replace(arm, effects=(*arm.effects, Effect("load_friction", 1, {"fraction": 0.1})))
    assert nearest_rigid(rubbing).arm is rubbing
    for form in FORMS:
        text, notes = exported(rubbing, form)
        assert text == export_text(rubbing, form)
        assert not any("nearest" in note for note in notes)


@pytest.mark.parametrize("name", ["so101", "koch", "widowx250", "right"])
def test_where_gears_are_loose_the_tip_is_nearer_and_the_last_link_not_further_off(name: str) -> None:
    arm = with_play(load_arm(name))
    written, points = nearest_rigid(arm), other_poses(arm)
    (tip_m, turn_rad), (was_m, was_rad) = (off(rigid_of(one), arm, points) for one in (written.arm, arm))
    assert tip_m < 0.8 * was_m
    assert turn_rad < was_rad
    assert np.abs(written.arm.dh - arm.dh).max() < 0.02
    said_mm = float(written.notes[-1].split(" are off by ")[1].split(" mm")[0])
    assert said_mm == pytest.approx(1e3 * tip_m, rel=0.15)


def test_what_a_joint_always_does_goes_into_its_frame() -> None:
    ahead = CorrectionMap(2, corrects="angle_rad", over="angle_rad", lower=-3.0, upper=3.0, values=(0.03,) * 5)
    arm = replace(PUBLISHED, maps=(ahead,))
    points = other_poses(arm)
    assert off(rigid_of(arm), arm, points)[0] > 2e-3
    assert max(off(rigid_of(nearest_rigid(arm).arm), arm, points)) < 1e-5


def test_play_on_either_side_alike_moves_no_frame() -> None:
    arm = replace(PUBLISHED, effects=(Effect("backlash", 1, {"width_rad": PLAY_rad}),))  # about a vertical axis
    assert np.abs(nearest_rigid(arm).arm.dh - arm.dh).max() < 0.1 * PLAY_rad


def test_json_has_both_the_rows_of_the_rigid_arm_and_the_file() -> None:
    arm = with_play(PUBLISHED)
    text, notes = exported(arm, "json")
    q = other_poses(arm, 10).q_rad
    nothing = make_points([""] * len(q), [""] * len(q), [1] * len(q), q, np.full((len(q), 3), np.nan))
    expected = predicted_tips(rigid_of(nearest_rigid(arm).arm), nothing)
    np.testing.assert_allclose(json_tips(text, q), expected, atol=1e-9, rtol=0.0)
    assert text.split('"arm"')[1] == export_text(arm, "json").split('"arm"')[1]
    assert "nearest" in notes[-1]


def test_without_masses_play_is_at_its_middle_and_that_is_said() -> None:
    bare = tuple(replace(link, mass_kg=None, com_m=None, inertia_kg_m2=None) for link in PUBLISHED.links)
    arm = with_play(replace(PUBLISHED, links=bare))
    written = nearest_rigid(arm)
    assert written.arm is arm
    assert "no masses" in written.notes[0]
    scaled = replace(arm, effects=(*arm.effects, Effect("encoder_scale", 2, {"scale": 0.02})))
    assert len(nearest_rigid(scaled).notes) == 2


def test_a_program_that_knows_scale_and_eccentricity_keeps_them() -> None:
    scaled = replace(PUBLISHED, effects=(Effect("encoder_scale", 2, {"scale": 0.02}),))
    assert nearest_rigid(scaled, known=CORRECTED).arm is scaled
    loose = with_play(scaled)
    written, points = nearest_rigid(loose, known=CORRECTED).arm, other_poses(loose)
    before, after = (replace(one, effects=scaled.effects) for one in (loose, written))
    assert off(after, loose, points)[0] < 0.8 * off(before, loose, points)[0]
    assert "(0.02, 0.0, 0.0)," in python_text(written, PUBLISHED)


def with_zeros_of(arm: Arm, zeros: Arm) -> Arm:
    """The links of an arm with the zeros of its joints from another one."""
    rows, turns = np.array(arm.dh), np.array(arm.joints)
    rows[turns, 1] = zeros.dh[turns, 1]
    return rigid_of(arm.with_dh(rows))


def test_where_only_zeros_can_move_only_they_do() -> None:
    arm = with_play(PUBLISHED)
    written = nearest_zeros(arm, PUBLISHED).arm
    moved = np.array(dh_names(len(arm.links)))[(written.dh != arm.dh).ravel()]
    assert set(moved) == {f"theta{row}" for row, turns in enumerate(arm.joints, start=1) if turns}
    assert off(rigid_of(written), arm, other_poses(arm))[0] < off(rigid_of(arm), arm, other_poses(arm))[0]


@pytest.mark.parametrize("seed", range(3))
def test_zeros_make_up_for_published_links_that_the_program_keeps(seed: int) -> None:
    """Lengths 1 mm, angles 1 deg and zeros 2 deg off; the published links with identified zeros are further off."""
    draw = np.random.default_rng(seed).standard_normal((len(PUBLISHED.links), 4))
    off_by = draw * np.array([1e-3, 0.035, 1e-3, 0.0175]) * np.array(PUBLISHED.joints)[:, None]
    arm = PUBLISHED.with_dh(PUBLISHED.dh + off_by)
    written, points = nearest_zeros(arm, PUBLISHED), other_poses(arm)
    (tip_m, turn_rad), (was_m, was_rad) = (off(with_zeros_of(PUBLISHED, one), arm, points) for one in (written.arm, arm))
    assert tip_m < 0.99 * was_m
    assert turn_rad < 1.05 * was_rad
    assert "the zeros are those with which the links of so101 come nearest to this arm" in written.notes[-1]


def test_an_arm_whose_floor_is_above_it_is_exported_too() -> None:
    arm = with_play(PUBLISHED)
    arm = replace(arm, limits=dataclasses.replace(arm.limits, floor_z_m=5.0))
    assert nearest_rigid(arm).arm is not arm


def test_a_program_that_goes_through_serve_gets_the_links_of_the_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    mine, out = tmp_path / "mine.toml", tmp_path / "mine.urdf"
    save_arm(with_play(PUBLISHED), mine)
    assert main(["export-arm", "--arm", str(mine), "--export", "urdf", "--served", "--out", str(out)]) == 0
    assert out.read_text(encoding="utf-8") == export_text(load_arm(mine), "urdf")
    assert "nearest" not in capsys.readouterr().out
    assert main(["export-arm", "--arm", str(mine), "--export", "python", "--served", "--out", str(tmp_path / "mine.py")]) == 2
    assert "--served: expected --export urdf" in capsys.readouterr().err


def test_the_command_says_what_it_gains(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    mine = tmp_path / "mine.toml"
    save_arm(with_play(PUBLISHED), mine)
    for form in ("urdf", "python"):
        assert (
            main(["export-arm", "--arm", str(mine), "--export", form, "--generic", "so101", "--out", str(tmp_path / form)]) == 0
        )
        assert "the rigid arm nearest to this one" in capsys.readouterr().out
