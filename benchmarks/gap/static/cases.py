"""Static recordings in which an effect is hidden, made without control's kinematics or dynamics: three arms, many designs."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from functools import cache

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.calibration.chains import REFERENCE, TILTS, ChainModel, angles_for, board_points, deviations
from benchmarks.gap.static import physics
from benchmarks.gap.static.physics import Hidden, Poses, Rig, bent, camera_m, frames_of, gravity_torques, known_wrong, shifted_m
from calib.arrays import Array
from calib.points.points import Points, make_points
from control.model.arm import Arm, Camera, Drive, Link
from control.model.description import load_arm

PARAMETER = {  # of the hidden value
    "backlash": "width_rad",
    "joint_compliance": "stiffness_Nm_rad",
    "encoder_scale": "scale",
    "encoder_eccentricity": "amplitude_rad",
    "belt_coupling": "ratio",
    "thermal_drift": "final_rad",
    "link_flexure": "EI_Nm2",
    "base_frame": "x_m",
    "payload": "mass_kg",
    "torque_constant": "scale",
    "link_inertia": "mass_kg",
}
ARM = load_arm("right")
NOISE_m, NOISE_A = 0.00014, 0.02
FRICTION_Nm = np.array([0.9, 0.8, 1.0])  # in the gear, on the motor's side for the most part
LINK_SHARE = 0.3
SEEDS_rad = np.array([0.0, -1.0, 0.0])
PI = np.pi
Row = tuple[str, str, int, np.ndarray, np.ndarray, float]  # setup, point, repeat, angles, approach, payload
DESIGNS = {"full": (True, 25, 1), "thin": (True, 25, 4), "level": (False, 0, 1)}
__all__ = ["ARM", "DESIGNS", "FRICTION_Nm", "NOISE_m", "Design", "Hidden", "case", "designed", "gravity_Nm"]


@dataclass(frozen=True)
class Design:
    """What was recorded: `free` poses and every `step`-th cavity of `tilts`, in `visits` ((approach, payload) each)."""

    rig: str = "reference"
    tilts: tuple[str, ...] = ("normal", "roll", "pitch")
    step: int = 4
    free: int = 25
    visits: int = 7
    noise_m: float = NOISE_m
    has_currents: bool = True
    has_directions: bool = True
    has_payload: bool = True
    has_time: bool = True
    is_noise_told: bool = True
    turn_noise_rad: float = 0.0  # of measured orientations; 0: there are none


def _six() -> Arm:
    """Six joints in modified DH, about the size of a Panda, with masses and drives."""
    rows = [
        (0.333, 0.0, 0.0, 0.0),
        (0.0, 0.0, 0.0, -PI / 2),
        (0.316, 0.0, 0.0, PI / 2),
        (0.0, 0.0, 0.0825, PI / 2),
        (0.384, 0.0, -0.0825, -PI / 2),
        (0.1, 0.0, 0.088, PI / 2),
    ]
    masses = (4.0, 3.0, 2.5, 2.0, 1.2, 0.6)
    centres = (
        (0.0, 0.02, -0.05),
        (0.0, -0.05, 0.02),
        (0.03, 0.02, -0.06),
        (-0.04, 0.06, 0.02),
        (0.0, 0.03, -0.1),
        (0.02, 0.0, -0.02),
    )
    links = tuple(
        Link("revolute", *row, mass_kg=m, com_m=c, inertia_kg_m2=(0.01, 0.01, 0.01))
        for row, m, c in zip(rows, masses, centres, strict=True)
    )
    drives = tuple(Drive(j, 100.0, 4096, 0.06, 0.3, 48.0, current_limit_A=20.0) for j in range(1, 7))
    return Arm("six", links, dh_convention="modified", drives=drives, camera=Camera(NOISE_m))


def _planar() -> Arm:
    """Two joints in a vertical plane: both axes along z, gravity along -y."""
    links = (
        Link("revolute", 0.0, 0.0, 0.35, 0.0, 1.5, (-0.17, 0.0, 0.0), (0.01, 0.01, 0.01)),
        Link("revolute", 0.02, 0.0, 0.3, 0.0, 0.8, (-0.15, 0.0, 0.0), (0.01, 0.01, 0.01)),
    )
    drives = tuple(Drive(j, 80.0, 4096, 0.05, 0.3, 24.0, current_limit_A=12.0) for j in (1, 2))
    return Arm("planar", links, (0.0, -9.81, 0.0), drives=drives, camera=Camera(NOISE_m))


RIGS = {
    "reference": Rig(ARM, REFERENCE, np.array([-1.0, -1.6, -1.0]), np.array([1.0, 0.6, 1.2]), FRICTION_Nm),
    "six": Rig(
        _six(),
        ChainModel((True,) * 6, modified=True),
        np.array([-1.5, -1.2, -1.2, -2.4, -1.5, 0.3]),
        np.array([1.5, 1.2, 1.2, -0.4, 1.5, 2.6]),
        np.array([1.5, 1.5, 1.0, 1.0, 0.5, 0.4]),
    ),
    "planar": Rig(_planar(), ChainModel((True, True)), np.array([-1.5, -2.0]), np.array([1.5, 2.0]), np.array([0.6, 0.4])),
}


@cache
def case(seed: int, hidden: tuple[Hidden, ...] = (), design: str = "thin") -> Points:
    """Three tilts from four approaches, with and without 0.5 kg, and free poses; `thin` visits every fourth cavity."""
    has_tilts, free, step = DESIGNS[design]
    tilts = tuple(TILTS) if has_tilts else ("normal",)
    return designed(seed, hidden, Design(tilts=tilts, step=step, free=free, visits=7 if has_tilts else 1))[1]


def designed(seed: int, hidden: tuple[Hidden, ...], design: Design) -> tuple[Arm, Points]:
    """The known arm, and the recording of the real one."""
    rng, rig = np.random.default_rng(seed), RIGS[design.rig]
    true_dh = rig.arm.dh + deviations(rng, len(rig.arm.links))
    rows: list[Row] = []
    for setup in design.tilts if rig.arm is ARM else ():
        q = angles_for(REFERENCE, true_dh, board_points(*TILTS[setup])[:: design.step], SEEDS_rad)
        rows += visited(rig, setup, q, design)
    for part in range(1 if rig.arm is ARM else len(design.tilts)):
        count = design.free if rig.arm is ARM else design.free // len(design.tilts)
        free = rng.uniform(rig.lower, rig.upper, (count, len(rig.lower)))
        rows += visited(rig, "free" if rig.arm is ARM else f"view{part + 1}", free, design)
    arm = rig.arm
    if not design.is_noise_told:
        arm = dataclasses.replace(arm, camera=None)
    elif design.noise_m != NOISE_m:
        arm = dataclasses.replace(arm, camera=Camera(design.noise_m))
    return arm, _measured(rng, rig, true_dh, rows, hidden, design)


def visited(rig: Rig, setup: str, q: np.ndarray, design: Design) -> list[Row]:
    """Rows of one setup: visit after visit, all poses each."""
    up, n = np.ones(len(rig.lower)), len(rig.lower)
    mixed = np.array([1.0 if j % 2 == 0 else -1.0 for j in range(n)])
    loaded = [(up, 0.5), (-up, 0.5)] if design.has_payload and setup != "pitch" else []
    visits = [(up, 0.0), (-up, 0.0), (mixed, 0.0), (-mixed, 0.0), (up, 0.0), *loaded]
    if setup == "pitch" and design.visits >= 7:
        visits = visits[:4]
    return [
        (setup, f"{setup[0]}{k + 1}", repeat, angles, approach, payload)
        for repeat, (approach, payload) in enumerate(visits[: design.visits], start=1)
        for k, angles in enumerate(q)
    ]


def _measured(
    rng: np.random.Generator, rig: Rig, true_dh: np.ndarray, rows: list[Row], hidden: tuple[Hidden, ...], design: Design
) -> Points:
    m, n = len(rows), len(rig.lower)
    joint_rad = np.array([row[3] for row in rows]) + rng.normal(0.0, 1e-3, (m, n))
    last, stated = np.array([row[4] for row in rows]), np.array([row[5] for row in rows])
    t_s: Array = np.arange(0.0, 8.0 * m, 8.0)
    loads, masses, constants = known_wrong(rig, hidden)
    gravity = gravity_torques(rig, true_dh, joint_rad, stated + loads, masses)
    held = gravity + rig.friction_Nm * last * rng.uniform(0.7, 1.0, (m, n))
    transmitted = gravity + LINK_SHARE * (held - gravity)
    poses = Poses(joint_rad, last, stated + loads, t_s, gravity, transmitted, tuple(row[0] for row in rows), rng)
    encoder = joint_rad - sum(physics.ahead_rad(one, poses, rig) for one in hidden)
    tip = rig.chain.tips(true_dh, joint_rad)
    tip = tip + sum(shifted_m(one, poses, rig, true_dh, tip) for one in hidden)
    tip = tip + rng.normal(0.0, design.noise_m, tip.shape)
    for one in hidden:
        tip = camera_m(one, poses, tip)
    per_A = np.array([d.gear_ratio * d.torque_constant_Nm_A for d in rig.arm.drives]) * constants
    seen = None
    if design.turn_noise_rad > 0.0:
        (own,) = rng.spawn(1)  # a stream of its own: the rest of a case is the same without orientations
        seen = orientations(own, rig, true_dh, poses, hidden, design.turn_noise_rad)
    current = held / per_A + rng.normal(0.0, NOISE_A, held.shape)
    return make_points(
        poses.setup,
        [row[1] for row in rows],
        [row[2] for row in rows],
        encoder,
        tip,
        last if design.has_directions else None,
        current if design.has_currents else None,
        t_s if design.has_time else None,
        stated if design.has_payload else None,
        orientation=seen,
    )


def gravity_Nm(q: np.ndarray, payload_kg: float) -> np.ndarray:
    """Holding torques (3,) of one pose of the reference arm."""
    rig = RIGS["reference"]
    return np.asarray(gravity_torques(rig, ARM.dh, q[None], np.array([payload_kg]), {})[0])


# Measured orientations of the static cases: a target that sits on the last link in a way that nobody told.


def orientations(
    rng: np.random.Generator, rig: Rig, dh: np.ndarray, at: Poses, hidden: tuple[Hidden, ...], noise_rad: float
) -> np.ndarray:
    """Quaternions w, x, y, z of the target, (m, 4), in the frame of the camera."""
    frames = frames_of(rig, dh, at.q)
    turned = sum((_turned_rad(one, at, rig, frames) for one in hidden), np.zeros((len(at.q), 3)))
    noise = Rotation.from_rotvec(rng.normal(0.0, noise_rad, (len(at.q), 3)))
    target = Rotation.from_rotvec(rng.normal(0.0, 0.5, 3))
    measured = noise * Rotation.from_rotvec(turned) * Rotation.from_matrix(frames[-1][:, :3, :3]) * target
    for one in hidden:
        if one.effect == "base_frame":  # the camera sees everything turned the other way
            measured = Rotation.from_rotvec([-one.more, 0.0, 0.0]) * measured
    return np.roll(measured.as_quat(), 1, axis=1)


def _turned_rad(one: Hidden, at: Poses, rig: Rig, frames: list[np.ndarray]) -> np.ndarray:
    """Turns of the last link, (m, 3), besides joint angles; a loose tool slides and does not turn."""
    if one.effect == "link_flexure":
        tip = (frames[-1] @ np.array([*rig.chain.tool_m, 1.0]))[:, :3]
        return bent(one, at, rig, frames, tip, np.asarray(rig.arm.gravity_m_s2))[1]
    if one.effect == "wobble":
        k = one.joint or 1
        tilt = one.value * np.cos(2.0 * at.q[:, k - 1] + one.more)
        return np.asarray(tilt[:, None] * frames[k - 1][:, :3, 0])
    return np.zeros((len(at.q), 3))


# Random hidden effects and random designs, for the score and the tests.

SIZES = {  # smallest and largest, drawn evenly in the logarithm
    "backlash": (0.002, 0.015),
    "joint_compliance": (300.0, 1500.0),
    "encoder_scale": (0.002, 0.015),
    "encoder_eccentricity": (0.002, 0.010),
    "belt_coupling": (0.004, 0.02),
    "thermal_drift": (0.002, 0.008),
    "link_flexure": (60.0, 600.0),
    "base_frame": (0.002, 0.006),
    "payload": (0.1, 0.5),
    "torque_constant": (0.08, 0.25),
    "link_inertia": (0.15, 0.6),
}
JOINTS: dict[str, tuple[int | None, ...]] = {
    "joint_compliance": (2, 3),
    "belt_coupling": (None,),
    "link_flexure": (2, 3),
    "base_frame": (None,),
    "payload": (None,),
    "torque_constant": (2, 3),
    "link_inertia": (2, 3),
}
ON_TIP = tuple(SIZES)[:8]
FOREIGN: dict[str, tuple[tuple[int | None, ...], float, float, float, float]] = {  # joints, sizes, more
    "slip": ((1, 2, 3), 0.002, 0.01, 0.3, 0.7),
    "bent rail": ((1, 2, 3), 0.002, 0.01, 0.0, 1.0),
    "hysteresis": ((2, 3), 0.001, 0.005, 0.0, 1.0),
    "ripple": ((1, 2, 3), 0.002, 0.006, 4.0, 9.0),
    "motor ripple": ((1, 2, 3), 0.001, 0.004, 0.0, 3.0),
    "slipping zero": ((1, 2, 3), 0.002, 0.008, 0.0, 1.0),
    "linear drift": ((1, 2, 3), 0.002, 0.008, 0.0, 1.0),
    "periodic drift": ((1, 2, 3), 0.001, 0.005, 1.0, 6.0),
    "stiffening": ((2, 3), 0.001, 0.004, 0.0, 1.0),
    "softening": ((2, 3), 0.0006, 0.003, 0.0, 1.0),
    "asymmetric compliance": ((2, 3), 0.0007, 0.003, 0.0, 1.0),
    "lost counts": ((1, 2, 3), 0.0001, 0.0005, 0.0, 1.0),
    "wobble": ((1, 2, 3), 0.001, 0.006, -3.0, 3.0),
    "loose tool": ((None,), 0.0004, 0.002, 0.6, 2.4),  # across the forearm it is equivalent to backlash of joint 3
    "camera scale": ((None,), 0.001, 0.01, 0.0, 1.0),
    "camera lens": ((None,), 0.001, 0.01, 0.0, 1.0),
    "camera skew": ((None,), 0.002, 0.01, 0.0, 1.0),
    "registration": ((None,), 0.0005, 0.003, 0.0, 3.0),
    "tilted table": ((None,), 0.003, 0.02, 0.0, 2.0),
    "late camera": ((None,), 0.002, 0.01, 0.0, 1.0),
}


def _log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def drawn(rng: np.random.Generator, among: tuple[str, ...] = tuple(SIZES)) -> Hidden:
    """A random effect of the list, with random size and joint."""
    effect = str(rng.choice(list(among)))
    joints = JOINTS.get(effect, (1, 2, 3))
    size = _log_uniform(rng, *SIZES[effect])
    if effect == "torque_constant":
        size = 1.0 + size * (1 if rng.uniform() < 0.5 else -1)
    more = {"encoder_eccentricity": rng.uniform(-3.1, 3.1), "base_frame": rng.uniform(-0.02, 0.02)}.get(
        effect, rng.uniform(400.0, 2400.0)
    )
    return Hidden(effect, joints[int(rng.integers(len(joints)))], size, float(more))


def drawn_foreign(rng: np.random.Generator) -> Hidden:
    """A random unlisted effect."""
    effect = str(rng.choice(list(FOREIGN)))
    joints, low, high, first, last = FOREIGN[effect]
    more = float(rng.uniform(first, last))
    return Hidden(effect, joints[int(rng.integers(len(joints)))], _log_uniform(rng, low, high), more)


def drawn_pair(rng: np.random.Generator, count: int = 2) -> tuple[Hidden, ...]:
    """Different effects, or the same on different joints."""
    found: dict[tuple[str, int | None], Hidden] = {}
    while len(found) < count:
        one = drawn(rng)
        found[(one.effect, one.joint)] = one
    return tuple(found.values())


def drawn_design(rng: np.random.Generator) -> Design:
    """A random design of 33 to 700 poses, with known or unknown noise."""
    rig = str(rng.choice(["reference", "reference", "six", "planar"]))
    tilts = ("normal", "roll", "pitch")[: int(rng.integers(1, 4))]
    visits = int(rng.choice([1, 2, 4, 5, 7]))
    has_repeats = visits >= 5
    return Design(
        rig=rig,
        tilts=tilts,
        step=int(rng.choice([1, 2, 4])),
        free=int(rng.choice([12, 25, 40])) if rig == "reference" else int(rng.integers(35, 100)),
        visits=visits,
        noise_m=float(np.exp(rng.uniform(np.log(5e-5), np.log(5e-4)))),
        has_currents=bool(rng.uniform() < 0.6),
        has_directions=bool(rng.uniform() < 0.8),
        has_payload=bool(rng.uniform() < 0.7),
        has_time=bool(rng.uniform() < 0.8),
        is_noise_told=bool(rng.uniform() < 0.7) or not has_repeats,
    )
