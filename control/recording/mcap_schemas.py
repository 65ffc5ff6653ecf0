"""JSON schemas of an exported MCAP file: our own columns with unit and meaning, and Foxglove's well-known messages.

Our own topics use the column names of the recording, `q1_rad` and not `position[0]`, so that every plot shows the unit
and a single missing value, a NaN of the recording, can be omitted. `armwright arm --keys armlog` prints them. Foxglove
recognises its own messages by the schemas' titles (docs.foxglove.dev, SDK schemas); of these only the fields that are written
here are described.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

Schema = dict[str, Any]
JOINTS, SET_POINT, ERROR, DRIVES, CAMERA, LOOP, END = (
    "/joints",
    "/joints/set_point",
    "/joints/following_error",
    "/drives",
    "/camera",
    "/loop",
    "/end_effector",
)


@dataclass(frozen=True, slots=True)
class Field:
    """A column of the recording, `{}` in its name for the joint's number: unit and meaning."""

    column: str
    unit: str
    meaning: str


TOPICS: Final[dict[str, tuple[Field, ...]]] = {
    JOINTS: (
        Field("q{}_rad", "rad", "angle by its encoder"),
        Field("speed{}_rad_s", "rad/s", "speed by its encoder and the board's clock"),
        Field("count{}", "1", "encoder count"),
        Field("joint{}_rad", "rad", "angle of the joint by the model; absent: same as by its encoder"),
        Field(
            "lead{}_rad",
            "rad",
            "how far the motor is ahead of the joint, where both have an encoder, from 0 when the drives came on; absent: no new"
            " pair of counts",
        ),
    ),
    SET_POINT: (
        Field("q{}_set_rad", "rad", "set-point of the angle"),
        Field("speed{}_set_rad_s", "rad/s", "set-point of the speed"),
        Field("joint{}_set_rad", "rad", "set-point of the joint; absent: same as of its encoder"),
    ),
    DRIVES: (
        Field("u{}_V", "V", "commanded motor voltage in the joint's sign; absent: open circuit"),
        Field("i{}_A", "A", "motor current in the joint's sign"),
        Field("supply{}_V", "V", "supply at the board"),
        Field("temperature{}_C", "degC", "temperature of the drive"),
        Field("statusword{}", "1", "CiA 402 statusword, low byte"),
        Field("drive_faults{}", "1", "fault bits of the motor board (docs/motor_board.md)"),
        Field("flags{}", "1", "flags of the encoder channel (docs/encoder_board.md)"),
        Field("counted{}_s", "s", "when the count was latched, by the clock of its encoder board"),
    ),
    CAMERA: tuple(
        Field(f"{axis}_m", "m", f"{axis} of the tip in the base frame, measured by the camera; absent: no new frame")
        for axis in "xyz"
    ),
    LOOP: (
        Field("t_s", "s", "clock of the loop"),
        Field("cycle", "1", "number of the cycle"),
        Field("run", "1", "number of the motion; 0 before the first"),
        Field("mode", "1", "number of the mode, by control.safety.modes.Mode; its name is in mode_name"),
        Field("missed", "1", "deadlines missed so far"),
        Field("late_s", "s", "how late the cycle began, its wait for the encoder's report included"),
        Field("busy_s", "s", "how long the cycle took"),
        Field("page_faults", "1", "page faults of the loop in the cycle; 0 on the stepped clock, as the next"),
        Field("switches", "1", "how often another program took the loop's processor in the cycle"),
        Field("age_s", "s", "age of the oldest counts when the cycle began, beyond that of a prompt report"),
        Field("payload_kg", "kg", "mass at the tip, as stated"),
    ),
    END: (
        Field("tool", "1", "number of the tool that is on, from 0, in the order of the arm.toml"),
        Field("gripper_m", "m", "opening of the gripper; absent: not known"),
        Field("gripper_goal_m", "m", "opening that was asked for; absent: none, or its end"),
        Field("gripper_A", "A", "current of the gripper's motor, opening positive"),
        Field("gripper_state", "1", "number of the gripper's state, by control.end_effector.GripState"),
        Field("digital", "1", "levels of the named pins as bits, in the order of the arm.toml"),
    ),
}
MODE_NAME: Final = Field("mode_name", "1", "mode of the arm: OFF, BRAKED, HOLDING, MOVING, ...")
FOLLOWING_ERROR: Final = Field("following_error{}_rad", "rad", "set-point minus angle")


def schemas_of(joint_count: int) -> dict[str, Schema]:
    """Topic -> JSON schema of all messages, for this number of joints."""
    return {**_own_schemas(joint_count), **{topic: FOXGLOVE[title] for topic, title in WELL_KNOWN.items()}}


def _own_schemas(joint_count: int) -> dict[str, Schema]:
    """Topic -> JSON schema of our own messages, for this number of joints."""
    fields = {**TOPICS, ERROR: (FOLLOWING_ERROR,)}
    schemas = {topic: _own(topic, topic_fields, joint_count) for topic, topic_fields in fields.items()}
    schemas[LOOP]["properties"]["mode_name"] = {"type": "string", "description": MODE_NAME.meaning}
    return schemas


def columns_of(topic: str, joint_count: int) -> tuple[str, ...]:
    """The recording's columns that a topic of our own carries."""
    return tuple(name for field in TOPICS[topic] for name, _ in _each(field, joint_count))


def _own(topic: str, fields: tuple[Field, ...], joint_count: int) -> Schema:
    properties = {
        name: {"type": "number", "description": f"{meaning} [{field.unit}]"}
        for field in fields
        for name, meaning in _each(field, joint_count)
    }
    title = "armwright." + "_".join(topic.strip("/").split("/"))
    about = f"columns of {topic}, in SI units and radians"
    return {"title": title, "description": about, "type": "object", "properties": properties}


def _each(field: Field, joint_count: int) -> list[tuple[str, str]]:
    if "{}" not in field.column:
        return [(field.column, field.meaning)]
    return [(field.column.format(j), f"joint {j}: {field.meaning}") for j in range(1, joint_count + 1)]


def _message(title: str, meaning: str, **properties: Schema) -> Schema:
    return {"title": title, "description": meaning, "type": "object", "properties": properties}


def _many(items: Schema) -> Schema:
    return {"type": "array", "items": items, "description": ""}


def _number(meaning: str) -> Schema:
    return {"type": "number", "description": meaning}


def _text(meaning: str) -> Schema:
    return {"type": "string", "description": meaning}


_TIME: Final = _message("time", "time since 1970, UTC", sec={"type": "integer"}, nsec={"type": "integer"})
_DURATION: Final = _message("duration", "0: until it is replaced", sec={"type": "integer"}, nsec={"type": "integer"})
_VECTOR: Final = _message("foxglove.Vector3", "[m]", **{axis: _number(f"{axis} [m]") for axis in "xyz"})
_POINT: Final = _message("foxglove.Point3", "[m]", **{axis: _number(f"{axis} [m]") for axis in "xyz"})
_QUATERNION: Final = _message("foxglove.Quaternion", "orientation [1]", **{part: _number(f"{part} [1]") for part in "xyzw"})
_POSE: Final = _message("foxglove.Pose", "a pose", position=_VECTOR, orientation=_QUATERNION)
_COLOUR: Final = _message("foxglove.Color", "[1], 0 to 1", **{part: _number(f"{part} [1]") for part in "rgba"})
_TRANSFORM: Final = _message(
    "foxglove.FrameTransform",
    "pose of a frame in its parent",
    timestamp=_TIME,
    parent_frame_id=_text("parent"),
    child_frame_id=_text("child"),
    translation=_VECTOR,
    rotation=_QUATERNION,
)
_CYLINDER: Final = _message(
    "foxglove.CylinderPrimitive",
    "a link",
    pose=_POSE,
    size=_VECTOR,
    bottom_scale=_number("[1]"),
    top_scale=_number("[1]"),
    color=_COLOUR,
)
_SPHERE: Final = _message("foxglove.SpherePrimitive", "a joint or a tip", pose=_POSE, size=_VECTOR, color=_COLOUR)
_LINE: Final = _message(
    "foxglove.LinePrimitive",
    "a path",
    type={"type": "integer", "description": "0: strip"},
    pose=_POSE,
    thickness=_number("pixels where scale_invariant [1], else [m]"),
    scale_invariant={"type": "boolean"},
    points=_many(_POINT),
    color=_COLOUR,
    colors=_many(_COLOUR),
    indices=_many({"type": "integer"}),
)
_ENTITY: Final = _message(
    "foxglove.SceneEntity",
    "shapes in one frame",
    timestamp=_TIME,
    frame_id=_text("frame of the shapes"),
    id=_text("name; a later entity of the same name takes its place"),
    lifetime=_DURATION,
    frame_locked={"type": "boolean", "description": "follows its frame"},
    metadata=_many(_message("foxglove.KeyValuePair", "", key=_text("key"), value=_text("value"))),
    arrows=_many({"type": "object"}),
    cubes=_many({"type": "object"}),
    spheres=_many(_SPHERE),
    cylinders=_many(_CYLINDER),
    lines=_many(_LINE),
    triangles=_many({"type": "object"}),
    texts=_many({"type": "object"}),
    models=_many({"type": "object"}),
)
_DELETION: Final = _message(
    "foxglove.SceneEntityDeletion", "entities to remove", timestamp=_TIME, type={"type": "integer"}, id=_text("name")
)
_JOINT: Final = _message(
    "foxglove.JointState",
    "a revolute joint",
    name=_text("joint1, ..., as in the URDF of `armwright export-arm`"),
    position=_number("angle [rad]"),
    velocity=_number("speed [rad/s]"),
)
FOXGLOVE: Final[dict[str, Schema]] = {
    schema["title"]: schema
    for schema in (
        _message("foxglove.FrameTransforms", "the frames of the arm", transforms=_many(_TRANSFORM)),
        _message("foxglove.SceneUpdate", "the arm as shapes", deletions=_many(_DELETION), entities=_many(_ENTITY)),
        _message("foxglove.PoseInFrame", "a pose in a frame", timestamp=_TIME, frame_id=_text("frame"), pose=_POSE),
        _message("foxglove.JointStates", "the joints", timestamp=_TIME, joints=_many(_JOINT)),
        _message(
            "foxglove.Log",
            "what happened",
            timestamp=_TIME,
            level={"type": "integer", "description": "2 information, 3 warning, 4 error"},
            message=_text("in words"),
            name=_text("program"),
            file=_text("none"),
            line={"type": "integer"},
        ),
    )
}
WELL_KNOWN: Final = {
    "/tf": "foxglove.FrameTransforms",
    "/scene": "foxglove.SceneUpdate",
    "/tip/measured": "foxglove.PoseInFrame",
    "/tip/set_point": "foxglove.PoseInFrame",
    "/tip/camera": "foxglove.PoseInFrame",
    "/joint_states": "foxglove.JointStates",
    "/log": "foxglove.Log",
}
