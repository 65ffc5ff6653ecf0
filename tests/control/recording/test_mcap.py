"""An exported MCAP file: strict readers take it, Foxglove finds its own messages, times and units are right."""

from __future__ import annotations

import itertools
import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from control.kinematics.kinematics import ForwardKinematics
from control.model.arm import Arm, Link, Tool
from control.model.description import arm_text, load_arm
from control.recording import mcap_scene as scene
from control.recording.export import CycleChanges, to_mcap
from control.recording.mcap_schemas import FOXGLOVE, TOPICS, columns_of
from control.recording.reading import Recording, recorded_arm
from control.recording.record import END_FIELDS, LEAD_FIELD, Layout
from tests.recordings import MODES, ERROR_rad, PERIOD_s, STARTED_s, write_recording

RIGHT = load_arm("right")
MODIFIED = replace(
    RIGHT,
    dh_convention="modified",
    tool=Tool((0.01, -0.02, 0.03)),
    links=tuple(
        Link(joint, d, theta, length, alpha)
        for d, theta, length, alpha, joint in (
            (0.3, 0.1, 0.0, 0.0, "revolute"),
            (0.02, -0.4, 0.1, -1.2, "revolute"),
            (0.0, 0.7, 0.25, 0.3, "revolute"),
            (0.1, 0.2, 0.05, 1.6, "fixed"),
        )
    ),
)


class Read:
    """Everything that mcap's readers find in a file, checksums compared."""

    def __init__(self, path: Path) -> None:
        from mcap.reader import make_reader
        from mcap.stream_reader import StreamReader

        with path.open("rb") as file:  # record by record, as a reader does that cannot seek
            for _ in StreamReader(file, validate_crcs=True).records:
                pass
        self.messages: dict[str, list[tuple[int, dict[str, Any]]]] = {}
        self.schemas: dict[str, dict[str, Any]] = {}
        with path.open("rb") as file:
            reader = make_reader(file, validate_crcs=True)
            self.metadata = {entry.name: entry.metadata for entry in reader.iter_metadata()}
            self.attachments = {entry.name: entry.data for entry in reader.iter_attachments()}
            for schema, channel, message in reader.iter_messages():
                assert schema is not None
                assert (schema.encoding, channel.message_encoding) == ("jsonschema", "json")
                assert message.log_time == message.publish_time
                self.schemas[channel.topic] = json.loads(schema.data)
                assert self.schemas[channel.topic]["title"] == schema.name
                found = json.loads(message.data, parse_constant=_no_nan)
                self.messages.setdefault(channel.topic, []).append((message.log_time, found))


def _no_nan(text: str) -> float:
    raise AssertionError(f"{text} is no JSON")


def exported(tmp_path: Path, recording: Path, arm: Arm | None = RIGHT, every: int = 1) -> Read:
    path = tmp_path / "log.mcap"
    to_mcap(Recording.open(recording), path, every, arm)
    return Read(path)


def fits(value: Any, schema: dict[str, Any]) -> bool:
    """Whether a message has what its schema describes and nothing else."""
    kind = schema.get("type")
    if kind == "object" and "properties" in schema:
        return set(value) <= set(schema["properties"]) and all(
            fits(part, schema["properties"][key]) for key, part in value.items()
        )
    if kind == "array":
        return isinstance(value, list) and all(fits(part, schema["items"]) for part in value)
    types: dict[Any, tuple[type, ...]] = {
        "number": (int, float),
        "integer": (int,),
        "string": (str,),
        "boolean": (bool,),
        "object": (dict,),
    }
    return isinstance(value, types[kind])


def test_every_message_is_what_its_schema_says_and_every_number_has_its_unit(tmp_path: Path) -> None:
    read = exported(tmp_path, write_recording(tmp_path / "a.armlog", 60))
    assert set(read.schemas) == {
        "/joints",
        "/joints/set_point",
        "/joints/following_error",
        "/drives",
        "/camera",
        "/loop",
        "/tf",
        "/scene",
        "/tip/measured",
        "/tip/set_point",
        "/tip/camera",
        "/joint_states",
        "/log",
    }
    for topic, schema in read.schemas.items():
        for _, message in read.messages[topic]:
            assert fits(message, schema), (topic, message)
        if not schema["title"].startswith("foxglove."):
            for name, entry in schema["properties"].items():
                assert entry["type"] == "string" or entry["description"].endswith("]"), name
    assert read.schemas["/joints"]["properties"]["q2_rad"]["description"] == "joint 2: angle by its encoder [rad]"


def test_times_are_those_of_the_day_whenever_the_machine_was_started(tmp_path: Path) -> None:
    read = exported(tmp_path, write_recording(tmp_path / "a.armlog", 5))
    times = [time for time, _ in read.messages["/joints"]]
    assert times == pytest.approx([1e9 * (STARTED_s + k * PERIOD_s) for k in range(5)], abs=1000)
    assert np.diff(times).tolist() == [2_000_000] * 4


def test_what_was_not_measured_is_left_out_alone(tmp_path: Path) -> None:
    gone = {3: {"u2_V": math.nan, "temperature1_C": math.inf, "q1_rad": math.nan}}
    read = exported(tmp_path, write_recording(tmp_path / "a.armlog", 6, changes=gone))
    drives = read.messages["/drives"][3][1]
    assert "u2_V" not in drives
    assert "temperature1_C" not in drives
    assert {"u1_V", "u3_V", "temperature2_C"} <= set(drives)
    assert "q1_rad" not in read.messages["/joints"][3][1]
    assert "following_error1_rad" not in read.messages["/joints/following_error"][3][1]
    assert len(read.messages["/camera"]) == len(read.messages["/tip/camera"]) == 2  # cycles 0 and 5


def test_the_frames_chain_to_where_kinematics_has_the_links_and_the_tip(tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    for arm in (RIGHT, load_arm("left"), MODIFIED):
        for q in rng.uniform(-3.0, 3.0, (5, 3)):
            at = {"base": np.eye(4)}
            for one in scene.transforms(arm, "x", q.tolist(), 0):
                at[one["child_frame_id"]] = at[one["parent_frame_id"]] @ _matrix(one["translation"], one["rotation"])
            links = ForwardKinematics(arm).link_transforms([q])[0]
            for number in range(1, len(arm.links) + 1):
                np.testing.assert_allclose(at[f"x/link{number}"], links[number], atol=1e-12)
            np.testing.assert_allclose(at["x/tip"][:3, 3], ForwardKinematics(arm).tips([q])[0], atol=1e-12)


def _matrix(at: dict[str, float], turn: dict[str, float]) -> np.ndarray[Any, Any]:
    x, y, z, w = (turn[key] for key in "xyzw")
    matrix = np.eye(4)
    matrix[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    matrix[:3, 3] = [at[key] for key in "xyz"]
    return matrix


@pytest.mark.parametrize("arm", [RIGHT, MODIFIED], ids=["standard", "modified"])
def test_the_shapes_reach_from_joint_to_joint_and_to_the_tip(arm: Arm) -> None:
    q = np.array([0.3, -0.5, 0.7])
    at = {"base": np.eye(4)}
    for one in scene.transforms(arm, "measured", q.tolist(), 0):
        at[one["child_frame_id"]] = at[one["parent_frame_id"]] @ _matrix(one["translation"], one["rotation"])
    joints = [*ForwardKinematics(arm).link_transforms([q])[0][:, :3, 3], ForwardKinematics(arm).tips([q])[0]]
    ends = []
    for entity in scene.shapes(arm, 0)["entities"]:
        if not entity["id"].startswith("measured/shape") or not entity["cylinders"]:
            continue
        cylinder = entity["cylinders"][0]
        pose = at[entity["frame_id"]] @ _matrix(cylinder["pose"]["position"], cylinder["pose"]["orientation"])
        half = 0.5 * cylinder["size"]["z"]
        ends.append([pose[:3, 3] + side * half * pose[:3, 2] for side in (-1, 1)])
    wanted = [pair for pair in itertools.pairwise(joints) if np.linalg.norm(pair[1] - pair[0]) > 1e-9]
    assert len(ends) == len(wanted)
    for got, pair in zip(ends, wanted, strict=True):
        distances = [np.abs(np.array(got) - order).max() for order in (pair, pair[::-1])]
        assert min(distances) < 1e-9


def test_a_shape_that_points_straight_down_is_no_division_by_zero() -> None:
    down = replace(RIGHT, tool=Tool((0.0, 0.0, -0.1)))
    entity = scene.shapes(down, 0)["entities"][len(RIGHT.links)]
    assert entity["cylinders"][0]["pose"]["orientation"] == {"x": 1.0, "y": 0.0, "z": 0.0, "w": 0.0}


def test_the_commanded_path_is_shown_when_its_run_begins(tmp_path: Path) -> None:
    read = exported(tmp_path, write_recording(tmp_path / "a.armlog", 120))
    (_, _), (time, update) = read.messages["/scene"]
    assert time == next(t for t, m in read.messages["/loop"] if m["run"] == 1)
    points = update["entities"][0]["lines"][0]["points"]
    k = np.arange(10, 120, 10)  # one each 0.02 s
    q = np.stack([0.1 * j * np.sin(2 * np.pi * k * PERIOD_s) for j in (1, 2, 3)], axis=1)
    np.testing.assert_allclose([[p["x"], p["y"], p["z"]] for p in points], ForwardKinematics(RIGHT).tips(q), atol=1e-9)


def test_following_errors_and_joint_states_are_those_of_the_recording(tmp_path: Path) -> None:
    read = exported(tmp_path, write_recording(tmp_path / "a.armlog", 30))
    for _, message in read.messages["/joints/following_error"]:
        assert message == pytest.approx({f"following_error{j}_rad": j * ERROR_rad for j in (1, 2, 3)})
    _, states = read.messages["/joint_states"][0]
    assert [joint["name"] for joint in states["joints"]] == ["joint1", "joint2", "joint3"]
    assert states["joints"][1]["position"] == pytest.approx(-2 * ERROR_rad)


def test_the_log_says_what_changed_and_warns_of_missed_deadlines_once_a_second(tmp_path: Path) -> None:
    changes: dict[int, dict[str, float]] = {k: {"missed": k - 19} for k in range(20, 600)}  # one in every cycle
    changes[599] |= {"mode": MODES.index("FAULT"), "drive_faults2": 4}
    read = exported(tmp_path, write_recording(tmp_path / "a.armlog", 600, changes=changes))
    said = [(entry["level"], entry["message"]) for _, entry in read.messages["/log"]]
    assert said == [
        (2, "mode HOLDING"),
        (2, "mode MOVING"),
        (2, "run 1 begins"),
        (3, "1 deadlines missed, 1 so far"),
        (3, "500 deadlines missed, 501 so far"),
        (4, "mode FAULT"),
        (4, "drive of joint 2: fault bits 0x04"),
    ]


def test_a_mode_of_a_later_version_is_its_number() -> None:
    assert list(CycleChanges(("OFF",)).look(0.0, 7, 0, 0, (0.0,))) == [(2, "mode mode 7")]


def test_the_arm_is_attached_and_the_origin_is_said(tmp_path: Path) -> None:
    recording = write_recording(tmp_path / "a.armlog", 3, arm_toml=arm_text(RIGHT))
    read = exported(tmp_path, recording)
    assert read.attachments["arm.toml"].decode() == arm_text(RIGHT)
    about = read.metadata["armwright"]
    assert (about["arm"], about["cycles"], about["joint_count"]) == ("right", "3", "3")
    assert len(about["recording_sha256"]) == 64


def test_without_an_arm_there_are_plots_and_no_scene(tmp_path: Path) -> None:
    recording = write_recording(tmp_path / "a.armlog", 20, joint_count=5, arm="nobody's")
    assert recorded_arm(Recording.open(recording)) is None
    read = exported(tmp_path, recording, None)
    assert "/tf" not in read.messages
    assert "/scene" not in read.messages
    assert len(read.messages["/joints"]) == 20
    assert "q5_rad" in read.messages["/joints"][0][1]


@pytest.mark.parametrize("cycles", [0, 1])
def test_a_recording_of_no_cycle_is_a_file_that_opens(tmp_path: Path, cycles: int) -> None:
    read = exported(tmp_path, write_recording(tmp_path / "a.armlog", cycles))
    assert len(read.messages.get("/joints", [])) == cycles
    assert read.metadata["armwright"]["cycles"] == str(cycles)


def test_a_torn_last_row_costs_that_row_alone(tmp_path: Path) -> None:
    whole = write_recording(tmp_path / "a.armlog", 7).read_bytes()
    (tmp_path / "torn.armlog").write_bytes(whole[:-11])
    assert len(exported(tmp_path, tmp_path / "torn.armlog").messages["/joints"]) == 6


def test_the_arm_is_that_of_the_header_then_of_its_file_then_of_its_name(tmp_path: Path) -> None:
    own = replace(RIGHT, name="own")
    (tmp_path / "own.toml").write_text(arm_text(replace(own, name="filed")))
    for header, expected in (
        ({"arm_toml": arm_text(own), "arm_file": str(tmp_path / "own.toml")}, "own"),
        ({"arm_toml": "name = 3", "arm_file": str(tmp_path / "own.toml")}, "filed"),
        ({"arm_file": str(tmp_path / "gone.toml")}, "right"),
        ({"arm": "left"}, "left"),
    ):
        path = write_recording(tmp_path / "a.armlog", 1, **header)
        arm = recorded_arm(Recording.open(path))
        assert arm is not None
        assert arm.name == expected


def test_every_column_of_a_recording_is_in_its_topic() -> None:
    carried = [name for topic in TOPICS for name in columns_of(topic, 3)]
    of_leads = [(LEAD_FIELD[0].format(joint), LEAD_FIELD[1]) for joint in (1, 2, 3)]
    assert sorted(carried) == sorted(Layout.of(3, has_joint_side=True, more=(*END_FIELDS, *of_leads)).names)


def test_foxglove_knows_its_messages_by_their_titles() -> None:
    assert set(FOXGLOVE) == {
        f"foxglove.{name}" for name in ("FrameTransforms", "SceneUpdate", "PoseInFrame", "JointStates", "Log")
    }


def test_the_arm_is_drawn_of_its_joints_where_they_are_recorded_beside_their_encoders(tmp_path: Path) -> None:
    for has_joint_side, name in ((True, "joint{}{}_rad"), (False, "q{}{}_rad")):
        folder = tmp_path / str(has_joint_side)
        folder.mkdir()
        path = write_recording(folder / "a.armlog", 60, has_joint_side=has_joint_side)
        opened = Recording.open(path)
        last = dict(zip(opened.layout.names, list(opened.rows())[50], strict=True))
        read = exported(folder, path)
        for topic, which in (("/tip/measured", ""), ("/tip/set_point", "_set")):
            expected = ForwardKinematics(RIGHT).tip(*(last[name.format(j, which)] for j in (1, 2, 3)))
            found = read.messages[topic][-1][1]["pose"]["position"]
            assert [found[axis] for axis in "xyz"] == pytest.approx(expected, abs=1e-9)
