"""Good inputs of every target, to be mutated: fuzzers that begin with them get behind the first check."""

from __future__ import annotations

import io
import json
import tempfile
from functools import cache
from pathlib import Path

import numpy as np

from calib.export import export_text
from calib.points.writer import Record
from calib.session.folder import SessionFolder
from calib.studies import ChunkStore
from calib.vision.lens import NAMES
from calib.vision.targets import png_of
from control.kinematics.kinematics import ForwardKinematics
from control.model.description import load_arm
from control.recording.export import to_mcap
from control.recording.reading import Recording
from control.recording.record import Layout
from control.recording.writer import PartFile, begin
from firmware_iface.encoder import wire
from firmware_iface.mocap import qtm
from hil_mocks.devices.cameras import NatNetMock, QtmMock
from procedures.bringup.procedure import Journal
from tests.calib.capture.recordings import both, c3d_bytes, vicon_csv
from tests.firmware_iface.mocap.test_bodies import VICON
from tests.firmware_iface.mocap.test_streams import NATNET_3, NATNET_41, QTM, SCENE, SETUP
from tests.firmware_iface.motor_command import MotorCommand
from tests.firmware_iface.test_camera import golden as camera_datagram
from tests.fuzz.bought_seeds import bought_seeds
from tests.fuzz.readers import PLAN
from tests.recordings import row_of

ROOT = Path(__file__).parents[2]
REPORTS = [wire.Report(k, 1000 * k, (0, 4, 8), (k * 50, -k, 1 << 20)) for k in range(3)]
REQUESTS = (
    {"do": "status", "id": 1},
    {"do": "jog", "joint_speed_rad_s": [0.1, 0.0, -0.1]},
    {"do": "move_joints", "q_rad": [0.1, 0.2, 0.3], "speed": 0.5, "as_encoders": False},
    {"do": "payload", "mass_kg": 0.5},
    {"do": "stop"},
)
POINTS = (
    "setup,point,repeat,q1_rad,q2_rad,q3_rad,x_m,y_m,z_m\n"
    "normal,1,1,0.1,-0.5,0.4,0.5,0.0,0.1\nnormal,2,1,0.2,-0.5,0.4,0.5,0.1,0.1\n"
)
LOG = "run,t_s,q1_rad,q2_rad,q3_rad,i1_A,i2_A,i3_A\n" + "".join(
    f"1,{0.002 * k:.3f},{0.001 * k},0.1,0.2,0.5,0.6,0.7\n" for k in range(12)
)
CONTACTS = (
    "setup,point,repeat,q1_rad,q2_rad,q3_rad,q4_rad,q5_rad,q6_rad,distance_m,joined\n"
    "contact,1,1,0.1,-0.5,0.4,0.2,-0.5,0.4,0.05,\ncontact,2,1,0.1,-0.5,0.4,0.2,-0.5,0.4,,clamp\n"
)
CAMERA = {
    "format": "camera/1",
    "width_px": 640,
    "height_px": 480,
    "readout_s": 0.0,
    "noise_px": 0.1,
    "lens": dict.fromkeys(NAMES, 1.0),
    "covariance": [[float(j == k) for j in NAMES] for k in NAMES],
}
BOARD = {"origin_m": [0.5, 0.0, 0.1], "rotation": [[1, 0, 0], [0, 1, 0], [0, 0, 1]]}
CORNERS_m = [[0.4, 0.0, 0.1], [0.5, 0.0, 0.1], [0.5, 0.1, 0.1], [0.4, 0.1, 0.1]]
HISTORY = {
    "format": "history/1",
    "measured": "2026-11-23T09:00:00Z",
    "by": "calibrate",
    "arm": "right",
    "program_version": "0.1",
    "geometry": {"names": ["a", "b"], "values": [0.1, 0.2], "scales": [1.0, 1.0], "information": [[1.0, 0.0], [0.0, 1.0]]},
    "quantities": {"gear": {"value": 0.1, "sd": 0.01}},
}
LENGTHS = (
    "setup,point,repeat,q1_rad,q2_rad,q3_rad,x_m,y_m,z_m,distance_of,distance_m,distance_sd_m\n"
    "wire,1,1,0.1,-0.5,0.4,,,,wire:a,0.512,0.0001\nwire,2,1,0.2,-0.5,0.4,,,,between:b,0.1,\n"
    "wire,3,1,0.3,-0.5,0.4,,,,between:b,0.1,\n"
)
RUN_FORMS = ("q{}_rad", "q{}_set_rad", "i{}_A", "u{}_V", "counted{}_s")
RUN = ",".join(["t_s", *(form.format(j) for form in RUN_FORMS for j in (1, 2, 3)), "x_m,y_m,z_m,payload_kg\n"])
TIP = ",".join(map(str, ForwardKinematics(load_arm("right")).tip(0.1, 0.1, 0.1)))
SCENARIO = 'name = "x"\nseed = 3\n[start]\nhomed = true\n'


RECORD = Record("normal", "1", 1, (0.1, -0.5, 0.4), (1e-5,) * 3, (1, -1, 1), (0.5,) * 3, 2.0, 0.0, (0.5, 0.0, 0.1))


def recording() -> bytes:
    """A small recording in frames."""
    layout = Layout.of(1)
    rows = b"".join(layout.packing.pack(*(row_of(k, 1).get(name, 0) for name in layout.names)) for k in range(12))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "x.armlog"
        begin(path, layout.about(arm="x", period_s=0.002, **layout.framed((1e-4,))))
        part = PartFile(path)
        for at in (0, 6):
            part.append(rows[at * layout.packing.size : (at + 6) * layout.packing.size])
        part.close()
        return path.read_bytes()


def _mcap(recorded: bytes) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "x.armlog"
        path.write_bytes(recorded)
        to_mcap(Recording.open(path), path.with_suffix(".mcap"))
        return path.with_suffix(".mcap").read_bytes()


@cache
def _session_files() -> dict[str, list[bytes]]:
    with tempfile.TemporaryDirectory() as name:
        with SessionFolder(Path(name), PLAN) as folder:
            folder.record(RECORD)
        files = (("session.json", "session.json"), ("journal.jsonl", "journal.jsonl"), ("recorded.csv", "points.csv"))
        return {target: [(Path(name) / file).read_bytes()] for target, file in files}


def _written() -> dict[str, list[bytes]]:
    """Files that the product itself writes and resumes."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        ChunkStore(folder / "study", {"of": "this"})
        Journal(folder / "bringup.json", load_arm("right")).note_pulses([])
        return {
            "study.json": [(folder / "study" / "study.json").read_bytes()],
            "bringup.json": [(folder / "bringup.json").read_bytes()],
        }


def _chunk() -> bytes:
    content = io.BytesIO()
    np.savez(content, error_m=np.arange(4.0), index=np.arange(3))
    return content.getvalue()


def seeds_of(name: str) -> list[bytes]:
    """Good inputs of a target, or near ones."""
    return {**_seeds(), **bought_seeds(), **_session_files(), **_written()}[name]


@cache
def _seeds() -> dict[str, list[bytes]]:
    recorded, short = recording(), both(1, span_s=4.1)
    arm = (ROOT / "tests/control/model/arms/pendulum.toml").read_bytes()
    run = RUN + "".join(",".join([f"{0.002 * k:.3f}", *["0.1"] * 19]) + "\n" for k in range(4))
    return {
        "encoder": [b"".join(map(wire.encode, REPORTS)), wire.encode(wire.Ack(1, 2, 3))],
        "cobs": [wire.encode(report)[:-1] for report in REPORTS],
        "motor": [MotorCommand(15, 1, 3, -20, 0).pack(), bytes(8), b"\xff" * 8],
        "slcan": [b"\rz\rt18180F2920D1FFFF0000\rt1812AABB\r", b"T000001812AABB\rt00010\a"],
        "camera": [camera_datagram()],
        "vicon": [VICON, VICON.ljust(256, b"\0")],
        "natnet": [NATNET_3, NATNET_41, *NatNetMock(SETUP, SCENE).answer(bytes((4, 0, 0, 0)))],
        "qtm": [QTM, *QtmMock(SETUP, SCENE).answer(bytes(8) + b"getparameters 6d"), qtm.command("Version 1.19")],
        "socket": [json.dumps(request).encode() for request in REQUESTS],
        "recording frames": [recorded[recorded.index(b"}") + 1 :]],
        "run.armlog": [recorded],
        "arm.toml": [arm],
        "points.csv": [POINTS.encode()],
        "log.csv": [LOG.encode()],
        "scenario.toml": [SCENARIO.encode(), (ROOT / "hil_mocks/scenarios/demo.toml").read_bytes()],
        "path.csv": [b"x_m,y_m,z_m\n0.4,0.0,0.1\n0.4,0.1,0.1\n"],
        "markers.csv": [b"setup,marker,x_m,y_m,z_m\nnormal,1,0.1,0.2,0.3\nnormal,2,0.1,0.3,0.3\n"],
        "boards.json": [json.dumps({"format": "boards/1", "boards": {"normal": BOARD}}).encode()],
        "programme.json": [json.dumps({"format": "iso9283-programme/1", "rectangle_m": CORNERS_m}).encode()],
        "tolerances.toml": [(ROOT / "calib/tolerances/right.toml").read_bytes()],
        "capture.csv": [vicon_csv(short).encode()],
        "capture.c3d": [c3d_bytes(short.markers_m, kind, is_float) for kind, is_float in ((84, True), (85, True), (86, False))],
        "cell.toml": [(ROOT / "control/cells/pair.toml").read_bytes()],
        "contacts.csv": [CONTACTS.encode()],
        "camera.json": [json.dumps(CAMERA).encode()],
        "tags.csv": [b"tag,size_m,x_m,y_m,z_m,qw,qx,qy,qz\n3,0.03,0.1,0,0.2,1,0,0,0\n4,0.03,0.2,0,0.2,,,,\n"],
        "arm.urdf": [export_text(load_arm("right"), "urdf").encode()],
        "arm.xml": [export_text(load_arm("right"), "mjcf").encode()],
        "places.toml": [b"[home]\nq_rad = [0.0, 0.1, 0.2]\n[there]\ntip_m = [0.5, 0.0, 0.1]\n"],
        "history.jsonl": [json.dumps(HISTORY).encode() + b"\n"],
        "poses.csv": [b"point,q1_rad,q2_rad,q3_rad\na,0.1,-0.5,0.4\n,0.2,-0.5,0.4\n"],
        "lengths.csv": [LENGTHS.encode()],
        "runs.csv": [("run," + run.replace("\n", "\n1,").removesuffix("1,")).replace("0.1,0.1,0.1,0.1\n", f"{TIP},0\n").encode()],
        "run.csv": [run.encode()],
        "series": [recorded, LOG.encode()],
        "run.mcap": [_mcap(recorded)],
        "picture": [png_of(np.arange(48, dtype=np.uint8).reshape(6, 8))],
        "chunk.npz": [_chunk()],
        "config.toml": [b'arm = "right"\n'],
        "script": [b"move --joints 0.1 -0.2 0.3 --speed 0.5\nstop\n# end\nhome --again\n"],
        "session line": [b"skip normal 3 1", b"jog 1 0.5deg", b"auto 3", b"note a text"],
    }
