"""Requests that cross each other's transitions, at random; `python -m tests.crossing --count 100000` plays them for a night."""

from __future__ import annotations

import pytest

from tests.crossing import KINDS, Judge, played, stand

# At night; a third of them at each change. More of those whose loops are slow: a sequence takes a twentieth of the time.
COUNTS = {"dynamixel": 45, "feetech": 45, "roboclaw": 36, "cell": 9}
USUAL_COUNT = 18


@pytest.mark.parametrize("share", [pytest.param(1.0 / 3.0, id="third"), pytest.param(1.0, id="all", marks=pytest.mark.nightly)])
@pytest.mark.parametrize("kind", KINDS)
def test_no_torque_in_off_no_motion_unasked_nothing_beyond_a_limit_and_no_answer_untrue(kind: str, share: float) -> None:
    count = round(share * COUNTS.get(kind, USUAL_COUNT))
    broken = {number: what for number, _, what in played(kind, seed=7, count=count) if what}
    assert broken == {}


def test_the_judge_sees_torque_in_off() -> None:
    with stand("feetech") as one:
        (judge,) = one.judges.values()
        judge.runtime.parts.hardware.write = lambda *_: None  # type: ignore[method-assign]
        one.play([{"meddle": "switched_on", "joint": 1, "after": 0.0, "arm": ""}, {"cycles": 60}])
        assert judge.broken == ["torque in OFF on 1 joints"]


def test_the_judge_sees_an_answer_that_was_not_true() -> None:
    with stand("reference") as one:
        (judge,) = one.judges.values()
        assert isinstance(judge, Judge)
        judge.accepted({"do": "enable"})
        judge.judge_answer()
        assert judge.broken == ["`enable` was answered with ok, and the arm is OFF"]
