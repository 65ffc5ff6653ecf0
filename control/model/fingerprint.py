"""What an arm is, apart from where its boards are connected: compared between the runtime and its clients.

A client plans, records and draws with an arm.toml of its own. If it is not the one that the runtime has, the tip goes elsewhere
without a word. So the values that planning and measuring depend on are compared, key by key, as they are after reading: comments,
order, and values that are left out because they are usual make no difference. docs/socket.md lists what is not compared.
"""

import hashlib
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import is_dataclass
from typing import TYPE_CHECKING, Any, Final

from control.errors import ArmError
from control.model.arm import Arm, Drive, Effect, Tool
from control.model.maps import CorrectionMap
from control.model.reader import keys_of

if TYPE_CHECKING:
    from control.model.cell import Cell

NOT_COMPARED: Final = frozenset(
    {
        "name",
        "as_given",
        "placeholders",
        "rest",
        "recording",
        "calibration",
        "encoder_board",
        "can",
        "board",
        "digital",
        "gripper",
        "link.joint_name",
        "link.link_name",
        "tolerances",
        "camera.udp_port",
        "camera.position_noise_m",
        "camera.orientation_noise_rad",
        "camera.stream.host",
        "camera.stream.port",
        "drive.encoder_board",
        "drive.encoder_channel",
        "drive.motor_node",
        "drive.motor_serial_number",
        "drive.board",
        "drive.board_channel",
        "drive.servo",
        "drive.board_holds",
        "drive.home",
        "drive.pid.kp",
        "drive.pid.ki",
        "drive.pid.kd",
        "drive.pid.derivative_filter_s",
        "limits.stale_s",
        "limits.watchdog_s",
        "limits.following_error_rad",
        "limits.following_error_per_speed_s",
        "limits.jog_silence_s",
        "limits.speed_contradiction_rad_s",
        "limits.transmission_slack_rad",
        "limits.unexplained_torque",
        "limits.supply_low",
        "limits.supply_high",
        "limits.temperature_degC",
    }
)
"""Keys of arm.toml: where things are connected, what only the loop uses, and what is for the record."""
IN_ANY_ORDER: Final = frozenset({"effect", "map", "tool"})
LONGEST: Final = 80  # characters of a value; a longer one is told by its hash
MOST_SHOWN: Final = 8
ABSENT: Final = "nothing"


class AnotherArm(ArmError):
    """The runtime has another arm than the client: nothing was sent."""


def content_of(arm: Arm) -> dict[str, str]:
    """The compared values as text, by what they are called: `link 2, L_m` is `0.4`."""
    content: dict[str, str] = {}
    for key, field in keys_of(Arm).items():
        value = arm.tools if key == "tool" else getattr(arm, field.name)
        if isinstance(value, tuple) and value and is_dataclass(value[0]):
            for called, row in _called(key, sorted(value, key=repr) if key in IN_ANY_ORDER else value):
                content.update(_values(row, key, called))
        else:
            content.update(_values(value, key, key))
    return content


def fingerprint(arm: Arm) -> str:
    """A short hash of the arm's content."""
    return fingerprint_of(content_of(arm))


def fingerprint_of(content: Mapping[str, str]) -> str:
    """The fingerprint of an arm with this content."""
    return hashlib.sha256(repr(sorted(content.items())).encode()).hexdigest()[:16]


def places_of(cell: "Cell") -> dict[str, str]:
    """The compared values of a cell: where each arm's base stands, and what distance is kept."""
    content = {f"cell, {key}": _text(getattr(cell, key)) for key in ("clearance_m", "tool_length_m")}
    for placed in cell.arms:
        content |= {f"arm {placed.name}, {key}": _text(getattr(placed, key)) for key in ("origin_m", "orientation")}
    return content


def require_same(arm: Arm, described: Mapping[str, Any], cell: "Cell | None" = None) -> None:
    """AnotherArm names every key in which an arm differs from the runtime's, which has `described` itself (request `arm`).

    With a `cell`, in the places of its arms, too; an arm that is served alone has none.
    """
    if "content" not in described:
        raise AnotherArm("the runtime does not say which arm it has: it is of an earlier version, start it again")
    ours, theirs = content_of(arm), dict(described["content"])
    if cell is not None and "cell" in described:
        ours |= places_of(cell)
        theirs |= described["cell"]
    file, their_file = str(arm.path or "the arm at hand"), str(described.get("file") or "unknown")
    lines = [
        f"{key}: {theirs.get(key, ABSENT)}, in {file} {ours.get(key, ABSENT)}"
        for key in dict.fromkeys((*theirs, *ours))
        if ours.get(key) != theirs.get(key)
    ]
    if lines:
        more = [f"and {len(lines) - MOST_SHOWN} more"] if len(lines) > MOST_SHOWN else []
        text = "\n  - ".join([*lines[:MOST_SHOWN], *more])
        is_edited = arm.path is not None and str(arm.path.absolute()) == their_file
        way_out = (
            f"{file} has changed since the runtime read it: start the runtime again, or undo the change"
            if is_edited
            else f"the runtime has another arm than {file}: start it with this file, or give the one that it has ({their_file})"
        )
        raise AnotherArm(f"{way_out}\n  - {text}")


def _called(key: str, rows: Sequence[object]) -> Iterator[tuple[str, object]]:
    """Rows with their names; those of the same name are numbered."""
    names = [_name(key, row, number) for number, row in enumerate(rows, 1)]
    count: Counter[str] = Counter()
    for name, row in zip(names, rows, strict=True):
        count[name] += 1
        yield (f"{name} ({count[name]})" if names.count(name) > 1 else name), row


def _name(key: str, row: object, number: int) -> str:
    if isinstance(row, Drive):
        return f"drive of joint {row.joint}"
    if isinstance(row, Tool):
        return f"tool {row.name}".rstrip()
    if isinstance(row, Effect):
        return f"effect {row.effect}" + (f" of joint {row.joint}" if row.joint is not None else "")
    if isinstance(row, CorrectionMap):
        return f"map of joint {row.joint}"
    return f"{key} {number}"


def _values(value: object, key: str, called: str) -> Iterator[tuple[str, str]]:
    """The values below a key of arm.toml; nothing for one that is absent, or not compared."""
    if key in NOT_COMPARED or value is None:
        return
    if is_dataclass(value):
        for name, field in keys_of(type(value)).items():
            yield from _values(getattr(value, field.name), f"{key}.{name}", f"{called}, {name}")
    elif isinstance(value, Mapping):
        for name, inner in value.items():
            yield from _values(inner, f"{key}.{name}", f"{called}, {name}")
    else:
        text = _text(value)
        if len(text) > LONGEST:
            text = f"{text[:20]}... ({hashlib.sha256(text.encode()).hexdigest()[:8]})"
        yield called, text


def _text(value: object) -> str:
    """One number as another of the same value: 1 is 1.0, and -0.0 is 0.0."""
    if isinstance(value, tuple | list):
        return f"[{', '.join(map(_text, value))}]"
    if isinstance(value, int | float) and not isinstance(value, bool):
        return repr(float(value) + 0.0).removesuffix(".0")
    return str(value)
