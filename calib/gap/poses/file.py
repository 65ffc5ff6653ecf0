"""The arm.toml that poses lead to: identified as `calibrate` does it, with all that is named, and what it leaves, read back.

Nothing else is reported as the gap that is left: what is not in the file (blocks, departures from laws, how friction is shared
between the two sides of a gear) explains nothing to whoever starts the arm with it.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calib.arm_problem.assembly import BASE, Choice, problem_of
from calib.arm_problem.joint_effects import DRIFT, LAWS, effect_key, made_effects, node_values, resting_points, spline_columns
from calib.arrays import Mask
from calib.calibration import CalibrationPlan, calibrated_arm, identified
from calib.gap.effects.catalogue import RECORDS
from calib.gap.effects.links import FRAME
from calib.gap.finding import EffectName, Parameters, effect_of, with_totals
from calib.gap.poses.linear import Fit
from calib.gap.posterior.decide import Estimated, sureness_of_file
from calib.gap.posterior.term import parameters_of
from calib.identify.identification import Identification
from calib.identify.objective import LeastSquares
from calib.points.points import Points
from calib.settling import Settling
from control.model.arm import Arm, Effect
from control.model.description import arm_text, parse_arm
from control.model.effects import linear_values
from control.model.maps import CorrectionMap, LARGEST_rad, Over

PLACED_m = 1e-8  # of all tips together: a step by which frames, tool and boards have their places
NODES = 33  # of a map that stands for a law: its ends, which are level, cost a line next to nothing
SMOOTH = 1e-3  # of a map's bend beside what a pose says: it only settles nodes without a pose


@dataclass(frozen=True, slots=True)
class File:
    """An arm as its file says it, what `calibrate` says of its parameters, the names' standard deviations by linear unknown, and
    the file's own fit to all poses. `unshared`: the file without the maps of what sets share, where it has any.
    """

    arm: Arm
    identification: Identification
    sd: Mapping[str, float]
    fit: Fit
    unshared: File | None = None

    @classmethod
    def of(
        cls,
        arm: Arm,
        points: Points,
        rows: Mask,
        named: Mapping[EffectName, Parameters],
        beside: Mapping[EffectName, Parameters],
        firmer: Collection[EffectName] = (),
        is_last: bool = True,
    ) -> File:
        """`arm` with what is named in place of its own, all identified at the poses of a mask (m,).

        `named`: first estimates, which stay where poses do not show the effect (loads), and where other recordings know it better
        (`firmer`); without parameters it is taken out.
        `beside`: what acts, but has no name, as one of an ambiguous set: it is identified with the names, which else took its
        part. The members of a set agree about the correction where poses were recorded, else the poses told them apart: for that
        range it stands in the file, as a map; what no map can do stays out. Then, with all that kept, the rest of the arm
        follows. What the arm has by its tolerances, such as the play of its gears, is identified as `calibrate` does it.
        Stages on the way to the last file are fitted from one start, as they are only drawn.
        """
        gone = {(name.effect, name.joint) for name, parameters in named.items() if not parameters}
        kept = tuple(effect for effect in arm.effects if (effect.effect, effect.joint) not in gone)
        bare = dataclasses.replace(arm, effects=kept, maps=())
        freed = (BASE,) if EffectName(FRAME) in {**named, **beside} else ()
        by_tolerances = [EffectName(*effect_key(text, bare)) for text in made_effects(bare)]

        def identify(begun: Arm, init: Mapping[EffectName, Parameters], is_free: bool) -> tuple[Identification, Arm]:
            sought = [
                name for name in init if is_free and (init[name] or name in beside) and name.effect in LAWS and name not in firmer
            ]
            # what poses do not determine stays as the given arm has it, as `calibrate` leaves it
            stated = [name for name in init if init[name] and (name not in sought or name.effect == DRIFT)]
            begun = with_totals(begun, [effect_of(name, init[name]) for name in stated])
            sought += [name for name in by_tolerances if is_free and name not in {*sought, *stated, *firmer}]
            keys = [name.effect if name.joint is None else f"{name.effect}:{name.joint}" for name in sought]
            choice = Choice(effects=tuple(keys), freed=freed).for_points(begun, points)
            plan = CalibrationPlan(choice) if is_last else CalibrationPlan(choice, LeastSquares(), starts_count=1)
            _, fit = identified(begun, points, plan, rows)
            return fit, calibrated_arm(begun, fit, points)

        acting = {name: parameters for name, parameters in {**named, **beside}.items() if name.effect != FRAME}
        fit, made = identify(bare, acting, True)
        sd = {estimate.parameter.name: estimate.sd for estimate in fit.estimates}

        def file(fit: Identification, made: Arm, unshared: File | None = None) -> File:
            read = parse_arm(arm_text(made), Path(f"{arm.name}.toml"))
            return cls(dataclasses.replace(read, path=arm.path), fit, sd, placed(read, points, rows), unshared)

        if not beside:
            return file(fit, made)
        values = [effect for effect in made.effects if EffectName(effect.effect, effect.joint) in {*named, *by_tolerances}]
        without = file(*identify(with_totals(bare, values), {}, False))
        maps = _shared(made, beside, points, rows)
        if not maps:
            return without
        rest = tuple(effect for effect in bare.effects if (effect.effect, effect.joint) not in maps)
        shared = dataclasses.replace(bare, effects=rest, maps=tuple(maps.values()))
        others = tuple(e for e in made.effects if e.effect == FRAME or EffectName(e.effect, e.joint) not in beside)
        # what was identified beside the laws fits maps that do the same; begun anew, beside maps, it may end elsewhere
        as_laws = file(fit, dataclasses.replace(made, effects=others, maps=shared.maps), without)
        anew = file(*identify(with_totals(shared, values), {}, False), without)
        return min(as_laws, anew, key=lambda candidate: candidate.fit.residuals().sizes(rows)["tip_m"])

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
        of_fit: Parameters = {}
        if terms := self._terms(name):
            values = np.array(linear_values(name.effect, effect.parameters))
            of_fit = parameters_of(name.effect)(values, np.diag([self.sd[term] ** 2 for term in terms]))
        parameters = {}
        for key, value in effect.parameters.items():
            before, sd = first.get(key, (value, math.nan))
            apart = value - before if key != "phase_rad" else math.remainder(value - before, 2.0 * math.pi)
            parameters[key] = (value, math.hypot(float(np.fmax(sd, of_fit.get(key, (0.0, math.nan))[1])), apart))
        return parameters

    def sureness(self, name: EffectName, first: Estimated) -> float:
        """How sure the file is of an effect, over how sure it has to be: below 1, it may be none.

        In the unknowns that the effect is linear in: a gear without softness has no stiffness of nought. What is not identified
        stays at its first estimate.
        """
        value, terms = np.array(linear_values(name.effect, _of(self.arm, name).parameters)), self._terms(name)
        if len(value) != len(first.value) or not terms:
            return math.inf
        larger = np.maximum(np.array([self.sd[term] for term in terms]) / first.sd, 1.0)
        return sureness_of_file(value, first.value, first.covariance * np.outer(larger, larger))

    def _terms(self, name: EffectName) -> list[str]:
        """Names of an effect's linear unknowns, if these were identified."""
        terms = [one.name(name.joint) for one in LAWS.get(name.effect, ()) if not one.is_side]
        return terms if all(term in self.sd for term in terms) else []

    def between_flanks(self, points: Points) -> dict[int, Mask]:
        """Of each loose joint the poses (m,) of which nothing tells the flank: whoever reads the file takes its play's middle."""
        at = resting_points(self.arm, points)
        loose = [one.joint for one in self.arm.effects if one.effect == "backlash" and one.joint]
        return {joint: at.flank(joint) == 0.0 for joint in loose}


def _shared(
    arm: Arm, beside: Mapping[EffectName, Parameters], points: Points, rows: Mask
) -> dict[tuple[str, int | None], CorrectionMap]:
    """What effects of an arm do to their joints' angles at poses of a mask (m,), as maps, at most one a joint and variable."""
    maps: dict[tuple[str, int | None], CorrectionMap] = {}
    at = resting_points(arm, points)
    for effect in arm.effects:
        name = EffectName(effect.effect, effect.joint)
        over = follows(name)
        if name not in beside or over is None or effect.joint is None:
            continue
        x = (at.q_rad(effect.joint) if over == "angle_rad" else at.gravity_Nm(effect.joint))[rows]
        laws = [law.slope(at, effect.joint)[rows] for law in LAWS[effect.effect] if not law.is_side]
        added = linear_values(effect.effect, effect.parameters) @ np.array(laws)
        lower, upper = float(x.min()), float(x.max())
        taken = {(other.joint, other.over) for other in maps.values()}
        if lower < upper and (effect.joint, over) not in taken and np.abs(added).max() < LARGEST_rad:
            columns = spline_columns(NODES, lower, upper, False, x).toarray()
            bends = SMOOTH * np.diff(np.eye(NODES), 2, axis=0)
            whole = np.vstack((columns, bends)), np.concatenate((added, np.zeros(len(bends))))
            values = tuple(node_values(np.linalg.lstsq(*whole)[0], False).tolist())
            maps[effect.effect, effect.joint] = CorrectionMap(effect.joint, "angle_rad", over, values, lower, upper)
    return maps


def follows(name: EffectName) -> Over | None:
    """The variable of a map that can do what an effect does: its joint's angle or load; None for a play, time, a beam."""
    variables: dict[str, Over] = {"q{j}": "angle_rad", "load": "load_Nm"}
    return variables.get(RECORDS[name.effect].traits.blocks) if name.effect in LAWS else None


def _of(arm: Arm, name: EffectName) -> Effect:
    return next(one for one in arm.effects if (one.effect, one.joint) == (name.effect, name.joint))


def placed(arm: Arm, points: Points, rows: Mask) -> Fit:
    """An arm as it is; what no file says (frames, tool, boards, target) is placed by the poses of a mask (m,)."""
    problem = problem_of(arm, points, Choice().for_points(arm, points))
    x, settling = np.zeros(len(problem.parameters)), Settling()
    free = [k for k, parameter in enumerate(problem.parameters) if not parameter.has_bound]
    while free and settling.goes_on:
        residual, slope = problem.residuals_and_jacobian(x)
        wanted = slope[rows][:, :, free].reshape(-1, len(free))
        step = np.linalg.lstsq(wanted, -residual[rows].ravel(), rcond=1e-9)[0]
        x[free] += step if settling.takes(np.linalg.norm(wanted @ step), PLACED_m) else 0.0
    return Fit.nominal(problem, x)
