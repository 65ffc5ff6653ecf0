"""Smart servos by their data sheets: what `servo = "..."` of a [[drive]] or [gripper] stands for.

A key that stands in the file beside it counts instead: a servo that was measured, or one on another supply.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Final

from control.model.board_kinds import KINDS
from control.model.reader import Rejected, show

RPM: Final = 2.0 * math.pi / 60.0
KG_CM: Final = 0.0980665  # N m
HORN_TEETH: Final = 25  # of an STS3215
DRIVE_KEYS: Final = (
    "gear_ratio",
    "encoder_counts_per_rev",
    "torque_constant_Nm_A",
    "resistance_ohm",
    "supply_V",
    "current_limit_A",
)
GRIPPER_KEYS: Final = ("encoder_counts_per_rev", "torque_constant_Nm_A", "resistance_ohm", "supply_V")


@dataclass(frozen=True, slots=True)
class ServoType:
    """A servo at its output, whose gear is inside: stalled and without load, at its nominal supply; a speed of 0 is not known."""

    kind: str
    supply_V: float
    stall_Nm: float
    stall_A: float
    free_rad_s: float
    horn_teeth: int = 0  # places in which the horn fits its shaft, where it can be put on wrongly

    @property
    def torque_constant_Nm_A(self) -> float:
        """At the output, less what its gear loses when stalled."""
        return self.stall_Nm / self.stall_A

    @property
    def resistance_ohm(self) -> float:
        """Of the winding: a stalled motor has no other voltage."""
        return self.supply_V / self.stall_A

    def values(self, servos: int = 1) -> dict[str, float | int]:
        """What it gives a drive that so many of them turn together: one motor of their summed current."""
        return {
            "gear_ratio": 1.0,
            "encoder_counts_per_rev": KINDS[self.kind].counts_per_turn,
            "torque_constant_Nm_A": self.torque_constant_Nm_A,
            "resistance_ohm": self.resistance_ohm / servos,
            "supply_V": self.supply_V,
            "current_limit_A": self.stall_A * servos,
        }


SERVOS: Final[Mapping[str, ServoType]] = MappingProxyType(
    {
        # ROBOTIS e-Manual: stall torque and current, speed without load, at the recommended voltage
        "XL330-M288": ServoType("dynamixel", 5.0, 0.52, 1.47, 103.0 * RPM),
        "XL430-W250": ServoType("dynamixel", 12.0, 1.5, 1.4, 61.0 * RPM),
        "XM430-W350": ServoType("dynamixel", 12.0, 4.1, 2.3, 46.0 * RPM),
        "XM540-W270": ServoType("dynamixel", 12.0, 10.6, 4.4, 30.0 * RPM),
        # Feetech's data sheet of the ST-3215-C018, gear 1:345: 30 kg cm, 2.7 A, 0.222 s for 60 deg
        "STS3215-12V": ServoType("feetech", 12.0, 30.0 * KG_CM, 2.7, 45.0 * RPM, HORN_TEETH),
        # C001, the same gear: 19.5 kg cm by those who sell it. The current is reckoned: a motor of the same size loses as much
        # heat for the square of its torque, however it is wound
        "STS3215-7.4V": ServoType("feetech", 7.4, 19.5 * KG_CM, 12.0 * 2.7 / 7.4 * (19.5 / 30.0) ** 2, 0.0, HORN_TEETH),
    }
)


def with_servo_values(document: dict[str, Any]) -> dict[str, Any]:
    """A parsed arm.toml with what its servos' data sheets say where it says nothing. Rejected: no such servo."""

    def filled(table: Any, path: tuple[str | int, ...], keys: tuple[str, ...]) -> Any:
        return _sheet(table, path, keys) | table if _names_servo(table) else table

    return _each(document, filled)


def without_servo_values(document: dict[str, Any]) -> dict[str, Any]:
    """The opposite, for a file that is written: what the data sheet says is left out."""

    def emptied(table: Any, path: tuple[str | int, ...], keys: tuple[str, ...]) -> Any:
        said = _sheet(table, path, keys) if _names_servo(table) else {}
        return {key: value for key, value in table.items() if said.get(key) != value}

    return _each(document, emptied)


def _each(document: dict[str, Any], changed: Callable[[Any, tuple[str | int, ...], tuple[str, ...]], Any]) -> dict[str, Any]:
    """The document with what may name a servo changed; what is no table is left to the reader to refuse."""
    others = dict(document)
    if isinstance(drives := document.get("drive"), list):
        others["drive"] = [changed(drive, ("drive", i), DRIVE_KEYS) for i, drive in enumerate(drives)]
    if "gripper" in document:
        others["gripper"] = changed(document["gripper"], ("gripper",), GRIPPER_KEYS)
    return others


def _names_servo(table: Any) -> bool:
    return isinstance(table, dict) and table.get("servo", "") != ""


def _sheet(table: dict[str, Any], path: tuple[str | int, ...], keys: tuple[str, ...]) -> dict[str, float | int]:
    named, servos = table["servo"], table.get("servos", 1)
    if not isinstance(named, str) or named not in SERVOS:
        raise Rejected((*path, "servo"), " or ".join(f'"{name}"' for name in SERVOS), show(named))
    values = SERVOS[named].values(servos if type(servos) is int and servos > 0 else 1)
    return {key: values[key] for key in keys}
