"""A session as text: the board drawn with done, current and left points, and the count of each."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from calib.session.moves import Vector
from calib.session.plan import FREE, Target
from calib.session.state import Mark, SessionState

WIDTH, HEIGHT = 61, 25  # a character is twice as high as wide
SIGNS: Mapping[Mark, str] = {Mark.DONE: "#", Mark.LEFT: ".", Mark.SKIPPED: "-", Mark.BAD: "x"}
CURRENT, PARTLY = "O", "+"
LEGEND = "# done  + some repeats  O now  . left  - skipped  x bad"


def board_text(
    state: SessionState, cavities_m: Mapping[str, Vector], setup: str, current: Target | None
) -> str:
    """The cavities of one setup, seen from above, the board's x axis to the right."""
    marks = {name: _sign(state, setup, name, current) for name in cavities_m}
    shown = {name: cavities_m[name] for name, sign in marks.items() if sign}
    if not shown:
        return f"setup {setup}: this session has no cavities there\n"
    left, right = min(p[0] for p in shown.values()), max(p[0] for p in shown.values())
    low, high = min(p[1] for p in shown.values()), max(p[1] for p in shown.values())
    per_column = max((right - left) / (WIDTH - 1), (high - low) / (2 * (HEIGHT - 1)), 1e-6)
    rows = round((high - low) / (2 * per_column)) + 1
    grid = [[" "] * WIDTH for _ in range(rows)]
    for name, (x, y, _) in shown.items():
        grid[round((high - y) / (2 * per_column))][round((x - left) / per_column)] = marks[name]
    drawn = "\n".join("  " + "".join(line).rstrip() for line in grid)
    now = f"; now: {current.name}" if current is not None else ""
    return f"setup {setup}{now}\n{drawn}\n  {LEGEND}\n"


def status_text(state: SessionState) -> str:
    """How many points of each setup are done, left, skipped and bad."""
    lines = []
    for setup in dict.fromkeys(target.setup for target in state.targets.values()):
        marks = [state.marks[key] for key in state.targets if key[0] == setup]
        counts = ", ".join(f"{sum(m is mark for m in marks)} {mark.value}" for mark in Mark if mark in marks)
        names = _names(state, setup)
        what = "free poses" if setup == FREE else f"setup {setup}"
        lines.append(f"  {what}: {counts}{names}")
    return "\n".join(lines) + "\n"


def _names(state: SessionState, setup: str) -> str:
    """Skipped and bad points by name: they are few."""
    parts = []
    for mark in (Mark.SKIPPED, Mark.BAD):
        keys = [key for key, one in state.marks.items() if key[0] == setup and one is mark]
        if keys:
            parts.append(f"{mark.value}: {', '.join(_short(keys))}")
    return f" ({'; '.join(parts)})" if parts else ""


def _short(keys: Iterable[tuple[str, str, int]]) -> list[str]:
    return [point if repeat == 1 else f"{point} (repeat {repeat})" for _, point, repeat in keys]


def _sign(state: SessionState, setup: str, name: str, current: Target | None) -> str:
    """The character of a cavity; empty if the session does not use it."""
    if current is not None and (current.setup, current.point) == (setup, name):
        return CURRENT
    marks = {state.marks[key] for key in state.targets if key[:2] == (setup, name)}
    if not marks:
        return ""
    if len(marks) == 1:
        return SIGNS[marks.pop()]
    return PARTLY
