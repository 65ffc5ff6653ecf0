"""How exactly the parts of an arm are made, known before anything is measured: [tolerances] of arm.toml, and tolerances.toml.

`calibrate`, `gap` and all that identify an arm weigh what they measure against it; `trust --design` draws arms by it.
"""

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated, Any, Final, TypeVar

from control.model.drive import NonNegative, Positive

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

Table = TypeVar("Table", bound="LinkTolerances | JointTolerances")


@dataclass(frozen=True, slots=True)
class Spread:
    """A distribution: anywhere within +- `within` of `mean`; normal with `sd` about `mean`; or anywhere in `from` .. `to`."""

    within: NonNegative | None = None
    sd: NonNegative | None = None
    mean: float = 0.0
    lowest: float | None = field(default=None, metadata={"key": "from"})
    highest: float | None = field(default=None, metadata={"key": "to"})

    @property
    def least(self) -> float:
        """The smallest value that it gives."""
        if self.lowest is not None:
            return self.lowest
        return self.mean - (self.within if self.within is not None else math.inf if self.sd else 0.0)

    @property
    def centre(self) -> float:
        """The mean of its values."""
        return 0.5 * (self.lowest + self.highest) if self.lowest is not None and self.highest is not None else self.mean

    @property
    def sd_about(self) -> float:
        """The standard deviation of its values about their mean."""
        if self.sd is not None:
            return self.sd
        half = 0.5 * (self.highest - self.lowest) if self.lowest is not None and self.highest is not None else self.within or 0.0
        return half / math.sqrt(3.0)

    def draw(self, rng: "np.random.Generator", count: int) -> "NDArray[np.float64]":
        """Values (count,)."""
        if self.sd is not None:
            return self.mean + self.sd * rng.standard_normal(count)
        if self.lowest is not None and self.highest is not None:
            return rng.uniform(self.lowest, self.highest, count)
        return self.mean + (self.within or 0.0) * rng.uniform(-1.0, 1.0, count)


@dataclass(frozen=True, slots=True)
class LinkTolerances:
    """Of a link, such as `[tolerances.every_link]` or `[tolerances.link.2]`. Each is `{ within }`, `{ sd }` or `{ from, to }`."""

    d_m: Annotated[Spread | None, "deviation from what the file says"] = None
    theta_rad: Annotated[Spread | None, "the same; a joint's zero is beside it"] = None
    L_m: Annotated[Spread | None, "the same"] = None
    alpha_rad: Annotated[Spread | None, "the same"] = None
    EI_Nm2: Annotated[Spread | None, "bending stiffness of a link of 50 mm or more; above 0"] = None


@dataclass(frozen=True, slots=True)
class JointTolerances:
    """Of what is between a joint's motor, its encoder and its link, such as `[tolerances.joint.3]`."""

    encoder_zero_rad: Annotated[Spread | None, "deviation of the joint's zero"] = None
    encoder_scale: Annotated[Spread | None, "the joint turns (1 + scale) times the encoder's reading"] = None
    encoder_eccentricity_rad: Annotated[Spread | None, "amplitude, not below 0; its phase is anywhere"] = None
    gear_eccentricity_rad: Annotated[Spread | None, "the same of the gear"] = None
    gear_waves_per_turn: Annotated[Positive | None, "of the gear's eccentricity, per turn of the joint", "1"] = None
    backlash_rad: Annotated[Spread | None, "total play, not below 0"] = None
    stiffness_Nm_rad: Annotated[Spread | None, "of gear, shaft or belt; above 0"] = None


@dataclass(frozen=True, slots=True)
class ToolTolerances:
    """Deviations of the tip in the last frame."""

    x_m: Annotated[Spread | None, "of the tip along x"] = None
    y_m: Annotated[Spread | None, "of the tip along y"] = None
    z_m: Annotated[Spread | None, "of the tip along z"] = None


@dataclass(frozen=True, slots=True)
class Tolerances:
    """How exactly the parts are made, as distributions."""

    every_link: Annotated[LinkTolerances, ""] = LinkTolerances()
    every_joint: Annotated[JointTolerances, ""] = JointTolerances()
    link: Annotated[Mapping[str, LinkTolerances], "by number: single keys of `every_link` for a link"] = field(
        default_factory=dict
    )
    joint: Annotated[Mapping[str, JointTolerances], "by number: single keys of `every_joint` for a joint"] = field(
        default_factory=dict
    )
    tool: Annotated[ToolTolerances, ""] = ToolTolerances()

    def of_link(self, number: int) -> LinkTolerances:
        """What every link has, and what the table of this one (1-based) says instead."""
        return _overridden(self.every_link, self.link.get(str(number)))

    def of_joint(self, number: int) -> JointTolerances:
        """What every joint has, and what the table of this one (1-based) says instead."""
        return _overridden(self.every_joint, self.joint.get(str(number)))


Row = tuple[float, float, float, float]


@dataclass(frozen=True, slots=True)
class ArmTolerances(Tolerances):
    """How exactly the parts are made, known before any measurement (docs/tolerances.md)."""

    about: Annotated[
        tuple[Row, ...],
        "d_m, theta_rad, L_m, alpha_rad of each link as it was to be made: `calibrate` writes it",
        "as in this file",
    ] = ()

    def with_rows(self, row: int, added: Sequence[Row], turned_rad: float) -> "ArmTolerances":
        """For an arm with more rows from place `row` (0-based) on, whose next row is turned by `turned_rad` about z."""
        about = self.about
        if about:
            d_m, theta_rad, length_m, alpha_rad = about[row]
            about = (*about[:row], *added, (d_m, theta_rad + turned_rad, length_m, alpha_rad), *about[row + 1 :])
        link = {str(int(name) + (len(added) if int(name) > row else 0)): table for name, table in self.link.items()}
        return dataclasses.replace(self, about=about, link=link)


AnyTable = LinkTolerances | JointTolerances | ToolTolerances


def _overridden(every: Table, special: Table | None) -> Table:
    if special is None:
        return every
    said = {key: value for key, value in spreads_and_more(special).items() if value is not None}
    return dataclasses.replace(every, **said)


def spreads_and_more(table: AnyTable) -> dict[str, Any]:
    """The values of a table, by key."""
    return {each.name: getattr(table, each.name) for each in dataclasses.fields(table)}


def spreads(table: AnyTable) -> list[tuple[str, Spread]]:
    """The distributions of a table, by key."""
    return [(key, value) for key, value in spreads_and_more(table).items() if isinstance(value, Spread)]


TOLERANCE_OF: Final = {"encoder_scale": "encoder_scale", "backlash": "backlash_rad"}
"""Effects whose parameter is what a joint's tolerance says."""
NOT_NEGATIVE: Final = ("encoder_eccentricity_rad", "gear_eccentricity_rad", "backlash_rad")
POSITIVE: Final = ("stiffness_Nm_rad", "EI_Nm2")
RANGE: Final = "such as { from = ..., to = ... }"
Fault = Callable[[tuple[str | int, ...], str, str], Exception]


def check_tolerances(made: Tolerances, links: int, joints: int, fault: Fault) -> None:
    """Raise `fault(path inside the table, expected, got)` for tolerances that no part can have."""
    for kind, tables, count in (("link", made.link, links), ("joint", made.joint, joints)):
        for name in tables:
            if name not in map(str, range(1, count + 1)):
                raise fault((kind, name), f"a number from 1 to {count}: the arm has {count} {kind}s", name)
    named: list[tuple[tuple[str, ...], AnyTable]] = [(("every_link",), made.every_link), (("every_joint",), made.every_joint)]
    named += [(("link", name), table) for name, table in made.link.items()]
    named += [(("joint", name), table) for name, table in made.joint.items()]
    for path, table in (*named, (("tool",), made.tool)):
        for key, spread in spreads(table):
            _check_spread(spread, (*path, key), fault)


def _check_spread(spread: Spread, path: tuple[str, ...], fault: Fault) -> None:
    has_range = spread.lowest is not None or spread.highest is not None
    if (spread.within is not None) + (spread.sd is not None) + has_range != 1:
        raise fault(path, "one of { within }, { sd } or { from, to }, such as { within = 2e-4 }", "none or several of them")
    if has_range:
        if spread.lowest is None or spread.highest is None or spread.mean != 0.0:
            raise fault(path, "{ from, to }, both and without mean", "another table")
        if spread.lowest > spread.highest:
            raise fault(path, "from <= to", f"{spread.lowest:g} and {spread.highest:g}")
    reaches = "a normal distribution, which has no end" if spread.sd else f"one that reaches down to {spread.least:g}"
    if path[-1] in NOT_NEGATIVE and spread.least < 0.0:
        raise fault(path, f"no value below 0, {RANGE}", reaches)
    if path[-1] in POSITIVE and spread.least <= 0.0:
        raise fault(path, f"values above 0, {RANGE}", reaches)
