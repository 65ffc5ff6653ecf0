"""Digital outputs under control, and the levels of all named pins.

An output is set by a request and stays. When the arm goes to FAULT or its drives go off, each goes to its safe level, and stays
there until it is set anew: nothing comes on again by itself. The boards do the same without the host.
"""

import math
from collections.abc import Sequence

from control.errors import ArmError
from control.hardware.interface import NamedPins
from control.model.can_bus import PIN_PERIOD_s
from control.model.end_effector import Digital


class Outputs:
    """The pins of one arm. `cycle` is called in each control cycle."""

    def __init__(self, described: Sequence[Digital], pins: NamedPins) -> None:
        self.described = tuple(described)
        self.levels: dict[str, bool | None] = {pin.name: None for pin in described}
        self._by_name = {pin.name: pin for pin in described}
        self._pins = pins
        self._wanted: dict[str, bool] = {}
        self._next_s = -math.inf
        self._was_safe = True

    def set(self, name: str, level: bool) -> None:
        """Set an output. ArmError if there is none of this name, or while outputs have their safe levels."""
        pin = self._by_name.get(name)
        outputs = ", ".join(p.name for p in self.described if p.direction == "output") or "none"
        if pin is None:
            raise ArmError(f"digital: no pin {name!r}: expected one of the outputs {outputs}")
        if pin.direction != "output":
            raise ArmError(f"digital: {name} is an input: expected one of the outputs {outputs}")
        if self._was_safe:
            raise ArmError(
                f"digital: {name} has its safe level ({pin.safe}) while the drives are off or the arm is in FAULT: enable first"
            )
        self._wanted[name] = level
        self._next_s = -math.inf

    def cycle(self, now_s: float, is_safe: bool) -> None:
        """One control cycle; `is_safe`: the arm is in FAULT, or its drives are not enabled."""
        if is_safe and not self._was_safe:
            self._wanted = {
                name: level if self._by_name[name].safe == "keep" else self._by_name[name].safe == "high"
                for name, level in self._wanted.items()
            }
            self._next_s = -math.inf
        self._was_safe = is_safe
        self.levels = self._pins.levels(now_s)
        if now_s >= self._next_s:
            self._next_s = now_s + PIN_PERIOD_s - 1e-6
            self._pins.command(self._wanted)
