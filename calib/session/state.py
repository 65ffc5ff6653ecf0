"""State of a session: which targets are left, done, skipped or bad, and which is next. No I/O, nothing moves.

Transitions of a target by event:

| is | recorded | skip | redo | bad |
| --- | --- | --- | --- | --- |
| left | done | skipped | - | - |
| done | - | - | left | bad |
| skipped | - | - | left | - |
| bad | - | - | left | - |

`-` is refused with a SessionError that says what to do, and changes nothing.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from enum import Enum
from types import MappingProxyType

from calib.errors import SessionError
from calib.points.writer import Key
from calib.session.plan import Target


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
