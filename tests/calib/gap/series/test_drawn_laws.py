"""What a report draws of a name: its law, the law as this part has it, and the data, over the law's own variable."""

from __future__ import annotations

import numpy as np
import pytest

from calib.gap.finding import EffectName
from calib.gap.series.find import examine
from tests.calib.gap.series.prescribed import arm_with_friction, log_of

pytestmark = pytest.mark.usefixtures("without_motion")

STICKY_Nm = 0.9


def sticky(joint: int, q, speed, link):
    return STICKY_Nm * np.tanh(speed / 0.003) if joint == 1 else np.zeros_like(q)


def test_a_name_is_drawn_over_its_own_variable_beside_the_data() -> None:
    arm = arm_with_friction()
    outcome = examine(arm, log_of(arm, sticky))
    (law,) = (one for one in outcome.laws if one.name == EffectName("coulomb_friction", 2))
    drive = arm.drive(2)
    size_mA = 1e3 * STICKY_Nm / (drive.gear_ratio * drive.torque_constant_Nm_A)
    fast = np.abs(law.at) > 0.1
    assert (law.variable, law.unit) == ("speed of joint 2 [rad/s]", "mA")
    assert law.law[fast] == pytest.approx(size_mA * np.sign(law.at[fast]), rel=0.1)
    assert float(np.std(law.data - law.whole)) < 0.05 * size_mA
