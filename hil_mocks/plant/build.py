"""The MuJoCo model of an arm: links at their true DH frames, motors behind gears, friction, backlash, a hand and a payload.

Per joint a link-side hinge and, with an effect between motor and joint (backlash, compliance, a coupled belt), a
motor-side hinge of inertia N^2 Jr, both in joint angles, coupled by a fixed tendon of motor - link + ratio * q2. Without
such an effect the rotor is the armature of the link's hinge: exactly rigid, and cheaper.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from hil_mocks.errors import MockError
from hil_mocks.plant.effects import JointEffects, PlantEffects
from hil_mocks.plant.flexure import LOSS_S, Beam, beam, ends_of, remaining_inertia, split_mass
from hil_mocks.plant.geometry import Frame, Matrix, true_frame
from hil_mocks.plant.parts import ArmParts, DriveParts

# Hard rows: 0.9999 is MuJoCo's largest impedance; under 10 Nm such a row gives by some 1e-8 rad.
_HARD = [0.9999, 0.9999, 0.001, 0.5, 2.0]
_BRISTLE_RAD = 2e-5  # presliding deflection of a LuGre bristle at breakaway; below any encoder's resolution
_BRISTLE_DAMPING_RATIO = 0.5
_LIGHT_LINK = 0.1  # smallest inertia of a link as a share of the reflected rotor's
_FASTEST = 2.0  # steps per radian of a bending link's vibration: 1000 rad/s at 0.5 ms
_LEAST_KG = 1e-6  # of half a link without mass
_ROTOR_BODY_KG = 1e-9  # MuJoCo requires a mass; the effective inertia is the hinge's armature


@dataclass(frozen=True, slots=True)
class Standing:
    """An arm in a world: its name there, and the pose of its base frame (quaternion w, x, y, z)."""

    name: str = ""
    origin_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    orientation: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)

    @property
    def prefix(self) -> str:
        """What the names of the arm's elements begin with; one arm alone has its names to itself."""
        return f"{self.name}/" if self.name else ""

    def in_world(self, base_m: Sequence[float]) -> tuple[float, float, float]:
        """Convert a point of the base frame to the world."""
        turned = np.zeros(3)
        mujoco.mju_rotVecQuat(turned, np.asarray(base_m, dtype=float), np.array(self.orientation))
        x, y, z = (turned + self.origin_m).tolist()
        return x, y, z

    def in_base(self, world_m: Sequence[float]) -> tuple[float, float, float]:
        """Convert a point of the world to the base frame."""
        w, x, y, z = self.orientation
        turned = np.zeros(3)
        mujoco.mju_rotVecQuat(turned, np.subtract(world_m, self.origin_m), np.array((w, -x, -y, -z)))
        a, b, c = turned.tolist()
        return a, b, c


@dataclass(frozen=True, slots=True)
class PlantModel:
    """The compiled model and its indices. Per joint: index of the motor's and the link's hinge, its bridge."""

    model: Any
    standing: Standing
    motor_hinge: tuple[int, ...]
    link_hinge: tuple[int, ...]
    bridge: tuple[int, ...]  # actuator, control and current of a joint all have this index
    friction_dofs: tuple[
        tuple[tuple[int, float], ...], ...
    ]  # per joint (dof, share) with load-dependent friction
    bristles: tuple[tuple[tuple[int, float], ...], ...]  # per joint (actuator, share) of its LuGre elements
    tip_site: int
    payload_body: int
    tool_body: int
    end_shift_m: Matrix  # of the frame that tip, payload and tool are in, from that of the last link
    grip: int  # the constraint between the operator's hand and the tip
    mocap: int  # the hand's place in the list of bodies that are moved from outside
    bends: tuple[int, ...] = ()  # indices of the joints in the middle of bending links


@dataclass(frozen=True, slots=True)
class ArmToBuild:
    """What the plant of one arm is built from."""

    arm: ArmParts
    effects: PlantEffects
    timestep_s: float
    link_share: float
    end_stop_margin_rad: float
    standing: Standing = Standing()


def build(arms: Sequence[ArmToBuild]) -> list[PlantModel]:
    """Compile one world with all arms; one entry an arm. Raises MockError if a moving joint has no drive.

    Gravity and time step are those of the first arm; gravity of an arm.toml is in the arm's own base frame.
    """
    builders = [_Builder(one) for one in arms]
    is_alone = len(builders) == 1 and arms[0].standing == Standing()
    spec = builders[0].specified() if is_alone else _world(builders)
    try:
        model = spec.compile()
    except ValueError as error:
        names = ", ".join(f'"{one.arm.name}"' for one in arms)
        raise MockError(f"arm {names}: MuJoCo cannot build it: {error}") from error
    return [builder.located(model) for builder in builders]


def _world(builders: Sequence[_Builder]) -> Any:
    """One specification with every arm at the pose of its base."""
    world, first = mujoco.MjSpec(), builders[0].standing
    upright, weight = np.zeros(3), np.array(builders[0].gravity_m_s2)
    mujoco.mju_rotVecQuat(upright, weight, np.array(first.orientation))
    for builder in builders:
        spec, at = builder.specified(), builder.standing
        _set_options(world, builders[0].timestep_s, upright)
        _set_options(spec, builders[0].timestep_s, upright)
        world.attach(
            spec, prefix=at.prefix, frame=world.worldbody.add_frame(pos=at.origin_m, quat=at.orientation)
        )
    return world


def _set_options(spec: Any, timestep_s: float, gravity_m_s2: Any) -> None:
    spec.compiler.degree = False
    option = spec.option
    option.timestep = timestep_s
    # Joint damping is implicit here, too. The implicit integrators also predict back-EMF, so a step's torque is not that
    # of the current read: K^2 h / R, a tenth of a joint's inertia at 1 ms.
    option.integrator = mujoco.mjtIntegrator.mjINT_EULER
    option.gravity = gravity_m_s2
    option.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
    off = mujoco.mjtDisableBit
    option.disableflags = int(
        off.mjDSBL_CONTACT | off.mjDSBL_AUTORESET | off.mjDSBL_SENSOR | off.mjDSBL_ISLAND
    )


class _Builder:
    """Collects the elements of a specification and their indices; for a single use."""

    def __init__(self, one: ArmToBuild) -> None:
        self._arm, self._effects, self.standing = one.arm, one.effects, one.standing
        self.timestep_s, self._link_share = one.timestep_s, one.link_share
        self._margin_rad = one.end_stop_margin_rad
        self._spec = mujoco.MjSpec()
        self._bristles: list[list[tuple[str, float]]] = [[] for _ in one.arm.drives]
        self._bends: list[str] = []
        self._end_shift_m: Matrix = np.zeros(3)

    @property
    def gravity_m_s2(self) -> tuple[float, float, float]:
        """Gravity in the arm's base frame."""
        return self._arm.gravity_m_s2

    def specified(self) -> Any:
        """The arm alone, at the origin."""
        _set_options(self._spec, self.timestep_s, self._arm.gravity_m_s2)
        self._links()
        for j, drive in enumerate(self._arm.drives):
            self._transmission(j, drive, self._effects.joints[j])
        for j, drive in enumerate(self._arm.drives):
            self._bridge(j, drive, self._effects.joints[j])
        for j in range(len(self._arm.drives)):
            self._friction(j, self._effects.joints[j])
        self._hand()
        return self._spec

    def _links(self) -> None:
        parent, joint = self._spec.worldbody, 0
        frames = [self._true_frame(i) for i in range(len(self._arm.links))]
        shift_m = np.zeros(
            3
        )  # of the parent's frame from that of its link: half a beam, where the link bends
        for i, (link, frame) in enumerate(zip(self._arm.links, frames, strict=True)):
            body = parent.add_body(
                name=f"link{i + 1}", pos=frame.position_m - shift_m, quat=_quaternion(frame.rotation)
            )
            if link.is_revolute:
                self._hinge(body, frame, joint)
                joint += 1
            if i in self._effects.link_EI_Nm2:
                bent = self._beam(i, frames)
                parent, shift_m = self._bending(body, bent, i), bent.middle_m
            else:
                self._mass(body, i)
                parent, shift_m = body, np.zeros(3)
        if joint != len(self._arm.drives):
            raise MockError(
                f'arm "{self._arm.name}": {joint} revolute links but {len(self._arm.drives)} [[drive]] sections; '
                "the plant needs one drive for each joint."
            )
        tool = self._arm.tool
        self._end_shift_m = shift_m
        parent.add_site(name="tip", pos=tool.tip_m - shift_m)
        for name, place_m, mass_kg in (
            ("payload", tool.tip_m, self._effects.payload_kg),
            ("tool", tool.com_m, tool.mass_kg),
        ):
            load = parent.add_body(name=name, pos=place_m - shift_m, explicitinertial=True)
            load.mass, load.inertia = mass_kg, [0.0, 0.0, 0.0]
            load.ipos = [0.0, 0.0, 0.0]  # if unset, it would add the body's own pose again

    def _true_frame(self, i: int) -> Frame:
        deviation = {key: value for (at, key), value in self._effects.dh_deviation.items() if at == i}
        return true_frame(self._arm.links[i], deviation, self._arm.convention)

    def _mass(self, body: Any, i: int) -> None:
        mass, com_m, inertia = self._mass_of(i)
        body.explicitinertial = True
        body.mass, body.ipos, body.inertia = mass, com_m, inertia

    def _mass_of(self, i: int) -> tuple[float, Matrix, Matrix]:
        """Mass, its centre in the link's frame, and principal inertia of a link, including an effect."""
        link = self._arm.links[i]
        more = self._effects.link_inertia_kg_m2.get(i, 0.0)
        mass = link.mass_kg + self._effects.link_mass_kg.get(i, 0.0)
        return mass, np.array(link.com_m), np.array(link.inertia_kg_m2) + more

    def _beam(self, i: int, frames: Sequence[Frame]) -> Beam:
        turns = [link.is_revolute for link in self._arm.links]
        ends = ends_of(i, frames, turns, self._arm.convention == "standard", np.array(self._arm.tool.tip_m))
        return beam(*ends, self._effects.link_EI_Nm2[i], f'arm "{self._arm.name}", link {i + 1}')

    def _bending(self, near: Any, bent: Beam, i: int) -> Any:
        """Split a bending link: `near` is its near half; returns its far half, on two slides and two hinges."""
        mass, com_m, inertia = self._mass_of(i)
        parts = split_mass(bent, mass, com_m)
        left = remaining_inertia(inertia, com_m, parts)
        far = near.add_body(name=f"link{i + 1}far", pos=bent.middle_m)
        for body, part, origin_m in ((near, parts[0], np.zeros(3)), (far, parts[1], bent.middle_m)):
            body.explicitinertial = True
            body.mass, body.ipos = max(part.mass_kg, _LEAST_KG), part.place_m - origin_m
            body.inertia = 0.5 * left
        kinds = mujoco.mjtJoint
        for kind, stiffness in ((kinds.mjJNT_SLIDE, bent.slide_N_m), (kinds.mjJNT_HINGE, bent.hinge_Nm_rad)):
            for k, axis in enumerate(bent.across):
                name = f"{'s' if kind is kinds.mjJNT_SLIDE else 'h'}{k + 1}_link{i + 1}"
                joint = far.add_joint(name=name, type=kind, axis=axis)
                joint.stiffness, joint.damping = [stiffness, 0.0, 0.0], [LOSS_S * stiffness, 0.0, 0.0]
                # Added inertia of the far half, so that the step can follow its vibration; without weight.
                joint.armature = stiffness * (_FASTEST * self.timestep_s) ** 2
                self._bends.append(name)
        return far

    def _hinge(self, body: Any, frame: Frame, j: int) -> None:
        drive = self._arm.drives[j]
        hinge = body.add_joint(
            name=f"q{j + 1}", type=mujoco.mjtJoint.mjJNT_HINGE, axis=frame.axis, pos=frame.anchor_m
        )
        hinge.limited = mujoco.mjtLimited.mjLIMITED_TRUE
        hinge.range = [drive.joint_lower_rad - self._margin_rad, drive.joint_upper_rad + self._margin_rad]
        hinge.solref_limit, hinge.solimp_limit = [4.0 * self.timestep_s, 1.0], _HARD

    def _is_rigid(self, j: int, effect: JointEffects) -> bool:
        coupled = j == 2 and self._effects.belt_ratio != 0.0
        return effect.backlash_rad == 0.0 and math.isinf(effect.stiffness_Nm_rad) and not coupled

    def _transmission(self, j: int, drive: DriveParts, effect: JointEffects) -> None:
        inertia = drive.gear_ratio**2 * drive.rotor_inertia_kg_m2
        if self._is_rigid(j, effect):
            self._spec.joint(f"q{j + 1}").armature = inertia
            return
        body = self._spec.worldbody.add_body(
            name=f"motor{j + 1}", mass=_ROTOR_BODY_KG, inertia=[_ROTOR_BODY_KG] * 3, explicitinertial=True
        )
        body.add_joint(
            name=f"m{j + 1}", type=mujoco.mjtJoint.mjJNT_HINGE, axis=[0.0, 0.0, 1.0], armature=inertia
        )
        tendon = self._spec.add_tendon(name=f"gear{j + 1}")
        tendon.wrap_joint(f"m{j + 1}", 1.0)
        tendon.wrap_joint(f"q{j + 1}", -1.0)
        if j == 2 and self._effects.belt_ratio != 0.0:
            tendon.wrap_joint("q2", self._effects.belt_ratio)
        self._gear(tendon, effect)

    def _gear(self, tendon: Any, effect: JointEffects) -> None:
        """A spring with backlash as its dead band; backlash with hard flanks; or a rigid coupling."""
        half = 0.5 * effect.backlash_rad
        if math.isfinite(effect.stiffness_Nm_rad):
            tendon.stiffness = [effect.stiffness_Nm_rad, 0.0, 0.0]
            tendon.damping = [effect.damping_Nm_s_rad, 0.0, 0.0]
            tendon.springlength = [-half, half]
        elif half > 0.0:
            tendon.limited = mujoco.mjtLimited.mjLIMITED_TRUE
            tendon.range = [-half, half]
            tendon.solref_limit, tendon.solimp_limit = [2.0 * self.timestep_s, 1.0], _HARD
        else:
            row = self._spec.add_equality(
                type=mujoco.mjtEq.mjEQ_TENDON, objtype=mujoco.mjtObj.mjOBJ_TENDON, name1=tendon.name
            )
            row.solref, row.solimp = [2.0 * self.timestep_s, 1.0], _HARD

    def _motor_hinge(self, j: int) -> str:
        return f"q{j + 1}" if self._is_rigid(j, self._effects.joints[j]) else f"m{j + 1}"

    def _bridge(self, j: int, drive: DriveParts, effect: JointEffects) -> None:
        """The motor, referred to the joint: K = N kt in Nm/A and V s/rad; one state, the current."""
        K = drive.gear_ratio * drive.torque_constant_Nm_A * effect.torque_constant_scale
        actuator = self._add_actuator(f"bridge{j + 1}", self._motor_hinge(j))
        actuator.set_to_dcmotor(
            [K, K],
            drive.resistance_ohm,
            inductance=[drive.inductance_H, 0.0],
            # The effect is what the motor has to add; the magnets act the other way.
            cogging=[-effect.cogging_Nm, effect.cogging_order * drive.gear_ratio, effect.cogging_phase_rad],
        )
        actuator.actearly = True  # torque of the current at the step's end: second order instead of first

    def _add_actuator(self, name: str, hinge: str) -> Any:
        return self._spec.add_actuator(name=name, target=hinge, trntype=mujoco.mjtTrn.mjTRN_JOINT)

    def _friction(self, j: int, effect: JointEffects) -> None:
        """Coulomb friction as a hard row, viscous as damping; a falling (Stribeck) law as a native LuGre bristle."""
        for hinge, share in self._friction_shares(j):
            joint = self._spec.joint(hinge)
            joint.damping = [effect.viscous_Nm_s_rad * share, 0.0, 0.0]
            if effect.stribeck_Nm > 0.0:
                self._bristle(j, hinge, share, effect)
            else:
                joint.frictionloss = effect.coulomb_Nm * share
                # The row must exist so that load can raise it later.
                if effect.load_fraction > 0.0 and effect.coulomb_Nm == 0.0:
                    joint.frictionloss = 1e-6
                joint.solref_friction, joint.solimp_friction = [2.0 * self.timestep_s, 1.0], _HARD

    def _friction_shares(self, j: int) -> tuple[tuple[str, float], ...]:
        motor, link = self._motor_hinge(j), f"q{j + 1}"
        if motor == link:
            return ((link, 1.0),)
        return ((motor, 1.0 - self._link_share), (link, self._link_share))

    def _bristle(self, j: int, hinge: str, share: float, effect: JointEffects) -> None:
        if share <= 0.0:
            return
        static_Nm = (effect.coulomb_Nm + effect.stribeck_Nm) * share
        drive = self._arm.drives[j]
        inertia = drive.gear_ratio**2 * drive.rotor_inertia_kg_m2
        if hinge.startswith("q") and hinge != self._motor_hinge(j):
            inertia *= _LIGHT_LINK
        # An explicit bristle is stable while omega h stays below about 1; half of that keeps its response clean.
        stiffness = min(static_Nm / _BRISTLE_RAD, inertia * (0.5 / self.timestep_s) ** 2)
        damping = 2.0 * _BRISTLE_DAMPING_RATIO * math.sqrt(stiffness * inertia)
        name = f"bristle_{hinge}"
        actuator = self._add_actuator(name, hinge)
        actuator.set_to_dcmotor(
            [1e-12, 1e-12],
            1e12,  # a motor that carries no current: only its friction is wanted
            lugre=[stiffness, damping, effect.coulomb_Nm * share, static_Nm, effect.stribeck_speed_rad_s],
        )
        actuator.actearly = True
        self._bristles[j].append((name, share))

    def _hand(self) -> None:
        hand = self._spec.worldbody.add_body(name="hand", mocap=True)
        hand.add_site(name="hand")
        grip = self._spec.add_equality(
            name="grip",
            type=mujoco.mjtEq.mjEQ_CONNECT,
            objtype=mujoco.mjtObj.mjOBJ_SITE,
            name1="tip",
            name2="hand",
            active=False,
        )
        grip.solref, grip.solimp = [2e-3, 1.0], _HARD

    def located(self, model: Any) -> PlantModel:
        """Where the arm's elements are in the compiled world."""
        joints, prefix = range(len(self._arm.drives)), self.standing.prefix
        motor = tuple(int(model.joint(prefix + self._motor_hinge(j)).qposadr[0]) for j in joints)
        rows = tuple(
            tuple(
                (int(model.joint(prefix + name).dofadr[0]), share) for name, share in self._friction_shares(j)
            )
            for j in joints
        )
        bristles = tuple(
            tuple((int(model.actuator(prefix + name).id), share) for name, share in self._bristles[j])
            for j in joints
        )
        return PlantModel(
            model=model,
            standing=self.standing,
            motor_hinge=motor,
            link_hinge=tuple(int(model.joint(f"{prefix}q{j + 1}").qposadr[0]) for j in joints),
            bridge=tuple(int(model.actuator(f"{prefix}bridge{j + 1}").id) for j in joints),
            friction_dofs=rows,
            bristles=bristles,
            tip_site=int(model.site(f"{prefix}tip").id),
            payload_body=int(model.body(f"{prefix}payload").id),
            tool_body=int(model.body(f"{prefix}tool").id),
            end_shift_m=self._end_shift_m,
            grip=int(model.equality(f"{prefix}grip").id),
            mocap=int(model.body(f"{prefix}hand").mocapid[0]),
            bends=tuple(int(model.joint(prefix + name).qposadr[0]) for name in self._bends),
        )


def _quaternion(rotation: Matrix) -> Matrix:
    quaternion = np.zeros(4)
    mujoco.mju_mat2Quat(quaternion, np.ascontiguousarray(rotation).ravel())
    return quaternion
