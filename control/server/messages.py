"""Requests of the socket as strict types: an unknown key, another type or a value out of range is refused.

The server reads only `do` and `id` of a line; the rest is decoded when the client's right and the arm's mode allow the
request. A long line is read in slices before (control.server.server).
"""

import math
from collections.abc import Mapping
from typing import Annotated, Any, Literal, NamedTuple

import msgspec
from msgspec import Meta

from control.errors import ArmError

LONGEST_ID = 64  # characters
LARGEST_ID = (1 << 53) - 1  # what a client's JSON can hold exactly
LONGEST_PLAIN_bytes = 1 << 12  # of a line without a path: more would cost a cycle before its error is found
SHOWN = 80  # characters of a wrong value in a message
LONGEST_AVERAGE_S = 60.0
LEAST_OVERRIDE = 0.01  # slower would be a pause
LARGEST_STEP_rad, LARGEST_STEP_m = 7.0, 1.0  # more is a mistake in the unit

# Watching and stopping are everybody's; all other requests are those of the client in control (control.server.requests).
STOPPING = frozenset(("stop", "brake", "pause", "off", "acknowledge"))
WATCHING = frozenset(("status", "arm", "mode", "average_result", "fault_cycles", "control"))
AT_ONCE = frozenset(("stop", "brake"))  # overtake what waits
LONG = frozenset(("run_path", "run_joints", "move_together"))  # carry paths

_IN_WORDS = {
    "`float`": "a number",
    "`int`": "a whole number",
    "`bool`": "true or false",
    "`str`": "text",
    "`array`": "a list",
    "`object`": "a JSON object",
}

Id = Annotated[int, Meta(ge=-LARGEST_ID, le=LARGEST_ID)] | Annotated[str, Meta(max_length=LONGEST_ID)] | None
Name = Annotated[str, Meta(max_length=LONGEST_ID)]
Share = Annotated[float, Meta(ge=1e-3, le=1.0)]
Numbers = tuple[float, ...]


class _Message(msgspec.Struct, kw_only=True, forbid_unknown_fields=True, tag_field="do"):
    id: Id = None
    arm: Name = ""


class Plain(_Message, kw_only=True, tag=False):
    """A request without arguments."""

    do: str


class Owned(_Message, kw_only=True):
    """Begins something that belongs to its connection, unless it is detached."""

    detached: bool = False


class StartHoming(Owned, tag="home", kw_only=True):
    """Search the zeros."""

    again: bool = False


class MoveJoints(Owned, tag="move_joints", kw_only=True):
    """A joint move."""

    q_rad: Numbers
    speed: Share = 1.0
    as_encoders: bool = False


class RunJoints(Owned, tag="run_joints", kw_only=True):
    """A path of the joints (planned for the tip of `tool`, if that is given); read by control.motion.joint_path."""

    path: dict[str, Any]
    tool: Annotated[str, Meta(max_length=LONGEST_ID)] | None = None
    as_encoders: bool = False


class RunPath(RunJoints, tag="run_path", kw_only=True):
    """The same of a planned path of the tip: what PlannedPath.to_message() gives."""


class OfOneArm(msgspec.Struct, kw_only=True, forbid_unknown_fields=True):
    """What one arm does in a motion of several: a joint move, or a path."""

    q_rad: Numbers | msgspec.UnsetType = msgspec.UNSET
    speed: Share = 1.0
    path: dict[str, Any] | msgspec.UnsetType = msgspec.UNSET
    tool: Name | None = None

    def request(self, detached: bool) -> MoveJoints | RunJoints:
        """The same for this arm alone. ArmError unless one of `q_rad` and `path` is given."""
        if self.path is not msgspec.UNSET and self.q_rad is msgspec.UNSET:
            return RunJoints(path=self.path, tool=self.tool, detached=detached)
        if isinstance(self.q_rad, tuple) and self.path is msgspec.UNSET:
            return MoveJoints(q_rad=self.q_rad, speed=self.speed, detached=detached)
        raise ArmError("move_together: expected either q_rad or path for each arm")


class MoveTogether(Owned, tag="move_together", kw_only=True):
    """Motions of several arms that begin and end together."""

    moves: Mapping[str, OfOneArm]


class StartJog(_Message, tag="jog", kw_only=True):
    """A velocity, or a step; control.server.requests checks which keys belong together."""

    joint_speed_rad_s: Numbers | msgspec.UnsetType = msgspec.UNSET
    tip_velocity_m_s: tuple[float, float, float] | msgspec.UnsetType = msgspec.UNSET
    tip_turn_rad_s: tuple[float, float, float] | msgspec.UnsetType = msgspec.UNSET
    frame: Literal["base", "tip"] = "base"
    joint: int | msgspec.UnsetType = msgspec.UNSET
    by_rad: Annotated[float, Meta(ge=-LARGEST_STEP_rad, le=LARGEST_STEP_rad)] | msgspec.UnsetType = msgspec.UNSET
    speed_rad_s: Annotated[float, Meta(ge=1e-3, le=100.0)] = 100.0
    axis: str | msgspec.UnsetType = msgspec.UNSET
    by_m: Annotated[float, Meta(ge=-LARGEST_STEP_m, le=LARGEST_STEP_m)] | msgspec.UnsetType = msgspec.UNSET
    speed_m_s: Annotated[float, Meta(ge=1e-4, le=10.0)] = 10.0


class Override(_Message, tag="override", kw_only=True):
    """Pace of motions."""

    fraction: Annotated[float, Meta(ge=LEAST_OVERRIDE, le=1.0)]


class Guide(Owned, tag="guide", kw_only=True):
    """Hand guiding."""

    weightless: bool = False


class StartAverage(_Message, tag="average", kw_only=True):
    """Start an average."""

    duration_s: Annotated[float, Meta(ge=0.01, le=LONGEST_AVERAGE_S)]


class SetPayload(_Message, tag="payload", kw_only=True):
    """Mass in the gripper."""

    mass_kg: Annotated[float, Meta(ge=0.0)]


class ChangeTool(_Message, tag="tool", kw_only=True):
    """Another tool is on."""

    name: Annotated[str, Meta(max_length=LONGEST_ID)]


class Grip(_Message, tag="gripper", kw_only=True):
    """Open, close, go to an opening, or stop."""

    action: Literal["open", "close", "move", "stop"]
    opening_m: float | None = None
    force_N: float | None = None


class SetOutput(_Message, tag="digital", kw_only=True):
    """Set a digital output."""

    name: Annotated[str, Meta(max_length=LONGEST_ID)]
    level: bool


class Off(_Message, tag="off", kw_only=True):
    """Shutdown. `lets_go`: of an arm that is held by its boards, too: somebody holds it."""

    quit: bool = False
    lets_go: bool = False


class TakeControl(_Message, tag="control", kw_only=True):
    """Take or release control, end that of another client, or join those who share a key."""

    take: bool | None = None
    revoke: bool = False
    key: Annotated[str, Meta(min_length=8, max_length=LONGEST_ID)] | None = None


class Asked(NamedTuple):
    """One request as it came: its name, its number for the answer, the whole line, and the arm; empty: the only one."""

    do: str
    id: int | str | None
    line: bytes
    arm: str = ""
    read: Any = None  # of a long line: what `decoded` returns


class _Envelope(msgspec.Struct):
    do: str
    id: Id = None
    arm: Name = ""


_ENVELOPE = msgspec.json.Decoder(_Envelope)
_KINDS: Mapping[str, type[_Message]] = {
    str(kind.__struct_config__.tag): kind
    for kind in (
        StartHoming,
        MoveJoints,
        RunPath,
        RunJoints,
        MoveTogether,
        StartJog,
        Override,
        Guide,
        StartAverage,
        SetPayload,
        ChangeTool,
        Grip,
        SetOutput,
        Off,
        TakeControl,
    )
}
_DECODERS = {do: msgspec.json.Decoder(kind) for do, kind in _KINDS.items()}
_PLAIN = msgspec.json.Decoder(Plain)
_Texts = dict[str, msgspec.Raw]


class _OutlinedOfOneArm(OfOneArm, kw_only=True):
    path: _Texts | msgspec.UnsetType = msgspec.UNSET


class _OutlinedTogether(MoveTogether, tag="move_together", kw_only=True):
    moves: Mapping[str, _OutlinedOfOneArm]


class _OutlinedPath(RunPath, tag="run_path", kw_only=True):
    path: _Texts


class _OutlinedJoints(RunJoints, tag="run_joints", kw_only=True):
    path: _Texts


_OUTLINES: Mapping[str, "msgspec.json.Decoder[Any]"] = {
    str(kind.__struct_config__.tag): msgspec.json.Decoder(kind) for kind in (_OutlinedTogether, _OutlinedPath, _OutlinedJoints)
}


def asked(line: bytes) -> Asked:
    """Read name and number of a request; ArmError says what a request looks like."""
    try:
        envelope = _ENVELOPE.decode(line)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise ArmError(
            f"request: expected one JSON object per line with the name of the request as `do`, got {line[:SHOWN]!r}"
            f" ({_reason(error)})"
        ) from None
    return Asked(envelope.do, envelope.id, line, envelope.arm)


def is_at_once(line: bytes) -> bool:
    """Whether a line is a stop; long lines are not looked into."""
    if len(line) > 4 * LONGEST_ID or not any(name.encode() in line for name in AT_ONCE):
        return False
    try:
        return asked(line).do in AT_ONCE
    except ArmError:
        return False


def decoded(request: Asked) -> Any:
    """Decode the whole request to its type. ArmError names the key, what was expected and what came."""
    if request.read is not None:
        return request.read
    if len(request.line) > LONGEST_PLAIN_bytes and request.do not in LONG:
        raise ArmError(f"request {request.do!r}: expected at most {LONGEST_PLAIN_bytes} bytes, got {len(request.line)}")
    return _decoded_by(_DECODERS.get(request.do, _PLAIN), request)


def outlined(request: Asked) -> Any:
    """The same of a long request, with each list of its path as text (msgspec.Raw), so that it costs one pass over the line."""
    return _decoded_by(_OUTLINES[request.do], request) if request.do in _OUTLINES else decoded(request)


def _decoded_by(decoder: "msgspec.json.Decoder[Any]", request: Asked) -> Any:
    try:
        return decoder.decode(request.line)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise ArmError(f"request {request.do!r}: {_complaint(request.line, error)}") from None


def _reason(error: Exception) -> str:
    return "nested too deeply" if isinstance(error, RecursionError) else str(error)


def _complaint(line: bytes, error: Exception) -> str:
    """`speed: expected a number <= 1.0, got 2`, from the decoder's message and the value at its path."""
    if not isinstance(error, msgspec.ValidationError):
        return _reason(error)
    what, _, path = str(error).partition(" - at `$.")
    what = what[0].lower() + what[1:]
    for word, plain in _IN_WORDS.items():
        what = what.replace(word, plain)
    if not path:
        return what
    path = path.rstrip("`")
    key = path.partition("[")[0].partition(".")[0]
    return f"{path}: {what.partition(', got ')[0]}, got {_shown(line, key)}"


def _shown(line: bytes, key: str) -> str:
    if len(line) > LONGEST_PLAIN_bytes:
        return "another value"
    try:
        text = msgspec.json.encode(msgspec.json.decode(line)[key]).decode()
    except (msgspec.DecodeError, RecursionError, KeyError, TypeError):
        return "another value"
    return text if len(text) <= SHOWN else f"{text[:SHOWN]}..."


def numbers(name: str, values: Numbers, count: int) -> Numbers:
    """`values` if they are `count` finite numbers; ArmError names them."""
    if len(values) != count or not all(map(math.isfinite, values)):
        raise ArmError(f"{name}: expected {count} finite numbers, got {len(values)}: {str(values)[:SHOWN]}")
    return values
