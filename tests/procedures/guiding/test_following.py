"""One arm follows another that a hand guides, as it is or mirrored, and ends when it is stopped."""

from __future__ import annotations

from dataclasses import replace

import pytest

from control.errors import ArmError
from control.model.cell import Placed
from control.model.description import load_arm
from control.safety.modes import Mode
from control.server.client import MotionStopped
from procedures.guiding import Following, mirror_signs
from tests.cell import FRICTION, scenario
from tests.pair import PAIR, Pair, holding_pair, open_pair

START = (0.2, -0.4, 0.4)
REQUESTS = 55  # 1.1 s
LEFT, RIGHT = PAIR.placed("left"), PAIR.placed("right")


def pair_of(pair: Pair, signs: tuple[float, ...]) -> Following:
    return Following(pair.clients["left"], pair.clients["right"], RIGHT, signs)


def test_the_supplied_arms_are_mirrored_by_turning_the_first_joint_the_other_way() -> None:
    assert mirror_signs(LEFT, RIGHT) == (-1.0, 1.0, 1.0)


def test_arms_that_are_no_mirror_images_are_refused() -> None:
    other = Placed(load_arm("right"), (0.0, 0.6, 0.0))
    with pytest.raises(ArmError, match=r"no mirror images of each other in this cell: the tips miss by 0\.024 m"):
        mirror_signs(other, RIGHT)
    with pytest.raises(ArmError, match="stand at one place"):
        mirror_signs(LEFT, replace(RIGHT, origin_m=LEFT.origin_m))


def test_the_follower_goes_where_a_hand_takes_the_leader() -> None:
    signs = (-1.0, 1.0, 1.0)
    with holding_pair(scenario(START, effect=FRICTION)) as pair:
        following = pair_of(pair, signs)
        pair.clients["left"].guide(weightless=True)
        x, y, z = pair.robot("left").tip_m()
        following.approach()
        pair.robot("left").hand.seat((x, y + 0.06, z - 0.05))
        steps = iter(range(REQUESTS))
        following.run(lambda: next(steps, None) is not None)
        leader, follower = pair.robot("left").joint_rad(), pair.robot("right").joint_rad()
        assert leader[0] - START[0] > 0.05  # it was guided
        assert follower == pytest.approx([s * q for s, q in zip(signs, leader, strict=True)], abs=0.01)
        assert (pair.mode("left"), pair.mode("right")) == (Mode.GUIDING, Mode.JOGGING)


def test_a_stop_ends_following_and_a_client_that_falls_silent_lets_the_follower_rest() -> None:
    with holding_pair(scenario(START, effect=FRICTION)) as pair:
        following = pair_of(pair, (1.0, 1.0, 1.0))
        following.step()
        pair.run(0.1)
        pair.channels["left"].request({"do": "stop"})
        pair.run(0.02)
        with pytest.raises(MotionStopped, match="arm 'right' was stopped"):
            following.step()
        again = pair_of(pair, (1.0, 1.0, 1.0))
        pair.until(lambda: pair.mode("right") is Mode.HOLDING, 0.5)
        again.step()
        pair.until(lambda: pair.mode("right") is Mode.HOLDING, 0.5)


def test_an_arm_that_is_off_is_not_followed() -> None:
    with open_pair() as pair, pytest.raises(ArmError, match="arm 'left' is OFF and not homed: enable and home both arms first"):
        pair_of(pair, (1.0, 1.0, 1.0)).approach()
