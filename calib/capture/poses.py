"""Static poses of a capture: rests in which the body was seen, as points with covariances; markers of a board."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from calib.arm_problem.observations import mean_rotation
from calib.arrays import Array, frozen, norms
from calib.boards import Markers
from calib.capture.alignment import Alignment, JointMotion
from calib.capture.tracks import BodyTrack, Capture, CaptureError, placed_m, relative
from calib.points.points import CAMERA_FRAME, Points, make_points, triangles
from control.kinematics.rotation import logarithms, quaternions
from control.model.arm import Arm
from control.model.table import board_cavities, table_of
from firmware_iface.mocap.bodies import BodyFrame, LeapWatch, RigidPose, SeenBody

LEAST_s, SETTLE_s = 0.4, 0.15  # of a rest; left out at either end, while arm and time stamps settle
FRAMES_LEAST, SEEN_LEAST = 10, 0.5  # frames of a pose, and their share that shows the body
BATCH = 10  # frames: noise of neighbouring frames is alike, so means of batches say how good a mean is
FLOOR_m, FLOOR_rad = 2e-5, 2e-5
SETUP = "capture"
Rows = npt.NDArray[np.intp]


@dataclass(frozen=True, slots=True)
class Rested:
    """What came of the rests: the points, and why others were left out. Noise of one frame, per axis (root of means)."""

    points: Points
    left_out: tuple[str, ...]
    noise_m: float
    noise_rad: float


@dataclass(frozen=True, slots=True)
class _Pose:
    t_s: float
    q_rad: Array
    direction: Array
    place_m: Array
    turn: Array | None
    off_m: Array
    off_rad: Array


def believed(capture: Capture, bodies: dict[str, BodyTrack]) -> tuple[dict[str, BodyTrack], tuple[str, ...]]:
    """The bodies without the frames in which they had leapt, or exchanged their names; and what was said of them."""
    watch, reasons = LeapWatch(), dict[str, None]()
    wrong = {name: np.zeros(len(capture.t_s), dtype=bool) for name in bodies}
    tracks = [
        (name, body.is_seen.tolist(), body.position_m.tolist(), _quaternions(body).tolist()) for name, body in bodies.items()
    ]
    for k in range(len(capture.t_s)):
        seen = [
            SeenBody(name, RigidPose(tuple(places[k]), tuple(turns[k]))) for name, is_seen, places, turns in tracks if is_seen[k]
        ]
        watch.look(BodyFrame(k, tuple(seen)))
        for name in bodies:
            if why := watch.problem(name):
                wrong[name][k] = True
                reasons[why.partition(":")[0]] = None
    return {name: _without(body, wrong[name]) for name, body in bodies.items()}, tuple(reasons)


def _quaternions(body: BodyTrack) -> Array:
    upright = np.tile([1.0, 0.0, 0.0, 0.0], (len(body.position_m), 1))
    if body.rotation is not None:
        seen = body.is_seen
        upright[seen] = quaternions(body.rotation[seen])
    return upright


def _without(body: BodyTrack, wrong: Array) -> BodyTrack:
    place = np.where(wrong[:, None], np.nan, body.position_m)
    return BodyTrack(place, None if body.rotation is None else np.where(wrong[:, None, None], np.nan, body.rotation))


def poses_at_rest(
    motion: JointMotion, capture_s: Array, body: BodyTrack, aligned: Alignment, frame: str = CAMERA_FRAME
) -> Rested:
    """A point for each rest. CaptureError if there is none."""
    t_s, poses, left_out = aligned.log_time(capture_s), [], []
    for begin_s, end_s in motion.rests(LEAST_s):
        margin_s = SETTLE_s + 3.0 * aligned.offset_sd_s
        rows = np.flatnonzero((t_s > begin_s + margin_s) & (t_s < end_s - margin_s))
        if len(rows) < FRAMES_LEAST:
            continue
        seen = rows[body.is_seen[rows]]
        if len(seen) < max(FRAMES_LEAST, SEEN_LEAST * len(rows)):
            left_out.append(f"rest at {begin_s:.1f} s: the body is hidden in {len(rows) - len(seen)} of {len(rows)} frames")
            continue
        poses.append(_pose(motion, t_s, seen, body, begin_s))
    if not poses:
        raise CaptureError(
            f"no rest of {LEAST_s + 2 * SETTLE_s:g} s or more in which the body was seen: let the arm stand at each pose"
        )
    spread_m, spread_rad = (_batches([getattr(one, key) for one in poses]) for key in ("off_m", "off_rad"))
    return Rested(_points(poses, spread_m, spread_rad, frame), tuple(left_out), *_noise(poses))


def _pose(motion: JointMotion, t_s: Array, rows: Rows, body: BodyTrack, begin_s: float) -> _Pose:
    inside = (motion.t_s >= t_s[rows[0]]) & (motion.t_s <= t_s[rows[-1]])
    before = np.abs(motion.speed_rad_s[: np.searchsorted(motion.t_s, begin_s)])
    direction = np.zeros(motion.q_rad.shape[1])
    for joint in range(len(direction)):
        moved = np.flatnonzero(before[:, joint] > 10 * 0.005)
        direction[joint] = np.sign(motion.speed_rad_s[moved[-1], joint]) if len(moved) else 0.0
    place = body.position_m[rows].mean(axis=0)
    turn, off_rad = None, np.zeros((len(rows), 3))
    if body.rotation is not None:
        turn = mean_rotation(body.rotation[rows])
        off_rad = logarithms(body.rotation[rows] @ turn.T)
    q_rad = motion.q_rad[inside].mean(axis=0)
    return _Pose(float(t_s[rows[0]]), q_rad, direction, place, turn, body.position_m[rows] - place, off_rad)


def _batches(offs: list[Array]) -> Array:
    """Covariance (3, 3) of the mean of one batch of frames, pooled over all poses."""
    total, freedom = np.zeros((3, 3)), 0
    for off in offs:
        count = len(off) // BATCH
        if count < 2:
            continue
        means = off[: count * BATCH].reshape(count, BATCH, 3).mean(axis=1)
        means -= means.mean(axis=0)
        total, freedom = total + means.T @ means, freedom + count - 1
    if not freedom:  # short rests: as if frames were independent
        every = np.concatenate(offs)
        return np.asarray(every.T @ every / len(every) / BATCH)
    return total / freedom


def _points(poses: list[_Pose], spread_m: Array, spread_rad: Array, frame: str) -> Points:
    count = np.array([len(pose.off_m) for pose in poses])
    share = (BATCH / count)[:, None, None]
    has_turn = poses[0].turn is not None
    position = share * spread_m + FLOOR_m**2 * np.eye(3)
    turning = share * spread_rad + FLOOR_rad**2 * np.eye(3)
    m = len(poses)
    covariance = np.concatenate((triangles(position), triangles(turning) if has_turn else np.full((m, 6), np.nan)), axis=1)
    turns = np.array([pose.turn for pose in poses]) if has_turn else np.zeros((0, 3, 3))
    return make_points(
        [SETUP] * m,
        [f"r{k + 1}" for k in range(m)],
        [1] * m,
        np.array([pose.q_rad for pose in poses]),
        np.array([pose.place_m for pose in poses]),
        np.array([pose.direction for pose in poses]),
        t_s=np.array([pose.t_s for pose in poses]),
        extra={"frame": (frame,) * m},
        orientation=quaternions(turns) if has_turn else None,
        covariance=covariance,
    )


def _noise(poses: list[_Pose]) -> tuple[float, float]:
    """Root mean square of frames about their pose's mean, per axis."""
    return (
        float(np.sqrt(np.mean(np.concatenate([one.off_m for one in poses]) ** 2))),
        float(np.sqrt(np.mean(np.concatenate([one.off_rad for one in poses]) ** 2))),
    )


# Markers in the cavities of the calibration board, in the arm's base frame: what registers the board.
#
# The base frame is known by the body on the base: a calibration has placed it (origin_m and orientation of [camera.stream]).

STILL_m = 1e-3  # standard deviation of a marker that stands


def board_markers(arm: Arm, capture: Capture, setup: str, base_body: str) -> Markers:
    """Mean positions of the markers that are called as cavities are. CaptureError if the frame is not placed, or one moves."""
    stream = arm.camera.stream if arm.camera is not None else None
    if stream is None or stream.origin_m is None or stream.base_body != base_body:
        raise CaptureError(
            f"arm {arm.name}: markers of the board need the base frame: expected a calibrated arm.toml whose [camera.stream] has"
            f' base_body = "{base_body}" and origin_m'
        )
    base = capture.body(base_body) if base_body else None
    names, places = [], []
    cavities = board_cavities(table_of(arm))
    for full, track in capture.markers.items():
        name = full.rpartition(":")[2]
        if name not in cavities:
            continue
        seen = track if base is None else relative(BodyTrack(track), base).position_m
        seen = seen[np.isfinite(seen).all(axis=1)]
        if not len(seen):
            continue
        if float(norms(seen.std(axis=0)[None])[0]) > STILL_m:
            raise CaptureError(f"{capture.path}: marker {full} moves: expected markers that stand in the board's cavities")
        names.append(name)
        places.append(placed_m(stream, seen.mean(axis=0)))
    if not names:
        there = ", ".join(capture.markers) or "none"
        raise CaptureError(
            f"{capture.path}: no marker is called like a cavity ({', '.join(list(cavities)[:3])}, ...): it has {there}"
        )
    return Markers((setup,) * len(names), tuple(names), frozen(places))
