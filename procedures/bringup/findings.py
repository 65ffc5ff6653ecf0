"""Result of a joint's bring-up: its drive, figures, and messages for the operator."""

import math
from dataclasses import dataclass, field

from control.model.arm import Drive


@dataclass(slots=True)
class Diagnosis:
    """The diagnosis of one joint. `drive` is the draft's with the measured values; problems prevent a new arm.toml."""

    drive: Drive
    figures: dict[str, float] = field(default_factory=dict)
    changes: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)
    coulomb_Nm: float = math.nan
    viscous_Nm_s_rad: float = math.nan
