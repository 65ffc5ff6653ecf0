"""The arm.toml that poses lead to: identified as `calibrate` does it, with all that is named, and what it leaves, read back.

Nothing else is reported as the gap that is left: what is not in the file (blocks, departures from laws, how friction is shared
between the two sides of a gear) explains nothing to whoever starts the arm with it.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calib.arm_problem.assembly import BASE, Choice, problem_of
from calib.arm_problem.joint_laws import LAWS, RestingPoints
from calib.arrays import Mask
from calib.calibration.calibrate import CalibrationPlan, identified
from calib.calibration.outcome import calibrated_arm
from calib.gap.effects.frame import FRAME
from calib.gap.finding import EffectName, Parameters
from calib.gap.model_update import effect_of, with_totals
from calib.gap.poses.measured import Fit
from calib.gap.posterior.coefficients import parameters_of
from calib.identify.identification import Identification
from calib.identify.objective import LeastSquares
from calib.points.points import Points
from control.model.arm import Arm, Effect
from control.model.description import arm_text, parse_arm
from control.model.effects import linear_values

STEPS = 2  # of the places of frames, tool and boards, which follow in nearly a straight line


@dataclass(frozen=True, slots=True)
class File:
    """An arm as its file says it, what `calibrate` says of its parameters, the names' standard deviations by linear unknown, and
    the file's own fit to all poses.
    """

    arm: Arm
    found: Identification
    sd: Mapping[str, float]
    fit: Fit

    @classmethod
    def of(
        cls,
        arm: Arm,
        points: Points,
        rows: Mask,
        named: Mapping[EffectName, Parameters],
        beside: Mapping[EffectName, Parameters],
        is_last: bool = True,
    ) -> File:
        """`arm` with what is named in place of its own, all identified at the poses of a mask (m,).

        `named`: first estimates, which stay where poses do not show the effect (loads); without parameters it is taken out.
        `beside`: what acts, but is in no file, as one of an ambiguous set: it is identified with the names, which else took its
        part; then, with their values kept, the rest of the arm follows the poses as far as it can without it.
        Stages on the way to the last file are fitted from one start, as they are only drawn.
        """
        gone = {(name.effect, name.joint) for name, own in named.items() if not own}
        kept = tuple(one for one in arm.effects if (one.effect, one.joint) not in gone)
        bare = dataclasses.replace(arm, effects=kept, maps=())
        freed = (BASE,) if EffectName(FRAME) in {**named, **beside} else ()

        def identify(started: Sequence[Effect], is_free: bool) -> tuple[Identification, Arm]:
            begun = with_totals(bare, started)
            keys = [
                one.effect if one.joint is None else f"{one.effect}:{one.joint}"
                for one in started
                if is_free and one.effect in LAWS
            ]
            choice = Choice(effects=tuple(keys), freed=freed).for_points(begun, points)
            plan = (
                CalibrationPlan(choice)
                if is_last
                else CalibrationPlan(choice, LeastSquares(), starts_count=1)
            )
            _, found = identified(begun, points, plan, rows)
            return found, calibrated_arm(begun, found, points)

        acting = {**named, **beside}
        found, made = identify(
            [effect_of(name, own) for name, own in acting.items() if own and name.effect != FRAME], True
        )
        sd = {one.parameter.name: one.sd for one in found.estimates}
        if beside:
            values = [
                one
                for one in made.effects
                if EffectName(one.effect, one.joint) in named and one.effect != FRAME
            ]
            found, made = identify(values, False)
        read = parse_arm(arm_text(made), Path(f"{arm.name}.toml"))
        return cls(dataclasses.replace(read, path=arm.path), found, sd, placed(read, points, rows))

    def has(self, name: EffectName) -> bool:
        """Whether the file has the effect: a width or a softness below nought is none."""
        return any((one.effect, one.joint) == (name.effect, name.joint) for one in self.arm.effects)

    def parameters(self, name: EffectName, first: Parameters) -> Parameters:
        """Values of the file with standard deviations: the larger of the identification's and the first estimate's, and how far
        these two are apart.

        The posterior's counts how real parts depart from their laws, the identification's what the poses scatter by. They come
        apart where something acts that the file does not hold, such as one of an ambiguous set.
        """
        effect = _of(self.arm, name)
        own: Parameters = {}
        terms = [one.name(name.joint) for one in LAWS.get(name.effect, ()) if not one.is_side]
        if terms and all(term in self.sd for term in terms):
            values = np.array(linear_values(name.effect, effect.parameters))
            own = parameters_of(name.effect)(values, np.diag([self.sd[term] ** 2 for term in terms]))
        found = {}
        for key, value in effect.parameters.items():
            before, sd = first.get(key, (value, math.nan))
            apart = value - before if key != "phase_rad" else math.remainder(value - before, 2.0 * math.pi)
            found[key] = (value, math.hypot(float(np.fmax(sd, own.get(key, (0.0, math.nan))[1])), apart))
        return found

    def told(self, points: Points, among: Mask) -> Mask:
        """Those poses (m,) of `among` of which the flank of its loose gears is known; all of them, where that is so of few."""
        loose = [one.joint for one in self.arm.effects if one.effect == "backlash" and one.joint is not None]
        at = RestingPoints(self.arm, points)
        told = (
            np.all([at.flank(joint) != 0.0 for joint in loose], axis=0)
            if loose
            else np.ones(len(points), dtype=bool)
        )
        return among & told if told[among].mean() > 0.5 else among


def _of(arm: Arm, name: EffectName) -> Effect:
    return next(one for one in arm.effects if (one.effect, one.joint) == (name.effect, name.joint))


def placed(arm: Arm, points: Points, rows: Mask) -> Fit:
    """An arm as it is; what no file says (frames, tool, boards, target) is placed by the poses of a mask (m,)."""
    problem = problem_of(arm, points, Choice().for_points(arm, points))
    x = np.zeros(len(problem.parameters))
    free = [k for k, parameter in enumerate(problem.parameters) if not parameter.has_bound]
    for _ in range(STEPS if free else 0):
        residual, slope = problem.residuals_and_jacobian(x)
        wanted = slope[rows][:, :, free].reshape(-1, len(free))
        x[free] += np.linalg.lstsq(wanted, -residual[rows].ravel(), rcond=1e-9)[0]
    return Fit.nominal(problem, x)
