"""One effect that could explain static poses, and how its coefficients become the parameters of docs/formats.md."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from calib.arrays import Array, Mask, frozen
from calib.gap.finding import EffectName

Parameters = Mapping[str, tuple[float, float]]


@dataclass(frozen=True, slots=True)
class Candidate:
    """An effect with c coefficients: `slope_rad` (c, m, n) moves joints, `slope_m` (c, m, 3) the tip; `size` (c,) is typical.

    `slope_Nm` (c, m, n): what it adds to the torque that motors seem to hold beyond gravity. Candidates of one name are shapes
    of one effect, of which at most one applies (`shape` says which). `is_positive`: its coefficients cannot be negative, a play
    or a softness. `unsure` (m,): poses in which nobody can tell what the effect does. `known` (c,): what the arm has of it.
    """

    name: EffectName
    slope_rad: Array
    size: Array
    parameters: Callable[[Array, Array], Parameters]
    is_positive: bool = False
    shape: float = 0.0
    unsure: Mask | None = None
    slope_m: Array | None = None
    slope_Nm: Array | None = None
    known: Array | None = None

    @property
    def moves_tip(self) -> bool:
        """Whether the tip shows it."""
        return self.slope_Nm is None or bool(self.slope_rad.any())

    @property
    def is_mass(self) -> bool:
        """Whether it is a weight that only holding currents tell."""
        return self.name.effect in ("payload", "link_inertia")

    def physical(self, value: Array) -> bool:
        """Whether coefficients (c,) are those of a real thing, the known part included."""
        return not self.is_positive or bool(np.all(self.whole(value) > 0.0))

    def whole(self, value: Array) -> Array:
        """Coefficients with what the arm has already."""
        return value if self.known is None else value + self.known

    def named(self, value: Array, covariance: Array) -> Parameters:
        """The parameters of coefficients (c,) with covariance (c, c)."""
        return self.parameters(self.whole(value), covariance)

    def beside(self, known: Array) -> Candidate:
        """The same where the arm has some of it already: what is named replaces that."""
        return dataclasses.replace(self, known=frozen(known))


def plain(
    effect: str,
    joint: int | None,
    slope_rad: Array,
    size: float,
    parameter: str,
    is_positive: bool = False,
) -> Candidate:
    """An effect on joints, slope_rad (m, n), whose only parameter is its coefficient."""
    return Candidate(
        EffectName(effect, joint), frozen(slope_rad[None]), frozen([size]), only(parameter), is_positive
    )


def only(parameter: str) -> Callable[[Array, Array], Parameters]:
    """The coefficient itself."""
    return lambda value, covariance: {parameter: (float(value[0]), float(np.sqrt(covariance[0, 0])))}


def inverse(parameter: str, beyond: float = 0.0) -> Callable[[Array, Array], Parameters]:
    """1 / (coefficient + beyond): a stiffness of a softness."""

    def made(value: Array, covariance: Array) -> Parameters:
        softness, sd = float(value[0]) + beyond, float(np.sqrt(covariance[0, 0]))
        return {parameter: (1.0 / softness, sd / softness**2)}

    return made


def amplitude_and_phase(value: Array, covariance: Array) -> Parameters:
    """Of a sin q + b cos q = A sin(q + phase)."""
    a, b = float(value[0]), float(value[1])
    amplitude = max(float(np.hypot(a, b)), 1e-300)
    by_amplitude, by_phase = np.array([a, b]) / amplitude, np.array([-b, a]) / amplitude**2
    return {
        "amplitude_rad": (amplitude, float(np.sqrt(by_amplitude @ covariance @ by_amplitude))),
        "phase_rad": (float(np.arctan2(b, a)), float(np.sqrt(by_phase @ covariance @ by_phase))),
    }
