"""The operator's commands skip, redo and bad, and the targets that they refer to."""

from __future__ import annotations

from calib.errors import SessionError
from calib.points.writer import Key
from calib.session.dialogue import Command, Do
from calib.session.folder import SessionFolder
from calib.session.plan import Target
from calib.session.state import AFTER, Event, SessionState

EVENTS = {Do.SKIP: Event.SKIP, Do.REDO: Event.REDO, Do.BAD: Event.BAD}


def done_to(folder: SessionFolder, command: Command, asked: Target | None, standing: str) -> list[Key]:
    """Execute a command; return the affected targets. SessionError, without effect, if it is invalid."""
    event = EVENTS[command.do]
    keys = _meant(folder.state, event, command, asked, standing)
    for key in keys:
        folder.happen(event, key)
    return keys


def _meant(
    state: SessionState, event: Event, command: Command, asked: Target | None, standing: str
) -> list[Key]:
    """Keys of a command. A point without a repeat means all its repeats for which the event is valid."""
    if not command.point:
        return [_unnamed(state, event, asked)]
    setup = command.setup or standing or (asked.setup if asked else "")
    keys = state.named(setup, command.point, command.repeat)
    possible = [key for key in keys if (state.marks[key], event) in AFTER]
    if not possible:
        state.after(event, keys[0])  # raises with the reason
    return possible


def _unnamed(state: SessionState, event: Event, asked: Target | None) -> Key:
    key = (asked.key if asked else None) if event is Event.SKIP else state.last
    if key is None:
        raise SessionError(f"{event.value}: no point given; type {event.value} [setup] point [repeat]")
    return key
