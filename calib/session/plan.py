"""The plan of a session: targets in order, and everything that must be the same when it is resumed.

No I/O here except text: `to_json` and `from_json` are session.json.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from pathlib import Path
from types import MappingProxyType
from typing import Literal, get_args

from calib.errors import SessionError
from calib.points.points import FREE, STREAM_FRAME
from calib.points.writer import Key
from control.files import parsed_json
from control.model.arm import Arm

FORMAT = "session/1"
Board = Literal["known", "measured", "unknown", "contact"]
Seating = Literal["hand", "jog"]
PoseFrame = Literal["", "base", "stream"]


@dataclass(frozen=True, slots=True)
class Target:
    """One record to take: a cavity of a setup, or in the setup `free` a pose. `approach`: number of the side, from 1.

    q_rad: the angles of a free pose, or the posture for a cavity, None for the nearest; in a contact, of both arms.
    distance_m: between the tips of a contact.
    """

    setup: str
    point: str
    repeat: int = 1
    approach: int = 1
    q_rad: tuple[float, ...] | None = None
    distance_m: float = 0.0

    @property
    def key(self) -> Key:
        """Key of a record."""
        return self.setup, self.point, self.repeat

    @property
    def is_free(self) -> bool:
        """Whether it is a pose away from the board."""
        return self.setup == FREE

    @property
    def name(self) -> str:
        """Name for the operator: `normal 3`, or `normal 3 (repeat 2)`."""
        return f"{self.setup} {self.point}" + (f" (repeat {self.repeat})" if self.repeat > 1 else "")


@dataclass(frozen=True, slots=True)
class SessionPlan:
    """The plan of a session, fixed at its start and for every resumption.

    board: its pose is known, measured with the camera, or unknown; "contact": there is none, two arms touch (calib.closed_chain).
    seat: how the tip is seated;
    has_camera: whether the tip is measured; has_pictures: whether somebody takes a picture at each free pose, which is measured
    later (`camera poses`); arm_sha256: of the arm's parameters (`fingerprint`).
    pose_frame: the frame in which full poses are measured, "stream" one of unknown place; empty: positions in the base frame.
    """

    arm: str
    arm_sha256: str
    joint_count: int
    targets: tuple[Target, ...]
    board: Board = "known"
    seat: Seating = "hand"
    has_camera: bool = False
    payload_kg: float = 0.0
    pose_frame: PoseFrame = ""
    has_pictures: bool = False

    @property
    def approaches(self) -> int:
        """Number of sides from which points are approached."""
        return max((target.approach for target in self.targets), default=1)

    def require_sound(self) -> None:
        """SessionError if the plan is invalid."""
        if not self.targets:
            raise SessionError("the session has no points: check --setups, --points, --plan and --free")
        for target in self.targets:
            if target.is_free and target.q_rad is None:
                raise SessionError(f"{target.name}: a free pose needs joint angles")
            if not (target.setup.strip() and target.point.strip()) or len(target.name.splitlines()) > 1:
                raise SessionError(f"setup and point: expected one line of text, got {target.name!r}")
        keys = [target.key for target in self.targets]
        if len(set(keys)) < len(keys):
            twice = next(key for k, key in enumerate(keys) if key in keys[:k])
            raise SessionError(f"{' '.join(map(str, twice))} is planned twice: use --repeats")
        if self.board == "measured" and not self.has_camera:
            raise SessionError("a board measured by the camera needs --camera")
        if self.seat == "jog" and self.board not in ("known", "contact"):
            raise SessionError(f"--seat jog needs a board with a known pose, got {self.board}: guide the tip by hand")
        if self.pose_frame == STREAM_FRAME and not all(t.is_free for t in self.targets):
            raise SessionError(
                "the camera's frame has no known place to the arm's base, so it cannot say where the cavities of a board are:"
                " record --free poses and calibrate first, or state origin_m in [camera.stream]"
            )
        if self.has_pictures and not all(t.is_free for t in self.targets):
            raise SessionError("--pictures is of free poses alone: add --free N and leave the cavities out")
        if any(t.is_free for t in self.targets) and not (self.has_camera or self.has_pictures):
            raise SessionError(
                "free poses need a camera that measures the tip: add --camera, or --pictures where a webcam sees a board on"
                " the arm"
            )


def board_targets(setups: Sequence[str], points: Sequence[str], repeats: int = 1, approaches: int = 1) -> tuple[Target, ...]:
    """Setup after setup; in each, round after round: every point once per approach and repeat.

    Records are numbered consecutively: with two approaches the odd ones come from the first side, the even from the second.
    """
    return tuple(
        Target(setup, point, (turn - 1) * approaches + side, side)
        for setup in setups
        for turn in range(1, repeats + 1)
        for side in range(1, approaches + 1)
        for point in points
    )


def free_targets(poses: Mapping[str, Sequence[float]], repeats: int = 1) -> tuple[Target, ...]:
    """Free poses by name, round after round."""
    return tuple(
        Target(FREE, name, turn, 1, tuple(float(q) for q in q_rad))
        for turn in range(1, repeats + 1)
        for name, q_rad in poses.items()
    )


def fingerprint(arm: Arm) -> str:
    """SHA-256 of the arm's parameters, independent of comments, order and ports."""
    ports = tuple(replace(board, port="") for board in arm.encoder_boards)
    camera = arm.camera.with_port(None) if arm.camera else None
    bare = replace(arm, encoder_boards=ports, can=None, camera=camera, path=None)
    return hashlib.sha256(repr(bare).encode()).hexdigest()


def to_json(plan: SessionPlan, started: str) -> str:
    """The text of session.json; `started` is the date and time in ISO 8601."""
    content = {
        "format": FORMAT,
        "started": started,
        "arm": plan.arm,
        "arm_sha256": plan.arm_sha256,
        "joint_count": plan.joint_count,
        "board": plan.board,
        "seat": plan.seat,
        "camera": plan.has_camera,
        "payload_kg": plan.payload_kg,
        **({"pose_frame": plan.pose_frame} if plan.pose_frame else {}),
        **({"pictures": True} if plan.has_pictures else {}),
        "targets": [_target_json(target) for target in plan.targets],
    }
    return json.dumps(content, indent=1) + "\n"


def from_json(text: str, path: Path) -> tuple[SessionPlan, str]:
    """The plan of a session.json and its start time; SessionError names file and key."""
    try:
        content = parsed_json(text)
        if content["format"] != FORMAT:
            raise SessionError(f'{path}, format: expected "{FORMAT}", got "{content["format"]}"')
        _require_one_of(path, "board", content["board"], get_args(Board))
        _require_one_of(path, "seat", content["seat"], get_args(Seating))
        _require_one_of(path, "pose_frame", content.get("pose_frame", ""), get_args(PoseFrame))
        plan = SessionPlan(
            str(content["arm"]),
            str(content["arm_sha256"]),
            int(content["joint_count"]),
            tuple(_target(entry) for entry in content["targets"]),
            content["board"],
            content["seat"],
            bool(content["camera"]),
            float(content["payload_kg"]),
            content.get("pose_frame", ""),
            bool(content.get("pictures", False)),
        )
        return plan, str(content["started"])
    except KeyError as error:
        raise SessionError(f"{path}: key {error} is missing: not a whole session.json") from error
    except (ValueError, TypeError, AttributeError) as error:
        raise SessionError(f"{path}: not a session.json ({error})") from error


def require_same(begun: SessionPlan, wanted: SessionPlan, where: Path) -> None:
    """SessionError names the difference if a session is resumed with another plan."""
    if begun.arm_sha256 != wanted.arm_sha256:
        raise SessionError(
            f"{where}: this session began with arm {begun.arm!r} (file {begun.arm_sha256[:12]}), got {wanted.arm!r} (file"
            f" {wanted.arm_sha256[:12]}): give the same arm file, or another --out for a new session"
        )
    for what, before, now in (
        ("board", begun.board, wanted.board),
        ("seat", begun.seat, wanted.seat),
        ("camera", begun.has_camera, wanted.has_camera),
        ("pictures", begun.has_pictures, wanted.has_pictures),
        ("payload in kg", begun.payload_kg, wanted.payload_kg),
    ):
        if before != now:
            raise SessionError(f"{where}: this session began with {what} {before}, got {now}: {_REMEDY}")
    if begun.targets != wanted.targets:
        raise SessionError(f"{where}: this session began with another plan ({_difference(begun, wanted)}): {_REMEDY}")


_REMEDY = "omit the options to resume it, or name another --out"


def _difference(begun: SessionPlan, wanted: SessionPlan) -> str:
    before, now = set(begun.targets), set(wanted.targets)
    gone, new = _first(begun.targets, before - now), _first(wanted.targets, now - before)
    if not gone and not new:
        return "the same points in another order"
    return " and ".join(
        text for text in (f"{gone} is not in the new one" if gone else "", f"{new} is new" if new else "") if text
    )


def _first(targets: Iterable[Target], among: set[Target]) -> str:
    return next((target.name for target in targets if target in among), "")


def _target_json(target: Target) -> dict[str, object]:
    entry: dict[str, object] = {"setup": target.setup, "point": target.point, "repeat": target.repeat}
    if target.approach != 1:
        entry["approach"] = target.approach
    if target.q_rad is not None:
        entry["q_rad"] = list(target.q_rad)
    if target.distance_m:
        entry["distance_m"] = target.distance_m
    return entry


def _target(entry: Mapping[str, object]) -> Target:
    q_rad = entry.get("q_rad")
    angles = tuple(float(q) for q in q_rad) if isinstance(q_rad, list) else None
    return Target(
        str(entry["setup"]),
        str(entry["point"]),
        int(str(entry["repeat"])),
        int(str(entry.get("approach", 1))),
        angles,
        float(str(entry.get("distance_m", 0.0))),
    )


def _require_one_of(path: Path, key: str, value: object, choices: Sequence[str]) -> None:
    if value not in choices:
        raise SessionError(f"{path}, {key}: expected one of {', '.join(choices)}, got {value!r}")


# State of a session: which targets are left, done, skipped or bad, and which is next. No I/O, nothing moves.
#
# Transitions of a target by event:
#
# | is | recorded | skip | redo | bad |
# | --- | --- | --- | --- | --- |
# | left | done | skipped | - | - |
# | done | - | - | left | bad |
# | skipped | - | - | left | - |
# | bad | - | - | left | - |
#
# `-` is refused with a SessionError that says what to do, and changes nothing.


class Mark(Enum):
    """State of a target."""

    LEFT = "left"
    DONE = "done"
    SKIPPED = "skipped"
    BAD = "bad"


class TargetEvent(Enum):
    """Event of a target."""

    RECORDED = "recorded"
    SKIP = "skip"
    REDO = "redo"
    BAD = "bad"


AFTER: Mapping[tuple[Mark, TargetEvent], Mark] = MappingProxyType(
    {
        (Mark.LEFT, TargetEvent.RECORDED): Mark.DONE,
        (Mark.LEFT, TargetEvent.SKIP): Mark.SKIPPED,
        (Mark.DONE, TargetEvent.REDO): Mark.LEFT,
        (Mark.DONE, TargetEvent.BAD): Mark.BAD,
        (Mark.SKIPPED, TargetEvent.REDO): Mark.LEFT,
        (Mark.BAD, TargetEvent.REDO): Mark.LEFT,
    }
)
_ADVICE = {
    (Mark.LEFT, TargetEvent.REDO): "it is not recorded yet",
    (Mark.LEFT, TargetEvent.BAD): "it is not recorded; `skip` omits it",
    (Mark.DONE, TargetEvent.RECORDED): "`redo` it first",
    (Mark.DONE, TargetEvent.SKIP): "it is recorded; `bad` removes the record",
    (Mark.SKIPPED, TargetEvent.SKIP): "it is skipped already",
    (Mark.BAD, TargetEvent.BAD): "it is marked already",
}


@dataclass(frozen=True, slots=True)
class SessionState:
    """Marks by key, in the plan's order, and the last record."""

    targets: Mapping[Key, Target]
    marks: Mapping[Key, Mark]
    last: Key | None = None

    @classmethod
    def begun(cls, targets: tuple[Target, ...]) -> SessionState:
        """The initial state: everything is left."""
        return cls(
            MappingProxyType({target.key: target for target in targets}),
            MappingProxyType({target.key: Mark.LEFT for target in targets}),
        )

    def after(self, event: TargetEvent, key: Key) -> SessionState:
        """The state after an event; SessionError if it is invalid."""
        self.require_planned(key)
        now = self.marks[key]
        if (now, event) not in AFTER:
            advice = _ADVICE.get((now, event), "`redo` it first")
            raise SessionError(f"{self.targets[key].name} is {now.value}, so not {event.value}: {advice}")
        return self.marked(key, AFTER[now, event], is_last=event is TargetEvent.RECORDED)

    def marked(self, key: Key, mark: Mark, is_last: bool = False) -> SessionState:
        """The state with a target marked, when restoring from a file."""
        self.require_planned(key)
        marks = MappingProxyType({**self.marks, key: mark})
        last = key if is_last else (None if self.last == key and mark is not Mark.DONE else self.last)
        return replace(self, marks=marks, last=last)

    def next(self, standing: str = "") -> Target | None:
        """The first remaining target, preferably of the present setup; None if nothing is left."""
        left = self.left()
        return next((target for target in left if target.setup == standing), left[0] if left else None)

    def left(self) -> list[Target]:
        """Remaining targets, in order."""
        return [target for key, target in self.targets.items() if self.marks[key] is Mark.LEFT]

    def count(self, mark: Mark) -> int:
        """Number of targets with a mark."""
        return sum(one is mark for one in self.marks.values())

    def named(self, setup: str, point: str, repeat: int | None = None) -> list[Key]:
        """Keys of a point: of one repeat or of all. SessionError if the plan has none."""
        keys = [key for key in self.targets if key[:2] == (setup, point) and repeat in (None, key[2])]
        if not keys:
            wanted = " ".join((setup, point, *([] if repeat is None else [str(repeat)])))
            setups = ", ".join(dict.fromkeys(key[0] for key in self.targets))
            raise SessionError(f"the session has no point {wanted}; its setups are {setups}")
        return keys

    def require_planned(self, key: Key) -> None:
        """SessionError if the plan has no such target."""
        if key not in self.targets:
            raise SessionError(f"{' '.join(map(str, key))} is not in the session's plan")
