"""A request for a plan, and the plan."""

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
    """A request: `count` poses, `free_count` of them free poses (None: the criterion decides).

    setups: those to plan in (None: the table's own); only: only free poses, or only cavities; noise_m:
    standard deviation of a tip coordinate (None: the camera's); turn_noise_rad: of orientations measured beside tips (None: of
    points taken, if they have some); view: the camera's field of view (None: all).
    """

    count: int = USUAL_COUNT
    free_count: int | None = None
    setups: tuple[str, ...] | None = None
    only: Literal["free", "table"] | None = None
    criterion: str = "D"
    noise_m: float | None = None
    turn_noise_rad: float | None = None
    view: View | None = None


@dataclass(frozen=True, slots=True)
class PlannedPose:
    """One pose of the plan: q_rad by the nominal arm; `visit` from 1.

    gain: increase of log det when added to the previous ones of the plan; `after`: the uncertainty then.
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
    """The result of the best `count` poses, or all, of one kind alone: cavities of one setup, or free poses."""

    setup: str
    count: int
    gain: float
    after: Uncertainty


@dataclass(frozen=True, slots=True)
class Plan:
    """What to record next. `poses` in order of value, `points` in visiting order."""

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
        """Uncertainty after the whole plan."""
        return self.poses[-1].after
