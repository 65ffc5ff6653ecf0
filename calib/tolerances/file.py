"""tolerances.toml: how exactly each part of an arm is made, as distributions. Reference: docs/formats.md.

Strict: an unknown key, a wrong type, a part that the arm does not have, or a number that is not finite is one error.
"""

from __future__ import annotations

import math
from importlib.resources import files
from pathlib import Path
from typing import Annotated, TypeVar

import msgspec
import numpy as np

from calib.arrays import Array
from calib.errors import CalibrationError
from control.files import read_text
from control.model.arm import Arm
from control.strict_toml import Fault, converted, table_as

NotNegative = Annotated[float, msgspec.Meta(ge=0.0)]
Positive = Annotated[float, msgspec.Meta(gt=0.0)]
T = TypeVar("T", bound=msgspec.Struct)


class TolerancesFileError(CalibrationError):
    """An invalid tolerances.toml; the message names file and key."""


class Spread(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A distribution: anywhere within +- `within` of `mean`; normal with `sd` about `mean`; or anywhere in `from` .. `to`."""

    within: NotNegative | None = None
    sd: NotNegative | None = None
    mean: float = 0.0
    lowest: float | None = msgspec.field(name="from", default=None)
    highest: float | None = msgspec.field(name="to", default=None)

    def __post_init__(self) -> None:
        """Exactly one kind of distribution."""
        is_range = self.lowest is not None or self.highest is not None
        if (self.within is not None) + (self.sd is not None) + is_range != 1:
            raise ValueError("expected one of { within }, { sd } or { from, to }")
        if is_range:
            if self.lowest is None or self.highest is None or self.mean != 0.0:
                raise ValueError("expected { from, to }, both and without mean")
            if self.lowest > self.highest:
                raise ValueError(f"expected from <= to, got {self.lowest:g} and {self.highest:g}")

    @property
    def least(self) -> float:
        """The smallest value that it gives."""
        if self.lowest is not None:
            return self.lowest
        return self.mean - (self.within if self.within is not None else math.inf if self.sd else 0.0)

    def draw(self, rng: np.random.Generator, count: int) -> Array:
        """Values (count,)."""
        if self.sd is not None:
            return self.mean + self.sd * rng.standard_normal(count)
        if self.lowest is not None and self.highest is not None:
            return rng.uniform(self.lowest, self.highest, count)
        return self.mean + (self.within or 0.0) * rng.uniform(-1.0, 1.0, count)


class LinkTolerances(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Deviations of a link's DH parameters from nominal, and its bending stiffness."""

    d_m: Spread | None = None
    theta_rad: Spread | None = None
    L_m: Spread | None = None
    alpha_rad: Spread | None = None
    EI_Nm2: Spread | None = None


class JointTolerances(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What is between a joint's motor, its encoder and its link."""

    encoder_zero_rad: Spread | None = None
    encoder_scale: Spread | None = None
    encoder_eccentricity_rad: Spread | None = None
    gear_eccentricity_rad: Spread | None = None
    gear_waves_per_turn: Positive = 1.0  # of the gear's eccentricity, per turn of the joint
    backlash_rad: Spread | None = None
    stiffness_Nm_rad: Spread | None = None


class ToolTolerances(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Deviations of the tip in the last frame."""

    x_m: Spread | None = None
    y_m: Spread | None = None
    z_m: Spread | None = None


class CalibrationTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How the arm will be calibrated: number of poses, and standard deviation of one axis of the measured tip."""

    poses: Annotated[int, msgspec.Meta(ge=10, le=5000)] = 60
    noise_m: NotNegative | None = None  # absent: that of arm.toml's [camera]


class _Document(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    name: str = ""
    every_link: LinkTolerances = LinkTolerances()
    every_joint: JointTolerances = JointTolerances()
    link: dict[str, dict[str, object]] = {}
    joint: dict[str, dict[str, object]] = {}
    tool: ToolTolerances = ToolTolerances()
    calibration: CalibrationTable = CalibrationTable()


class Tolerances(msgspec.Struct, frozen=True):
    """The file's content for one arm: `links` and `joints` in the arm's order, with what every one of them has."""

    name: str
    links: tuple[LinkTolerances, ...]
    joints: tuple[JointTolerances, ...]
    tool: ToolTolerances
    poses: int
    noise_m: float


NOT_NEGATIVE = ("encoder_eccentricity_rad", "gear_eccentricity_rad", "backlash_rad")
POSITIVE = ("stiffness_Nm_rad", "EI_Nm2")
RANGE = "such as { from = ..., to = ... }"


def tolerances_text(path_or_name: str) -> str:
    """The text of a file, or of a supplied one by name. TolerancesFileError names the file."""
    supplied = files("calib.tolerances") / f"{path_or_name}.toml"
    try:
        return supplied.read_text("utf-8") if supplied.is_file() else read_text(Path(path_or_name))
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "not UTF-8 text"
        raise TolerancesFileError(f"{path_or_name}: cannot be read: {reason}") from None


def parse_tolerances(text: str, where: str, arm: Arm) -> Tolerances:
    """Tolerances from TOML text; `where` names it in errors."""

    def fault(what: str) -> Exception:
        hint = ", such as { within = 2e-4 }" if "Expected a table" in what else ""
        return TolerancesFileError(f"{where}: {what}{hint}")

    document = converted(text, _Document, fault)
    links = _of_each(document.link, document.every_link, LinkTolerances, len(arm.links), "link", fault)
    joints = _of_each(document.joint, document.every_joint, JointTolerances, arm.joint_count, "joint", fault)
    named: list[tuple[str, msgspec.Struct]] = [(f"link.{k}", one) for k, one in enumerate(links, 1)]
    named += [(f"joint.{k}", one) for k, one in enumerate(joints, 1)]
    for name, table in named:
        _require_possible(table, name, fault)
    if not any(spreads(table) for _, table in (*named, ("tool", document.tool))):
        raise fault(
            "no tolerance: expected some in [every_link], [every_joint], [link.2], [joint.1] or [tool]"
        )
    noise_m = _noise_m(document.calibration, arm, fault)
    return Tolerances(document.name, links, joints, document.tool, document.calibration.poses, noise_m)


def spreads(table: msgspec.Struct) -> list[tuple[str, Spread]]:
    """The distributions of a table, by key."""
    values = ((key, getattr(table, key)) for key in table.__struct_fields__)
    return [(key, value) for key, value in values if isinstance(value, Spread)]


def _of_each(
    given: dict[str, dict[str, object]], every: T, kind: type[T], count: int, what: str, fault: Fault
) -> tuple[T, ...]:
    """The table of each link or joint: `every`, and what its own table says instead."""
    known = [str(k) for k in range(1, count + 1)]
    for name in given:
        if name not in known:
            raise fault(f"[{what}.{name}]: expected a number from 1 to {count}: the arm has {count} {what}s")
    own = [table_as(given.get(name, {}), kind, fault, f"{what}.{name}") for name in known]
    return tuple(
        msgspec.structs.replace(every, **{key: getattr(one, key) for key in given.get(name, {})})
        for name, one in zip(known, own, strict=True)
    )


def _require_possible(table: msgspec.Struct, name: str, fault: Fault) -> None:
    for key, spread in spreads(table):
        if key in NOT_NEGATIVE and spread.least < 0.0:
            raise fault(f"[{name}] {key}: {_reaches(spread)}; expected no value below 0, {RANGE}")
        if key in POSITIVE and spread.least <= 0.0:
            raise fault(f"[{name}] {key}: {_reaches(spread)}; expected values above 0, {RANGE}")


def _reaches(spread: Spread) -> str:
    return "a normal distribution has no end" if spread.sd else f"it reaches down to {spread.least:g}"


def _noise_m(given: CalibrationTable, arm: Arm, fault: Fault) -> float:
    if given.noise_m is not None:
        return given.noise_m
    if arm.camera is not None:
        return arm.camera.position_noise_m
    raise fault(
        f"[calibration] noise_m is missing, and arm {arm.name} has no [camera]: expected the standard deviation of one axis of"
        " the measured tip in m"
    )
