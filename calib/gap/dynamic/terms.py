"""What a model of the arm is made of here: terms, each an effect in one form with its values."""

from __future__ import annotations

from dataclasses import dataclass, replace

from calib.gap.finding import EffectName
from control.model.arm import Arm

# Parameters of an effect, in the order in which a term's `values` hold them; logarithms where only positive makes sense
# would bend the search, so bounds are kept by the fit instead.
PARAMETERS: dict[str, tuple[str, ...]] = {
    "coulomb_friction": ("torque_Nm",),
    "viscous_friction": ("coefficient_Nm_s_rad",),
    "stribeck_friction": ("torque_Nm", "speed_rad_s"),
    "load_friction": ("fraction",),
    "asymmetric_friction": ("torque_Nm",),
    "cogging": ("amplitude_Nm", "order", "phase_rad"),
    "torque_constant": ("scale",),
    "command_delay": ("delay_s",),
    "supply_sag": ("resistance_ohm",),
    "payload": ("mass_kg",),
    "link_inertia": ("inertia_kg_m2", "mass_kg"),
    "joint_compliance": ("stiffness_Nm_rad", "damping_Nm_s_rad"),
    "backlash": ("width_rad",),
    "encoder_eccentricity": ("amplitude_rad", "phase_rad"),
    "encoder_scale": ("scale",),
    "belt_coupling": ("ratio",),
}


@dataclass(frozen=True, slots=True)
class Term:
    """An effect, or something that is in no list, in one of the forms that it may have.

    `form` is the effect's name, or a variant of it; `values` are internal and may differ from the file's
    parameters (sine and cosine instead of amplitude and phase, compliance instead of stiffness).
    """

    name: EffectName
    form: str
    values: tuple[float, ...]
    order: float = 0.0  # of cogging, which is searched and then kept

    @property
    def index(self) -> int:
        """0-based joint or link; -1 where it has none."""
        return -1 if self.name.joint is None else self.name.joint - 1

    def at(self, values: tuple[float, ...]) -> Term:
        """The same with other values."""
        return replace(self, values=values)


def known_terms(arm: Arm) -> tuple[Term, ...]:
    """What the arm's file already has and what shows in time series."""
    from calib.gap.dynamic.forms import from_file

    terms = (from_file(EffectName(e.effect, e.joint), e.parameters) for e in arm.effects)
    return tuple(term for term in terms if term is not None)
