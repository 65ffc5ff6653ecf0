"""Draws arms as they are made: every tolerance is a factor, drawn on its own or exact."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np

from calib.arm_problem.arm_model import ArmModel
from calib.arm_problem.link_bending import beams
from calib.arrays import Array
from calib.tolerances.file import JointTolerances, Spread, Tolerances, spreads
from calib.tolerances.terms import Kind, MadePoses, Term
from calib.trust.prediction import encoder_steps_rad
from control.model.arm import Arm

STEPS: Final = "encoder steps"
# Key of tolerances.toml, term, whether the term is its inverse; and the effect of arm.toml that is the same, with its parameter.
LAWS: Final[tuple[tuple[str, Kind, bool, str, str], ...]] = (
    ("encoder_scale", "scale", False, "encoder_scale", "scale"),
    ("backlash_rad", "play", False, "backlash", "width_rad"),
    ("stiffness_Nm_rad", "compliance", True, "joint_compliance", "stiffness_Nm_rad"),
    ("EI_Nm2", "bending", True, "link_flexure", "EI_Nm2"),
)
GEOMETRY: Final = ("d_m", "theta_rad", "L_m", "alpha_rad")
TOOL: Final = ("x_m", "y_m", "z_m")


@dataclass(frozen=True, slots=True)
class Factor:
    """One tolerance of one part, and the places in z that it sets: two, sine and cosine, for an eccentricity.

    is_deviation: added to what arm.toml says; else it is the part's value itself.
    """

    name: str
    spread: Spread
    places: tuple[int, ...]
    is_deviation: bool = False
    is_inverse: bool = False


class MadeArms:
    """The arms that a design and its tolerances allow, as vectors z of terms (`calib.tolerances.terms`)."""

    def __init__(self, arm: Arm, tolerances: Tolerances) -> None:
        """Links that are too short to bend have no bending."""
        self.arm = arm
        self._first = 4 * len(arm.links) + 3
        self._places: dict[Term, int] = {}
        self.factors = (*self._link_factors(tolerances), *self._joint_factors(tolerances))
        self.file_z = self._of_file()

    @property
    def terms(self) -> tuple[Term, ...]:
        """Beyond geometry and tool, in the order of z."""
        return tuple(self._places)

    @property
    def correctable(self) -> list[int]:
        """Places in z that a gap correction can hold: not waves that are no eccentricity of the joint."""
        return [place for term, place in self._places.items() if term.waves == 1.0]

    def drawn(self, rng: np.random.Generator, count: int, exact: str = "") -> Array:
        """Arms (count, k); the factor named `exact` is as arm.toml says. The others are the same whatever is exact."""
        z = np.tile(self.file_z, (count, 1))
        z[:, [place for one in self.factors if not one.is_deviation for place in one.places]] = 0.0
        for one in self.factors:
            values = self._values(one, rng, count)
            if one.name == exact:
                values = np.zeros_like(values) if one.is_deviation else self.file_z[list(one.places)]
            z[:, list(one.places)] += values
        return z

    def scatter_rad(self, rng: np.random.Generator, poses: MadePoses, z: Array, exact: str = "") -> Array:
        """What joints (n, arms, m) are off by in one visit: gears loose in their play, encoder steps."""
        shape = (self.arm.joint_count, len(z), len(poses.at))
        turned = poses.loose_rad(z, rng.uniform(-1.0, 1.0, shape))
        steps = rng.uniform(-0.5, 0.5, shape) * encoder_steps_rad(self.arm)[:, None, None]
        return turned if exact == STEPS else turned + steps

    def _values(self, one: Factor, rng: np.random.Generator, count: int) -> Array:
        """What it adds to its places, (count, places)."""
        values = one.spread.draw(rng, count)
        if len(one.places) == 1:
            return (1.0 / values if one.is_inverse else values)[:, None]
        phase = rng.uniform(0.0, 2.0 * math.pi, count)
        return np.column_stack((values * np.cos(phase), values * np.sin(phase)))

    def _place(self, term: Term) -> int:
        return self._places.setdefault(term, self._first + len(self._places))

    def _link_factors(self, tolerances: Tolerances) -> Iterator[Factor]:
        bend = beams(self.arm)
        for number, table in enumerate(tolerances.links, 1):
            for key, spread in spreads(table):
                if key in GEOMETRY:
                    place = 4 * (number - 1) + GEOMETRY.index(key)
                    yield Factor(f"link {number}: {_words(key)}", spread, (place,), is_deviation=True)
                elif number in bend:
                    places = (self._place(Term("bending", number)),)
                    yield Factor(f"link {number}: bending", spread, places, is_inverse=True)
        for key, spread in spreads(tolerances.tool):
            place = self._first - 3 + TOOL.index(key)
            yield Factor(f"tool: {_words(key)}", spread, (place,), is_deviation=True)

    def _joint_factors(self, tolerances: Tolerances) -> Iterator[Factor]:
        thetas = ArmModel(self.arm).theta_places
        laws = {key: (kind, is_inverse) for key, kind, is_inverse, *_ in LAWS}
        for number, table in enumerate(tolerances.joints, 1):
            for key, spread in spreads(table):
                name = f"joint {number}: {_words(key)}"
                if key == "encoder_zero_rad":
                    yield Factor(name, spread, (thetas[number - 1],), is_deviation=True)
                elif key in laws:
                    kind, is_inverse = laws[key]
                    yield Factor(name, spread, (self._place(Term(kind, number)),), is_inverse=is_inverse)
                else:
                    yield Factor(name, spread, self._wave(number, _waves(key, table)))

    def _wave(self, number: int, waves: float) -> tuple[int, ...]:
        kinds: tuple[Kind, ...] = ("sine", "cosine")
        return tuple(self._place(Term(kind, number, waves)) for kind in kinds)

    def _of_file(self) -> Array:
        """Z of arm.toml: no deviation, and its effects where a tolerance says how the part is made."""
        z = np.zeros(self._first + len(self._places))
        for effect in self.arm.effects:
            number, values = effect.joint or 0, effect.parameters
            for _, kind, is_inverse, name, parameter in LAWS:
                place = self._places.get(Term(kind, number))
                if effect.effect == name and place is not None:
                    z[place] = 1.0 / values[parameter] if is_inverse else values[parameter]
            sine, cosine = (self._places.get(Term(kind, number)) for kind in ("sine", "cosine"))
            if effect.effect == "encoder_eccentricity" and sine is not None and cosine is not None:
                z[sine] = values["amplitude_rad"] * math.cos(values["phase_rad"])
                z[cosine] = values["amplitude_rad"] * math.sin(values["phase_rad"])
        return z


def _waves(key: str, table: JointTolerances) -> float:
    return table.gear_waves_per_turn if key == "gear_eccentricity_rad" else 1.0


def _words(key: str) -> str:
    """encoder_zero_rad: encoder zero."""
    quantity, _, unit = key.rpartition("_")
    return (quantity if unit in ("m", "rad", "Nm2") else key).removesuffix("_Nm").replace("_", " ")
