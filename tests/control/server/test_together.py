"""Motions of two arms that begin and end together."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from control.model.cell import load_cell
from control.motion.plan import plan_path
from control.motion.waypoints import Waypoints
from control.safety.modes import Mode
from control.server import cell_requests
from tests.cell import FRICTION, scenario
from tests.pair import APART, FREE, PAIR, PERIOD_S, Pair, holding_pair

NEAR, WIDE = (0.1, 0.1, 0.7), (-0.5, -0.2, 0.5)


def ends_s(pair: Pair, limit_s: float) -> dict[str, float]:
    """When each arm has come to rest."""
    ends: dict[str, float] = {}
    begun_s = pair.rig.clock.now_s()
    while len(ends) < 2:
        pair.run(PERIOD_S)
        now_s = pair.rig.clock.now_s()
        ends |= {arm: now_s for arm in pair.clients if arm not in ends and pair.mode(arm) is Mode.HOLDING}
        assert now_s < begun_s + limit_s
    return ends


def test_both_begin_and_end_in_the_same_cycle() -> None:
    with holding_pair() as pair:
        moves = {"left": {"q_rad": NEAR}, "right": {"q_rad": WIDE, "speed": 0.9}}
        answer = pair.clients["left"].ask("move_together", moves=moves)
        assert answer["runs"] == {"left": 1, "right": 1}
        half_s = 0.5 * answer["duration_s"]
        pair.run(half_s)
        assert pair.runtime("left").progress() == pytest.approx(pair.runtime("right").progress(), abs=1e-9)
        ends = ends_s(pair, half_s + 0.1)
        assert ends["left"] == ends["right"]
        assert pair.runtime("left").set_point.q_rad == pytest.approx(NEAR)
        assert pair.runtime("right").set_point.q_rad == pytest.approx(WIDE)


def test_a_pause_and_an_override_of_one_are_those_of_both() -> None:
    with holding_pair() as pair:
        pair.clients["left"].ask("move_together", moves={"left": {"q_rad": NEAR}, "right": {"q_rad": WIDE}})
        pair.run(0.2)
        pair.clients["right"].pause()
        pair.until(lambda: pair.mode("left") is pair.mode("right") is Mode.PAUSED, 0.1)
        pair.run(0.4)
        pair.clients["left"].override(0.5)
        pair.clients["left"].resume()
        ends = ends_s(pair, 3.0)
        assert ends["left"] == ends["right"], "both keep one pace"
        assert pair.runtime("right").override == 0.5


def test_a_path_of_one_and_a_move_of_the_other() -> None:
    pose = (-0.2, -0.6, 0.3)
    with holding_pair(scenario(pose, effect=FRICTION)) as pair:
        arm = PAIR.placed("right").arm
        x, y, z = pair.clients["right"].status()["tip_set_m"]
        points = Waypoints(((x, y, z), (x + 0.03, y - 0.03, z), (x, y - 0.05, z)), None)
        path = plan_path(arm, points, 0.2, q_near_rad=pose)
        moves = {"right": {"path": path.to_message()}, "left": {"q_rad": (0.2, -0.6, 0.3)}}
        duration_s = pair.clients["right"].ask("move_together", moves=moves)["duration_s"]
        assert duration_s == pytest.approx(path.duration_s)
        assert ends_s(pair, duration_s + 0.1)["left"] == pytest.approx(pair.rig.clock.now_s(), abs=2.5 * PERIOD_S)


def test_motions_that_would_meet_are_refused_and_neither_begins() -> None:
    with holding_pair() as pair:
        moves = {"left": {"q_rad": (-0.6, -0.8, 0.0)}, "right": {"q_rad": (0.6, -0.8, 0.0)}}
        assert "of arm 'right' after" in pair.refusal("left", do="move_together", moves=moves)
        assert pair.mode("left") is pair.mode("right") is Mode.HOLDING


@pytest.mark.parametrize(
    ("moves", "said"),
    [
        ({"left": {"q_rad": NEAR}}, "expected moves of two arms or more, got 1"),
        ({"left": {"q_rad": NEAR}, "middle": {"q_rad": NEAR}}, "expected one of left, right"),
        ({"left": {"q_rad": NEAR}, "right": {"q_rad": (0.1, 9.0, 0.1)}}, "arm 'right': joint move: joint 2 cannot go"),
        ({"left": {"q_rad": NEAR}, "right": {}}, "expected either q_rad or path for each arm"),
        ({"left": {"q_rad": NEAR}, "right": {"q": NEAR}}, "unknown field `q`"),
    ],
)
def test_what_is_wrong_with_one_is_said_and_neither_begins(together: Pair, moves: dict[str, object], said: str) -> None:
    assert said in together.refusal("left", do="move_together", moves=moves)
    assert together.mode("left") is together.mode("right") is Mode.HOLDING


@pytest.fixture(scope="module")
def together() -> Iterator[Pair]:
    with holding_pair() as pair:
        yield pair


def test_a_stop_ends_both_and_a_client_that_goes_stops_both() -> None:
    with holding_pair() as pair:
        moves = {"left": {"q_rad": NEAR}, "right": {"q_rad": WIDE}}
        pair.clients["left"].ask("move_together", moves=moves)
        pair.run(0.1)
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(cell_requests, "decoded", lambda request: pytest.fail("it was read"))
            assert "is MOVING" in pair.refusal("left", do="move_together", moves=moves)
        pair.channels["left"].close()
        assert pair.mode("left") is pair.mode("right") is Mode.STOPPING
        pair.until(lambda: pair.mode("left") is pair.mode("right") is Mode.HOLDING, 0.6)
        assert pair.runtime("left").set_point.q_rad != APART


@pytest.mark.parametrize("ends", [{"do": "control", "revoke": True}, {"do": "off"}], ids=["revoke", "off"])
def test_what_ends_a_joint_motion_for_one_ends_it_for_all(ends: dict[str, object]) -> None:
    with holding_pair() as pair:
        moves = {"left": {"q_rad": NEAR, "speed": 0.2}, "right": {"q_rad": WIDE, "speed": 0.2}}
        pair.clients["left"].ask("move_together", moves=moves)
        pair.run(0.5)
        pair.clients["right"].ask(**ends)
        pair.until(lambda: pair.mode("left") is Mode.HOLDING, 0.5)
        left = pair.runtime("left")
        assert left.was_stopped
        assert left.stop_reason == "arm 'right', which moves with it, was stopped"
        assert left.set_point.q_rad != pytest.approx(NEAR, abs=0.05)


FOUR = """name = "four"
clearance_m = 0.06
can = {interface = "socketcan", channel = "can0", bitrate = 1000000}
"""
ONE_OF_FOUR = """
[[arm]]
name = "arm{0}"
file = "left"
origin_m = [0.0, {0}.0, 0.0]
encoder_ports = ["/dev/ttyACM{0}"]
motor_nodes = {1}
camera_port = 4731{0}
"""


def test_two_joint_motions_at_once_end_each_for_its_own_arms(tmp_path: Path) -> None:
    nodes = ([1, 2, 3], [4, 5, 6], [7, 8, 9], [10, 11, 12])
    text = "".join(ONE_OF_FOUR.format(number, of_it) for number, of_it in enumerate(nodes))
    (tmp_path / "cell.toml").write_text(FOUR + text)
    with holding_pair(cell=load_cell(str(tmp_path / "cell.toml"))) as four:
        for names in (("arm0", "arm1"), ("arm2", "arm3")):
            moves = {name: {"q_rad": FREE, "speed": 0.2} for name in names}
            four.clients[names[0]].ask("move_together", moves=moves)
        four.run(0.3)
        four.clients["arm1"].ask("off")
        four.until(lambda: four.mode("arm0") is Mode.HOLDING, 0.5)
        assert four.mode("arm2") is four.mode("arm3") is Mode.MOVING
        four.clients["arm2"].ask("off")
        four.until(lambda: four.mode("arm3") is Mode.HOLDING, 0.5)


def test_an_arm_that_moves_on_its_own_beside_another_is_not_stopped_with_it() -> None:
    with holding_pair() as pair:
        pair.clients["left"].move_joints(NEAR, 0.2, waits=False)
        pair.clients["right"].move_joints(WIDE, 0.2, waits=False)
        pair.run(0.3)
        pair.clients["right"].ask("off")
        pair.run(0.2)
        assert pair.mode("left") is Mode.MOVING
