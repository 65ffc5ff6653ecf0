"""Poses and time series of one mock arm as one question: what poses leave open, the runs settle, in the poses' own file."""

import pytest

from benchmarks.gap.mock.together import names_of, recorded
from calib.gap.finding import EffectName, updated_arm
from calib.gap.report import GapOutcome
from calib.gap.workflow import find_gap
from control.model.description import load_arm
from hil_mocks.plant.effects import EffectEntry

pytestmark = pytest.mark.nightly  # a minute; tests/calib/gap/posterior/test_told.py stands for it at each change
SEED = 8000  # an eccentricity beside a spring on joint 2, and a belt that is not quite straight
TURNED = EffectName("encoder_eccentricity", 2)


@pytest.fixture(scope="module")
def found() -> tuple[tuple[EffectEntry, ...], GapOutcome, set[EffectName]]:
    """What is hidden, the outcome of both, and the names that poses alone leave open."""
    known, hidden, points, log = recorded(load_arm("right"), SEED)
    alone = find_gap(known, points=points).finding
    return (hidden, find_gap(known, points=points, log=log), {name for names in alone.ambiguous for name in names})


def test_a_set_that_poses_leave_open_is_settled_by_the_runs(found) -> None:
    hidden, both, open_ = found
    assert TURNED in open_
    assert names_of(both.finding) == {EffectName(one.effect, one.joint or None) for one in hidden}
    assert both.finding.ambiguous == ()


def test_the_poses_file_has_the_size_that_is_likeliest_for_both(found) -> None:
    hidden, both, _ = found
    own = next(one for one in both.static.file.effects if (one.effect, one.joint) == (TURNED.effect, 2))
    true = next(one.parameters["amplitude_rad"] for one in hidden if one.effect == TURNED.effect)
    value, sd = next(one for one in both.finding.effects if one.name == TURNED).parameters["amplitude_rad"]
    assert own.parameters["amplitude_rad"] == pytest.approx(value, rel=1e-6)
    assert abs(value - true) < 3.0 * sd
    assert sd < 0.1 * true  # poses alone have half of it


def test_the_gap_of_the_runs_is_what_that_file_leaves(found) -> None:
    _, both, _ = found
    again = both.dynamic.examined.outcome(updated_arm(both.static.file, both.finding))
    assert both.dynamic.finding.gap_after == pytest.approx(again.finding.gap_after, rel=1e-9)
