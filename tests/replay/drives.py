"""Recorded drives: the bytes that the boards sent, cycle by cycle, and what the control code made of them.

`python -m tests.replay.drives` records them anew, which a change of the control law needs: the difference is then part of the
change. The boards' side is replayed from the file, so that neither physics nor mock boards can hide or make one.
"""

from __future__ import annotations

import json
import lzma
import struct
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np
import numpy.typing as npt

from benchmarks.loop.memory_rig import Delivery, MemoryRig
from control.model.description import load_arm
from control.model.drive import JointMap
from control.recording.frame_decoder import FrameDecoder, row_type
from control.recording.frames import FrameEncoder, columns_of, content_of, in_frames, stored_columns
from control.recording.record import Layout
from control.recording.recorder_state import RecorderState
from control.server.assemble import Assembly, assemble
from control.server.client import ArmClient
from control.server.in_process import InProcessChannel
from hil_mocks.scenario import FaultTable, Start, load_scenario

FOLDER = Path(__file__).parent / "recorded"
ARM = load_arm("right")
LAYOUT = Layout.of(ARM.joint_count)
COLUMNS = stored_columns(LAYOUT.names, LAYOUT.codes, [JointMap(drive).radians_per_count for drive in ARM.drives])
PERIOD_s = 0.002
START_rad = (0.1, -0.6, 0.2)
_DELIVERY, _FRAME = struct.Struct("<dHB"), struct.Struct("<HB")
Drive = Callable[[ArmClient], None]


def _move_and_stop(client: ArmClient) -> None:
    client.ask("move_joints", q_rad=[0.9, -0.5, 0.4], speed=1.0)
    client.wait(0.3)
    client.ask("stop")
    client.wait(0.3)


def _jog_and_payload(client: ArmClient) -> None:
    client.ask("payload", mass_kg=0.5)
    for _ in range(4):
        client.ask("jog", joint_speed_rad_s=[0.4, 0.0, -0.3])
        client.wait(0.1)
    client.wait(0.6)


def _pause_and_resume(client: ArmClient) -> None:
    client.ask("move_joints", q_rad=[0.3, -0.7, 0.2], speed=0.6)
    client.wait(0.3)
    client.ask("pause")
    client.wait(0.3)
    client.ask("resume")
    client.wait(0.6)


def _fault(client: ArmClient) -> None:
    """The scenario's fault comes in motion; then it is acknowledged."""
    client.ask("move_joints", q_rad=[0.5, -0.4, 0.4], speed=1.0)
    client.wait(0.6)
    with suppress(Exception):
        client.ask("acknowledge")
    client.wait(0.2)


DRIVES: dict[str, tuple[Drive, tuple[FaultTable, ...]]] = {
    "move and stop": (_move_and_stop, ()),
    "jog and payload": (_jog_and_payload, ()),
    "pause and resume": (_pause_and_resume, ()),
    "silent encoder": (_fault, (FaultTable("silent", "encoder", at_s=0.55, until_s=0.7),)),
    "over-current": (_fault, (FaultTable("over_current", "motor2", at_s=0.55, until_s=0.6),)),
    "stuck joint": (_fault, (FaultTable("stuck_joint", "motor1", at_s=0.5, until_s=0.9),)),
}


@dataclass(frozen=True, slots=True)
class Recorded:
    """What the boards sent, and the rows that the loop recorded, which the file keeps as a recording does."""

    script: tuple[Delivery, ...]
    names: tuple[str, ...]
    packing: struct.Struct
    rows: bytes

    def table(self) -> npt.NDArray[np.void]:
        """The rows, by column."""
        return np.frombuffer(self.rows, row_type(self.names, self.packing))

    def save(self, path: Path) -> None:
        """Write the file."""
        frames = FrameEncoder(COLUMNS, self.packing)
        rows = b"".join(frames.frame(part) for part in in_frames(self.rows, self.packing.size))
        about = {"names": self.names, "packing": self.packing.format, "columns": content_of(COLUMNS)}
        header = json.dumps(about).encode()
        parts = [struct.pack("<III", len(header), len(rows), len(self.script)), header, rows]
        for sent in self.script:
            parts += [_DELIVERY.pack(sent.at_s, len(sent.serial), len(sent.frames)), sent.serial]
            parts += [_FRAME.pack(can_id, len(payload)) + payload for can_id, payload in sent.frames]
        path.write_bytes(lzma.compress(b"".join(parts), preset=9))

    @staticmethod
    def load(path: Path) -> Recorded:
        """Read the file; its columns are those of the version that wrote it."""
        content = lzma.decompress(path.read_bytes())
        header_bytes, rows_bytes, count = struct.unpack_from("<III", content)
        about = json.loads(content[12 : 12 + header_bytes])
        at = 12 + header_bytes + rows_bytes
        names, packing = tuple(about["names"]), struct.Struct(about["packing"])
        columns = columns_of(about["columns"], about["packing"].removeprefix("<"))
        rows, _ = FrameDecoder(columns, names, packing).rows(content[12 + header_bytes : at])
        script = []
        for _ in range(count):
            at_s, serial_bytes, frames = _DELIVERY.unpack_from(content, at)
            at += _DELIVERY.size
            serial, at = content[at : at + serial_bytes], at + serial_bytes
            sent = []
            for _ in range(frames):
                can_id, length = _FRAME.unpack_from(content, at)
                at += _FRAME.size
                sent.append((can_id, content[at : at + length]))
                at += length
            script.append(Delivery(at_s, serial, tuple(sent)))
        return Recorded(tuple(script), names, packing, rows)


class _Rows:
    """A sink that keeps rows."""

    def __init__(self) -> None:
        self.rows: list[bytes] = []

    def write(self, row: bytes) -> bool:
        self.rows.append(row)
        return True

    def state(self) -> RecorderState:
        return RecorderState(True)

    def close(self) -> None:
        pass


def driven(name: str, script: Sequence[Delivery] | None = None) -> Recorded:
    """Drive the arm: simulated, or with boards that send `script`."""
    drive, faults = DRIVES[name]
    demo = load_scenario("demo")
    scenario = msgspec.structs.replace(demo, start=Start(q_rad=START_rad, homed=True), fault=faults)
    rig, rows = MemoryRig(ARM, scenario, PERIOD_s, script), _Rows()
    assembly: Assembly = assemble(ARM, rig.hardware, PERIOD_s, None, rows, rig.clock.now_s)
    client = ArmClient(InProcessChannel(assembly, rig.clock))
    client.wait(0.05)
    client.ask("enable")
    client.wait(0.1)
    client.ask("home")
    drive(client)
    return Recorded(tuple(rig.script), LAYOUT.names, LAYOUT.packing, b"".join(rows.rows))


def path_of(name: str) -> Path:
    """The file of a drive."""
    return FOLDER / f"{name.replace(' ', '_')}.drive"


def main() -> None:
    """Record all drives anew."""
    FOLDER.mkdir(exist_ok=True)
    for name in DRIVES:
        driven(name).save(path_of(name))
        print(f"{path_of(name).name}: {path_of(name).stat().st_size} bytes")


if __name__ == "__main__":
    main()
