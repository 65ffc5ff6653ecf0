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
from control.safety.table import Mode
from control.server.requests import Requests
from tests.cell import RIGHT, STRETCHED, Cell, holding_cell, open_cell, scenario
from tests.places import ROOT

DOCUMENT = (ROOT / "docs" / "socket.md").read_text("utf-8")


def snapshot(cell: Cell) -> tuple[object, ...]:
    """What a request could change."""
    runtime = cell.runtime
    return (
        runtime.monitor.mode, runtime.motion, runtime.run_number, runtime.set_point, runtime.averaging, runtime.is_quitting,
        runtime.jogging, runtime.override, runtime.is_weightless,
        runtime.parts.servo.torque_model.payload_kg, runtime.monitor.is_homed, runtime.wants_hold, runtime.is_going_off,
    )  # fmt: skip


NUMBERS = [None, "1", [], {}, True, -1.0, 1e300, math.inf, math.nan]
POSES = [
    None, 1.0, "abc", {}, [], [0.1, 0.2], [0.1, 0.2, 0.3, 0.4], [0.1, "0.2", 0.3], [0.1, None, 0.3], [0.1, math.nan, 0.3],
    [math.inf, 0.0, 0.0], [[0.1], [0.2], [0.3]], [9.0, 0.0, 0.0], [0.0, 0.9, 0.0], [True, False, True],
]  # fmt: skip


def resting_at(pose: tuple[float, ...]) -> dict[str, Any]:
    """A path of the joints that stays at a pose."""
    zeros = [[0.0] * len(pose)] * 2
    still = {"speed_rad_s": zeros, "acceleration_rad_s2": zeros}
    return {"times_s": [0.0, 1.0], "q_rad": [list(pose)] * 2, **still}


BAD: list[dict[str, Any]] = [
    {}, {"do": None}, {"do": 5}, {"do": ["status"]}, {"do": "dance"}, {"do": "__init__"}, {"do": ""},
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
    {"do": "acknowledge"}, {"do": "pause"}, {"do": "resume"}, {"do": "jog_on"},
    *({"do": "override", "fraction": number} for number in [*NUMBERS, 0.0, 1.01]),
    {"do": "jog"}, {"do": "jog", "axis": "z"}, {"do": "jog", "joint": 1}, {"do": "jog", "joint": 1, "axis": "x", "by_m": 0.01},
    *({"do": "jog", "joint_speed_rad_s": pose} for pose in POSES[:12]),
    *({"do": "jog", "tip_velocity_m_s": pose} for pose in POSES[:12]),
    *({"do": "jog", "joint": number, "by_rad": 0.1} for number in [*NUMBERS, 0, 4, 1.5]),
    *({"do": "jog", "joint": 1, "by_rad": number} for number in [*(n for n in NUMBERS if n != -1.0), 7.1]),
    *({"do": "jog", "joint": 1, "by_rad": 0.1, "speed_rad_s": number} for number in [*NUMBERS[1:], 0.0]),
    *({"do": "jog", "axis": axis, "by_m": 0.01} for axis in [None, 3, "w", ["x"], ""]),
    *({"do": "jog", "axis": "z", "by_m": number} for number in [*(n for n in NUMBERS if n != -1.0), 1.1]),
    *({"do": "jog", "axis": "z", "by_m": 0.01, "speed_m_s": number} for number in [*NUMBERS[1:], 0.0]),
]  # fmt: skip


@pytest.fixture(scope="module")
def held() -> Any:
    with holding_cell() as cell:
        yield cell


@pytest.mark.parametrize("request_", BAD, ids=str)
def test_a_request_that_is_wrong_is_refused_with_a_reason_and_changes_nothing(
    held: Cell, request_: dict[str, Any]
) -> None:
    before = snapshot(held)
    answer = held.assembly.requests.handle(request_, 7)
    assert answer["ok"] is False
    assert len(answer["error"]) > 10
    assert "Traceback" not in answer["error"]
    assert snapshot(held) == before


def values() -> st.SearchStrategy[Any]:
    plain = st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5)
    return st.recursive(
        plain,
        lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    )


@settings(max_examples=120, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    do=st.sampled_from(
        [
            "status",
            "move_joints",
            "run_path",
            "jog",
            "override",
            "average",
            "average_result",
            "payload",
            "fault_cycles",
        ]
    )
    | values(),
    keys=st.dictionaries(
        st.sampled_from(
            [
                "q_rad",
                "speed",
                "path",
                "duration_s",
                "mass_kg",
                "id",
                "detached",
                "joint",
                "axis",
                "tip_velocity_m_s",
            ]
        ),
        values(),
    ),
)
def test_whatever_json_says_it_is_answered_and_never_raises(
    held: Cell, do: Any, keys: dict[str, Any]
) -> None:
    answer = held.assembly.requests.handle({"do": do, **keys}, 7)
    assert isinstance(answer["ok"], bool)
    msgspec.json.encode(answer)


@pytest.mark.parametrize("key", ["spline", "q_waypoints_rad", "branch", "slowdowns"])
@pytest.mark.parametrize("value", [None, 5, "x", [], {}, [[1.0]], [[math.nan] * 3] * 4, {"times_s": [0.0]}])
def test_a_path_with_a_part_that_is_wrong_is_refused(held: Cell, key: str, value: object) -> None:
    path = {**PATH, key: value}
    before = snapshot(held)
    answer = held.assembly.requests.handle({"do": "run_path", "path": path}, 7)
    if key in ("branch", "slowdowns") and answer["ok"]:
        pytest.fail(f"a path with {key} = {value!r} was run")
    assert not answer["ok"]
    assert snapshot(held) == before


PATH = json.loads(
    json.dumps(plan_path(RIGHT, [(0.5, 0.0, 0.1), (0.5, 0.1, 0.1), (0.5, 0.1, 0.15)], 0.1).to_message())
)


def test_a_path_is_refused_where_the_arm_does_not_stand_at_its_first_point(held: Cell) -> None:
    error = held.assembly.requests.handle({"do": "run_path", "path": PATH}, 7)["error"]
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
    requests: Requests = held.assembly.requests
    assert {name.strip("`") for name in documented("| `do` | arguments |")} == set(requests.names)


def test_every_key_of_the_status_is_documented_and_every_documented_one_is_there(held: Cell) -> None:
    keys = {key for cell in documented("| key | meaning |") for key in re.findall(r"`(\w+)`", cell)}
    of_the_process = {"rights"}  # what `armwright serve` adds
    assert keys == set(held.client.status()) - {"ok"} | of_the_process


def test_every_argument_of_a_request_is_documented() -> None:
    folder = ROOT / "control" / "server"
    source = "".join((folder / name).read_text("utf-8") for name in ("requests.py", "jog_requests.py"))
    asked = set(re.findall(r'request(?:\.get\(|\[)"(\w+)"', source)) | set(
        re.findall(r'\b(?:numbers?|flag)\(request, "(\w+)"', source)
    )
    said = set(re.findall(r"`(\w+)`", DOCUMENT)) | set(re.findall(r'"(\w+)": true', DOCUMENT))
    assert asked <= said
    assert asked >= {
        "q_rad",
        "speed",
        "path",
        "duration_s",
        "mass_kg",
        "detached",
        "again",
        "quit",
        "do",
        "by_rad",
    }
