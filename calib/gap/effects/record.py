"""One record an effect: how the gap workflow looks for it, in poses and in time series, and what it can be mistaken for.

Name, acting joint or link, parameters and torque are those of its record in `control.model.effects`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Literal

from calib.arrays import Array
from calib.gap.effects.departures import Shape
from calib.gap.effects.pose_scene import PoseScene
from calib.gap.finding import EffectName, Parameters
from calib.gap.posterior.constants import USUAL
from calib.gap.posterior.term import NO_TRAITS, Term, Traits
from calib.gap.residuals.operating_point import OperatingPoint
from calib.gap.residuals.term import SeriesTerm
from calib.gap.signals.terms import Form, Law
from control.model.arm import Arm

Role = Literal["", "angle", "torque"]
Needs = Literal["motor", "angle", "tip", "electrical"]
Over = Literal["load", "speed", "angle", "current", "time", "motor"]


@dataclass(frozen=True, slots=True)
class InPoses:
    """How an effect is looked for in static poses."""

    size: float  # usual, of the law's coefficient
    terms: Callable[[EffectRecord, PoseScene], Iterator[Term]]  # on every joint or link, in every variant
    told_apart_by: str  # the recording that would settle whether it is there
    is_load: bool = False  # holding currents alone show it
    is_total: bool = True  # what the file has of it is left out of the model and looked for as a whole


@dataclass(frozen=True, slots=True)
class InSeries:
    """How an effect is looked for in time series."""

    forms: tuple[Form, ...]  # that it may have; the first is that of arm.toml
    terms: Callable[[OperatingPoint, EffectRecord, EffectName], Iterator[SeriesTerm]]  # on one joint or link
    needs: Needs  # currents or voltages; these or the tip; the tip; both currents and voltages
    usual: float = USUAL  # size, in smallest sizes worth a name
    departs: tuple[Shape, ...] = ()  # functions that a real part's law is multiplied by
    variable: str = ""  # of these, in a word
    blocks: tuple[str, ...] = ()  # of its joint, those that are functions of the law's own variables
    over: Over = "load"  # the axis of its picture
    is_common: bool = False  # every gear has it
    places: Callable[[Arm], Iterable[int | None]] = lambda arm: (None,)  # links; of joints it is all of them
    least: Callable[[Arm, Law], float] = lambda arm, law: -math.inf  # that a law's first value can be
    # the law of an `[[effect]]`, and the parameters of a law of an arm with the covariance of its values, where these are not
    # simply those of the effect's linear unknowns
    known: Callable[[InSeries, EffectName, Mapping[str, float]], Law | None] | None = None
    parameters: Callable[[Arm, Law, Array], Parameters] | None = None

    @property
    def form(self) -> Form:
        """The first of them."""
        return self.forms[0]


@dataclass(frozen=True, slots=True)
class EffectRecord:
    """All that the gap workflow knows of an effect."""

    effect: str
    poses: InPoses | None = None
    series: InSeries | None = None
    role: Role = ""  # a joint that is not where its encoder says, or that is hard to turn: mistaken for others of its role
    traits: Traits = NO_TRAITS
    needs_drives: bool = False  # no answer without the drives' electrical values
