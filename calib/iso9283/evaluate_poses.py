"""Criteria 1, 2, 3, 6, 7 and 13 of recorded poses: AP, RP, vAP, AD, RD, drift, exchangeability, static compliance."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from calib.arrays import Array
from calib.iso9283 import pose_criteria
from calib.iso9283.pose_criteria import Compliance, Iso9283Error, static_compliance
from calib.iso9283.recorded import PoseGroup
from calib.iso9283.result import Criterion, Figure, criterion, with_headlines
from control.plain_text import first_of

SAME_POSE_m = 1e-4  # commanded positions closer than this are the same pose
OWN_SETUPS = ("from_x", "from_y", "from_z", "distance", "load", "posing")
AXES = "xyz"
NAMES_SAID = 5
Groups = Sequence[PoseGroup]
ORIENTATION = (
    "for the orientation (AP_a, AP_b, AP_c, RP_a, RP_b, RP_c) a measured orientation of the tip: points.csv with"
    " qw, qx, qy, qz, or a_rad, b_rad, c_rad and a_set_rad, b_set_rad, c_set_rad"
)


def is_pose_setup(name: str) -> bool:
    """Whether a setup has plain visits: any name that no other programme uses."""
    return name not in OWN_SETUPS and not name.startswith("drift_")


def pose_criterion(groups: Groups) -> Criterion:
    """1: AP and RP of every pose, and of the orientation if it was measured."""
    chosen = sorted((g for g in groups if is_pose_setup(g.setup)), key=lambda g: (g.setup, g.point))
    figures = [figure for group in chosen for figure in _pose_figures(group)]
    needs = _unseen(chosen)
    if not chosen:
        needs.append("repeated visits of poses (P1 to P5, thirty times each) in points.csv")
    if once := [_named(group) for group in chosen if len(group.attained_m) == 1]:
        needs.append(f"for the repeatability a second visit of {first_of(once, NAMES_SAID)}")
    if not any(group.angle_rad is not None for group in chosen):
        needs.append(ORIENTATION)
    return criterion(1, with_headlines(figures), needs)


def _pose_figures(group: PoseGroup) -> list[Figure]:
    n, where = len(group.attained_m), _named(group)
    figures = []
    if n:
        accuracy = pose_criteria.pose_accuracy(group.commanded_m, group.attained_m)
        figures.append(Figure("AP_p", accuracy.total_m, "m", where, n))
    if n >= 2:
        figures.append(Figure("RP_l", pose_criteria.pose_repeatability(group.attained_m), "m", where, n))
    if group.angle_rad is not None and group.angle_set_rad is not None:
        figures += _orientation_figures(group.angle_set_rad, group.angle_rad, where)
    return figures


def _orientation_figures(commanded_rad: Array, attained_rad: Array, where: str) -> list[Figure]:
    n, criteria = len(attained_rad), {"AP": pose_criteria.orientation_accuracy(commanded_rad, attained_rad)}
    if n >= 2:
        criteria["RP"] = pose_criteria.orientation_repeatability(attained_rad)
    return [
        Figure(f"{symbol}_{letter}", float(value), "rad", where, n)
        for symbol, values in criteria.items()
        for letter, value in zip("abc", values, strict=True)
    ]


def direction_criterion(groups: Groups) -> Criterion:
    """2: vAP of the poses that were reached from three directions."""
    by_point: dict[str, dict[str, Array]] = {}
    for group in groups:
        if group.setup.startswith("from_") and len(group.attained_m):
            by_point.setdefault(group.point, {})[group.setup] = group.attained_m
    figures, needs = [], []
    for point, directions in by_point.items():
        if len(directions) < 3:
            needs.append(f"{point} approached from three perpendicular directions; got {', '.join(directions)}")
        if len(directions) >= 2:
            value = pose_criteria.multidirectional_variation(list(directions.values()))
            count = min(len(attained) for attained in directions.values())
            figures.append(Figure("vAP_p", value, "m", point, count))
    if not by_point:
        needs.append("poses reached from three perpendicular directions: setups from_x, from_y and from_z in points.csv")
    return criterion(2, with_headlines(figures), needs)


def distance_criterion(groups: Groups) -> Criterion:
    """3: AD and RD between P2 and P4, of their own programme or else of the plain visits."""
    pairs = [
        tuple(g for p in ("P2", "P4") for g in groups if g.setup == setup and g.point == p)
        for setup in dict.fromkeys(g.setup for g in groups)
        if setup == "distance" or is_pose_setup(setup)
    ]
    whole = sorted((p for p in pairs if len(p) == 2), key=lambda p: p[0].setup != "distance")
    if not whole:
        return criterion(3, (), ("poses P2 and P4 in the same setup of points.csv, thirty times each",))
    first, second = whole[0]
    n = min(len(first.attained_m), len(second.attained_m))
    if not n:
        return criterion(3, (), _unseen((first, second)))
    needs = _unseen((first, second))
    attained = first.attained_m[:n], second.attained_m[:n]
    where = f"P2 to P4 ({first.setup})"
    accuracy = pose_criteria.distance_accuracy(first.commanded_m, second.commanded_m, *attained)
    figures = _with_axes("AD", accuracy, where, n)
    if n >= 2:
        figures += _with_axes("RD", pose_criteria.distance_repeatability(*attained), where, n)
    else:
        needs.append("for the distance repeatability a second visit of P2 and P4; there is one")
    return criterion(3, with_headlines(figures, ("AD", "RD")), needs)


def drift_criterion(groups: Groups) -> Criterion:
    """6: dAP and dRP between the first set of visits and the last."""
    sets = [g for g in groups if g.setup.startswith("drift_") and len(g.attained_m)]
    if len(sets) < 2:
        return criterion(
            6, (), ("the same pose measured again after a time (eight hours in the standard): setups drift_1, drift_2, ...",)
        )
    first, last = sets[0], sets[-1]
    change = pose_criteria.drift(first.commanded_m, first.attained_m, last.attained_m)
    lasted_s = float(last.t_s.mean() - first.t_s.mean())
    where = f"P1 after {lasted_s:.0f} s" if np.isfinite(lasted_s) else "P1 from the first set to the last"
    n = min(len(first.attained_m), len(last.attained_m))
    figures = [
        Figure("dAP_p", change.accuracy_m, "m", where, n),
        Figure("|barycentre shift|", change.barycentre_m, "m", where, n, remark="not defined in the standard"),
    ]
    if change.repeatability_m is not None:
        figures.insert(1, Figure("dRP_l", change.repeatability_m, "m", where, n))
    return criterion(6, with_headlines(figures, ("dAP_p", "dRP_l")), ())


def exchange_criterion(groups: Groups, others: Mapping[str, Groups]) -> Criterion:
    """7: E at P1, with the visits of P1 by other arms (name to groups)."""
    reference = _first(groups)
    needs = (
        []
        if len(others) >= 4
        else [f"the same programme run by four other arms of this type in the same place (--other POINTS); got {len(others)}"]
    )
    if reference is None or not others:
        return criterion(7, (), needs)
    clouds = [reference.attained_m]
    for name, visited in others.items():
        visit = _first(visited)
        if visit is None:
            raise Iso9283Error(f"{name}: no measured visits of P1 to compare with")
        away = float(np.linalg.norm(visit.commanded_m - reference.commanded_m))
        if away > SAME_POSE_m:
            raise Iso9283Error(
                f"{name}: its commanded P1 is {1e3 * away:.3f} mm from this arm's: exchangeability needs the same"
                " programme (--cube-centre and --cube-edge)"
            )
        clouds.append(visit.attained_m)
    value = pose_criteria.exchangeability(clouds)
    figure = Figure("E", value, "m", f"P1, {len(clouds)} arms", min(map(len, clouds)))
    return criterion(7, with_headlines([figure]), needs)


def load_criterion(groups: Groups) -> Criterion:
    """13: displacement per newton along each axis that was loaded."""
    loaded = [g for g in groups if g.setup == "load" and len(g.attained_m)]
    needs = "loads along {} (forces on the tip in fx_N, fy_N, fz_N of points.csv, setup load)"
    if not loaded:
        return criterion(
            13,
            (),
            ("the tip measured under known loads: weights at the tip (--rated-load-kg), or " + needs.format("x, y and z"),),
        )
    forces = np.concatenate([g.force_N for g in loaded])
    try:
        compliance = static_compliance(forces, np.concatenate([g.attained_m for g in loaded]))
    except Iso9283Error as error:
        return criterion(13, (), (str(error),))
    along = [k for k in range(3) if np.isfinite(compliance.m_N[:, k]).all()]
    figures = [figure for k in along for figure in _load_figures(compliance, k, len(forces))]
    missing = [AXES[k] for k in range(3) if k not in along]
    return criterion(13, figures, (needs.format(" and ".join(missing)),) if missing else ())


def _load_figures(compliance: Compliance, k: int, count: int) -> Iterator[Figure]:
    """The displacement by a load along axis k, and its components."""
    total, along = float(np.linalg.norm(compliance.m_N[:, k])), AXES[k]
    yield Figure(f"per N along {along}", total, "m/N", "P1", count, True)
    for i in range(3):
        sd = compliance.sd_m_N[i, k]
        remark = f"standard deviation {1e6 * sd:.3f} µm/N" if np.isfinite(sd) else ""
        symbol = f"along {AXES[i]} per N along {along}"
        yield Figure(symbol, float(compliance.m_N[i, k]), "m/N", "P1", count, remark=remark)


def clouds(groups: Groups) -> dict[str, Array]:
    """Attained minus commanded positions of the plain visits, by pose, for the picture."""
    return {_named(g): g.attained_m - g.commanded_m for g in groups if is_pose_setup(g.setup) and len(g.attained_m)}


def _first(groups: Groups) -> PoseGroup | None:
    """The plain visits of P1."""
    found = (g for g in groups if is_pose_setup(g.setup) and g.point == "P1" and len(g.attained_m))
    return next(found, None)


def _with_axes(symbol: str, value: pose_criteria.PoseAccuracy, where: str, n: int) -> list[Figure]:
    axes = [Figure(f"{symbol}_{a}", float(v), "m", where, n) for a, v in zip(AXES, value.axes_m, strict=True)]
    return [Figure(symbol, value.total_m, "m", where, n), *axes]


def _named(group: PoseGroup) -> str:
    return group.point if group.setup == "pose" else f"{group.point} ({group.setup})"


def _unseen(groups: Groups) -> list[str]:
    """One sentence about visits without a measured tip, if there are any."""
    missing = sum(group.unseen for group in groups)
    if not missing:
        return []
    visits = missing + sum(len(group.attained_m) for group in groups)
    where = first_of([_named(group) for group in groups if group.unseen], NAMES_SAID)
    return [f"a tip measured by a camera (x_m, y_m, z_m) in {missing} of {visits} visits: of {where}"]
