"""tolerances.toml: what it means, and one clear error for each mistake."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from calib.tolerances.making import TolerancesFileError, parse_tolerances, tolerances_text
from control.model.description import load_arm
from control.model.tolerances import Spread

ARM = load_arm("right")


def test_the_supplied_example_is_for_the_supplied_arm() -> None:
    tolerances = parse_tolerances(tolerances_text("right"), "right", ARM)
    assert tolerances.of_joint(1).stiffness_Nm_rad == Spread(lowest=3000.0, highest=6000.0)
    assert tolerances.of_joint(3).stiffness_Nm_rad == Spread(lowest=800.0, highest=1500.0)
    assert (tolerances.of_link(2).EI_Nm2 is not None, tolerances.of_link(1).EI_Nm2 is None) == (True, True)
    assert ARM.camera is not None
    assert (tolerances.poses, tolerances.noise_m) == (60, ARM.camera.position_noise_m)


@pytest.mark.parametrize(
    ("spread", "mean", "sd", "least", "most"),
    [
        (Spread(within=2.0, mean=1.0), 1.0, 2.0 / 3**0.5, -1.0, 3.0),
        (Spread(lowest=1.0, highest=5.0), 3.0, 4.0 / 12**0.5, 1.0, 5.0),
        (Spread(sd=0.5, mean=2.0), 2.0, 0.5, -np.inf, np.inf),
        (Spread(within=0.0, mean=0.3), 0.3, 0.0, 0.3, 0.3),
    ],
)
def test_distributions_are_as_they_are_written(spread: Spread, mean: float, sd: float, least: float, most: float) -> None:
    drawn = spread.draw(np.random.default_rng(1), 20_000)
    assert (spread.centre, spread.sd_about) == pytest.approx((mean, sd))
    assert drawn.mean() == pytest.approx(mean, abs=0.03)
    assert drawn.std() == pytest.approx(sd, rel=0.02)
    assert least - 1e-12 <= drawn.min() <= drawn.max() <= most + 1e-12
    assert spread.least == least


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "no tolerance"),
        ("[every_link\n", "not valid TOML"),
        ("[every_link]\nd_mm = { within = 0.1 }", "every_link.d_mm: expected one of the keys"),
        ("[joint.2]\nbacklash = { from = 0, to = 1 }", "joint.2.backlash: expected one of the keys"),
        ("[joint.4]\nencoder_zero_rad = { sd = 1e-3 }", "joint.4: expected a number from 1 to 3"),
        ("[link.one]\nd_m = { sd = 1e-3 }", "link.one: expected a number from 1 to 4"),
        ("[every_link]\nd_m = 0.0002", "every_link.d_m: expected a table, got 0.0002, such as { within = 2e-4 }"),
        ("[every_link]\nd_m = { within = -0.1 }", "every_link.d_m.within: expected a number not below 0, got -0.1"),
        ("[every_link]\nd_m = { within = nan }", "every_link.d_m.within: expected a finite number, got nan"),
        ("[link.2]\nd_m = { within = 1e-4, sd = 1e-4 }", "link.2.d_m: expected one of { within }, { sd }"),
        ("[link.2]\nd_m = { }", "link.2.d_m: expected one of"),
        ("[link.2]\nd_m = { from = 1e-4 }", "both and without mean"),
        ("[link.2]\nd_m = { from = 2e-4, to = 1e-4 }", "link.2.d_m: expected from <= to, got 0.0002 and 0.0001"),
        ("[every_joint]\nbacklash_rad = { within = 1e-3 }", "every_joint.backlash_rad: expected no value below 0, such as"),
        ("[joint.2]\nstiffness_Nm_rad = { sd = 100, mean = 4000 }", "joint.2.stiffness_Nm_rad: expected values above 0, such as"),
        ("[joint.2]\nstiffness_Nm_rad = { from = 0, to = 4000 }", "expected values above 0"),
        ("[link.2]\nEI_Nm2 = { within = 10, mean = 10 }", "got one that reaches down to 0"),
        ("[calibration]\nposes = 3\n[tool]\nx_m = { sd = 1e-3 }", "calibration.poses: expected a whole number from 10 to 5000"),
    ],
)
def test_a_mistake_is_named_with_file_and_key(text: str, said: str) -> None:
    with pytest.raises(TolerancesFileError) as error:
        parse_tolerances(text, "t.toml", ARM)
    assert str(error.value).startswith("t.toml: ")
    assert said in str(error.value)


def test_an_arm_without_camera_needs_the_noise_of_its_measurement() -> None:
    bare = dataclasses.replace(ARM, camera=None)
    with pytest.raises(TolerancesFileError, match="noise_m is missing"):
        parse_tolerances("[tool]\nx_m = { sd = 1e-3 }", "t.toml", bare)
    text = "[tool]\nx_m = { sd = 1e-3 }\n[calibration]\nnoise_m = 2e-4"
    assert parse_tolerances(text, "t.toml", bare).noise_m == 2e-4


def test_a_file_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(TolerancesFileError, match=r"none\.toml: cannot be read: No such file"):
        tolerances_text(str(tmp_path / "none.toml"))
