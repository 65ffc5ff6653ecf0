"""The line of figures that `armwright bringup` prints of a joint."""

import math

import pytest

from console.commands.bringup import figures_in_words
from procedures.bringup.diagnosis import Diagnosis
from tests.cell import RIGHT


def of(**figures: float) -> str:
    return figures_in_words(2, Diagnosis(RIGHT.drives[1], figures=figures))


def test_every_figure_has_its_own_unit() -> None:
    line = of(coulomb_Nm=1.2, viscous_Nm_s_rad=1.5, lower_stop_rad=-math.pi / 2, upper_stop_rad=math.pi / 4)
    assert line.endswith(", friction 1.20 Nm + 1.50 Nm s/rad, stops -90.0 to +45.0 deg")


@pytest.mark.parametrize("missing", [{}, {"gear_ratio": math.nan}, {"lower_stop_rad": -1.0}])
def test_what_was_not_measured_is_left_out(missing: dict[str, float]) -> None:
    assert of(**missing) == "joint 2: node 2 (+1), channel 1 (+1)"
