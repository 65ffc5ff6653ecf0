"""Each name of a time series over its own variable: what the data show of it, its law, and how the part departs from it."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from calib.arrays import Array
from calib.gap.drawn_law import DrawnLaw
from calib.gap.finding import EffectName
from calib.gap.series.look import Look, left
from calib.gap.series.scene import Beside
from calib.gap.series.term import SeriesTerm
from control.model.effects import COUPLED, COUPLED_TO

UNITS = {"current_A": ("mA", 1e3), "voltage_as_A": ("mA", 1e3), "tip_m": ("mm", 1e3)}
OVER_SPEED = ("coulomb_friction", "viscous_friction", "stribeck_friction", "asymmetric_friction")
OVER_ANGLE = ("encoder_scale", "encoder_eccentricity")
OVER_CURRENT = ("torque_constant", "command_delay", "supply_sag")
ROWS_LEAST = 60


def drawn_laws(look: Look, names: Collection[EffectName]) -> tuple[DrawnLaw, ...]:
    """Of the names, each in the channel where it does most."""
    size, _ = look.evidence.estimate(look.best.members, look.best.kappa)
    rest, found, first = left(look, look.numbers), {}, 0
    for number in look.numbers:
        one = look.linear.terms[number]
        own = size[first : first + one.count]
        first += one.count
        if isinstance(one.key, EffectName) and one.key in names and one.response:
            drawn = _drawn(look, one, one.key, own, rest)
            if drawn is not None:
                found[one.key] = drawn
    return tuple(found[name] for name in names if name in found)


def _drawn(look: Look, one: SeriesTerm, name: EffectName, size: Array, rest: Array) -> DrawnLaw | None:
    laws = size * (np.arange(one.count) < one.laws)
    scene = look.around.scene
    done = {k: columns @ laws for k, columns in one.response.items() if len(columns) >= ROWS_LEAST}
    if not done:
        return None
    k = max(done, key=lambda k: float(np.sum(done[k] ** 2)))
    cell, whole = scene.cells[k], one.response[k] @ size
    unit, factor = UNITS[cell.channel]
    scale = factor * cell.floor
    at, label = _variable(look, one, name, cell.joint, scene.beside[k])
    return DrawnLaw(name, label, unit, at, scale * (whole + rest[cell.rows]), scale * done[k], scale * whole)


def _variable(look: Look, one: SeriesTerm, name: EffectName, j: int, at: Beside) -> tuple[Array, str]:
    """The law's own variable at the rows of a cell, and its label; j: the cell's joint (0-based), -1 for the tip."""
    joint = (COUPLED if name.effect == "belt_coupling" else name.joint) or max(j, 0) + 1
    own = min(joint, at.q.shape[1]) - 1
    if name.effect == "cogging":
        turn = one.variant * look.around.scene.rows.physics.gear_ratios[own] * at.q[:, own]
        return np.degrees(turn % (2.0 * np.pi)), f"{one.variant:g} times the motor's angle [deg]"
    if name.effect in OVER_SPEED:
        return at.speed[:, own], f"speed of joint {own + 1} [rad/s]"
    if name.effect in OVER_ANGLE:
        return np.degrees(at.q[:, own]), f"q{own + 1} [deg]"
    if name.effect == "belt_coupling":
        return np.degrees(at.q[:, COUPLED_TO - 1]), f"q{COUPLED_TO} [deg]"
    if name.effect in OVER_CURRENT:
        return at.current_A[:, own], f"current of joint {own + 1} [A]"
    if name.effect == "thermal_drift":
        return at.t_s, "time in the run [s]"
    return at.load_Nm[:, own], f"transmitted torque of joint {own + 1} [N m]"
