"""Events between two statuses of the runtime, as text for the log."""

from typing import Any

Message = dict[str, Any]
Event = tuple[str, bool]  # text, whether it is a fault


def events_between(before: Message | None, after: Message | None, why_lost: str = "") -> list[Event]:
    """Events between `before` and `after`; None is a lost link."""
    if after is None:
        return [(f"link lost: {why_lost}", True)] if before is not None else []
    if before is None:
        return [(f"connected: {after['mode']}, {_homed(after)}", False)]
    return [*_of_mode(before, after), *_of_faults(before, after), *_of_stale(before, after)]


def stale_s(status: Message) -> list[float | None]:
    """Age [s] of each joint's data if one of its boards is silent, else None."""
    boards = zip(status["encoder_stale_s"], status["drive_stale_s"], strict=True)
    return [max((age for age in ages if age is not None), default=None) for ages in boards]


def _homed(status: Message) -> str:
    return "homed" if status["is_homed"] else "not homed"


def _of_mode(before: Message, after: Message) -> list[Event]:
    events: list[Event] = []
    if before["run"] != after["run"] and after["mode"] in ("MOVING", "HOLDING"):
        events.append((f"motion {after['run']} began", False))
    if before["mode"] != after["mode"]:
        ending = ", stopped" if after["mode"] == "HOLDING" and after["was_stopped"] else ""
        events.append((f"{before['mode']} → {after['mode']}{ending}", False))
    if before["is_homed"] != after["is_homed"]:
        events.append((_homed(after), False))
    return events


def _of_faults(before: Message, after: Message) -> list[Event]:
    known = [(fault["code"], fault["where"]) for fault in before["faults"]]
    events: list[Event] = [
        (f"fault: {fault['where']}: {fault['message']}", True)
        for fault in after["faults"]
        if (fault["code"], fault["where"]) not in known
    ]
    if before["faults"] and not after["faults"]:
        events.append(("faults acknowledged", False))
    return events


def _of_stale(before: Message, after: Message) -> list[Event]:
    events: list[Event] = []
    for number, ages in enumerate(zip(stale_s(before), stale_s(after), strict=True), 1):
        if ages[0] is None and ages[1] is not None:
            events.append((f"J{number}: no new data for {ages[1]:.1f} s", True))
        elif ages[0] is not None and ages[1] is None:
            events.append((f"J{number}: new data again", False))
    return events
