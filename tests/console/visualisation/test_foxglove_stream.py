"""`armwright view --foxglove`: the messages are what the status says, and a viewer gets them through the SDK's server."""

from __future__ import annotations

import json
import struct
import sys
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from console.commands import view
from console.main import main
from console.visualisation.streams import Address, LiveMessages, address_of, serve
from control.errors import ArmError
from control.kinematics.kinematics import ForwardKinematics
from control.recording.mcap_schemas import schemas_of
from control.server.channel import Message, RuntimeGone
from tests.cell import RIGHT, Cell

FREE = Address("127.0.0.1", 0)


def topics_of(messages: LiveMessages, status: Message) -> dict[str, Message]:
    """The last message of each topic."""
    return dict(messages.of(status, 5_000_000_007))


def tip_by_frames(message: Message, which: str) -> Any:
    """The tip [m] in the base frame by a FrameTransforms message."""
    base_T_tip = np.eye(4)
    for frame in message["transforms"]:
        if frame["child_frame_id"].startswith(which):
            x, y, z, w = (frame["rotation"][part] for part in "xyzw")
            parent_T_child = np.eye(4)
            parent_T_child[:3, :3] = [
                [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
                [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
                [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
            ]
            parent_T_child[:3, 3] = [frame["translation"][axis] for axis in "xyz"]
            base_T_tip = base_T_tip @ parent_T_child
    return base_T_tip[:3, 3]


def test_messages_say_what_the_status_says_in_the_recordings_topics(cell: Cell) -> None:
    cell.start_move((0.3, -0.5, 0.4))
    cell.run(0.2)
    status = cell.client.status()
    sent = topics_of(LiveMessages(RIGHT), status)
    assert sent["/joints"]["q2_rad"] == status["q_rad"][1]
    assert sent["/joints/set_point"]["joint3_set_rad"] == status["joint_set_rad"][2]
    assert sent["/joints/following_error"]["following_error2_rad"] == status["following_error_rad"][1]
    assert sent["/drives"]["i2_A"] == status["current_A"][1] != 0.0
    assert (sent["/loop"]["mode_name"], sent["/log"]["message"]) == ("MOVING", "run 1 begins")
    assert sent["/joint_states"]["timestamp"] == {"sec": 5, "nsec": 7}
    assert [joint["name"] for joint in sent["/joint_states"]["joints"]] == ["joint1", "joint2", "joint3"]
    tips = {"measured": status["tip_m"], "set_point": status["tip_set_m"]}
    for which, tip_m in tips.items():
        np.testing.assert_allclose(tip_by_frames(sent["/tf"], which), tip_m, atol=1e-9)
    assert sent["/tip/measured"]["pose"]["position"]["x"] == pytest.approx(status["tip_m"][0])
    assert {entity["frame_id"].partition("/")[0] for entity in sent["/scene"]["entities"]} == {"measured", "set_point"}
    schemas = schemas_of(3)
    for topic, message in sent.items():
        assert set(message) <= set(schemas[topic]["properties"]), topic


def test_shapes_come_again_each_second_and_faults_once(cell: Cell) -> None:
    messages, status = LiveMessages(RIGHT), cell.client.status()
    fault = {"code": "stale", "where": "joint 1", "message": "no reply", "remedy": "check the cable"}
    shapes, logged = 0, []
    for k in range(30):
        now = {**status, "t_s": status["t_s"] + 0.1 * k, "faults": [fault], "mode": "FAULT"}
        for topic, message in messages.of(now, k):
            shapes += topic == "/scene"
            logged += [message["message"]] if topic == "/log" else []
    assert shapes == 3
    assert logged == ["mode FAULT", "joint 1: no reply; check the cable"]


def test_what_is_not_known_is_omitted(cell: Cell) -> None:
    status = {**cell.client.status(), "supply_V": [None, 24.0, 24.0], "camera_m": [0.1, 0.2, 0.3]}
    sent = topics_of(LiveMessages(RIGHT), status)
    assert {name for name in sent["/drives"] if name.startswith("supply")} == {"supply2_V", "supply3_V"}
    assert sent["/camera"] == {"x_m": 0.1, "y_m": 0.2, "z_m": 0.3}
    assert sent["/tip/camera"]["pose"]["position"] == {"x": 0.1, "y": 0.2, "z": 0.3}


def test_a_tool_that_is_changed_moves_the_tip(cell: Cell) -> None:
    long = RIGHT.tool.__class__((0.0, 0.0, 0.2), name="long")
    arm = RIGHT.__class__(**{f: getattr(RIGHT, f) for f in RIGHT.__dataclass_fields__} | {"spare_tools": (long,)})
    messages, status = LiveMessages(arm), cell.client.status()
    topics_of(messages, status)
    sent = topics_of(messages, {**status, "tool": "long"})
    expected = ForwardKinematics(arm.with_tool("long")).tips([status["joint_rad"]])[0]
    np.testing.assert_allclose(tip_by_frames(sent["/tf"], "measured"), expected, atol=1e-9)
    assert "/scene" in sent


def test_a_viewer_gets_the_arm_through_the_sdks_server(cell: Cell) -> None:
    pytest.importorskip("foxglove", reason="foxglove-sdk (the extra `foxglove`, 19 MB) is not installed")
    from websockets.sync.client import connect

    urls: list[str] = []
    seen: dict[str, Any] = {}

    def statuses() -> Iterator[Message]:
        """The live arm, until the viewer has got what it asked for."""
        with connect(urls[0], subprotocols=["foxglove.sdk.v1"]) as viewer:  # type: ignore[list-item]
            channels: dict[int, str] = {}
            while len(channels) < len(schemas_of(3)):
                told = json.loads(viewer.recv(10.0))
                channels |= {one["id"]: one["topic"] for one in told.get("channels", ())}
            asked = [{"id": number, "channelId": number} for number in channels]
            viewer.send(json.dumps({"op": "subscribe", "subscriptions": asked}))
            while not {"/tf", "/scene", "/drives", "/joint_states"} <= set(seen):
                cell.run(0.1)
                yield cell.client.status()
                while True:
                    try:
                        data = viewer.recv(0.02)
                    except TimeoutError:
                        break
                    if isinstance(data, bytes) and data[0] == 1:
                        number, _ = struct.unpack_from("<IQ", data, 1)
                        seen[channels[number]] = json.loads(data[13:])

    serve(RIGHT, statuses(), FREE, urls.append)
    assert urls[0].startswith("ws://127.0.0.1:")
    np.testing.assert_allclose(tip_by_frames(seen["/tf"], "measured"), cell.client.status()["tip_m"], atol=1e-4)


def test_a_port_in_use_is_one_error() -> None:
    pytest.importorskip("foxglove", reason="foxglove-sdk (the extra `foxglove`, 19 MB) is not installed")
    with pytest.raises(ArmError, match=r"cannot listen at 127.0.0.1:\d+ .*in use.*choose another PORT"):
        serve(RIGHT, iter(()), FREE, lambda url: serve(RIGHT, iter(()), address_of(url.removeprefix("ws://")), print))


def test_it_listens_on_this_machine_alone_unless_told_otherwise() -> None:
    assert address_of("") == Address("127.0.0.1", 8765)
    assert address_of("9000") == Address("127.0.0.1", 9000)
    assert address_of("0.0.0.0:9000") == Address("0.0.0.0", 9000)


class Client:
    """A client whose runtime ends, or that is interrupted, at the first status."""

    def __init__(self, end: BaseException) -> None:
        self.end, self.is_closed = end, False

    def status(self) -> Message:
        raise self.end

    def close(self) -> None:
        self.is_closed = True


class Sdk:
    """foxglove-sdk's calls, written down."""

    def __init__(self) -> None:
        self.calls: list[str] = []
        self.port = 8765

    def __getattr__(self, name: str) -> Any:
        def call(*values: Any, **more: Any) -> Sdk:
            self.calls.append(name)
            return self

        return call


@pytest.mark.parametrize("end", [KeyboardInterrupt(), RuntimeGone("it was stopped")])
def test_ctrl_c_and_the_end_of_the_runtime_end_it_and_the_server(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], end: BaseException
) -> None:
    sdk, client = Sdk(), Client(end)
    monkeypatch.setitem(sys.modules, "foxglove", sdk)  # type: ignore[arg-type]
    monkeypatch.setattr(view, "connected", lambda given: client)
    assert main(["view", "--foxglove"]) == 0
    assert sdk.calls[-1] == "stop"
    assert client.is_closed
    printed = capsys.readouterr()
    assert "ws://127.0.0.1:8765; Ctrl-C ends it" in printed.out
    assert not printed.err


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--foxglove", "http"], "expected PORT or HOST:PORT with a port of 0 to 65535, got http"),
        (["--foxglove", "65536"], "got 65536"),
        (["--foxglove", "-1"], "got -1"),
        (["--foxglove", "localhost:"], "got localhost:"),
        (["run.armlog", "--foxglove"], "open the log.mcap of `armwright export`"),
        (["--cell", "pair", "--foxglove"], "not together with a LOG or --cell"),
        (["--foxglove", "--rerun"], "contradict"),
        (["--foxglove", "--from", "1"], "need a LOG"),
    ],
)
def test_a_bad_option_is_one_message(capsys: pytest.CaptureFixture[str], options: list[str], said: str) -> None:
    assert main(["view", *options]) == 2
    assert said in capsys.readouterr().err


def test_without_the_sdk_its_installation_is_named(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setitem(sys.modules, "foxglove", None)
    monkeypatch.setattr(view, "connected", lambda given: Client(KeyboardInterrupt()))
    assert main(["view", "--foxglove"]) == 2
    assert ".venv/bin/pip install -e '.[foxglove]'" in capsys.readouterr().err
