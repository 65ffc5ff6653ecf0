"""The MuJoCo model of an arm: links at their true DH frames, motors behind gears, friction, backlash, a hand and a payload.

Links with their hinges, masses and bending stand here; motors, gears and friction in transmission.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from hil_mocks.errors import MockError
from hil_mocks.plant.effects import PlantEffects
from hil_mocks.plant.parts import ArmParts, LinkFrame, Matrix, true_frame
from hil_mocks.plant.transmission import HARD, LOSS_S, Beam, Transmissions, beam, ends_of, remaining_inertia, split_mass

_FASTEST = 2.0  # steps per radian of a bending link's vibration: 1000 rad/s at 0.5 ms
_LEAST_KG = 1e-6  # of half a link without mass


@dataclass(frozen=True, slots=True)
class PlantOptions:
    """Options of the simulation, independent of the arm."""

    timestep_s: float = 5e-4  # a tenth of the motors' mechanical time constant; 0.25 ms moves a path by 3e-6 rad
    link_share: float = 0.5  # of a joint's friction that acts on the link side of the gear
    end_stop_margin_rad: float = 0.05  # from a joint limit to the hard stop behind it
    hand_speed_m_s: float = 0.3
    seating_noise_m: float = 0.0
    seed: int = 0


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
        if self.is_at_origin:  # an arm that stands alone; its camera asks a hundred times a second
            x, y, z = map(float, world_m)
            return x, y, z
        w, x, y, z = self.orientation
        turned = np.zeros(3)
        mujoco.mju_rotVecQuat(turned, np.subtract(world_m, self.origin_m), np.array((w, -x, -y, -z)))
        a, b, c = turned.tolist()
        return a, b, c

    @property
    def is_at_origin(self) -> bool:
        """Whether its base frame is the world's."""
        return self.orientation == (1.0, 0.0, 0.0, 0.0) and self.origin_m == (0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class PlantModel:
    """The compiled model and its indices. Per joint: index of the motor's and the link's hinge, its bridge."""

    model: Any
    standing: Standing
    motor_hinge: tuple[int, ...]
    link_hinge: tuple[int, ...]
    bridge: tuple[int, ...]  # actuator, control and current of a joint all have this index
    friction_dofs: tuple[tuple[tuple[int, float], ...], ...]  # per joint (dof, share) with load-dependent friction
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
    builders = [_Builder(design) for design in arms]
    is_alone = len(builders) == 1 and arms[0].standing == Standing()
    spec = builders[0].specified() if is_alone else _world(builders)
    try:
        model = spec.compile()
    except ValueError as error:
        names = ", ".join(f'"{design.arm.name}"' for design in arms)
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
        world.attach(spec, prefix=at.prefix, frame=world.worldbody.add_frame(pos=at.origin_m, quat=at.orientation))
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
    option.disableflags = int(off.mjDSBL_CONTACT | off.mjDSBL_AUTORESET | off.mjDSBL_SENSOR | off.mjDSBL_ISLAND)


class _Builder:
    """Collects the elements of a specification and their indices; for a single use."""

    def __init__(self, design: ArmToBuild) -> None:
        self._arm, self._effects, self.standing = design.arm, design.effects, design.standing
        self.timestep_s, self._margin_rad = design.timestep_s, design.end_stop_margin_rad
        self._spec = mujoco.MjSpec()
        self._drives = Transmissions(self._spec, design.arm, design.effects, design.timestep_s, design.link_share)
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
        self._drives.add()
        self._hand()
        return self._spec

    def _links(self) -> None:
        parent, joint = self._spec.worldbody, 0
        frames = [self._true_frame(i) for i in range(len(self._arm.links))]
        shift_m = np.zeros(3)  # of the parent's frame from that of its link: half a beam, where the link bends
        for i, (link, frame) in enumerate(zip(self._arm.links, frames, strict=True)):
            body = parent.add_body(name=f"link{i + 1}", pos=frame.position_m - shift_m, quat=_quaternion(frame.rotation))
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
        for name, place_m, mass_kg in (("payload", tool.tip_m, self._effects.payload_kg), ("tool", tool.com_m, tool.mass_kg)):
            load = parent.add_body(name=name, pos=place_m - shift_m, explicitinertial=True)
            load.mass, load.inertia = mass_kg, [0.0, 0.0, 0.0]
            load.ipos = [0.0, 0.0, 0.0]  # if unset, it would add the body's own pose again

    def _true_frame(self, i: int) -> LinkFrame:
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

    def _beam(self, i: int, frames: Sequence[LinkFrame]) -> Beam:
        turns = [link.is_revolute for link in self._arm.links]
        ends = ends_of(i, frames, turns, self._arm.convention == "standard", np.array(self._arm.tool.tip_m))
        return beam(*ends, self._effects.link_EI_Nm2[i], f'arm "{self._arm.name}", link {i + 1}')

    def _bending(self, near: Any, bent: Beam, i: int) -> Any:
        """Split a bending link: `near` is its near half; returns its far half, on two slides and two hinges."""
        mass, com_m, inertia = self._mass_of(i)
        parts = split_mass(bent, mass, com_m)
        remaining_kg_m2 = remaining_inertia(inertia, com_m, parts)
        far = near.add_body(name=f"link{i + 1}far", pos=bent.middle_m)
        for body, part, origin_m in ((near, parts[0], np.zeros(3)), (far, parts[1], bent.middle_m)):
            body.explicitinertial = True
            body.mass, body.ipos = max(part.mass_kg, _LEAST_KG), part.place_m - origin_m
            body.inertia = 0.5 * remaining_kg_m2
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

    def _hinge(self, body: Any, frame: LinkFrame, j: int) -> None:
        drive = self._arm.drives[j]
        hinge = body.add_joint(name=f"q{j + 1}", type=mujoco.mjtJoint.mjJNT_HINGE, axis=frame.axis, pos=frame.anchor_m)
        hinge.limited = mujoco.mjtLimited.mjLIMITED_TRUE
        hinge.range = [drive.joint_lower_rad - self._margin_rad, drive.joint_upper_rad + self._margin_rad]
        hinge.solref_limit, hinge.solimp_limit = [4.0 * self.timestep_s, 1.0], HARD

    def _hand(self) -> None:
        hand = self._spec.worldbody.add_body(name="hand", mocap=True)
        hand.add_site(name="hand")
        grip = self._spec.add_equality(
            name="grip", type=mujoco.mjtEq.mjEQ_CONNECT, objtype=mujoco.mjtObj.mjOBJ_SITE, name1="tip", name2="hand", active=False
        )
        grip.solref, grip.solimp = [2e-3, 1.0], HARD

    def located(self, model: Any) -> PlantModel:
        """Where the arm's elements are in the compiled world."""
        joints, prefix = range(len(self._arm.drives)), self.standing.prefix
        motor = tuple(int(model.joint(prefix + self._drives.motor_hinge(j)).qposadr[0]) for j in joints)
        rows = tuple(
            tuple((int(model.joint(prefix + name).dofadr[0]), share) for name, share in self._drives.friction_shares(j))
            for j in joints
        )
        bristles = tuple(
            tuple((int(model.actuator(prefix + name).id), share) for name, share in self._drives.bristles[j]) for j in joints
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


def to_build(arm: ArmParts, effects: PlantEffects, options: PlantOptions, standing: Standing) -> ArmToBuild:
    """Return what `build` makes of an arm with these options."""
    return ArmToBuild(arm, effects, options.timestep_s, options.link_share, options.end_stop_margin_rad, standing)
