"""The tolerance study against an independent chain, against `calibrate`, and against what its numbers must obey."""

import dataclasses
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from benchmarks.calibration.chains import REFERENCE
from calib.arrays import Array
from calib.calibration import CalibrationPlan, calibrate
from calib.points.points import Points, make_points
from calib.studies import ChunkStore, InProcess, run_study
from calib.tolerances.making import (
    MadeArms,
    MadePoses,
    MakingTerm,
    TolerancesFile,
    TolerancesFileError,
    parse_tolerances,
    tolerances_text,
)
from calib.tolerances.result import Made, costliest, made_of, sentences, warnings_about
from calib.tolerances.study import StudyDesign, StudyIdentification, design_of, require_near, study_task
from control.model.arm import Arm, Effect
from control.model.description import load_arm

ARM = load_arm("right")
GEOMETRY = "[every_link]\nL_m = { within = 1e-3 }\ntheta_rad = { within = 5e-3 }\n"
ALL = parse_tolerances(tolerances_text("right"), "right", ARM)


def tolerances(text: str, arm: Arm = ARM) -> TolerancesFile:
    return parse_tolerances(text, "t.toml", arm)


@cache
def studied(text: str, folder: Path, arms: int = 40) -> Made:
    design = design_of(ARM, tolerances(text), arms)
    store = ChunkStore(folder / str(abs(hash(text))), {})
    run_study(study_task, design, design.tasks, InProcess(), store)
    return made_of(design, store)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("studies")


def poses_of(design: StudyDesign) -> tuple[MadeArms, MadePoses]:
    made = MadeArms(design.arm, design.tolerances)
    return made, MadePoses(design.arm, made.terms, design.calibration)


def test_tips_of_made_arms_are_those_of_an_independent_chain() -> None:
    text = GEOMETRY + "[joint.2]\nencoder_scale = { sd = 1e-3 }\nencoder_eccentricity_rad = { from = 1e-3, to = 2e-3 }"
    design = design_of(ARM, tolerances(text), 5)
    made, poses = poses_of(design)
    z = made.drawn(np.random.default_rng(1), 5)
    tips = poses.tips(z)
    scale, sine, cosine = (made.terms.index(MakingTerm(kind, 2)) + 19 for kind in ("scale", "sine", "cosine"))
    for one, mine in zip(z, tips.transpose(1, 2, 0), strict=True):
        q = design.calibration.q_rad.copy()
        ahead = one[scale] * q[:, 1] + one[sine] * np.sin(q[:, 1]) + one[cosine] * np.cos(q[:, 1])
        q[:, 1] += ahead
        assert mine == pytest.approx(REFERENCE.tips(ARM.dh + one[:16].reshape(4, 4), q), abs=1e-12)
        assert np.hypot(one[sine], one[cosine]) == pytest.approx(1.5e-3, abs=0.5e-3)


def test_slopes_are_differences_of_tips() -> None:
    made, poses = poses_of(design_of(ARM, ALL, 1))
    z = made.drawn(np.random.default_rng(2), 1)[0]
    slopes = poses.slopes(z)
    for k in range(len(z)):
        step = 1e-6 * np.eye(len(z))[k]
        across = (poses.tips((z + step)[None]) - poses.tips((z - step)[None]))[:, 0] / 2e-6
        assert slopes[:, :, k] == pytest.approx(across, abs=1e-6)


def test_many_arms_are_calibrated_as_calibrate_does_it_with_one() -> None:
    design = design_of(ARM, tolerances(GEOMETRY + "[joint.2]\nbacklash_rad = { from = 1e-3, to = 2e-3 }"), 2)
    made, poses = poses_of(design)
    rng = np.random.default_rng(3)
    z = made.drawn(rng, 2)
    seen = poses.tips(z) + rng.normal(0.0, 1e-4, (3, 2, len(design.calibration)))
    found = StudyIdentification(made, poses, list(range(16)), 1e-4).found(seen)
    elsewhere = MadePoses(ARM, made.terms, design.map)
    true = elsewhere.tips(z)
    for k in range(2):
        names = ["free"] * len(design.calibration)
        points = make_points(
            names, [f"p{i}" for i in range(len(names))], [1] * len(names), design.calibration.q_rad, seen[:, k].T
        )
        arm = calibrate(ARM, points, CalibrationPlan(starts_count=1)).arm
        real = rms_m(true[:, k].T - REFERENCE.tips(arm.dh, design.map.q_rad))
        quick = rms_m((true[:, k] - elsewhere.tips(found[k : k + 1])[:, 0]).T)
        assert quick == pytest.approx(real, rel=0.15)
        assert real < 0.3 * rms_m(true[:, k].T - REFERENCE.tips(ARM.dh, design.map.q_rad))


def recorded(q_rad: Array, tip_m: Array) -> Points:
    names = [f"p{k}" for k in range(len(q_rad))]
    return make_points(["free"] * len(q_rad), names, [1] * len(q_rad), q_rad, tip_m)


def rms_m(errors: Array) -> float:
    return float(np.sqrt(np.mean(np.sum(errors**2, axis=1))))


def test_geometry_alone_is_calibrated_down_to_the_noise(folder: Path) -> None:
    made = studied(GEOMETRY, folder)
    assert made.rms_m(0) > 10.0 * made.rms_m(1)
    assert made.rms_m(1) == pytest.approx(made.rms_m(2), rel=1e-6)  # nothing is left to correct
    assert made.rms_m(1) < made.design.tolerances.noise_m


def test_play_is_left_by_a_calibration_and_taken_by_a_correction(folder: Path) -> None:
    made = studied(GEOMETRY + "[every_joint]\nbacklash_rad = { from = 1e-3, to = 2e-3 }", folder)
    assert made.rms_m(2) < 0.6 * made.rms_m(1)
    assert "backlash" in costliest(made, 1)[0].name
    assert made.kept(1, 0.95).value > made.kept(1, 0.5).value


def test_shares_of_geometry_add_up(folder: Path) -> None:
    costs = studied(GEOMETRY, folder, 300).costs
    spread = sum(cost.share[0].upper - cost.share[0].value for cost in costs)
    assert sum(cost.share[0].value for cost in costs) == pytest.approx(1.0, abs=spread)
    assert spread < 0.7
    assert all(cost.share[0].lower <= cost.share[0].value <= cost.share[0].upper for cost in costs)


def test_an_arm_made_exactly_has_no_error_beyond_encoder_steps(folder: Path) -> None:
    made = studied("[every_link]\nd_m = { within = 0 }", folder)
    assert made.rms_m(0) < 1e-4
    assert {one.name for one in made.costs if one.share[0].value > 0.01} == {"encoder steps"}


def test_what_the_file_corrects_already_costs_nothing_as_built() -> None:
    effect = Effect("joint_compliance", 2, {"stiffness_Nm_rad": 4000.0})
    known = dataclasses.replace(ARM, effects=(effect,))
    text = "[joint.2]\nstiffness_Nm_rad = { from = 4000, to = 4000 }"
    of_both = [np.concatenate([design_errors(arm, text)["mean_square_m2"][0]]).mean() ** 0.5 for arm in (ARM, known)]
    assert of_both[0] > 3e-4
    assert of_both[1] < 1e-4


def design_errors(arm: Arm, text: str) -> dict[str, Array]:
    return dict(study_task(design_of(arm, tolerances(text, arm), 20), 0))


def test_a_task_gives_the_same_bytes_each_time_and_another_seed_others() -> None:
    design = design_of(ARM, ALL, 20)
    first, again = (study_task(design, 0) for _ in range(2))
    other = study_task(dataclasses.replace(design, seed=1), 0)
    assert all(first[name].tobytes() == again[name].tobytes() for name in first)
    assert not np.array_equal(first["kept_m"], other["kept_m"])


def test_the_words_name_the_yield_and_what_costs_most(folder: Path) -> None:
    made = studied(GEOMETRY, folder, 300)
    text = " ".join(sentences(made, 1e-3))
    assert "1 mm are kept by: " in text
    assert f"What costs most as built: {costliest(made, 0)[0].name}" in text
    assert sum(made.within(stage, 1e-3).value for stage in range(3)) > 1.9


def test_tolerances_beyond_the_bounds_of_calibrate_are_told() -> None:
    assert warnings_about(design_of(ARM, ALL, 20)) == []
    wide = design_of(ARM, tolerances("[joint.1]\nencoder_zero_rad = { within = 0.2 }"), 20)
    assert ["bounds of 5 mm and 2 deg" in one for one in warnings_about(wide)] == [True]
    few = design_of(ARM, tolerances(GEOMETRY + "[calibration]\nposes = 10"), 20)
    assert ["10 poses are few" in one for one in warnings_about(few)] == [True]


def test_tolerances_in_a_wrong_unit_are_refused_and_the_part_is_named() -> None:
    require_near(design_of(ARM, ALL, 20), "t.toml")
    require_near(design_of(ARM, tolerances("[joint.1]\nencoder_zero_rad = { within = 0.1 }"), 20), "t.toml")
    for text, part in (
        (GEOMETRY + "[link.2]\nL_m = { within = 0.3 }", "link 2: L"),  # millimetres
        ("[joint.2]\nstiffness_Nm_rad = { from = 1.0, to = 2.0 }", "joint 2: stiffness"),
    ):
        with pytest.raises(TolerancesFileError, match=f"t.toml: such arms miss by .* mostly by {part}; expected"):
            require_near(design_of(ARM, tolerances(text), 20), "t.toml")
