"""A tip path relative to the tip of another arm that moves meanwhile: one time for both, so that neither leads.

    p(t) = R' (P(t) + o(t) - b),  0 <= t <= T

P: the other tip, o: the offset along the axes of the cell, R and b: this arm's base in the cell. P moves as planned, and o takes
as long; the whole is slowed until every limit of this arm is kept, too. The loop follows cubics through p and its speed every
STEP_S, which are 1e-6 m off at most where the other's jerk steps.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from control.errors import ArmError
from control.kinematics.kinematics import ForwardKinematics
from control.model.cell import Cell
from control.motion.pace import Stretched
from control.motion.plan import PlannedPath, plan_in_time
from control.motion.setpoint import Motion, Vector
from control.motion.spline import CartesianSpline, hermite, timed
from control.motion.waypoints import Waypoints

STEP_S = 0.01
KNOTS_MOST = 1500  # a request stays below the server's longest line


@dataclass(frozen=True, slots=True)
class Beside:
    """The path of the arm, how many times longer it takes than the other's motion alone, and which limit of this arm says so.

    `limit`: "" if none does. `offsets`: over the path's time, along the axes of the cell.
    """

    path: PlannedPath
    slower: float
    limit: str
    offsets: CartesianSpline


def plan_beside(
    cell: Cell, name: str, other: str, motion: Motion, offsets: Waypoints, q_near_rad: Sequence[float]
) -> Beside:
    """Plan arm `name` along `offsets` from the tip of arm `other`, which runs `motion` from rest to rest.

    Both are where they should be to each other if they begin together and the runtime stretches the other's motion to this one's
    time (move_together). ArmError if the path cannot be run.
    """
    if offsets.orientations is not None:
        raise ArmError("offsets from another tip: expected way-points without orientation (qw,qx,qy,qz)")
    if motion.duration_s <= 0.0:
        raise ArmError(
            f"arm {other!r} does not move: offsets from a tip at rest are run with `armwright run --relative-to {other}`"
        )
    way = _way(offsets, motion.duration_s)
    duration_s = way.duration_s
    times_s = _times(way)
    spline = _sum(cell, name, other, Stretched(motion, duration_s), way, times_s)
    places = [_place(offsets, way, time_s) for time_s in times_s]
    path, rest, limit = plan_in_time(cell.placed(name).arm, spline, places, q_near_rad)
    return Beside(path, path.duration_s / motion.duration_s, limit, way.stretched(rest))


def _way(offsets: Waypoints, least_s: float) -> CartesianSpline:
    """Through the offsets, in their own time but not less than `least_s`; a single one is kept."""
    if len(offsets.points) == 1:
        return CartesianSpline((0.0, least_s), [[c for x in offsets.points[0] for c in (x, 0.0, 0.0, 0.0)]])
    way = timed(offsets.points, offsets.speeds_m_s).spline()
    return way.stretched(max(least_s / way.duration_s, 1.0))


def _times(way: CartesianSpline) -> list[float]:
    """Even times, and those of the offsets' own knots, where their acceleration steps."""
    count = min(KNOTS_MOST, max(2, round(way.duration_s / STEP_S)))
    even, own = np.linspace(0.0, way.duration_s, count + 1), np.array(way.times_s[1:-1])
    is_far = np.abs(even[:, None] - own[None, :]).min(axis=1, initial=np.inf) > 0.1 * STEP_S
    is_far[[0, -1]] = True
    return [float(time_s) for time_s in np.sort(np.concatenate((even[is_far], own)))]


def _sum(
    cell: Cell, name: str, other: str, motion: Motion, way: CartesianSpline, times_s: Sequence[float]
) -> CartesianSpline:
    """The tip in this arm's base frame: cubics through place and speed at each time."""
    own, beside = cell.placed(name), cell.placed(other)
    jacobian_at = ForwardKinematics(beside.arm).tip_jacobian
    turn = np.array(own.rotation).T
    across = turn @ np.array(beside.rotation)
    points: list[Vector] = []
    speeds: list[Vector] = []
    for time_s in times_s:
        state = motion.at(time_s)
        tip, rows = jacobian_at(*state.q_rad)
        offset, speed, _ = way.at(time_s)
        points += cell.beside_tip(name, other, tip, [offset])
        x, y, z = (across @ np.array(rows) @ state.speed_rad_s + turn @ speed).tolist()
        speeds.append((x, y, z))
    return hermite(points, speeds, np.diff(times_s).tolist())


def _place(offsets: Waypoints, way: CartesianSpline, time_s: float) -> str:
    """A time on the path, by the way-point before it."""
    number = int(np.searchsorted(way.times_s, time_s + 1e-9))
    return f"{time_s:.2f} s after the start, at offset {offsets.name(max(number, 1))}"
