"""Each name of a time series over its own variable: what the data show of it, its law, and how the part departs from it."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from calib.arrays import Array
from calib.gap.drawn_law import DrawnLaw
from calib.gap.effects.catalogue import series_of
from calib.gap.finding import EffectName
from calib.gap.residuals.scene import RowConditions
from calib.gap.residuals.term import SeriesTerm
from calib.gap.series.fit import SeriesFit, left
from control.model.effects import followed_joint

UNITS = {"current_A": ("mA", 1e3), "voltage_as_A": ("mA", 1e3), "tip_m": ("mm", 1e3)}
ROWS_LEAST = 60


def drawn_laws(fit: SeriesFit, names: Collection[EffectName]) -> tuple[DrawnLaw, ...]:
    """Of the names, each in the channel where it does most."""
    size, _ = fit.evidence.estimate(fit.best.members, fit.best.kappa)
    rest, found, first = left(fit, fit.numbers), {}, 0
    for number in fit.numbers:
        one = fit.linear.terms[number]
        own = size[first : first + one.count]
        first += one.count
        if isinstance(one.key, EffectName) and one.key in names and one.response:
            drawn = _drawn(fit, one, one.key, own, rest)
            if drawn is not None:
                found[one.key] = drawn
    return tuple(found[name] for name in names if name in found)


def _drawn(fit: SeriesFit, one: SeriesTerm, name: EffectName, size: Array, rest: Array) -> DrawnLaw | None:
    laws = size * (np.arange(one.count) < one.laws)
    scene = fit.around.scene
    done = {k: columns @ laws for k, columns in one.response.items() if len(columns) >= ROWS_LEAST}
    if not done:
        return None
    k = max(done, key=lambda k: float(np.sum(done[k] ** 2)))
    cell, whole = scene.cells[k], one.response[k] @ size
    unit, factor = UNITS[cell.channel]
    scale = factor * cell.floor
    at, label = _variable(fit, one, name, cell.joint, scene.beside[k])
    return DrawnLaw(name, label, unit, at, scale * (whole + rest[cell.rows]), scale * done[k], scale * whole)


def _variable(
    fit: SeriesFit, one: SeriesTerm, name: EffectName, j: int, at: RowConditions
) -> tuple[Array, str]:
    """The law's own variable at the rows of a cell, and its label; j: the cell's joint (0-based), -1 for the tip."""
    joint = followed_joint(name.effect, name.joint) or max(j, 0) + 1
    own = min(joint, at.q.shape[1]) - 1
    series = series_of(name.effect)
    match series.over if series is not None else "load":
        case "motor":
            turn = one.variant * fit.around.scene.rows.physics.gear_ratios[own] * at.q[:, own]
            return np.degrees(turn % (2.0 * np.pi)), f"{one.variant:g} times the motor's angle [deg]"
        case "speed":
            return at.speed[:, own], f"speed of joint {own + 1} [rad/s]"
        case "angle":
            return np.degrees(at.q[:, own]), f"q{own + 1} [deg]"
        case "current":
            return at.current_A[:, own], f"current of joint {own + 1} [A]"
        case "time":
            return at.t_s, "time in the run [s]"
        case _:
            return at.load_Nm[:, own], f"transmitted torque of joint {own + 1} [N m]"
