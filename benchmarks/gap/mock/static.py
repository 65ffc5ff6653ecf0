"""Static poses from the mock arm's physics: both approaches, a payload pair, repeats, geometry off, in shuffled order."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from benchmarks.gap.mock.rig import CAMERA_NOISE_m, MockRig, Reading, eased, effects_with
from calib.arrays import Array
from calib.points.points import Points, make_points
from control.model.arm import Arm
from hil_mocks.plant.effects import EffectEntry

CURRENT_NOISE_A = 0.02
NEAR, FREE = 10, 16  # poses
PAYLOAD_kg = 0.5
GEOMETRY_m, GEOMETRY_rad = 0.003, 0.012
FRICTION_Nm = 0.035  # of the stall torque: dry friction that arm.toml does not know of
TRAVEL_rad_s, RUN_UP_rad, PAUSE_S, APPROACH_S, SETTLE_S = 2.0, 0.04, 0.25, 1.0, 0.25
STEP_S, RATE_Hz = 1e-3, 250.0  # sufficient for slow motions
MARGIN = 0.12  # of a joint's range, kept at both ends


def static_case(
    arm: Arm, hidden: Sequence[EffectEntry], seed: int, is_crooked: bool = True, has_unknown_friction: bool = True
) -> Points:
    """Some 180 poses of an arm with these effects; `is_crooked`: its geometry is off by millimetres and milliradians.

    `has_unknown_friction`: beyond that of its file.
    """
    rng = np.random.default_rng(seed)
    friction = _frictions(arm, rng) if has_unknown_friction else []
    entries = [*friction, *hidden, *([geometry_of(arm, rng)] if is_crooked else [])]
    visits = _visits(arm, rng)
    rig = MockRig(arm, effects_with(arm, entries), visits[0][2].tolist(), integral=False, step_s=STEP_S, rate_Hz=RATE_Hz)
    place, readings = visits[0][2], []
    for payload in (0.0, PAYLOAD_kg):
        rig.load(payload)
        for _, _, target, direction, load in visits:
            if load == payload:
                readings.append(_visit(rig, place, target, direction))
                place = target
    ordered = [visit for payload in (0.0, PAYLOAD_kg) for visit in visits if visit[4] == payload]
    return _points(rng, ordered, readings)


Visit = tuple[str, str, Array, Array, float]  # setup, point, angles, direction of approach, payload


def _visits(arm: Arm, rng: np.random.Generator) -> list[Visit]:
    """Every pose from four sides and a repeat, and from two sides with the payload; shuffled."""
    n = arm.joint_count
    lower, upper = np.clip(np.array(arm.limits_rad), -1.5, 1.5).T
    room = MARGIN * (upper - lower)
    middle, half = 0.5 * (lower + upper), 0.5 * (upper - lower) - room
    poses = [("near", f"n{k}", middle + 0.35 * half * rng.uniform(-1, 1, n)) for k in range(NEAR)]
    poses += [("free", f"f{k}", middle + half * rng.uniform(-1, 1, n)) for k in range(FREE)]
    sides = np.array([[1] * n, [-1] * n, [(-1) ** j for j in range(n)], [-((-1) ** j) for j in range(n)]])
    found = [(*pose, side, 0.0) for pose in poses for side in (*sides, sides[0])]
    found += [(*pose, side, PAYLOAD_kg) for pose in poses for side in sides[:2]]
    return [found[k] for k in rng.permutation(len(found))]


def _visit(rig: MockRig, place: Array, target: Array, direction: Array) -> Reading:
    """Travel to beside the target, approach it gently from there, let it settle.

    A swinging link would come to rest anywhere within its friction, or on either flank of the backlash.
    """
    beside = target - RUN_UP_rad * direction
    travel_s = max(0.2, 1.875 * float(np.abs(beside - place).max()) / TRAVEL_rad_s)
    rig.follow(eased(place, beside, travel_s, RATE_Hz))
    rig.follow(np.tile(beside, (round(PAUSE_S * RATE_Hz), 1)))
    rig.follow(eased(beside, target, APPROACH_S, RATE_Hz))
    rig.follow(np.tile(target, (round(SETTLE_S * RATE_Hz), 1)))
    return rig.reading()


def _frictions(arm: Arm, rng: np.random.Generator) -> list[EffectEntry]:
    found = []
    for j, drive in enumerate(arm.drives, start=1):
        stall = drive.gear_ratio * drive.torque_constant_Nm_A * drive.current_limit_A
        torque = FRICTION_Nm * stall * float(rng.uniform(0.7, 1.3))
        found.append(EffectEntry("coulomb_friction", j, {"torque_Nm": torque}))
        found.append(EffectEntry("viscous_friction", j, {"coefficient_Nm_s_rad": torque}))
    return found


def geometry_of(arm: Arm, rng: np.random.Generator) -> EffectEntry:
    """How an arm's links are off its file."""
    sizes = {"d_m": GEOMETRY_m, "theta_rad": GEOMETRY_rad, "L_m": GEOMETRY_m, "alpha_rad": GEOMETRY_rad}
    values = {f"link{i + 1}_{key}": float(rng.uniform(-size, size)) for i in range(len(arm.links)) for key, size in sizes.items()}
    return EffectEntry("link_geometry", 0, values)


def _points(rng: np.random.Generator, visits: Sequence[Visit], readings: Sequence[Reading]) -> Points:
    """Points with noise on tips and currents; repeats of a pose are numbered in order of recording."""
    count: dict[str, int] = {}
    repeats = []
    for _, point, *_ in visits:
        count[point] = count.get(point, 0) + 1
        repeats.append(count[point])
    tips = np.array([one.tip_m for one in readings])
    currents = np.array([one.current_A for one in readings])
    return make_points(
        [visit[0] for visit in visits],
        [visit[1] for visit in visits],
        repeats,
        np.array([one.q_rad for one in readings]),
        tips + rng.normal(0.0, CAMERA_NOISE_m, tips.shape),
        np.array([visit[3] for visit in visits], dtype=float),
        currents + rng.normal(0.0, CURRENT_NOISE_A, currents.shape),
        np.array([one.t_s for one in readings]) - readings[0].t_s,
        np.array([visit[4] for visit in visits]),
    )
