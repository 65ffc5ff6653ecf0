"""The arm for programs that know rigid trees only: the nearest rigid arm to one with play, soft gears or encoder errors; its
frames on joint axes; and what such a program cannot have of it.

In poses at rest all over the joints' ranges, approached from either side, the whole model of the file says where tip and last
link are, as the runtime and `verify` have it. Deviations x of the DH rows, in units of 5 mm and 2 deg (SpringerPlus 5:1771,
eq. (4)), let a rigid arm agree with that best:

    minimise |r(x)|^2 / v + |x|^2,   v the variance of what is left of r

r: tips, and orientations as they count in a calibration. What the poses do not determine stays as in the file. Joint angles stay
those of the encoders with the file's zeros: what play adds on average goes into the frames.
"""

from __future__ import annotations

import math
import re
import xml.etree.ElementTree as ET
from collections.abc import Collection, Iterable
from dataclasses import dataclass, replace

import numpy as np

from calib.arm_problem.arm_model import ArmModel, dh_names
from calib.arm_problem.assembly import BASE, Choice, problem_of
from calib.arm_problem.parallel_axes import in_the_same_rows
from calib.arm_problem.posed import TARGET, whole_problem
from calib.arrays import Array, frozen, norms
from calib.design.candidates import joint_box, spread_poses, workspace_poses
from calib.points.points import FREE, Points, make_points
from calib.validation.verify import predicted_orientations, predicted_tips
from control.dynamics.dynamics import has_masses
from control.kinematics.rotation import logarithms, matrices, quaternions
from control.model.arm import Arm, Drive, Effect, Link, Vector3

POSES = 1000  # drawn; those below the floor are left out
ROUNDS = 5  # Gauss-Newton's: deviations of some mm have settled after three
OF_LOADS = ("backlash", "joint_compliance", "link_flexure")


@dataclass(frozen=True, slots=True)
class RigidArm:
    """`arm`: the file's, but for the DH rows, which are the rigid arm's; `notes`: sentences for the operator."""

    arm: Arm
    notes: tuple[str, ...] = ()


def nearest_rigid(arm: Arm, known: Collection[str] = ()) -> RigidArm:
    """For a program that knows the effects `known` besides rigid links."""
    own = tuple(effect for effect in arm.effects if effect.effect in known)
    how = "the links are those of the rigid arm nearest to this one with its effects", "with the file's links"
    return _nearest(arm, replace(arm, effects=own), (), how)


def nearest_zeros(arm: Arm, generic: Arm) -> RigidArm:
    """For a program that keeps the links of the `generic` arm, and learns the joints' zeros alone. ArmError: another arm."""
    arm, generic = in_the_same_rows(arm, generic)
    zeros, names, rows = ArmModel(arm).theta_places, dh_names(len(arm.links)), np.array(generic.dh)
    for place in zeros:
        rows.flat[place] = arm.dh.flat[place]
    fixed = set(names) - {names[place] for place in zeros}
    how = f"the zeros are those with which the links of {generic.name} come nearest to this arm", "with the file's zeros"
    return _nearest(arm, replace(arm.with_dh(rows), effects=()), fixed, how)


def _nearest(arm: Arm, rigid: Arm, fixed: Collection[str], how: tuple[str, str]) -> RigidArm:
    """Of a rigid arm to begin with, of which the DH parameters `fixed` stay; `how`: what the numbers are, and what they were."""
    model, notes = _with_sides(arm)
    rigid = replace(rigid, maps=(), tolerances=None, tool=replace(arm.tool, known=True))
    poses = _predicted(model, _poses(arm))
    as_rigid = _predicted(rigid, poses)
    if np.array_equal(as_rigid.tip_m, poses.tip_m) and np.array_equal(as_rigid.orientation, poses.orientation):
        return RigidArm(arm, notes)
    half = len(poses) // 4 * 2
    fitted, others = poses.chosen(np.arange(half)), poses.chosen(np.arange(half, len(poses)))
    problem = problem_of(rigid, fitted, Choice(fixed=(BASE, TARGET, *fixed)))
    whole, x = whole_problem(problem), np.zeros(len(problem.parameters))
    for _ in range(ROUNDS):
        residuals, jacobian = whole.residuals_and_jacobian(x)
        rows, variance = jacobian.reshape(-1, len(x)), float(np.mean(residuals**2))
        x = x - np.linalg.solve(rows.T @ rows + variance * np.eye(len(x)), rows.T @ residuals.ravel() + variance * x)
    dh = problem.solution(x).dh
    what, else_ = how
    after, before = (_in_words(_off(one, others)) for one in (rigid.with_dh(dh), rigid))
    sentence = f"{what}: at rest tip and orientation are off by {after} on average, {else_} by {before}"
    return RigidArm(arm.with_dh(dh), (*notes, sentence))


def _with_sides(arm: Arm) -> tuple[Arm, tuple[str, ...]]:
    """The arm as far as its file says what its effects do, and what it leaves open."""
    if has_masses(arm):
        return arm, ()
    effects = tuple(effect for effect in arm.effects if effect.effect not in OF_LOADS)
    maps = tuple(one for one in arm.maps if one.over != "load_Nm")
    if len(effects) == len(arm.effects) and len(maps) == len(arm.maps):
        return arm, ()
    return replace(arm, effects=effects, maps=maps), (
        "the file has no masses, from which the side follows on which a loose gear lies, and how far soft parts give way: the"
        " links are written for the middle of the play and for no load",
    )


def _poses(arm: Arm) -> Points:
    """Poses over the joints' ranges, above the floor; each twice, every joint approached from either side."""
    q = workspace_poses(arm, (), POSES)
    q = np.repeat(q if len(q) else spread_poses(joint_box(arm), POSES), 2, axis=0)
    direction = np.random.default_rng(0).choice((-1.0, 1.0), q.shape)
    direction[1::2] = -direction[::2]
    count = len(q)
    return make_points([FREE] * count, [""] * count, [1] * count, q, np.full((count, 3), np.nan), direction)


def _predicted(arm: Arm, poses: Points) -> Points:
    """The poses with tips and orientations as the arm's model has them."""
    return replace(
        poses, tip_m=frozen(predicted_tips(arm, poses)), orientation=frozen(quaternions(predicted_orientations(arm, poses)))
    )


def _off(arm: Arm, poses: Points) -> Array:
    """How far tips [m] and last links [rad] of an arm are from those of the poses, (m, 2)."""
    there = _predicted(arm, poses)
    turned = matrices(poses.orientation) @ np.swapaxes(matrices(there.orientation), 1, 2)
    return np.column_stack((norms(poses.tip_m - there.tip_m), norms(logarithms(turned))))


def _in_words(off: Array) -> str:
    """Errors of tips [m] and last links [rad], (m, 2)."""
    tip_m, turn_rad = off.T
    return f"{1e3 * tip_m.mean():.1f} mm (95 %: {1e3 * np.quantile(tip_m, 0.95):.1f}), {1e3 * turn_rad.mean():.1f} mrad"


@dataclass(frozen=True, slots=True)
class Placement:
    """Tz(d) Rz(theta) Tx(L) Rx(alpha): a frame in another."""

    d_m: float = 0.0
    theta_rad: float = 0.0
    L_m: float = 0.0
    alpha_rad: float = 0.0

    @property
    def position_m(self) -> Vector3:
        """Origin."""
        return (self.L_m * math.cos(self.theta_rad) + 0.0, self.L_m * math.sin(self.theta_rad) + 0.0, self.d_m + 0.0)

    @property
    def rpy_rad(self) -> Vector3:
        """Turns about the fixed x, y, z axes, in this order: URDF's rpy."""
        return self.alpha_rad + 0.0, 0.0, self.theta_rad + 0.0

    @property
    def quaternion(self) -> tuple[float, float, float, float]:
        """Orientation w, x, y, z."""
        ct, st = math.cos(0.5 * self.theta_rad), math.sin(0.5 * self.theta_rad)
        ca, sa = math.cos(0.5 * self.alpha_rad), math.sin(0.5 * self.alpha_rad)
        return ct * ca + 0.0, ct * sa + 0.0, st * sa + 0.0, st * ca + 0.0

    @property
    def matrix(self) -> Array:
        """The 4x4 transform."""
        c, s = math.cos(self.theta_rad), math.sin(self.theta_rad)
        ca, sa = math.cos(self.alpha_rad), math.sin(self.alpha_rad)
        x, y, z = self.position_m
        return np.array([[c, -s * ca, s * sa, x], [s, c * ca, -c * sa, y], [0.0, sa, ca, z], [0.0, 0.0, 0.0, 1.0]])

    def of(self, point_m: Vector3) -> Vector3:
        """Convert a point of this frame to the parent frame."""
        x, y, z = (self.matrix @ np.array([*point_m, 1.0]))[:3].tolist()
        return x + 0.0, y + 0.0, z + 0.0


@dataclass(frozen=True, slots=True)
class ExportedLink:
    """One link: `joint` (1-based) rotates it about its frame's z axis; None if fixed.

    `parent_T_body` at joint angle 0; `body_T_dh` is the pose of the link's DH frame, in which masses are given.
    """

    number: int
    joint: int | None
    parent_T_body: Placement
    body_T_dh: Placement
    link: Link

    @property
    def name(self) -> str:
        """Name in the exported file."""
        return (self.joint is not None and self.link.link_name) or f"link{self.number}"

    @property
    def joint_name(self) -> str:
        """Name of its joint in the exported file; a fixed one's, if it does not turn."""
        return self.link.joint_name or (f"fixed{self.number}" if self.joint is None else f"joint{self.joint}")

    @property
    def has_inertia(self) -> bool:
        """Whether mass, centre of mass and inertia are known."""
        link = self.link
        return bool(link.mass_kg) and link.com_m is not None and link.inertia_kg_m2 is not None

    @property
    def com_m(self) -> Vector3:
        """Centre of mass in the body's frame."""
        return self.body_T_dh.of(self.link.com_m or (0.0, 0.0, 0.0))


def bodies_of(arm: Arm) -> tuple[ExportedLink, ...]:
    """The links from base to tip."""
    bodies, joint, before = [], 0, Placement()
    for number, link in enumerate(arm.links, start=1):
        turns = link.joint == "revolute"
        joint += turns
        if arm.dh_convention == "standard":
            at, after = before, Placement(link.d_m, link.theta_rad, link.L_m, link.alpha_rad)
        else:
            at = Placement(before.d_m, before.theta_rad, link.L_m, link.alpha_rad)
            after = Placement(link.d_m, link.theta_rad)
        bodies.append(ExportedLink(number, joint if turns else None, at, after, link))
        before = after
    return tuple(bodies)


def tip_in_last(arm: Arm, bodies: tuple[ExportedLink, ...]) -> Vector3:
    """The tip in the last body's frame; its axes are those of the last DH frame, `body_T_dh`."""
    return bodies[-1].body_T_dh.of(arm.tool.position_m)


def end_names(arm: Arm) -> tuple[str, str]:
    """Names of base and tip in the exported file."""
    base, tip = (link.link_name if link.joint == "fixed" else "" for link in (arm.links[0], arm.links[-1]))
    return base or "base", tip or "tip"


def ends_m(arm: Arm, bodies: tuple[ExportedLink, ...]) -> tuple[Vector3, ...]:
    """The end of each body, at the next one or the tip, to which its shape is drawn."""
    return (*(body.parent_T_body.position_m for body in bodies[1:]), tip_in_last(arm, bodies))


def massless_joints(bodies: tuple[ExportedLink, ...]) -> tuple[int, ...]:
    """Joints without a known mass before the next joint; a simulator cannot move these."""
    weighs: dict[int, bool] = {}
    joint = 0
    for body in bodies:
        joint = body.joint or joint
        weighs[joint] = weighs.get(joint, False) or body.has_inertia
    return tuple(joint for joint, does in weighs.items() if joint and not does)


# Not allowed in XML 1.0 even escaped: controls, lone surrogates, the last two of the first plane.
_FORBIDDEN = re.compile("[\x00-\x08\x0b\x0c\x0e-\x1f\ud800-\udfff\ufffe\uffff]")


def numbers(values: Iterable[float]) -> str:
    """Format numbers so that they read back exactly."""
    return " ".join(repr(float(value)) for value in values)


def safe(text: str) -> str:
    """A name for XML: invalid characters become underscores, line breaks spaces."""
    return _FORBIDDEN.sub("_", " ".join(text.split())) or "arm"


def document(root: ET.Element, comment: str) -> str:
    """The whole file, indented, with a leading comment."""
    ET.indent(root)
    text = re.sub(r"-(?=-)", "- ", safe(comment)).rstrip("-")
    return f'<?xml version="1.0" encoding="utf-8"?>\n<!-- {text} -->\n{ET.tostring(root, encoding="unicode")}\n'


def about(arm: Arm) -> str:
    """The origin of the arm, for the leading comment."""
    text = f"armwright: arm {arm.name}, {arm.dh_convention} DH, SI units and radians"
    made = arm.calibration
    if made is None:
        return f"{text}; not calibrated"
    inputs = ", ".join(f"{name} (SHA-256 {digest})" for name, digest in made.inputs.items())
    return f"{text}; calibrated from {made.source} on {made.date}, {made.objective}, {made.program_version}, with {inputs}"


HELD = ("viscous_friction", "coulomb_friction")
EARTH_m_s2 = (0.0, 0.0, -9.81)


def losses(arm: Arm, form: str) -> tuple[str, ...]:
    """One sentence each; none for JSON, which represents everything."""
    if form == "json":
        return ()
    sentences = [*_effects(arm, form), *_masses(arm)]
    if form == "urdf" and arm.gravity_m_s2 != EARTH_m_s2:
        x, y, z = arm.gravity_m_s2
        sentences.append(f"urdf has no gravity: set {x:g}, {y:g}, {z:g} m/s^2 in the tool that reads it")
    return (*sentences, *_drives(arm, form), *_rest(arm, form))


def _effects(arm: Arm, form: str) -> list[str]:
    """Of those that do something: `calibrate --fix base` writes a base_frame of zeros."""
    acting = (effect for effect in arm.effects if effect.effect not in HELD and any(effect.parameters.values()))
    return [f"{form} cannot express the effect {_spelled(effect)}: omitted" for effect in acting]


def _spelled(effect: Effect) -> str:
    figures = ", ".join(f"{key} {value:g}" for key, value in effect.parameters.items())
    where = f" of {effect.joint}" if effect.joint is not None else ""
    return f"{effect.effect}{where} ({figures})"


def _masses(arm: Arm) -> list[str]:
    bodies = bodies_of(arm)
    bare = massless_joints(bodies)
    sentences = []
    if bare:
        joints = ", ".join(map(str, bare))
        sentences.append(
            f"masses behind joint {joints} are unknown: the geometry is valid, the dynamics are not"
            " (MuJoCo gets 1e-6 kg per link, since it refuses zero mass)"
        )
    vague = [body.number for body in bodies if body.link.mass_kg and not body.has_inertia]
    if vague:
        sentences.append(f"link {', '.join(map(str, vague))}: mass without com_m and inertia_kg_m2 is omitted")
    return sentences


def _drives(arm: Arm, form: str) -> list[str]:
    sentences = []
    for joint in range(1, arm.joint_count + 1):
        figures = joint_figures(arm, joint)
        ends = (figures.lower_rad, figures.upper_rad)
        if not figures.is_limited and any(abs(end) < 1e3 for end in ends):
            sentences.append(
                f"{form} has no joint with a single limit: joint {joint}, {ends[0]:g} to {ends[1]:g} rad, is unlimited"
            )
        if form == "urdf" and figures.rotor_kg_m2:
            sentences.append(
                f"urdf has no rotor inertia: joint {joint} lacks {figures.rotor_kg_m2:.3g} kg m^2"
                " and will accelerate too fast in a simulation"
            )
    if arm.drives:
        included = "limits, torque, speed and friction" if form == "urdf" else "limits, torque, friction and rotor"
        sentences.append(
            f"{form} contains {included} of the drives; motors, gears, encoders, accelerations, jerk and gains are omitted"
        )
    return sentences


def _rest(arm: Arm, form: str) -> list[str]:
    parts = [
        name
        for name, part in (
            ("table", arm.table),
            ("camera", arm.camera),
            ("gripper", arm.gripper),
            ("boards", arm.encoder_boards or arm.can or arm.boards),
            ("rest pose", arm.rest),
        )
        if part
    ]
    return [f"{form} cannot express: {', '.join(parts)}; omitted"] if parts else []


@dataclass(frozen=True, slots=True)
class DriveFigures:
    """Figures of one joint; infinite if unlimited, 0 if there is none."""

    lower_rad: float
    upper_rad: float
    torque_Nm: float
    speed_rad_s: float
    rotor_kg_m2: float
    viscous_Nm_s_rad: float
    coulomb_Nm: float

    @property
    def is_limited(self) -> bool:
        """Whether both ends of its range are known."""
        return math.isfinite(self.lower_rad) and math.isfinite(self.upper_rad)


def joint_figures(arm: Arm, joint: int) -> DriveFigures:
    """Figures of a joint (1-based), from its drive, if it has one, and the model's friction."""
    drive = next((d for d in arm.drives if d.joint == joint), None)
    lower, upper = arm.limits_rad[joint - 1]
    return DriveFigures(
        lower_rad=lower,
        upper_rad=upper,
        torque_Nm=drive.torque_limit_Nm if drive else math.inf,
        speed_rad_s=_speed_rad_s(drive) if drive else math.inf,
        rotor_kg_m2=drive.gear_ratio**2 * drive.rotor_inertia_kg_m2 if drive else 0.0,
        viscous_Nm_s_rad=_effect(arm, "viscous_friction", joint, "coefficient_Nm_s_rad"),
        coulomb_Nm=_effect(arm, "coulomb_friction", joint, "torque_Nm"),
    )


def _speed_rad_s(drive: Drive) -> float:
    """The joint's limit, or the motor's idle speed at the full supply if that is less."""
    idle_rad_s = drive.supply_V / (drive.torque_constant_Nm_A * drive.gear_ratio)
    return min(drive.joint_speed_limit_rad_s, idle_rad_s)


def _effect(arm: Arm, name: str, joint: int, parameter: str) -> float:
    return next((e.parameters[parameter] for e in arm.effects if (e.effect, e.joint) == (name, joint)), 0.0)
