"""Reads arm.toml strictly and writes it exactly. The dataclasses are in `control.model.arm`.

An error names file, line, key, the expected and the actual value. The supplied arms are found by name.
"""

import dataclasses
import math
import re
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import tomli_w

from control.errors import ArmError, ArmFileError
from control.files import parsed_toml, read_text, write_whole
from control.model.arm import Arm
from control.model.arm_checks import check_arm
from control.model.drive import with_servo_values, without_servo_values
from control.model.end_effector import read_tools
from control.model.reader import Path as KeyPath
from control.model.reader import Rejected, key_lines, keys_of, nearest_line, read_table, show

SUPPLIED = Path(__file__).parents[1] / "arms"
_POSITION_IN_MESSAGE = re.compile(r" ?\(at (?:line (\d+), column \d+|end of document)\)$")


def load_arm(path_or_name: str | Path) -> Arm:
    """Load an arm from a file, or a supplied arm by its name ("right", "left"); ArmFileError otherwise."""
    path = Path(path_or_name)
    if path.suffix == ".toml" or path.exists():
        return parse_arm(_text_of(path), path)
    name = _supplied_name(str(path_or_name))
    return parse_arm(supplied_text(name), SUPPLIED / f"{name}.toml")


def supplied_text(name: str) -> str:
    """Return the file of a supplied arm, its name in capitals or with dashes as well; ArmFileError lists their names."""
    return (SUPPLIED / f"{_supplied_name(name)}.toml").read_text(encoding="utf-8")


def _supplied_name(name: str) -> str:
    plain = re.sub(r"[-_ .]", "", name).lower()
    if plain not in arm_names():
        from difflib import get_close_matches

        names = " or ".join(f'"{name}"' for name in arm_names())
        near = get_close_matches(plain, arm_names(), n=1)
        meant = f"did you mean {near[0]}?" if near else ""
        raise ArmFileError(name, None, "", f"a path to an arm.toml, or {names}", "an unknown name", meant)
    return plain


def arm_names() -> tuple[str, ...]:
    """Return the names of the supplied arms."""
    return tuple(sorted(file.stem for file in SUPPLIED.glob("*.toml")))


def parse_arm(text: str, path: Path) -> Arm:
    """Parse a TOML text to an arm; `path` is the origin of the text."""
    try:
        document = parsed_toml(text)
    except tomllib.TOMLDecodeError as error:
        raise syntax_error(error, text, path) from None
    try:
        document, tools = read_tools(with_servo_values(document))
        arm = read_table(Arm, document)
        if tools:
            arm = dataclasses.replace(arm, tool=tools[0], spare_tools=tools[1:])
        check_arm(arm)
    except Rejected as error:
        line = nearest_line(key_lines(text), error.path)
        raise ArmFileError(path, line, _spelled(error.path), error.expected, error.got, error.hint) from None
    drives = tuple(sorted(arm.drives, key=lambda drive: drive.joint))
    return dataclasses.replace(arm, drives=drives, path=path)


def save_arm(arm: Arm, path: str | Path) -> None:
    """Write the arm to a new file; an existing file is never overwritten. Numbers are written exactly.

    Keys with their default value are omitted. NotWritten where there is no room, or the place is not ours; then there is no file.
    """
    try:
        write_whole(Path(path), arm_text(arm), is_new=True)
    except FileExistsError:
        raise ArmFileError(path, None, "", "a new file", "an existing one", "arms are never overwritten") from None


def arm_text(arm: Arm) -> str:
    """Return the arm as the text of an arm.toml, with exact numbers."""
    table = without_servo_values(_table_of(arm))
    if arm.spare_tools:
        table["tool"] = [_table_of(tool) for tool in arm.tools]
    text = tomli_w.dumps(table)
    if arm.calibration is not None:
        return f"# A calibrated arm, from {_one_line(arm.calibration.source)}; see [calibration].\n{text}"
    return text


def _text_of(path: Path) -> str:
    try:
        return read_text(path)
    except UnicodeDecodeError as error:
        raise ArmFileError(path, None, "", "UTF-8 text", f"an invalid byte at {error.start}", "save it as UTF-8") from None
    except OSError as error:
        got = f"an error: {error.strerror or type(error).__name__}"
        supplied = f"supplied arms: {', '.join(arm_names())}"
        raise ArmFileError(path, None, "", "a readable file", got, supplied) from None


def syntax_error(error: tomllib.TOMLDecodeError, text: str, path: Path) -> ArmFileError:
    """What is wrong with a text that is no TOML, by its line."""
    message = str(error)
    position = _POSITION_IN_MESSAGE.search(message)
    line = int(position[1]) if position and position[1] else text.count("\n") + 1
    is_xml = text.lstrip().startswith("<")
    hint = "`armwright new --from-urdf` makes an arm.toml of a URDF, --from-mjcf of an MJCF" if is_xml else ""
    got = "XML" if is_xml else f"an error: {_POSITION_IN_MESSAGE.sub('', message)}"
    return ArmFileError(path, line, "", "valid TOML", got, hint)


def _spelled(path: KeyPath) -> str:
    """`("link", 2, "d_m")` -> `d_m of [[link]] 3`: tables are counted from 1, as joints are."""
    if len(path) > 2 and isinstance(path[0], str) and isinstance(path[1], int) and isinstance(path[2], str):
        return f"{_dotted(path[2:])} of [[{path[0]}]] {path[1] + 1}"
    if len(path) == 2 and isinstance(path[1], int):
        return f"{path[0]} {path[1] + 1}"
    return _dotted(path)


def _dotted(path: KeyPath) -> str:
    text = ""
    for part in path:
        text += f"[{part + 1}]" if isinstance(part, int) else f".{part}"
    return text.removeprefix(".")


def _one_line(text: str) -> str:
    return re.sub(r"[\x00-\x1f\x7f]", " ", text)


def _table_of(thing: object) -> dict[str, Any]:
    """Return a dataclass as a TOML table, without keys that have their default value."""
    table: dict[str, Any] = {}
    for key, field in keys_of(type(thing)).items():
        value = getattr(thing, field.name)
        default = field.default
        if field.default_factory is not dataclasses.MISSING:
            default = field.default_factory()
        if value is None or value == default:
            continue
        if isinstance(value, float) and not math.isfinite(value):
            raise ArmError(f"arm cannot be saved: {key}: expected a finite number, got {show(value)}")
        table[key] = _plain(value)
    return table


def _plain(value: object) -> Any:
    if dataclasses.is_dataclass(value):
        return _table_of(value)
    if isinstance(value, tuple):
        return [_plain(item) for item in value]
    if isinstance(value, Mapping):
        return {key: _plain(item) for key, item in value.items()}
    return value
