"""The live arm in other viewers: Rerun (an extra of 521 MB) and Foxglove (of 19 MB), imported when they are asked for."""

from __future__ import annotations

import importlib
import math
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

import msgspec

from console.visualisation.snapshots import Snapshot
from control.errors import ArmError
from control.kinematics.kinematics import ForwardKinematics
from control.model.arm import Arm
from control.recording import mcap_scene as scene
from control.recording.export import ERROR_LEVEL, CycleChanges
from control.recording.mcap_schemas import CAMERA, DRIVES, ERROR, JOINTS, LOOP, SET_POINT, schemas_of
from control.safety.modes import Mode
from control.server.channel import Message

TIMELINE: Final = "arm"
MEASURED, COMMANDED, CAMERA_PATH = [0, 114, 178], [213, 94, 0], [0, 158, 115]


def stream(arm: Arm, snapshots: Iterator[Snapshot], file: Path | None) -> int:
    """Send all snapshots to a viewer that Rerun starts, or to an .rrd `file`; return their number.

    ArmError if rerun-sdk is not installed or the file exists.
    """
    rerun = _rerun()
    rerun.init(f"armwright {arm.name}", spawn=file is None)
    if file is not None:
        if file.exists():
            raise ArmError(f"{file} exists already and is never overwritten: choose another file")
        rerun.save(file)
    rerun.log("arm", rerun.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    kinematics, count = ForwardKinematics(arm), 0
    for snapshot in snapshots:
        rerun.set_time(TIMELINE, duration=snapshot.t_s)
        _log(rerun, kinematics, snapshot)
        count += 1
    return count


def _rerun() -> Any:
    try:
        return importlib.import_module("rerun")
    except ImportError as error:
        raise ArmError(
            "--rerun: rerun-sdk is not installed (521 MB, so it is an extra): in the clone, .venv/bin/pip install -e '.[rerun]'"
        ) from error


def _log(rerun: Any, kinematics: ForwardKinematics, snapshot: Snapshot) -> None:
    for number, (angle, wanted) in enumerate(zip(snapshot.q_rad, snapshot.q_set_rad, strict=True), start=1):
        rerun.log(f"joint{number}/q_rad", rerun.Scalars(angle))
        rerun.log(f"joint{number}/q_set_rad", rerun.Scalars(wanted))
        rerun.log(f"joint{number}/following_error_rad", rerun.Scalars(wanted - angle))
    for number, current in enumerate(snapshot.current_A, start=1):
        rerun.log(f"joint{number}/current_A", rerun.Scalars(current))
    for name, angles, colour in (("measured", snapshot.joint_rad, MEASURED), ("commanded", snapshot.joint_set_rad, COMMANDED)):
        points = [*kinematics.link_transforms([angles])[0][:, :3, 3], kinematics.tips([angles])[0]]
        rerun.log(f"arm/{name}", rerun.LineStrips3D([points], colors=[colour], radii=[0.01]))
        rerun.log(f"arm/{name}_tip", rerun.Points3D([points[-1]], colors=[colour], radii=[0.012]))
    if snapshot.camera_m is not None:
        rerun.log("arm/camera", rerun.Points3D([snapshot.camera_m], colors=[CAMERA_PATH], radii=[0.008]))


# Serves the live arm to Foxglove over a WebSocket: the topics of an exported MCAP file. An extra: foxglove-sdk is 19 MB.
#
# The server runs in this command's process, in threads of its own; the loop only answers its requests for the status.


LOOPBACK, PORT = "127.0.0.1", 8765  # Foxglove's usual port
SHAPES_EVERY_s: Final = 1.0  # a viewer gets nothing that was sent before it came
MODES: Final = tuple(mode.name for mode in Mode)
OF_JOINTS: Final = {  # topic: its columns by the status's key (docs/socket.md)
    JOINTS: {"q{}_rad": "q_rad", "speed{}_rad_s": "speed_rad_s", "count{}": "count", "joint{}_rad": "joint_rad"},
    SET_POINT: {"q{}_set_rad": "q_set_rad", "joint{}_set_rad": "joint_set_rad"},
    ERROR: {"following_error{}_rad": "following_error_rad"},
    DRIVES: {"i{}_A": "current_A", "supply{}_V": "supply_V", "temperature{}_C": "temperature_C"},
}
OF_LOOP: Final = {
    "t_s": "t_s",
    "cycle": "cycle",
    "run": "run",
    "missed": "missed_cycles",
    "payload_kg": "payload_kg",
    "mode_name": "mode",
}


class Address(NamedTuple):
    """Where the server listens."""

    host: str
    port: int


def address_of(text: str) -> Address:
    """The address in `[HOST:]PORT`; this machine only without HOST, Foxglove's usual port for "". ArmError."""
    host, _, port = text.rpartition(":")
    if not text:
        return Address(LOOPBACK, PORT)
    if not (port.isascii() and port.isdigit() and int(port) < 65536):
        raise ArmError(f"--foxglove: expected PORT or HOST:PORT with a port of 0 to 65535, got {text}")
    return Address(host or LOOPBACK, int(port))


def serve(arm: Arm, statuses: Iterator[Message], address: Address, announce: Callable[[str], None]) -> None:
    """Serve statuses to every viewer until they end. `announce` gets the server's URL.

    ArmError if foxglove-sdk is not installed, or the address cannot be used.
    """
    foxglove = _foxglove()
    context = foxglove.Context()
    channels = {
        topic: foxglove.Channel(topic, schema=schema, context=context) for topic, schema in schemas_of(arm.joint_count).items()
    }
    try:
        server = foxglove.start_server(name=f"armwright {arm.name}", host=address.host, port=address.port, context=context)
    except RuntimeError as error:
        raise ArmError(
            f"--foxglove: cannot listen at {address.host}:{address.port} ({error}): choose another PORT, or 0 for a free one"
        ) from None
    try:
        announce(f"ws://{address.host}:{server.port}")
        messages = LiveMessages(arm)
        for status in statuses:
            time_ns = time.time_ns()
            for topic, message in messages.of(status, time_ns):
                channels[topic].log(msgspec.json.encode(message), log_time=time_ns)
    finally:
        server.stop()


def _foxglove() -> Any:
    try:
        return importlib.import_module("foxglove")
    except ImportError as error:
        raise ArmError(
            "--foxglove: foxglove-sdk is not installed (19 MB, so it is an extra): in the clone,"
            " .venv/bin/pip install -e '.[foxglove]'"
        ) from error


class LiveMessages:
    """Statuses as messages of the topics of `schemas_of`. What is not known is omitted, because JSON has no NaN."""

    def __init__(self, arm: Arm) -> None:
        self._arm, self._kinematics = arm, ForwardKinematics(arm)
        self._events, self._faults = CycleChanges(MODES), frozenset[str]()
        self._shapes_s = -math.inf

    def of(self, status: Message, time_ns: int) -> Iterator[tuple[str, Message]]:
        """Topic and message of all that a status says, at the time of day `time_ns`."""
        self._wear(status["tool"])
        yield from _columns(status)
        yield from self._happened(status, time_ns)
        joint_rad, wanted_rad = _known(status["joint_rad"]), _known(status["joint_set_rad"])
        yield "/joint_states", scene.joint_states(joint_rad, _known(status["speed_rad_s"]), time_ns)
        yield from scene.posed(self._arm, self._kinematics, joint_rad, wanted_rad, time_ns)
        if (seen := status["camera_m"]) is not None:
            yield CAMERA, dict(zip(("x_m", "y_m", "z_m"), seen, strict=True))
            yield "/tip/camera", scene.pose_in_base((seen[0], seen[1], seen[2]), time_ns)
        if not 0.0 <= status["t_s"] - self._shapes_s < SHAPES_EVERY_s:
            self._shapes_s = status["t_s"]
            yield "/scene", scene.shapes(self._arm, time_ns)

    def _wear(self, tool: str) -> None:
        if tool and tool != self._arm.tool.name:
            self._arm = self._arm.with_tool(tool)
            self._kinematics, self._shapes_s = ForwardKinematics(self._arm), -math.inf

    def _happened(self, status: Message, time_ns: int) -> Iterator[tuple[str, Message]]:
        """Changes of mode, runs, missed deadlines, new faults."""
        mode = MODES.index(status["mode"])
        for level, text in self._events.look(status["t_s"], mode, status["run"], status["missed_cycles"], ()):
            yield "/log", scene.log_entry(level, text, time_ns)
        faults = {f"{fault['where']}: {fault['message']}; {fault['remedy']}" for fault in status["faults"]}
        for text in sorted(faults - self._faults):
            yield "/log", scene.log_entry(ERROR_LEVEL, text, time_ns)
        self._faults = frozenset(faults)


def _columns(status: Message) -> Iterator[tuple[str, Message]]:
    for topic, columns in OF_JOINTS.items():
        yield (
            topic,
            {
                name.format(joint): value
                for name, key in columns.items()
                for joint, value in enumerate(status[key], start=1)
                if value is not None
            },
        )
    yield LOOP, {name: status[key] for name, key in OF_LOOP.items()}


def _known(values: Sequence[float | None]) -> list[float]:
    return [math.nan if value is None else value for value in values]
