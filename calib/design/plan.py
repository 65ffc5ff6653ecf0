"""What is asked of a plan, and what it is."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from calib.design.candidates import View
from calib.design.information import Uncertainty
from calib.points.points import Points

USUAL_COUNT = 12


@dataclass(frozen=True, slots=True)
class Request:
    """What is wanted: `count` poses, `free_count` of them free poses (None: as the criterion chooses).

    setups: those to plan in (None: the table's own); only: nothing but free poses, or nothing but the table's; noise_m:
    standard deviation of a coordinate of the tip (None: the camera's); view: the box that the camera sees (None: all).
    """

    count: int = USUAL_COUNT
    free_count: int | None = None
    setups: tuple[str, ...] | None = None
    only: Literal["free", "table"] | None = None
    criterion: str = "D"
    noise_m: float | None = None
    view: View | None = None


@dataclass(frozen=True, slots=True)
class PlannedPose:
    """One pose of the plan: q_rad is where the nominal arm would have its joints; `visit` from 1.

    gain: by how much it raises log det when taken after those before it in the plan; `after`: what is known then.
    """

    setup: str
    point: str
    repeat: int
    q_rad: tuple[float, ...]
    visit: int
    gain: float
    after: Uncertainty


@dataclass(frozen=True, slots=True)
class Alternative:
    """What the best `count` poses of one kind alone would bring, or all: cavities of one setup, or free poses."""

    setup: str
    count: int
    gain: float
    after: Uncertainty


@dataclass(frozen=True, slots=True)
class Plan:
    """What to take next. `poses` in the order of their worth, `points` in that of the visit."""

    criterion: str
    noise_m: float
    poses: tuple[PlannedPose, ...]
    points: Points
    before: Uncertainty
    alternatives: tuple[Alternative, ...]
    candidates: Mapping[str, int]
    combinations_count: int
    is_tied: bool
    blocked: tuple[tuple[str, str], ...]

    @property
    def after(self) -> Uncertainty:
        """What is known with the whole plan."""
        return self.poses[-1].after
