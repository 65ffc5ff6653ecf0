"""The effects as data: one record each, with its law in every channel and the ways in which a real part departs from it."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from scipy.special import erf

from calib.arm_problem.arm_model import ArmModel
from calib.arm_problem.link_bending import beams, bending_m
from calib.arm_problem.link_frames import link_frames
from calib.arrays import Array, Mask
from calib.gap.finding import EffectName
from calib.gap.poses.candidate import Candidate, Parameters, amplitude_and_phase, inverse, only
from calib.gap.poses.frame import of_the_frame
from calib.gap.poses.loads import of_the_loads, stated_kg
from calib.gap.posterior.constants import WOUND_SHARE
from calib.gap.posterior.term import Term, like, on_joint
from calib.points.points import Points
from control.dynamics.effect_laws import backlash_rad, compliance_rad
from control.dynamics.feedforward import own_payload_kg, with_link_inertia
from control.dynamics.static_pose import CURRENT_NOISE_A, GRAVITY_ERROR, RestingPose, resting, torque_per_A
from control.errors import MissingModel
from control.model.arm import Arm

NO_TORQUE_Nm = 1e-6
TOLD = 0.5  # of the poses must have a flank that can be told: else a play fits anything
TILT_rad = (
    0.003  # how well a fitted link's direction is known: where gravity turns round, its sign is a guess
)
LEVELS = 16  # of constant friction on the link's side
LINK_SHARES = tuple(np.linspace(0.0, 1.0, 11).tolist())
TIME_CONSTANTS_s = np.geomspace(30.0, 30_000.0, 19)
DRIFT_TIMES_SPAN = 1.5  # of a session, up to which a time constant bends its course enough to be one
OTHER_TIMES = 3.0  # between the time constants of a part that warms in two stages


@dataclass(frozen=True, slots=True)
class Scene:
    """The arm at its fitted geometry and under the loads found so far, at the poses; `pose` is None without masses or drives."""

    nominal: Arm
    arm: Arm
    points: Points
    pose: RestingPose | None
    loads: tuple[Candidate, ...]

    @classmethod
    def of(cls, nominal: Arm, arm: Arm, points: Points) -> Scene:
        """With what the gears transmit, where that can be told."""
        try:
            pose = resting(arm, points.q_rad, points.direction, points.current_A, stated_kg(points))
        except MissingModel:
            pose = None
        return cls(nominal, arm, points, pose, of_the_loads(nominal, points, arm) if pose is not None else ())

    @property
    def gravity_Nm(self) -> Array | None:
        """What holds the links, (m, n); None for an arm without masses."""
        return None if self.pose is None else self.pose.gravity_Nm


@dataclass(frozen=True, slots=True)
class EffectRecord:
    """What acts (joint, link or arm), the usual size, and the terms that it makes of a scene.

    Parameters and their file form are those of formats.md; each term carries how its coefficients become them.
    """

    effect: str
    size: float
    terms: Callable[[EffectRecord, Scene], Iterator[Term]]
    parameter: str = ""

    def term(self, joint: int | None, laws: int, columns: Array, departures: int, **more: object) -> Term:
        """A term of this effect on joints: columns (c, m, n) per unit of the coefficient."""
        made = Term(
            EffectName(self.effect, joint), "", laws, departures, self.size, slope_rad=self.size * columns,
            parameters=only(self.parameter),
        )  # fmt: skip
        return dataclasses.replace(made, **more)  # type: ignore[arg-type]  # keywords of the record itself


def harmonics(angle: Array, *orders: int) -> list[Array]:
    """Sine and cosine of each order."""
    return [f(order * angle) for order in orders for f in (np.sin, np.cos)]


def _scale(record: EffectRecord, scene: Scene) -> Iterator[Term]:
    q, n = scene.points.q_rad, scene.points.joint_count
    for j in range(n):
        departs = like(q[:, j], harmonics(q[:, j], 1, 2))
        yield record.term(
            j + 1, 1, on_joint(np.array([q[:, j], *departs]), j, n), len(departs), variable=f"q{j + 1}"
        )


def _eccentricity(record: EffectRecord, scene: Scene) -> Iterator[Term]:
    q, n = scene.points.q_rad, scene.points.joint_count
    for j in range(n):
        columns = np.array(harmonics(q[:, j], 1, 2, 3))
        yield record.term(
            j + 1, 2, on_joint(columns, j, n), 4, parameters=amplitude_and_phase, variable=f"q{j + 1}"
        )  # fmt: skip


def _coupling(record: EffectRecord, scene: Scene) -> Iterator[Term]:
    q, n = scene.points.q_rad, scene.points.joint_count
    if n >= 3:
        departs = like(q[:, 1], harmonics(q[:, 1], 1, 2))
        yield record.term(None, 1, on_joint(np.array([q[:, 1], *departs]), 2, n), len(departs), variable="q2")


def _play(record: EffectRecord, scene: Scene) -> Iterator[Term]:
    """For every share of friction behind the gear that lays it on other flanks."""
    if scene.pose is None:
        return
    q, n, noise = scene.points.q_rad, scene.points.joint_count, CURRENT_NOISE_A * torque_per_A(scene.arm)
    for j in range(n):
        load = np.abs(scene.pose.gravity_Nm[:, j])
        ways = [*harmonics(q[:, j], 1, 2), *([load / load.max()] if load.max() > NO_TORQUE_Nm else [])]
        for share, flank, doubt in _flanks(scene.pose, j, noise[j]):
            law = backlash_rad(flank, 1.0)
            departs = like(law, [law * way for way in ways])
            columns = on_joint(np.array([law, *departs]), j, n)
            yield record.term(
                j + 1, 1, columns, len(departs), variant=share, is_positive=True, doubt=0.25 * doubt,
                variable=f"q{j + 1} and load",
            )  # fmt: skip


def _flanks(pose: RestingPose, j: int, noise_Nm: float) -> Iterator[tuple[float, Array, Array]]:
    """The expected flank (m,) of joint j and its variance, for every share of friction on the link's side that matters.

    Poses in which the motor holds little friction may have been led by a hand, or not: both are tried.
    """
    told: list[Array] = []
    gravity, led = pose.gravity_Nm[:, j], pose.is_led[:, j]
    turned = TILT_rad * float(np.abs(gravity).max())
    for is_led in (np.zeros_like(led), led) if led.any() else (led,):
        for share, behind, doubt in _behind_the_gear(pose, j, noise_Nm):
            torque = gravity + behind
            sd = np.maximum(0.5 * GRAVITY_ERROR * np.abs(gravity) + turned + doubt, NO_TORQUE_Nm)
            flank = np.where(np.abs(torque) > NO_TORQUE_Nm, erf(torque / (np.sqrt(2.0) * sd)), 0.0)
            flank = np.where(is_led, pose.flank[:, j], flank)
            if np.mean(flank**2) >= TOLD and not any(np.abs(flank - other).max() < 0.2 for other in told):
                told.append(flank)
                yield share, flank, 1.0 - flank**2


def _behind_the_gear(pose: RestingPose, j: int, noise_Nm: float) -> Iterator[tuple[float, Array, Array]]:
    """Friction on the link's side (m,) and its doubt (m,): a share of what the motor holds, or a constant in the last direction.

    Of constants only those differ between which poses change their flank.
    """
    gravity, held = pose.gravity_Nm[:, j], pose.held_Nm[:, j]
    for share in LINK_SHARES:
        yield share, share * held, 0.03 * np.abs(held) + share * noise_Nm
    last, most = np.sign(held), float(np.abs(held).max())
    turning = np.sort(-(gravity * last)[(gravity * last < 0.0) & (-gravity * last < most)])
    if len(turning) == 0:
        return
    levels = np.unique(np.quantile(turning, np.linspace(0.0, 1.0, LEVELS + 2)[1:-1]))
    for k, level in enumerate(levels.tolist()):
        step = 0.5 * float(np.min(np.abs(np.diff(levels)[max(0, k - 1) : k + 1]))) if len(levels) > 1 else 0.0
        yield 2.0 + level, level * last, np.full_like(held, 0.5 * step)


def _compliance(record: EffectRecord, scene: Scene) -> Iterator[Term]:
    if scene.pose is None:
        return
    for j in range(scene.points.joint_count):
        torque, held = scene.pose.gravity_Nm[:, j], scene.pose.held_Nm[:, j]
        if np.abs(torque).max() <= NO_TORQUE_Nm:
            continue
        law = compliance_rad(torque, 1.0)
        departs = like(law, [law * np.abs(torque), law * torque**2])
        wound = [compliance_rad(WOUND_SHARE * held, 1.0)] if held.any() else []
        for more in ([], wound) if wound else ([],):
            columns = on_joint(np.array([law, *departs, *more]), j, scene.points.joint_count)
            yield record.term(
                j + 1, 1, columns, len(departs), is_positive=True, parameters=inverse(record.parameter), variable="load",
                variant=float(len(more)),
            )  # fmt: skip


def _drift(record: EffectRecord, scene: Scene) -> Iterator[Term]:
    time = scene.points.t_s
    if not np.isfinite(time).all() or np.ptp(time) == 0.0:
        return
    elapsed, n = time - time.min(), scene.points.joint_count
    for j in range(n):
        for constant in TIME_CONSTANTS_s[TIME_CONSTANTS_s <= DRIFT_TIMES_SPAN * elapsed.max()].tolist():
            law = 1.0 - np.exp(-elapsed / constant)
            others = [1.0 - np.exp(-elapsed / (constant * f)) for f in (OTHER_TIMES, 1.0 / OTHER_TIMES)]
            departs = like(law, [other - law * (other @ law) / (law @ law) for other in others])
            yield record.term(
                j + 1, 1, on_joint(np.array([law, *departs]), j, n), len(departs), variant=constant,
                parameters=_final(constant), variable="time",
            )  # fmt: skip


def _final(constant_s: float) -> Callable[[Array, Array], Parameters]:
    return lambda value, covariance: {
        "final_rad": (float(value[0]), float(np.sqrt(covariance[0, 0]))),
        "time_constant_s": (constant_s, float("nan")),
    }


def _flexure(record: EffectRecord, scene: Scene) -> Iterator[Term]:
    """A cantilever; its own weight in its centre of mass, or spread along it."""
    arm = with_link_inertia(scene.arm)
    if not any(link.mass_kg for link in arm.links):
        return
    q, hung = scene.points.q_rad, stated_kg(scene.points) + own_payload_kg(arm)
    for link in beams(arm):
        bare = bending_m(arm, arm.dh, q, np.zeros(len(q)), link)
        payload = bending_m(arm, arm.dh, q, hung, link) - bare
        alone = dataclasses.replace(
            arm, links=tuple(dataclasses.replace(one, mass_kg=one.mass_kg if k == link else 0.0)
                             for k, one in enumerate(arm.links, start=1)),
        )  # fmt: skip
        own = (
            bending_m(alone, arm.dh, q, np.zeros(len(q)), link)
            if alone.links[link - 1].mass_kg
            else 0.0 * bare
        )
        for variant, weight in enumerate((own, _spread_m(arm, q, link)) if own.any() else (own,)):
            parts = [weight, bare - own, payload]
            total = np.asarray(sum(parts))
            if np.ptp(total, axis=0).max() == 0.0:
                continue
            departs = [part for part in parts if np.ptp(part, axis=0).max() > 0.0]
            yield Term(
                EffectName(record.effect, link), "", 1, len(departs), record.size,
                slope_m=record.size * np.array([total, *departs]), variant=float(variant), is_positive=True,
                parameters=inverse(record.parameter), variable="load",
            )  # fmt: skip


def _spread_m(arm: Arm, q_rad: Array, link: int) -> Array:
    """How the tip moves, (m, 3) per 1 / EI, when a link's own weight is spread evenly along it (q l^4 / 8, q l^3 / 6)."""
    frames = link_frames(ArmModel(arm), arm.dh, q_rad)
    before = 0 if arm.dh_convention == "modified" else 1
    following = next(
        (k for k, one in enumerate(arm.links, start=1) if k > link and one.joint == "revolute"), None
    )
    begin = frames.origin_m[:, link - before]
    end = frames.tip_m if following is None else frames.origin_m[:, following - before]
    length = np.linalg.norm(end - begin, axis=1, keepdims=True)
    along = (end - begin) / length
    mass = sum(
        one.mass_kg or 0.0
        for k, one in enumerate(arm.links, start=1)
        if k >= link and (following is None or k < following)
    )
    force = np.broadcast_to(mass * np.asarray(arm.gravity_m_s2), begin.shape)
    across = force - np.sum(force * along, axis=1, keepdims=True) * along
    turn = np.cross(along, across) * length**2 / 6.0
    return np.asarray(across * length**3 / 8.0 + np.cross(turn, frames.tip_m - end))


def _frame(record: EffectRecord, scene: Scene) -> Iterator[Term]:
    for one in of_the_frame(scene.nominal, scene.points):
        if one.slope_m is not None:
            yield Term(
                one.name, "", len(one.size), 0, 1.0, slope_m=one.slope_m * one.size[:, None, None],
                parameters=_sized(one.size, one.parameters),
            )  # fmt: skip


def _sized(size: Array, made: Callable[[Array, Array], Parameters]) -> Callable[[Array, Array], Parameters]:
    """Parameters of coefficients that are counted in sizes (c,)."""
    return lambda value, covariance: made(value * size, covariance * np.outer(size, size))


def _loads(record: EffectRecord, scene: Scene) -> Iterator[Term]:
    """Payload, masses and torque constants: what the holding currents tell."""
    for one in scene.loads:
        if one.name.effect == record.effect and one.slope_Nm is not None:
            size = float(one.size[0])
            torque = one.slope_Nm
            departs = np.zeros((0, *torque.shape[1:]))
            if record.effect == "torque_constant":  # a motor that saturates
                departs = np.array(like(torque[0], [torque[0] * np.abs(torque[0])]))
            moved = np.concatenate((one.slope_rad, np.zeros_like(departs)))
            yield Term(
                one.name, "", 1, len(departs), size, slope_rad=size * moved if moved.any() else None,
                slope_Nm=size * np.concatenate((torque, departs)), parameters=one.parameters, variable="load",
            )  # fmt: skip


RECORDS = (
    EffectRecord("encoder_scale", 0.005, _scale, "scale"),
    EffectRecord("encoder_eccentricity", 0.003, _eccentricity),
    EffectRecord("belt_coupling", 0.01, _coupling, "ratio"),
    EffectRecord("backlash", 0.005, _play, "width_rad"),
    EffectRecord("joint_compliance", 1.0 / 800.0, _compliance, "stiffness_Nm_rad"),
    EffectRecord("thermal_drift", 0.003, _drift),
    EffectRecord("link_flexure", 1.0 / 400.0, _flexure, "EI_Nm2"),
    EffectRecord("base_frame", 1.0, _frame),
    EffectRecord("payload", 0.2, _loads, "mass_kg"),
    EffectRecord("link_inertia", 0.2, _loads, "mass_kg"),
    EffectRecord("torque_constant", 0.1, _loads, "scale"),
)


def terms_of(scene: Scene) -> tuple[Term, ...]:
    """Every effect on every joint or link, in every variant, that these data could show."""
    return tuple(term for record in RECORDS for term in record.terms(record, scene))


__all__ = ["RECORDS", "EffectRecord", "Mask", "Scene", "terms_of"]
