"""An arm's motion as its encoders log it, and as a motion capture system records it: the same, on two clocks."""

from __future__ import annotations

import itertools
import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from control.kinematics.kinematics import ForwardKinematics
from control.model.arm import Arm
from control.model.description import load_arm

RIGHT = load_arm("right")
SYSTEM, SYSTEM_m = Rotation.from_rotvec([0.3, -0.8, 1.9]), np.array([1.0, 2.0, 0.5])
MARKERS_m = np.array([(0.0, 0.0, 0.0), (0.09, 0.0, 0.0), (0.0, 0.07, 0.0), (0.03, 0.02, 0.05)])
LOG_Hz, CAPTURE_Hz = 200.0, 120.0
NOISE_m, NOISE_rad = 2e-4, 1e-3
COUNT_rad = 2e-5


@dataclass(frozen=True)
class Both:
    """The log (t_s, q_rad), and the capture: tau_s, place and rotation of the body in the system's frame, markers (4, m, 3)."""

    true: Arm
    t_s: np.ndarray
    q_rad: np.ndarray
    tau_s: np.ndarray
    place_m: np.ndarray
    rotation: np.ndarray
    markers_m: np.ndarray


def both(seed: int, span_s: float = 20.0, offset_s: float = 2.3217, rate: float = 0.0, poses: int = 0) -> Both:
    """Moves between random poses with rests of 0.9 s; poses: repeat the first ones for ever (0: never)."""
    rng = np.random.default_rng(seed)
    true = RIGHT.with_dh(RIGHT.dh + rng.uniform(-1.0, 1.0, RIGHT.dh.shape) * [0.004, 0.026, 0.004, 0.026])
    lower, upper = np.array(RIGHT.limits_rad).T
    goals = 0.6 * rng.uniform(lower, upper, (400, 3))
    if poses:
        goals = np.tile(goals[:poses], (400 // poses, 1))
    pieces = []
    for here, there in itertools.pairwise(goals):
        s = np.linspace(0.0, 1.0, round(LOG_Hz * (1.1 if poses else rng.uniform(0.8, 1.5))))
        pieces.append(here + (10 * s**3 - 15 * s**4 + 6 * s**5)[:, None] * (there - here))
        pieces.append(np.repeat(there[None], round(0.9 * LOG_Hz), axis=0))
        if sum(map(len, pieces)) > span_s * LOG_Hz:
            break
    q = np.concatenate(pieces)[: round(span_s * LOG_Hz)]
    t_s = np.arange(len(q)) / LOG_Hz
    tau_s = np.arange(round((span_s - 4.0) * CAPTURE_Hz)) / CAPTURE_Hz
    seen_s = offset_s + (1.0 + rate) * tau_s
    links = ForwardKinematics(true).link_transforms(np.column_stack([np.interp(seen_s, t_s, q[:, j]) for j in range(3)]))
    last, turn = links[:, -1, :3, 3], links[:, -1, :3, :3]
    at = np.add(RIGHT.tool.position_m, (0.03, 0.02, 0.05))
    shake = Rotation.from_rotvec(rng.normal(0.0, NOISE_rad, (len(tau_s), 3))).as_matrix()
    markers = np.stack([SYSTEM.apply(last + turn @ (at + marker)) + SYSTEM_m for marker in MARKERS_m])
    return Both(
        true,
        t_s,
        np.round(q / COUNT_rad) * COUNT_rad,
        tau_s,
        SYSTEM.apply(last + turn @ at) + SYSTEM_m + rng.normal(0.0, NOISE_m, (len(tau_s), 3)),
        shake @ SYSTEM.as_matrix() @ turn,
        markers + rng.normal(0.0, NOISE_m, markers.shape),
    )


def write_log(path: Path, made: Both, run: str = "1") -> Path:
    rows = (f"{run},{t:.4f},{q[0]:.6f},{q[1]:.6f},{q[2]:.6f}\n" for t, q in zip(made.t_s, made.q_rad, strict=True))
    path.write_text("run,t_s,q1_rad,q2_rad,q3_rad\n" + "".join(rows))
    return path


def vicon_csv(made: Both, hidden: slice = slice(0, 0)) -> str:
    """Tracker's objects `tool` and `base` with rotation vectors in rad, and one marker as Nexus has it."""
    turn = Rotation.from_matrix(made.rotation).as_rotvec()
    base = "0.1,0.2,0.3,500.0,-250.0,125.0"
    lines = ["Objects", f"{CAPTURE_Hz:g}", ",,Global Angle tool:tool,,,,,,base:base,,,,,"]
    lines += ["Frame,Sub Frame," + ",".join(["RX,RY,RZ,TX,TY,TZ"] * 2), ",," + ",".join(["rad,rad,rad,mm,mm,mm"] * 2)]
    gone = set(range(*hidden.indices(len(turn))))
    for k, (r, p) in enumerate(zip(turn, 1e3 * made.place_m, strict=True)):
        cells = ",,,,," if k in gone else ",".join(f"{v:.6f}" for v in (*r, *p))
        lines.append(f"{k + 1},0,{cells},{base}")
    lines += ["", "Trajectories", f"{CAPTURE_Hz:g}", ",,arm:M1,,", "Frame,Sub Frame,X,Y,Z", ",,mm,mm,mm"]
    lines += [f"{k + 1},0," + ",".join(f"{v:.5f}" for v in 1e3 * p) for k, p in enumerate(made.markers_m[0])]
    return "\n".join(lines) + "\n"


def c3d_bytes(markers_m: np.ndarray, kind: int = 84, is_float: bool = True, labels: tuple[str, ...] = ()) -> bytes:
    """A file of markers (k, m, 3), NaN where hidden; written from www.c3d.org, not from our reader."""
    order = ">" if kind == 86 else "<"
    count, frames = markers_m.shape[:2]

    def real(value: float) -> bytes:
        if kind != 85:
            return struct.pack(f"{order}f", value)
        (bits,) = struct.unpack("<I", struct.pack("<f", 4.0 * value))
        return struct.pack("<I", (bits >> 16) | (bits & 0xFFFF) << 16)

    def parameter(group: int, name: bytes, sort: int, sizes: tuple[int, ...], data: bytes) -> bytes:
        body = struct.pack("bB", sort, len(sizes)) + bytes(sizes) + data + b"\0"
        return struct.pack("bb", len(name), group) + name + struct.pack(f"{order}h", 2 + len(body)) + body

    names = labels or tuple(f"arm:M{k + 1}" for k in range(count))
    scale = -0.1 if is_float else 0.1
    records = struct.pack("bb", 5, -1) + b"POINT" + struct.pack(f"{order}h", 3) + b"\0"
    records += parameter(1, b"USED", 2, (), struct.pack(f"{order}h", count))
    records += parameter(1, b"RATE", 4, (), real(CAPTURE_Hz)) + parameter(1, b"SCALE", 4, (), real(scale))
    records += parameter(1, b"DATA_START", 2, (), struct.pack(f"{order}h", 4))
    records += parameter(1, b"UNITS", -1, (2,), b"mm")
    records += parameter(1, b"LABELS", -1, (16, count), b"".join(name.encode().ljust(16) for name in names))
    head = struct.pack("BB", 2, 0x50) + struct.pack(f"{order}HHHHH", count, 1, 1, frames, 10)
    head += real(scale) + struct.pack(f"{order}HH", 4, 1) + real(CAPTURE_Hz)
    section = (struct.pack("BBBB", 1, 0x50, 2, kind) + records).ljust(1024, b"\0")
    data = bytearray()
    for frame in range(frames):
        for place in 1e3 * markers_m[:, frame]:
            values = [*(np.zeros(3) if np.isnan(place).any() else place), -1.0 if np.isnan(place).any() else 0.0]
            if is_float:
                data += b"".join(real(value) for value in values)
            else:
                data += struct.pack(f"{order}4h", *(round(v / scale) for v in values[:3]), round(values[3]))
        data += struct.pack(f"{order}{'f' if is_float else 'h'}", 0)  # one analog value
    return head.ljust(512, b"\0") + section + bytes(data)
