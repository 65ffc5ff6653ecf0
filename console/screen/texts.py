"""The console's panels as text: from a status to lines, without a screen, so that tests and eyes can read them."""

import math
from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

from control.model.arm import Arm

Message = dict[str, Any]
BLOCKS = "▁▂▃▄▅▆▇█"
NEAR = 0.8  # of a limit: shown in yellow
# A command and a reply of 8 bytes a joint and cycle, with the worst stuffing: 135 bit times each (docs/motor_board.md).
FRAME_bits = 135
MODE_COLOURS = {
    "HOLDING": "green", "MOVING": "cyan", "HOMING": "cyan", "JOGGING": "cyan", "PAUSED": "yellow", "STOPPING": "yellow",
    "GUIDING": "magenta", "BRAKED": "white", "OFF": "white", "FAULT": "red",
}  # fmt: skip
TODO = {
    "OFF": "drives are off: `n` switches them on and holds",
    "BRAKED": "0 V, the windings brake: `n` holds",
    "GUIDING": "the hand has the arm: `r` records a way-point, `n` holds, space brakes",
    "PAUSED": "paused on the path: `p` goes on, space leaves it",
}


@dataclass
class History:
    """The last values of what the strip charts show."""

    length: int = 120
    error_mrad: deque[float] = field(default_factory=deque)
    current_A: deque[float] = field(default_factory=deque)
    speed_m_s: deque[float] = field(default_factory=deque)
    late_us: deque[float] = field(default_factory=deque)
    _last: tuple[float, Sequence[float]] | None = None

    def add(self, status: Message) -> None:
        """One more status."""
        rows = (
            (self.error_mrad, 1e3 * max(map(abs, status["following_error_rad"]))),
            (self.current_A, max(map(abs, status["current_A"]))),
            (self.speed_m_s, self._tip_speed(status)),
            (self.late_us, 1e6 * status["late_p99_s"]),
        )
        for values, value in rows:
            values.append(value if math.isfinite(value) else 0.0)
            while len(values) > self.length:
                values.popleft()

    def _tip_speed(self, status: Message) -> float:
        tip, now_s = status["tip_set_m"], status["t_s"]
        last, self._last = self._last, (now_s, tip) if tip is not None else None
        if tip is None or last is None or now_s <= last[0]:
            return 0.0
        return math.dist(tip, last[1]) / float(now_s - last[0])


def strip(values: Iterable[float], width: int, top: float) -> str:
    """A strip chart of the newest values, `top` and more being a full block."""
    newest = list(values)[-width:]
    levels = (min(int(8.0 * max(v, 0.0) / top), 7) if top > 0.0 else 0 for v in newest)
    return "".join(BLOCKS[level] for level in levels).rjust(width)


def headline(status: Message | None, arm: Arm, why_lost: str) -> str:
    """Arm, mode, and what the loop does, in one line of markup."""
    if status is None:
        return f"[b]{arm.name}[/b]  [b white on red] NO LINK [/] {escaped(why_lost)}"
    mode = status["mode"]
    homed = "homed" if status["is_homed"] else "[yellow]not homed[/]"
    progress = f" {100 * status['progress']:.0f} %" if mode in ("MOVING", "PAUSED") else ""
    late_us, period_s = 1e6 * status["late_p99_s"], status["period_s"]
    late_colour = "yellow" if late_us > 0.2e6 * period_s else "none"
    return (
        f"[b]{arm.name}[/b]  [b black on {MODE_COLOURS.get(mode, 'white')}] {mode}{progress} [/]  {homed}"
        f"  loop {1e3 * period_s:g} ms [{late_colour}]late {late_us:.0f} us[/]"
        f"  missed {status['missed_cycles']}  bus {100 * bus_load(arm, period_s):.0f} %"
    )


def bus_load(arm: Arm, period_s: float) -> float:
    """Share of the CAN bus that commands and replies take at worst."""
    bitrate = arm.can.bitrate if arm.can is not None and arm.can.bitrate else 1_000_000
    return 2 * arm.joint_count * FRAME_bits / (bitrate * period_s)


def joint_lines(status: Message, arm: Arm, selected: str) -> list[str]:
    """A heading and a line a joint; values near their limits in yellow, `*` where a board is silent and they are its last."""
    lines = ["    angle rad e mrad  rad/s  current supply  temp      count drive"]
    for j, drive in enumerate(arm.drives):
        q, error = status["q_rad"][j], 1e3 * status["following_error_rad"][j]
        mark, age_s = "[reverse]" if selected == f"J{j + 1}" else "[none]", stale_s(status, j)
        temperature = status["temperature_C"][j]
        warm = f"{temperature:3.0f} C" if temperature is not None and math.isfinite(temperature) else "  -  "
        cells = (
            _near(f"{q:+10.4f}", _range_use(q, drive.joint_lower_rad, drive.joint_upper_rad)),
            _near(f"{round(error, 1) + 0.0:+6.1f}", abs(error) / (1e3 * arm.limits.following_error_rad)),
            _near(
                f"{status['speed_rad_s'][j]:+6.2f}",
                abs(status["speed_rad_s"][j]) / drive.joint_speed_limit_rad_s,
            ),
            _near(f"{status['current_A'][j]:+6.2f} A", abs(status["current_A"][j]) / drive.current_limit_A),
            f"{status['supply_V'][j]:4.1f} V",
            warm,
            f"{status['count'][j]:+10d}",
            escaped(str(status["drive_state"][j])) if age_s is None else f"[red]silent {age_s:.0f} s[/]",
        )
        lines.append(f"{mark}J{j + 1}[/]{' ' if age_s is None else '*'}{' '.join(cells)}")
    return lines


def stale_s(status: Message, joint: int) -> float | None:
    """Age in s of what is shown of a joint (0-based) where one of its boards is silent; None where all is live."""
    ages_s = (status["encoder_stale_s"][joint], status["drive_stale_s"][joint])
    return max((age_s for age_s in ages_s if age_s is not None), default=None)


def tip_line(status: Message, selected: str) -> str:
    """The tip by the arm's model, its set-point and what the camera sees."""
    axes = " ".join(f"[reverse]{axis}[/]" if selected == axis else axis for axis in ("X", "Y", "Z"))
    if status["tip_m"] is None:
        return f"{axes}  tip unknown before homing"
    tip = " ".join(f"{1e3 * x:+8.2f}" for x in status["tip_m"])
    off_mm = 1e3 * math.dist(status["tip_set_m"], status["tip_m"])
    text = f"{axes}  tip {tip} mm  set {off_mm:.2f} mm off"
    if status["camera_m"] is not None:
        text += f"  camera {1e3 * math.dist(status['camera_m'], status['tip_m']):.2f} mm off"
    return text


def news_lines(status: Message | None, why_lost: str) -> list[str]:
    """What is wrong and what to do about it, the worst first."""
    if status is None:
        return [
            f"[b red]The link to the runtime is lost[/]: {escaped(why_lost)}.",
            "If a motion of this console was under way, the runtime has stopped it. The link is tried twice a second.",
        ]
    lines = [
        f"[b red]{escaped(f['where'])}: {escaped(f['message'])}[/]; {escaped(f['remedy'])}"
        for f in status["faults"]
    ]
    if lines:
        lines.append("When it is safe: `a` acknowledges.")
    lines += [f"[yellow]{escaped(warning)}[/]" for warning in status["warnings"]]
    if not status["faults"] and status["mode"] in TODO:
        lines.append(escaped(TODO[status["mode"]]))
    if status["mode"] == "HOLDING" and not status["is_homed"]:
        lines.append("`h` homes the arm: every joint moves to its switch")
    return lines


def chart_lines(history: History, arm: Arm, width: int) -> list[str]:
    """Strip charts with their newest values."""
    room = max(width - 26, 8)
    limit_A = max(drive.current_limit_A for drive in arm.drives)
    rows = (
        ("error", history.error_mrad, 1e3 * arm.limits.following_error_rad, "{:6.1f} mrad"),
        ("current", history.current_A, limit_A, "{:6.2f} A   "),
        ("tip", history.speed_m_s, arm.limits.jog_tip_speed_m_s, "{:6.3f} m/s "),
        ("late", history.late_us, 1000.0, "{:6.0f} us  "),
    )
    return [
        f"{name:<8}{shown.format(values[-1] if values else 0.0)} {strip(values, room, top)}"
        for name, values, top, shown in rows
    ]


def escaped(text: str) -> str:
    """Text that a markup reader leaves alone."""
    return text.replace("[", "\\[")


def _range_use(q: float, lower: float, upper: float) -> float:
    """0 in the middle of a range, 1 at its ends."""
    half = 0.5 * (upper - lower)
    return abs(q - lower - half) / half if half > 0.0 and math.isfinite(half) else 0.0


def _near(text: str, share: float) -> str:
    if share > 1.0:
        return f"[red]{text}[/]"
    return f"[yellow]{text}[/]" if share > NEAR else text
