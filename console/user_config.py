"""What a user has chosen: the default arm ($ARMWRIGHT_ARM, else `arm` in config.toml, else "right"), and the unit of angles."""

import contextlib
import os
from pathlib import Path

from control.errors import ArmError
from control.files import read_toml, write_whole

VARIABLE = "ARMWRIGHT_ARM"
BUILT_IN = "right"
DEGREES = "deg"


class ConfigError(ArmError):
    """A config.toml that cannot be used; the message names file and cause."""


def config_file() -> Path:
    """Path of the user's configuration (XDG base directory specification)."""
    return Path(os.environ.get("XDG_CONFIG_HOME") or Path.home() / ".config") / "armwright" / "config.toml"


def default_arm() -> str:
    """A path to an arm.toml or the name of a supplied arm. Raises ConfigError."""
    if named := os.environ.get(VARIABLE):
        return _existing(named, Path(), VARIABLE)
    file = config_file()
    table = read_toml(file, ConfigError, may_be_absent=True)
    if not table:
        return BUILT_IN
    unknown = set(table) - {"arm"}
    if unknown:
        raise ConfigError(f"{file}: unknown key {sorted(unknown)[0]!r}; the only key is `arm`")
    if not isinstance(table["arm"], str) or not table["arm"]:
        raise ConfigError(f"{file}: arm: expected the path of an arm.toml or the name of an arm, got {table['arm']!r}")
    return _existing(table["arm"], file.parent, f"{file}: arm")


def shows_degrees() -> bool:
    """Whether the console showed joint angles in degrees when it was told last."""
    with contextlib.suppress(OSError, UnicodeDecodeError):
        return _unit_file().read_text(encoding="utf-8").strip() == DEGREES
    return False


def remember_degrees(are_shown: bool) -> None:
    """Keep it for the next console, where there is a place for it."""
    with contextlib.suppress(OSError):
        write_whole(_unit_file(), DEGREES if are_shown else "rad")


def _unit_file() -> Path:
    return config_file().with_name("console_angles")


def _existing(text: str, folder: Path, where: str) -> str:
    """A path relative to `folder`, or a name unchanged. ConfigError if a path does not exist."""
    path = folder / Path(text).expanduser()
    if path.suffix != ".toml" and len(path.parts) <= len(folder.parts) + 1:
        return text
    if not path.is_file():
        raise ConfigError(f"{where}: no file {path}")
    return str(path)
