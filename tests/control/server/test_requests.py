"""Requests: what is wrong with one is said and changes nothing; what docs/socket.md lists exists, and nothing else does."""

from __future__ import annotations

import json
import math
import re
from typing import Any

import msgspec
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from control.motion.plan import plan_path
from control.safety.modes import Mode
from control.server import messages, requests
from control.server.requests import Requests
from tests.cell import RIGHT, STRETCHED, Cell, handled, holding_cell, open_cell, scenario
from tests.places import ROOT

DOCUMENT = (ROOT / "docs" / "socket.md").read_text("utf-8")


def snapshot(cell: Cell) -> tuple[object, ...]:
    """What a request could change."""
    runtime = cell.runtime
    return (
        runtime.monitor.mode,
        runtime.motion,
        runtime.run_number,
        runtime.set_point,
        runtime.averaging,
        runtime.bound,
        runtime.jogging,
        runtime.override,
        runtime.is_weightless,
        runtime.parts.loads.masses_kg,
        runtime.parts.tool,
        runtime.monitor.is_homed,
    )


NUMBERS = [None, "1", [], {}, True, -1.0, 1e300, math.inf, math.nan]
POSES = [
    None,
    1.0,
    "abc",
    {},
    [],
    [0.1, 0.2],
    [0.1, 0.2, 0.3, 0.4],
    [0.1, "0.2", 0.3],
    [0.1, None, 0.3],
    [0.1, math.nan, 0.3],
    [math.inf, 0.0, 0.0],
    [[0.1], [0.2], [0.3]],
    [9.0, 0.0, 0.0],
    [0.0, 0.9, 0.0],
    [True, False, True],
]


def resting_at(pose: tuple[float, ...]) -> dict[str, Any]:
    """A path of the joints that stays at a pose."""
    zeros = [[0.0] * len(pose)] * 2
    still = {"speed_rad_s": zeros, "acceleration_rad_s2": zeros}
    return {"times_s": [0.0, 1.0], "q_rad": [list(pose)] * 2, **still}


BAD: list[dict[str, Any]] = [
    {},
    {"do": None},
    {"do": 5},
    {"do": ["status"]},
    {"do": "dance"},
    {"do": "__init__"},
    {"do": ""},
    *({"do": "move_joints", "q_rad": pose} for pose in POSES),
    {"do": "move_joints"},
    *({"do": "move_joints", "q_rad": list(STRETCHED), "speed": number} for number in [*NUMBERS, 0.0, 1.0001]),
    {"do": "average"},
    *({"do": "average", "duration_s": number} for number in [*NUMBERS, 0.0, 61.0]),
    {"do": "average_result"},
    {"do": "payload"},
    *({"do": "payload", "mass_kg": number} for number in [*NUMBERS, 101.0]),
    {"do": "run_path"},
    *({"do": "run_path", "path": path} for path in [None, 1, "x", [], {}, {"spline": {}}, {"spline": 5, "q_waypoints_rad": 5}]),
    {"do": "run_joints"},
    *({"do": "run_joints", "path": path} for path in [None, 1, "x", [], {}, {"times_s": [0.0, 1.0], "q_rad": 5}]),
    *({"do": "run_joints", "path": resting_at(pose)} for pose in [STRETCHED[:2], (0.0, 0.9, 0.0), (0.5, -0.5, 0.0)]),
    {"do": "acknowledge"},
    {"do": "pause"},
    {"do": "resume"},
    {"do": "jog_on"},
    *({"do": "override", "fraction": number} for number in [*NUMBERS, 0.0, 1.01]),
    {"do": "jog"},
    {"do": "jog", "axis": "z"},
    {"do": "jog", "joint": 1},
    {"do": "jog", "joint": 1, "axis": "x", "by_m": 0.01},
    *({"do": "jog", "joint_speed_rad_s": pose} for pose in POSES[:12]),
    *({"do": "jog", "tip_velocity_m_s": pose} for pose in POSES[:12]),
    *({"do": "jog", "joint": number, "by_rad": 0.1} for number in [*NUMBERS, 0, 4, 1.5]),
    *({"do": "jog", "joint": 1, "by_rad": number} for number in [*(n for n in NUMBERS if n != -1.0), 7.1]),
    *({"do": "jog", "joint": 1, "by_rad": 0.1, "speed_rad_s": number} for number in [*NUMBERS[1:], 0.0]),
    *({"do": "jog", "axis": axis, "by_m": 0.01} for axis in [None, 3, "w", ["x"], ""]),
    *({"do": "jog", "axis": "z", "by_m": number} for number in [*(n for n in NUMBERS if n != -1.0), 1.1]),
    *({"do": "jog", "axis": "z", "by_m": 0.01, "speed_m_s": number} for number in [*NUMBERS[1:], 0.0]),
]


@pytest.fixture(scope="module")
def held() -> Any:
    with holding_cell() as cell:
        yield cell


@pytest.mark.parametrize("request_", BAD, ids=str)
def test_a_request_that_is_wrong_is_refused_with_a_reason_and_changes_nothing(held: Cell, request_: dict[str, Any]) -> None:
    before = snapshot(held)
    answer = handled(held, request_, 7)
    assert answer["ok"] is False
    assert len(answer["error"]) > 10
    assert "Traceback" not in answer["error"]
    assert snapshot(held) == before


def values() -> st.SearchStrategy[Any]:
    plain = st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5)
    return st.recursive(
        plain, lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=5), inner, max_size=3)
    )


@settings(max_examples=120, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    do=st.sampled_from(
        ["status", "move_joints", "run_path", "jog", "override", "average", "average_result", "payload", "fault_cycles"]
    )
    | values(),
    keys=st.dictionaries(
        st.sampled_from(
            ["q_rad", "speed", "path", "duration_s", "mass_kg", "id", "detached", "joint", "axis", "tip_velocity_m_s"]
        ),
        values(),
    ),
)
def test_whatever_json_says_it_is_answered_and_never_raises(held: Cell, do: Any, keys: dict[str, Any]) -> None:
    answer = handled(held, {"do": do, **keys}, 7)
    assert isinstance(answer["ok"], bool)
    msgspec.json.encode(answer)


@pytest.mark.parametrize("key", ["spline", "q_waypoints_rad", "branch", "slowdowns"])
@pytest.mark.parametrize("value", [None, 5, "x", [], {}, [[1.0]], [[math.nan] * 3] * 4, {"times_s": [0.0]}])
def test_a_path_with_a_part_that_is_wrong_is_refused(held: Cell, key: str, value: object) -> None:
    path = {**PATH, key: value}
    before = snapshot(held)
    answer = handled(held, {"do": "run_path", "path": path}, 7)
    if key in ("branch", "slowdowns") and answer["ok"]:
        pytest.fail(f"a path with {key} = {value!r} was run")
    assert not answer["ok"]
    assert snapshot(held) == before


PATH = json.loads(json.dumps(plan_path(RIGHT, [(0.5, 0.0, 0.1), (0.5, 0.1, 0.1), (0.5, 0.1, 0.15)], 0.1).to_message()))


def test_a_path_is_refused_where_the_arm_does_not_stand_at_its_first_point(held: Cell) -> None:
    error = handled(held, {"do": "run_path", "path": PATH}, 7)["error"]
    assert "move there first" in error
    assert "rad away from the path's first point" in error


def test_a_good_path_runs_to_its_end(cell: Cell) -> None:
    path = plan_path(RIGHT, [(0.5, 0.0, 0.1), (0.5, 0.05, 0.1)], 0.3, q_near_rad=STRETCHED)
    cell.client.move_joints(path.q_start_rad)
    cell.client.run_path(path.to_message())
    assert cell.rig.tip_m() == pytest.approx((0.5, 0.05, 0.1), abs=2e-3)


@pytest.mark.parametrize("do", ["home", "move_joints", "run_path", "guide"])
def test_nothing_moves_while_the_drives_are_off(do: str) -> None:
    with open_cell(scenario(homed=True)) as cell:
        request = {"do": do, "again": True, "q_rad": list(STRETCHED), "path": PATH}
        assert cell.refusal(**request)
        cell.run(0.02)
        assert cell.mode is Mode.OFF
        assert {board.output for board in cell.rig.robot.motor_boards} == {("voltage", 0.0)}


def test_a_second_motion_is_refused_while_the_first_one_runs(cell: Cell) -> None:
    cell.start_move((0.3, -0.5, 0.3))
    cell.run(0.05)
    motion = cell.runtime.motion
    assert "MOVING" in cell.refusal(do="move_joints", q_rad=list(STRETCHED))
    assert cell.runtime.motion is motion


# ---- whose motion it is


def test_a_client_that_hangs_up_stops_its_own_motion_under_control(cell: Cell) -> None:
    cell.start_move((0.6, -0.3, 0.5))
    cell.run(0.2)
    cell.channel.close()
    cell.run(0.01)
    assert cell.mode is Mode.STOPPING
    cell.until(lambda: cell.mode is Mode.HOLDING, 1.0)
    assert cell.runtime.monitor.faults == ()


def test_a_detached_motion_outlives_its_client(cell: Cell) -> None:
    cell.client.ask("move_joints", q_rad=[0.3, -0.5, 0.3], detached=True)
    cell.run(0.1)
    cell.channel.close()
    cell.until(lambda: cell.mode is Mode.HOLDING, 1.0)
    assert cell.rig.joint_rad() == pytest.approx((0.3, -0.5, 0.3), abs=2e-3)


def test_another_clients_hanging_up_does_not_stop_a_motion(cell: Cell) -> None:
    cell.start_move((0.3, -0.5, 0.3))
    cell.run(0.1)
    cell.assembly.requests.on_gone(99)
    cell.run(0.01)
    assert cell.mode is Mode.MOVING


def test_a_homing_belongs_to_its_client_too() -> None:
    with holding_cell(scenario((-0.1, 0.0, 0.6), homed=False)) as cell:
        cell.client.ask("home")
        cell.run(0.1)
        cell.channel.close()
        cell.run(0.01)
        assert cell.mode is Mode.STOPPING


# ---- the document


def documented(heading: str) -> dict[str, str]:
    """First column of the table that begins with `heading` -> the rest of the row."""
    table = DOCUMENT.split(heading, 1)[1].split("\n\n", 1)[0]
    rows = [line.strip("|").split("|", 1) for line in table.splitlines()[2:]]
    return {first.strip(): rest for first, rest in rows}


def test_every_request_is_documented_and_every_documented_one_exists(held: Cell) -> None:
    served: Requests = held.assembly.requests
    assert {name.strip("`") for name in documented("| `do` | arguments |")} == set(served.names)


def test_every_key_of_the_status_is_documented_and_every_documented_one_is_there(held: Cell) -> None:
    keys = {key for cell in documented("| key | meaning |") for key in re.findall(r"`(\w+)`", cell)}
    of_the_process = {"rights", "cell"}  # what `armwright serve` adds, and a cell
    assert keys == set(held.client.status()) - {"ok"} | of_the_process


def test_every_argument_of_a_request_is_documented() -> None:
    kinds = [kind for kind in vars(messages).values() if isinstance(kind, type) and issubclass(kind, messages._Message)]
    asked = {name for kind in kinds for name in kind.__struct_fields__}
    said = set(re.findall(r"`(\w+)`", DOCUMENT)) | set(re.findall(r'"(\w+)": true', DOCUMENT))
    assert asked <= said
    assert asked >= {"q_rad", "speed", "path", "duration_s", "mass_kg", "detached", "again", "quit", "do", "by_rad"}


# ---- strict types


@pytest.mark.parametrize(
    ("request_", "complaint"),
    [
        ({"do": "move_joints", "q_rad": [0, 0, 0.5], "detached": "false"}, 'detached: expected true or false, got "false"'),
        ({"do": "off", "quit": 1}, "quit: expected true or false, got 1"),
        ({"do": "override", "fraction": 2}, "fraction: expected a number <= 1.0, got 2"),
        ({"do": "stop", "now": True}, "unknown field `now`"),
        ({"do": "average"}, "missing required field `duration_s`"),
        ({"do": "jog", "joint": 1.5, "by_rad": 0.1}, "joint: expected a whole number, got 1.5"),
        ({"do": "payload", "mass_kg": 100.0}, "expected mass_kg from 0 to 5 kg ([limits] payload_limit_kg), got 100"),
    ],
)
def test_a_refusal_names_the_key_what_was_expected_and_what_came(held: Cell, request_: dict[str, Any], complaint: str) -> None:
    assert complaint in handled(held, request_, 7)["error"]


def test_a_path_is_not_read_while_the_arm_moves(cell: Cell, monkeypatch: pytest.MonkeyPatch) -> None:
    cell.start_move((0.3, -0.5, 0.3))
    cell.run(0.05)
    monkeypatch.setattr(requests, "decoded", lambda request: pytest.fail("it was read"))
    assert "MOVING" in handled(cell, {"do": "run_path", "path": PATH, "id": 1})["error"]
    assert "control" in handled(cell, {"do": "run_path", "path": PATH}, 9)["error"]


def test_a_long_line_is_read_only_where_it_carries_a_path(held: Cell, monkeypatch: pytest.MonkeyPatch) -> None:
    """Anybody may ask to watch or to stop, and a wrong value of a megabyte cost ten cycles."""
    most = messages.LONGEST_PLAIN_bytes
    monkeypatch.setattr(messages, "_complaint", lambda line, error: pytest.fail("it was read"))
    for do in messages.STOPPING | messages.WATCHING:
        error = handled(held, {"do": do, "speed": "x" * most}, 1)["error"]
        assert f"expected at most {most} bytes, got" in error


# ---- one client is in control


COMMANDS = [
    {"do": "override", "fraction": 1.0},
    {"do": "resume"},
    {"do": "payload", "mass_kg": 1.0},
    {"do": "guide"},
    {"do": "enable"},
    {"do": "move_joints", "q_rad": [0.0, 0.0, 0.5]},
    {"do": "home"},
    {"do": "average", "duration_s": 1.0},
    {"do": "hold"},
    {"do": "jog", "joint": 1, "by_rad": 0.1},
    {"do": "control", "take": True},
]


def test_while_one_client_moves_the_arm_another_may_watch_and_stop_only(cell: Cell) -> None:
    cell.start_move((0.6, -0.3, 0.5), speed=0.3)
    cell.run(0.1)
    before = snapshot(cell)
    for command in COMMANDS:
        assert "client 0 has control" in handled(cell, command, 9)["error"], command
    assert snapshot(cell) == before
    assert handled(cell, {"do": "status"}, 9)["in_control"] == 0
    assert handled(cell, {"do": "pause"}, 9)["ok"]
    assert "client 0 has control" in handled(cell, {"do": "resume"}, 9)["error"]
    assert handled(cell, {"do": "stop"}, 9)["ok"]
    cell.until(lambda: cell.mode is Mode.HOLDING, 1.0)
    assert handled(cell, {"do": "override", "fraction": 0.5}, 9)["ok"]  # nothing goes on: the next command is free


def test_control_of_a_client_that_hangs_can_be_ended_and_it_commands_nothing_more(cell: Cell) -> None:
    cell.client.take_control()
    cell.start_move((0.6, -0.3, 0.5))
    cell.run(0.1)
    refusal = handled(cell, COMMANDS[0], 9)["error"]
    assert "`armwright stop --take` also ends" in refusal
    assert handled(cell, {"do": "control", "revoke": True}, 9) == {"ok": True, "client": 9, "in_control": None}
    cell.run(0.6)
    assert cell.mode is Mode.HOLDING
    assert cell.runtime.was_stopped
    assert handled(cell, {"do": "control", "take": True}, 9)["in_control"] == 9
    handled(cell, {"do": "control", "take": False}, 9)
    for command in COMMANDS:  # it wakes up: what it planned is not what is wanted any more
        assert "somebody has taken control from this client" in handled(cell, command, 0)["error"], command
    assert handled(cell, {"do": "stop"}, 0)["ok"]
    cell.assembly.requests.on_gone(0)  # and connects again
    assert handled(cell, {"do": "move_joints", "q_rad": [0.6, -0.3, 0.5]}, 0)["ok"]


def test_a_client_does_not_revoke_its_own_control(cell: Cell) -> None:
    cell.client.take_control()
    assert handled(cell, {"do": "control", "revoke": True}, 0)["in_control"] == 0


def test_control_that_was_taken_lasts_between_motions_until_its_connection_ends(cell: Cell) -> None:
    cell.client.take_control()
    for command in COMMANDS:
        assert "client 0 has taken control" in handled(cell, command, 9)["error"], command
    assert handled(cell, {"do": "stop"}, 9)["ok"]
    cell.channel.close()
    assert handled(cell, {"do": "control", "take": True}, 9)["in_control"] == 9
    assert handled(cell, {"do": "control", "take": False}, 9)["in_control"] is None


def test_connections_with_one_key_are_one_client(cell: Cell) -> None:
    for client in (0, 9):
        handled(cell, {"do": "control", "key": "0123456789"}, client)
    handled(cell, {"do": "control", "key": "9876543210"}, 8)
    cell.start_move((0.6, -0.3, 0.5), speed=0.3)
    assert handled(cell, {"do": "override", "fraction": 0.5}, 9)["ok"]
    assert not handled(cell, {"do": "override", "fraction": 0.5}, 8)["ok"]
    cell.assembly.requests.on_gone(9)  # the motion is the other one's
    cell.run(0.05)
    assert cell.mode is Mode.MOVING


def test_hand_guiding_ends_with_its_client_and_everybody_may_hold(cell: Cell) -> None:
    cell.client.guide()
    assert "client 0" in handled(cell, {"do": "payload", "mass_kg": 1.0}, 9)["error"]
    cell.channel.close()
    assert cell.mode is Mode.BRAKED
    cell.client.hold()
    cell.client.guide()
    assert handled(cell, {"do": "hold"}, 9)["ok"]
    cell.until(lambda: cell.mode is Mode.HOLDING, 0.5)


def test_a_payload_that_is_stated_wrongly_moves_the_arm_slowly_and_little(cell: Cell) -> None:
    """At once, 5 kg would be 30 Nm more on joint 2 in one cycle."""
    before, speeds = cell.rig.tip_m(), cell.true_speeds()
    cell.client.ask("payload", mass_kg=2.0)
    assert cell.runtime.stated_payload_kg == 2.0
    cell.run(2.2)
    assert cell.mode is Mode.HOLDING
    assert cell.runtime.payload_kg() == 2.0
    assert max(speeds) < 0.05
    assert math.dist(before, cell.rig.tip_m()) < 5e-3
