"""The console's panels as rows of text from a status, without a screen, so that tests can read them."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from console.screen.drawing import Row, Span, row, width_of, wrapped
from control.model.arm import Arm, Drive
from control.model.can_bus import bus_load

Message = dict[str, Any]
NEAR = 0.8  # of a limit: warn above
# A command and a reply of 8 bytes a joint and cycle, with the worst stuffing: 135 bit times each (docs/motor_board.md).
MODE_LOOKS = {
    "PAUSED": "warning-badge",
    "STOPPING": "warning-badge",
    "GUIDING": "warning-badge",
    "FAULT": "error-badge",
    "HELD": "warning-badge",
}
NEXT = {
    "OFF": "The drives are off. `n` switches them on and holds.",
    "BRAKED": "The drives are at 0 V; the windings brake. `n` holds.",
    "HELD": "Its boards hold the arm. `n` takes it over; `o` lets it go: hold it.",
    "GUIDING": "Move the arm by hand. `r` records a way-point, `n` holds, space brakes.",
    "PAUSED": "Paused on the path. `p` continues, space ends the motion.",
}
GAUGE_least, GAUGE_most = 12, 40  # columns


@dataclass(frozen=True, slots=True)
class Column:
    """A column of the joints' table: its long and short heading, and its widths."""

    heading: str
    short: str
    wide: int
    narrow: int
    cell: Callable[[Message, Drive, Arm, int], Span]


def headline(status: Message | None, arm: Arm, why_lost: str, width: int, clock: str) -> Row:
    """Arm, mode, and state of the loop."""
    name: Span = (f" {arm.name} ", "strong")
    if status is None:
        return row(name, (" NO LINK ", "error-badge"), f"  {why_lost}")
    mode = status["mode"]
    progress = f" {100 * status['progress']:.0f} %" if mode in ("MOVING", "PAUSED") else ""
    late_us, period_s = max(0.0, 1e6 * status["late_p99_s"]), status["period_s"]  # no minus zero
    spans = row(
        name,
        (f" {mode}{progress} ", MODE_LOOKS.get(mode, "badge")),
        ("  homed", "plain") if status["is_homed"] else ("  not homed", "warning"),
        *_others(status),
        f"  loop {1e3 * period_s:g} ms",
        (f"  late {late_us:.0f} us", "warning" if late_us > 0.2e6 * period_s else "plain"),
        f"  missed {status['missed_cycles']}",
        *_bus(status, arm),
    )
    room = width - width_of(spans) - 1
    return (*spans, (clock.rjust(room), "muted")) if room > len(clock) else spans


def _others(status: Message) -> Row:
    """The modes of the other arms of the cell."""
    cell = status.get("cell")
    others = cell["arms"].items() if cell else ()
    return tuple((f"  {name} {mode}", "error" if mode == "FAULT" else "plain") for name, mode in others if name != status["arm"])


def _bus(status: Message, arm: Arm) -> tuple[str, ...]:
    """The load of its CAN bus; in a cell, other arms may use it too."""
    load = bus_load([arm], 1.0 / status["period_s"])
    return () if status.get("cell") or not load else (f"  bus {100 * load:.0f} %",)


def joint_rows(status: Message, arm: Arm, selected: str, width: int, in_degrees: bool = False) -> list[Row]:
    """A heading and a row per joint; if there is room, with a gauge of the angle in its range."""
    columns = (DEGREES, *COLUMNS[1:]) if in_degrees else COLUMNS
    is_wide = width >= NAME + sum(column.wide for column in columns) + DRIVE
    widths = [column.wide if is_wide else column.narrow for column in columns]
    titles = [column.heading if is_wide else column.short for column in columns]
    gauge = min(width - NAME - sum(widths) - DRIVE - 1, GAUGE_most)
    heading = " " * NAME + "".join(title.rjust(w) for title, w in zip(titles, widths, strict=True))
    in_range = f"{'range':^{gauge}}" if gauge >= GAUGE_least else ""
    rows = [row((f"{heading}  {'drive':<{DRIVE - 2}}{in_range}", "muted"))]
    ages = stale_s(status)
    for j, drive in enumerate(arm.drives):
        spans = _joint_name(j, selected, ages[j])
        for column, cells in zip(columns, widths, strict=True):
            text, look = column.cell(status, drive, arm, j)
            spans += ((text.rjust(cells), "muted" if ages[j] is not None else look),)
        spans += (_drive_state(str(status["drive_state"][j]), ages[j]),)
        if gauge >= GAUGE_least:
            spans += _gauge(status, drive, j, gauge)
        rows.append(spans)
    return rows


def tip_row(status: Message, selected: str) -> Row:
    """The tip by the arm's model, and its distances from the set-point and the camera's measurement."""
    signs = {f"{turn}{axis}": sign for axis in "XYZ" for turn, sign in (("", "▸"), ("R", "↻"))}
    axes = tuple(
        (
            f"{signs[selected] if selected[-1:] == a and selected in signs else ' '}{a}",
            "chosen" if selected[-1:] == a and selected in signs else "strong",
        )
        for a in "XYZ"
    )
    if status["tip_m"] is None:
        return (*axes, ("   tip unknown before homing", "muted"))
    tip = " ".join(f"{1e3 * x:+8.2f}" for x in status["tip_m"])
    off_mm = 1e3 * math.dist(status["tip_set_m"], status["tip_m"])
    spans = (*axes, *row(("   tip mm ", "muted"), tip, ("  set off ", "muted"), f"{off_mm:.2f}"))
    if status["camera_m"] is not None:
        camera_mm = 1e3 * math.dist(status["camera_m"], status["tip_m"])
        spans += row(("  camera off ", "muted"), f"{camera_mm:.2f}")
    return spans


def end_rows(status: Message, width: int) -> list[Row]:
    """What is at the end of the arm: tool, gripper and pins, where it has them."""
    parts = [f"tool {status['tool']}"] if status.get("tools") else []
    if (grip := status.get("gripper")) is not None:
        opening = "" if grip["opening_m"] is None else f" {1e3 * grip['opening_m']:.1f} mm"
        parts.append(f"gripper {grip['state'].lower()}{opening} {grip['force_N']:.0f} N")
    signs = {None: "?", True: "1", False: "0"}
    parts += [f"{name} {signs[pin['level']]}" for name, pin in status.get("digital", {}).items()]
    return wrapped("  ".join(parts), "plain", width) if parts else []


def status_rows(status: Message | None, why_lost: str, width: int) -> list[Row]:
    """Problems with their remedies, the worst first."""
    if status is None:
        return [
            *wrapped(f"The link to the runtime is lost: {why_lost}.", "error", width, "! "),
            *wrapped("The runtime stops the motion of this console. The link is tried twice a second.", "plain", width),
        ]
    rows: list[Row] = []
    for fault in status["faults"]:
        rows += wrapped(f"{fault['where']}: {fault['message']}; {fault['remedy']}", "error", width, "! ")
    if rows:
        rows += wrapped("When it is safe: `a` acknowledges.", "plain", width)
    for warning in status["warnings"]:
        rows += wrapped(warning, "warning", width, "! ")
    if not status["faults"] and status["mode"] in NEXT:
        rows += wrapped(NEXT[status["mode"]], "plain", width)
    if status["mode"] == "HOLDING" and not status["is_homed"]:
        rows += wrapped("`h` homes the arm: every joint moves to its switch.", "plain", width)
    return rows or [row(("No faults, no warnings.", "muted"))]


def _joint_name(j: int, selected: str, age_s: float | None) -> Row:
    name = f"J{j + 1}"
    look = "chosen" if name == selected else "strong"
    return row((f"{'▸' if name == selected else ' '}{name}", look), ("?" if age_s is not None else " ", "warning"))


def _drive_state(state: str, age_s: float | None) -> Span:
    if age_s is not None:
        return f"  {f'STALE for {age_s:.1f} s':<{DRIVE - 2}}", "warning"
    return f"  {state[: DRIVE - 2]:<{DRIVE - 2}}", "plain" if state == "OPERATION ENABLED" else "muted"


def _gauge(status: Message, drive: Drive, j: int, width: int) -> Row:
    """A gauge of an angle within its range."""
    q, lower, upper = status["q_rad"][j], drive.joint_lower_rad, drive.joint_upper_rad
    if not math.isfinite(upper - lower) or not math.isfinite(q):
        return row((f"{'no range':^{width}}", "muted"))
    if not status["is_homed"]:
        return row((f"{'not homed':^{width}}", "muted"))
    room = width - 2
    at = min(max(round((q - lower) / (upper - lower) * (room - 1)), 0), room - 1)
    look = _near("", _range_use(status, drive, j))[1]
    sign: Span = ("●", look if look != "plain" else "accent")
    return row(("├" + "─" * at, "muted"), sign, ("─" * (room - 1 - at) + "┤", "muted"))


def _angle(status: Message, drive: Drive, arm: Arm, j: int) -> Span:
    return _near(f"{status['q_rad'][j]:+z.4f}", _range_use(status, drive, j))


def _degrees(status: Message, drive: Drive, arm: Arm, j: int) -> Span:
    return _near(f"{math.degrees(status['q_rad'][j]):+z.2f}", _range_use(status, drive, j))


def _error(status: Message, drive: Drive, arm: Arm, j: int) -> Span:
    error = status["following_error_rad"][j]
    return _near(f"{1e3 * error:+z.1f}", abs(error) / arm.limits.following_error_rad)


def _speed(status: Message, drive: Drive, arm: Arm, j: int) -> Span:
    speed = status["speed_rad_s"][j]
    return _near(f"{speed:+z.2f}", abs(speed) / drive.joint_speed_limit_rad_s)


def _current(status: Message, drive: Drive, arm: Arm, j: int) -> Span:
    current = status["current_A"][j]
    return _near(f"{current:+z.2f}", abs(current) / drive.current_limit_A)


def _temperature(status: Message, drive: Drive, arm: Arm, j: int) -> Span:
    temperature = status["temperature_C"][j]
    is_known = temperature is not None and math.isfinite(temperature)
    return (f"{temperature:.0f}" if is_known else "-"), "plain"


DEGREES = Column("angle deg", "angle deg", 10, 9, _degrees)
NAME, DRIVE = 4, 21  # columns of a joint's name and of its drive's state
COLUMNS = (
    Column("angle rad", "angle rad", 10, 9, _angle),
    Column("error mrad", "err mrad", 12, 9, _error),
    Column("speed rad/s", "rad/s", 13, 7, _speed),
    Column("current A", "A", 11, 7, _current),
    Column("supply V", "V", 10, 6, lambda status, _d, _a, j: (f"{status['supply_V'][j]:.1f}", "plain")),
    Column("temp °C", "°C", 9, 4, _temperature),
    Column("count", "count", 12, 11, lambda status, _d, _a, j: (f"{status['count'][j]:+d}", "plain")),
)


def _range_use(status: Message, drive: Drive, j: int) -> float:
    """0 in the middle of a joint's range, 1 at its ends; 0 before homing, when nobody knows where it is."""
    half = 0.5 * (drive.joint_upper_rad - drive.joint_lower_rad)
    if not status["is_homed"] or not 0.0 < half < math.inf:
        return 0.0
    return float(abs(status["q_rad"][j] - drive.joint_lower_rad - half)) / half


def _near(text: str, share: float) -> Span:
    """A value and its distance to the limit: `!` beyond it, `~` near it, besides the colour."""
    if share > 1.0:
        return f"!{text}", "error"
    return (f"~{text}", "warning") if share > NEAR else (text, "plain")


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
