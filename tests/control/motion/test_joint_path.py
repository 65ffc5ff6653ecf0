"""Paths of the joints: they meet their knots, are smooth between them, and say what is wrong with a message."""

import json
import math

import numpy as np
import pytest

from control.errors import MotionError
from control.motion.joint_limits import JointLimits
from control.motion.joint_path import JointPath
from control.motion.setpoint import SetPoint, at_rest
from control.server.server import LINE_LIMIT_bytes, encoded

LIMITS = JointLimits((-1.0, -1.0), (1.0, 1.0), (2.0, 2.0), (10.0, 10.0), (200.0, 200.0))


def swing(time_s: float) -> SetPoint:
    """Out and back within 2 s: q = sin^4(pi t / 2) / 2, at rest at both ends, and joint 2 the other way."""
    w = math.pi / 2.0
    s, c = math.sin(w * time_s), math.cos(w * time_s)
    q, v, a = 0.5 * s**4, 2.0 * w * s**3 * c, 2.0 * w * w * s * s * (3.0 * c * c - s * s)
    return SetPoint((q, -q), (v, -v), (a, -a))


def path(knots: int = 41) -> JointPath:
    times = [2.0 * k / (knots - 1) for k in range(knots)]
    return JointPath(times, [at_rest((0.0, 0.0)), *map(swing, times[1:-1]), at_rest((0.0, 0.0))])


def test_a_path_follows_the_motion_that_its_knots_were_taken_from() -> None:
    followed = path()
    for step in range(401):
        wanted, got = swing(0.005 * step), followed.at(0.005 * step)
        # the quintic's error is (w h)^6 / 46080 of a harmonic; the swing's fastest has w = 2 pi, h = 0.05 s
        assert got.q_rad == pytest.approx(wanted.q_rad, abs=1e-7)
        assert got.speed_rad_s == pytest.approx(wanted.speed_rad_s, abs=1e-5)
        assert got.acceleration_rad_s2 == pytest.approx(wanted.acceleration_rad_s2, abs=2e-3)


def test_times_beyond_the_path_are_its_ends_at_rest() -> None:
    assert path().at(-1.0) == path().at(0.0) == at_rest((0.0, 0.0))
    assert path().at(99.0) == at_rest((0.0, 0.0))


def test_thousands_of_knots_of_three_joints_fit_into_a_request() -> None:
    """3,000 way-points, each with the acceleration before and after it."""
    draw = np.random.default_rng(1)
    table = draw.uniform(-9.0, 9.0, (6000, 3, 3))
    table[[0, -1], 1] = 0.0
    message = JointPath([0.0, *np.cumsum(draw.uniform(0.01, 0.1, 5999)).tolist()], table).to_message()
    assert len(encoded(message)) < 0.9 * LINE_LIMIT_bytes


def test_where_a_time_stands_twice_the_acceleration_steps() -> None:
    """1 s of 1 rad/s^2, and 1 s of -1 rad/s^2."""
    knots = [
        SetPoint((0.0,), (0.0,), (1.0,)),
        SetPoint((0.5,), (1.0,), (1.0,)),
        SetPoint((0.5,), (1.0,), (-1.0,)),
        SetPoint((1.0,), (0.0,), (-1.0,)),
    ]
    followed = JointPath((0.0, 1.0, 1.0, 2.0), knots)
    assert followed.at(0.5) == SetPoint((0.125,), (0.5,), (1.0,))
    assert followed.at(1.0) == knots[2]
    assert followed.at(1.5) == SetPoint((0.875,), (0.5,), (-1.0,))
    assert followed.at(0.0) == at_rest((0.0,))
    assert followed.at(2.0) == at_rest((1.0,))


def test_a_message_survives_json_and_going_back_in_time_gives_the_same_set_points() -> None:
    again = JointPath.from_message(json.loads(json.dumps(path().to_message())))
    forth = [path().at(0.01 * k) for k in range(201)]
    back = [again.at(0.01 * k) for k in range(200, -1, -1)]
    np.testing.assert_allclose(back[::-1], forth, atol=1e-5)  # of accelerations: 1e-10 rad at knots 50 ms apart


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"times_s": [0.0, 1.0, 1.0]}, "increase from 0"),
        ({"times_s": [0.1, 1.0, 2.0]}, "increase from 0"),
        ({"times_s": [0.0, 1.0]}, "a time for each, got 3 and 2"),
        ({"q_rad": [[0.0, 0.0], [0.0], [0.0, 0.0]]}, "expected 2 joints in every knot"),
        ({"q_rad": [[0.0, 0.0], [math.nan, 0.0], [0.0, 0.0]]}, "finite"),
        ({"speed_rad_s": [[0.1, 0.0], [0.0, 0.0], [0.0, 0.0]]}, "at rest"),
        (
            {"times_s": [0.0, 1.0, 1.0, 2.0]}
            | dict.fromkeys(("speed_rad_s", "acceleration_rad_s2"), [[0.0, 0.0]] * 4)
            | {"q_rad": [[0.0, 0.0], [0.0, 0.0], [0.1, 0.0], [0.0, 0.0]]},
            "one angle and speed",
        ),
        ({"q_rad": None}, "expected what"),
        ({"q_rad": []}, "expected what"),
        ({"q_rad": [[10**400, 0.0]] * 3}, "expected what"),
        ({"q_rad": [[[0.0], [0.0]]] * 3}, "expected what"),
        ({"times_s": [[0.0], [1.0], [2.0]]}, "expected what"),
        ({"times_s": 5.0}, "expected what"),
        ({"q_rad": [[], [], []], "speed_rad_s": [[], [], []], "acceleration_rad_s2": [[], [], []]}, "some joints"),
        ({"times_s": [0.0], "q_rad": [[0.0]], "speed_rad_s": [[0.0]], "acceleration_rad_s2": [[0.0]]}, "2 to 10000 knots"),
    ],
)
def test_what_is_no_path_is_refused_in_words(change: dict[str, object], says: str) -> None:
    zeros = [[0.0, 0.0]] * 3
    message = {"times_s": [0.0, 1.0, 2.0], "q_rad": zeros, "speed_rad_s": zeros, "acceleration_rad_s2": zeros}
    with pytest.raises(MotionError, match=says):
        JointPath.from_message({**message, **change})


@pytest.mark.parametrize(
    ("knot", "says"),
    [
        (SetPoint((0.0, 1.1), (0.0, 0.0), (0.0, 0.0)), "joint 2 would be at 1.1000 rad after 1.000 s"),
        (SetPoint((0.0, 0.0), (-2.1, 0.0), (0.0, 0.0)), "joint 1 asks for -2.1 rad/s"),
        (SetPoint((0.0, 0.0), (0.0, 0.0), (0.0, 10.1)), r"joint 2 asks for 10.1 rad/s\^2"),
    ],
)
def test_a_knot_beyond_a_limit_names_joint_time_and_limit(knot: SetPoint, says: str) -> None:
    with pytest.raises(MotionError, match=says):
        JointPath((0.0, 1.0, 2.0), (at_rest((0.0, 0.0)), knot, at_rest((0.0, 0.0)))).require_within(LIMITS)


def test_a_path_of_another_number_of_joints_is_refused() -> None:
    with pytest.raises(MotionError, match="expected 2 joints, got 1"):
        JointPath((0.0, 1.0), (at_rest((0.0,)), at_rest((0.0,)))).require_within(LIMITS)


def test_a_knot_at_its_limits_is_allowed() -> None:
    knot = SetPoint((1.0, -1.0), (2.0, -2.0), (10.0, -10.0))
    JointPath((0.0, 1.0, 2.0), (at_rest((0.0, 0.0)), knot, at_rest((0.0, 0.0)))).require_within(LIMITS)
