"""The arm in Foxglove's 3-D panel: link frames and shapes, the tip, joint states.

Two arms stand in `base`: `measured/...` and `set_point/...`, each with its DH frames `link1` ... and `tip`. A link frame lies in
the previous one by Tz(d) Rz(theta + q) Tx(L) Rx(alpha) (standard) or Rx(alpha) Tx(L) Rz(theta + q) Tz(d) (modified).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any, Final

from control.kinematics.kinematics import ForwardKinematics
from control.model.arm import Arm, Link
from control.model.cell import Placed

Message = dict[str, Any]
Point = tuple[float, float, float]
Turn = tuple[float, float, float, float]  # x, y, z, w
NS_PER_S: Final = 1_000_000_000
BASE: Final = "base"
MEASURED, SET_POINT = "measured", "set_point"
COLOURS: Final = {MEASURED: (0.0, 0.447, 0.698, 1.0), SET_POINT: (0.835, 0.369, 0.0, 0.35)}  # Okabe and Ito
NO_TURN: Final[Turn] = (0.0, 0.0, 0.0, 1.0)
TIP_RADIUS_m: Final = 0.008
PATH_PIXELS: Final = 2.0
THICKNESS, THICKEST_m = 0.1, 0.02  # of a link's length; upper bound


def stamp(time_ns: int) -> Message:
    """Foxglove's time."""
    return {"sec": time_ns // NS_PER_S, "nsec": time_ns % NS_PER_S}


def placement(link: Link, q_rad: float, is_standard: bool) -> tuple[Point, Turn]:
    """Pose of a link's DH frame in the previous one at a joint angle (0 if fixed): position [m], quaternion."""
    theta, alpha, d, length = link.theta_rad + q_rad, link.alpha_rad, link.d_m, link.L_m
    ct, st = math.cos(0.5 * theta), math.sin(0.5 * theta)
    ca, sa = math.cos(0.5 * alpha), math.sin(0.5 * alpha)
    if is_standard:
        return (length * math.cos(theta), length * math.sin(theta), d), (ct * sa, st * sa, st * ca, ct * ca)
    return (length, -d * math.sin(alpha), d * math.cos(alpha)), (ct * sa, -st * sa, st * ca, ct * ca)


def transforms(arm: Arm, which: str, q_rad: Sequence[float], time_ns: int) -> list[Message]:
    """The frames of one arm as Foxglove's FrameTransform."""
    at, parent, joint, messages = stamp(time_ns), BASE, 0, []
    for number, link in enumerate(arm.links, start=1):
        turns = link.joint == "revolute"
        position, turn = placement(link, q_rad[joint] if turns else 0.0, arm.dh_convention == "standard")
        joint += turns
        child = f"{which}/link{number}"
        messages.append(_transform(at, parent, child, position, turn))
        parent = child
    return [*messages, _transform(at, parent, f"{which}/tip", arm.tool.position_m, NO_TURN)]


def _transform(at: Message, parent: str, child: str, position_m: Point, turn: Turn) -> Message:
    return {
        "timestamp": at,
        "parent_frame_id": parent,
        "child_frame_id": child,
        "translation": xyz(position_m),
        "rotation": _xyzw(turn),
    }


def xyz(point: Point) -> Message:
    """Foxglove's Vector3 or Point3."""
    return {"x": point[0], "y": point[1], "z": point[2]}


def _xyzw(turn: Turn) -> Message:
    return {"x": turn[0], "y": turn[1], "z": turn[2], "w": turn[3]}


def pose(position_m: Point, turn: Turn = NO_TURN) -> Message:
    """Foxglove's Pose."""
    return {"position": xyz(position_m), "orientation": _xyzw(turn)}


def pose_in_base(position_m: Point, time_ns: int) -> Message:
    """Foxglove's PoseInFrame of a point in the base frame; with the identity as orientation."""
    return {"timestamp": stamp(time_ns), "frame_id": BASE, "pose": pose(position_m)}


def posed(
    arm: Arm, kinematics: ForwardKinematics, joint_rad: Sequence[float], joint_set_rad: Sequence[float], time_ns: int
) -> Iterator[tuple[str, Message]]:
    """Topic and message of the frames and tips of both arms, as far as their angles are known."""
    frames = []
    for which, angles in ((MEASURED, joint_rad), (SET_POINT, joint_set_rad)):
        if all(map(math.isfinite, angles)):
            frames += transforms(arm, which, angles, time_ns)
            yield f"/tip/{which}", pose_in_base(kinematics.tip(*angles), time_ns)
    if frames:
        yield "/tf", {"transforms": frames}


def log_entry(level: int, text: str, time_ns: int) -> Message:
    """Foxglove's Log."""
    entry = {"timestamp": stamp(time_ns), "level": level, "message": text}
    return {**entry, "name": "armwright", "file": "", "line": 0}


def joint_states(q_rad: Sequence[float], speed_rad_s: Sequence[float], time_ns: int) -> Message:
    """Foxglove's JointStates; joints are named as in the exported URDF. Missing values are omitted."""
    joints = []
    for number, (angle, speed) in enumerate(zip(q_rad, speed_rad_s, strict=True), start=1):
        known = {"position": angle, "velocity": speed}
        joints.append({"name": f"joint{number}"} | {key: v for key, v in known.items() if math.isfinite(v)})
    return {"timestamp": stamp(time_ns), "joints": joints}


def shapes(arm: Arm, time_ns: int) -> Message:
    """SceneUpdate with the links of both arms, attached to their frames."""
    entities = []
    for which, colour in COLOURS.items():
        for number, (frame, end_m) in enumerate(_link_ends(arm), start=1):
            at = f"{which}/{frame}" if frame else BASE
            entities.append(_link_entity(f"{which}/shape{number}", at, end_m, colour, time_ns))
        ball = _sphere((0.0, 0.0, 0.0), TIP_RADIUS_m, colour)
        entities.append(_entity(f"{which}/tip", f"{which}/tip", time_ns, spheres=[ball]))
    return {"deletions": [], "entities": entities}


def _link_ends(arm: Arm) -> list[tuple[str, Point]]:
    """(frame, other end in it) of each link's shape, "" being the base.

    Standard: the link lies between frame i-1 and frame i and turns with frame i. Modified: it turns with frame i and reaches to
    frame i + 1, the last one to the tip.
    """
    if arm.dh_convention == "standard":
        ends: list[tuple[str, Point]] = []
        for number, link in enumerate(arm.links, start=1):
            sa, ca = math.sin(link.alpha_rad), math.cos(link.alpha_rad)
            ends.append((f"link{number}", (-link.L_m, -link.d_m * sa, -link.d_m * ca)))
        return [*ends, (f"link{len(arm.links)}", arm.tool.position_m)]
    names = ["", *(f"link{number}" for number in range(1, len(arm.links) + 1))]
    reaches = [placement(link, 0.0, False)[0] for link in arm.links]
    return list(zip(names, [*reaches, arm.tool.position_m], strict=True))


def _link_entity(name: str, frame: str, end_m: Point, colour: Turn, time_ns: int) -> Message:
    """A cylinder from the frame's origin to the other end, round at both; None if both coincide."""
    length_m = math.hypot(*end_m)
    if length_m == 0.0:
        return _entity(name, frame, time_ns)
    radius_m = min(THICKEST_m, THICKNESS * length_m)
    middle = (0.5 * end_m[0], 0.5 * end_m[1], 0.5 * end_m[2])
    cylinder = {
        "pose": pose(middle, _turn_of_z(end_m, length_m)),
        "size": xyz((2 * radius_m, 2 * radius_m, length_m)),
        "bottom_scale": 1.0,
        "top_scale": 1.0,
        "color": _rgba(colour),
    }
    balls = [_sphere(end_m, radius_m, colour), _sphere((0.0, 0.0, 0.0), radius_m, colour)]
    return _entity(name, frame, time_ns, cylinders=[cylinder], spheres=balls)


def _turn_of_z(to_m: Point, length_m: float) -> Turn:
    """The shortest turn of z, a cylinder's axis, towards a point."""
    if length_m == 0.0:
        return NO_TURN
    x, y, z = (part / length_m for part in to_m)
    if z < -1.0 + 1e-12:
        return (1.0, 0.0, 0.0, 0.0)
    w = math.sqrt(0.5 * (1.0 + z))
    return (-0.5 * y / w, 0.5 * x / w, 0.0, w)


def _sphere(at_m: Point, radius_m: float, colour: Turn) -> Message:
    size = 2.0 * radius_m
    return {"pose": pose(at_m), "size": xyz((size, size, size)), "color": _rgba(colour)}


def _rgba(colour: Turn) -> Message:
    return dict(zip("rgba", colour, strict=True))


def _entity(name: str, frame: str, time_ns: int, **primitives: list[Message]) -> Message:
    none: dict[str, list[Message]] = {
        kind: [] for kind in ("metadata", "arrows", "cubes", "spheres", "cylinders", "lines", "triangles", "texts", "models")
    }
    head = {"timestamp": stamp(time_ns), "frame_id": frame, "id": name, "lifetime": {"sec": 0, "nsec": 0}, "frame_locked": True}
    return {**head, **none, **primitives}


CELL: Final = "cell"
NAMED: Final = ("frame_id", "parent_frame_id", "child_frame_id", "id")


def standing(placed: Placed, time_ns: int) -> Message:
    """The base of an arm of a cell in the frame of the cell."""
    w, x, y, z = placed.orientation
    return _transform(stamp(time_ns), CELL, BASE, placed.origin_m, (x, y, z, w))


def of_arm(message: Any, name: str) -> Any:
    """The same message with the arm's name before its frames and entities; the frame of the cell is everybody's."""
    if isinstance(message, list):
        return [of_arm(part, name) for part in message]
    if not isinstance(message, dict):
        return message
    return {key: f"{name}/{part}" if key in NAMED and part != CELL else of_arm(part, name) for key, part in message.items()}


def path(points_m: Sequence[Point], time_ns: int) -> Message:
    """SceneUpdate with the commanded tip path of a run as a line in the base frame."""
    line = {
        "type": 0,
        "pose": pose((0.0, 0.0, 0.0)),
        "thickness": PATH_PIXELS,
        "scale_invariant": True,
        "points": [xyz(point) for point in points_m],
        "color": _rgba((*COLOURS[SET_POINT][:3], 1.0)),
        "colors": [],
        "indices": [],
    }
    return {"deletions": [], "entities": [_entity("commanded path", BASE, time_ns, lines=[line])]}
