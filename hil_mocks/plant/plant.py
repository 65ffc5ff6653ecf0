"""The physics of a mock arm: motors, gears, links, friction and a hand, advanced in fixed small steps.

The hand grips the tip, drags it to a point with limited speed, holds it there, releases it.
"""

from __future__ import annotations

import math
import random
from collections import deque
from collections.abc import Sequence
from typing import Any, Literal

import mujoco

from hil_mocks.errors import MockError, UnreachableError
from hil_mocks.plant.bridge import CURRENT, OPEN, VOLTAGE, Bridges, windings_of
from hil_mocks.plant.build import PlantModel, PlantOptions, Standing, build, to_build
from hil_mocks.plant.effects import BasePose, JointEffects, PlantEffects
from hil_mocks.plant.parts import ArmParts, PlantTool

Point = tuple[float, float, float]
HandState = Literal["away", "dragging", "holding", "cannot reach"]
_SETTLE_S = 0.25  # after which a tip that is still off cannot reach the point
_CANNOT_M = 1e-3


class Hand:
    """A mocap body that a connect constraint ties to the tip. Moves once a tick, never faster than `hand_speed_m_s`."""

    def __init__(self, at: PlantModel, state: Any, options: PlantOptions, base_pose: BasePose) -> None:
        self._base_pose, self._standing = base_pose, at.standing
        self._data, self._tip_site, self._grip, self._mocap = state, at.tip_site, at.grip, at.mocap
        self._model = at.model
        self._speed_m_s, self._noise_m = options.hand_speed_m_s, options.seating_noise_m
        self._random = random.Random(f"hand {options.seed}")
        self._start: Point = (0.0, 0.0, 0.0)
        self._target: Point = (0.0, 0.0, 0.0)
        self._begun_s = self._duration_s = 0.0
        self.state: HandState = "away"
        self.problem = ""

    def seat(self, point_m: Sequence[float]) -> float:
        """Drag the tip to a point (frame of table and camera) with seating noise; returns the duration in s."""
        x, y, z = (float(value) + self._noise() for value in self._base_pose.in_base(point_m))
        x, y, z = self._standing.in_world((x, y, z))
        if not all(map(math.isfinite, (x, y, z))):
            raise UnreachableError(f"hand: cannot seat the tip at {tuple(point_m)}: the coordinates are not finite.")
        mujoco.mj_kinematics(self._model, self._data)
        here = self._data.site_xpos[self._tip_site]
        self._start, self._target = (float(here[0]), float(here[1]), float(here[2])), (x, y, z)
        # The smooth profile below peaks at 1.875 times its mean speed.
        self._duration_s = max(0.1, 1.875 * math.dist(self._start, self._target) / self._speed_m_s)
        self._begun_s = float(self._data.time)
        self._data.mocap_pos[self._mocap] = here
        self._data.eq_active[self._grip] = 1
        self.state, self.problem = "dragging", ""
        return self._duration_s

    def let_go(self) -> None:
        """Release the tip."""
        self._data.eq_active[self._grip] = 0
        self.state = "away"

    @property
    def is_gripping(self) -> bool:
        """Whether the hand has the tip."""
        return self.state in ("dragging", "holding")

    def residual_m(self) -> float:
        """Distance of the tip from the hand."""
        mujoco.mj_kinematics(self._model, self._data)
        return math.dist(self._data.site_xpos[self._tip_site], self._data.mocap_pos[self._mocap])

    def move(self) -> None:
        """Advance by a tick; nothing while away or holding. Releases an unreachable tip, with the reason in `problem`."""
        if self.state != "dragging":
            return
        s = (float(self._data.time) - self._begun_s) / self._duration_s
        if s >= 1.0:
            self._data.mocap_pos[self._mocap] = self._target
            self._arrive()
            return
        blend = s * s * s * (10.0 + s * (6.0 * s - 15.0))
        self._data.mocap_pos[self._mocap] = [a + (b - a) * blend for a, b in zip(self._start, self._target, strict=True)]

    def _arrive(self) -> None:
        if self.residual_m() < _CANNOT_M:
            self.state = "holding"
        elif float(self._data.time) > self._begun_s + self._duration_s + _SETTLE_S:
            off_mm = self.residual_m() * 1e3
            self.let_go()
            place = ", ".join(f"{value:.3f}" for value in self._outside(self._target))
            self.state = "cannot reach"
            self.problem = f"hand: the arm cannot reach ({place}) m: {off_mm:.1f} mm short; the tip was released."

    def _noise(self) -> float:
        return self._random.gauss(0.0, self._noise_m) if self._noise_m > 0.0 else 0.0

    def _outside(self, world_m: Point) -> Point:
        """A point of the physics in the frame of table and camera."""
        return self._base_pose.in_world(self._standing.in_base(world_m))


_FALL_rad_s = 0.5  # of a link that an operator lets down by hand
_JAMMED_Nm_s_rad = 1e6  # a jammed gear creeps by a microradian per second under the full motor torque

_BENDING_ROUNDS = 3  # gravity's torque on a bent link differs from that on a straight one by some 1e-3


class Plant:
    """An arm with its motors. Joints are 0-based; angles are joint angles; the tip is in the base frame."""

    def __init__(
        self,
        arm: ArmParts,
        effects: PlantEffects,
        start_rad: Sequence[float],
        options: PlantOptions | None = None,
        world: tuple[PlantModel, Any] | None = None,
    ) -> None:
        """`world`: the model and the state of a world that has other arms, too (`plants_of`); else one of its own."""
        options = options or PlantOptions()
        self.joints = len(arm.drives)
        self.timestep_s = options.timestep_s
        self.effects = effects
        self._is_base_nominal = effects.base_pose.is_nominal
        if world is None:
            (at,) = build([to_build(arm, effects, options, Standing())])
            world = at, mujoco.MjData(at.model)
        self._at, self._data = world
        self._model: Any = self._at.model
        self._shafts = tuple(Shaft(effect) for effect in effects.joints)
        self._shafts_are_true = all(shaft.is_true for shaft in self._shafts)
        self._read_hinge = tuple(
            self._at.link_hinge[j] if drive.is_encoder_on_joint else self._at.motor_hinge[j] for j, drive in enumerate(arm.drives)
        )
        self._pose(arm, start_rad)
        self._bend()
        self.bridges = Bridges(self._model, self._data, windings_of(arm, effects), self._at.bridge, effects.supply_resistance_ohm)
        self.hand = Hand(self._at, self._data, options, self.effects.base_pose)
        self._steps = 0
        self._free_damping = [float(damping) for damping in self._model.dof_damping]
        self._steadying = [0.0] * len(self._free_damping)  # N m s/rad, by the hand
        self._is_steadied = False
        self._blocked_by: dict[int, set[str]] = {}
        self._gravity_m_s2 = self._model.opt.gravity.copy()
        self._delay_steps = round(effects.command_delay_s / options.timestep_s)
        self._pending: deque[tuple[int, int, int, float]] = deque()
        self._load_friction = tuple(j for j, effect in enumerate(effects.joints) if effect.load_fraction > 0.0)
        self._apply_asymmetry()
        self._read()

    @property
    def steps(self) -> int:
        """Time steps since the start."""
        return self._steps

    @property
    def time_s(self) -> float:
        """Simulated time since the start."""
        return self._steps * self.timestep_s

    def step(self, steps: int) -> None:
        """Advance by a number of time steps, alone in its world."""
        step_together((self,), steps)

    def next_due(self) -> float:
        """Time step at which the next delayed command reaches its bridge."""
        return self._pending[0][0] if self._pending else math.inf

    def take_due(self, step: float) -> None:
        """Apply the delayed commands of a time step."""
        while self._pending and self._pending[0][0] <= step:
            _, j, mode, value = self._pending.popleft()
            self.bridges.command(j, mode, value)

    def move_hand(self) -> None:
        """What the operator does before a tick."""
        self.hand.move()
        if self.hand.is_gripping != self._is_steadied:
            self._steady()

    def drive_voltage(self, j: int, voltage_V: float) -> None:
        """Mean terminal voltage of motor j; 0 shorts its windings."""
        self._post(j, VOLTAGE, voltage_V)

    def drive_current(self, j: int, current_A: float) -> None:
        """Current source for motor j, within the limits of supply and current."""
        self._post(j, CURRENT, current_A)

    def drive_open(self, j: int) -> None:
        """Open circuit: no current, the motor turns freely."""
        self._post(j, OPEN, 0.0)

    def motor_rad(self, j: int) -> float:
        """Angle of motor j in joint angles."""
        return self._q[self._at.motor_hinge[j]]

    def encoder_rad(self, j: int) -> float:
        """Encoder angle of joint j in joint angles, before quantisation: of its motor, or of the joint itself."""
        shaft, read_rad = self._shafts[j], self._q[self._read_hinge[j]]
        return read_rad if shaft.is_true else shaft.reading_rad(read_rad, self.time_s)

    def encoder_angles_rad(self) -> list[float]:
        """All encoder angles in joint angles."""
        q = self._q
        if self._shafts_are_true:
            return [q[k] for k in self._read_hinge]
        return [self.encoder_rad(j) for j in range(self.joints)]

    def joint_rad(self) -> tuple[float, ...]:
        """True joint angles."""
        q = self._q
        return tuple([q[k] for k in self._at.link_hinge])

    def joint_speed_rad_s(self) -> tuple[float, ...]:
        """True joint speeds."""
        v = self._v
        return tuple([v[k] for k in self._at.link_hinge])

    def current_A(self, j: int) -> float:
        """Current of motor j now."""
        return self.bridges.current_A(j)

    def tip_m(self) -> Point:
        """True tip in the frame of camera and table: the base frame, unless `base_frame` puts the arm elsewhere."""
        ahead = self._data.qpos.copy()
        self._data.qpos[:] = self._q
        mujoco.mj_kinematics(self._model, self._data)
        self._data.qpos[:] = ahead
        return self._in_world(self._data.site_xpos[self._at.tip_site])

    def _in_world(self, at_m: Sequence[float]) -> Point:
        """A point of the physics in the frame of camera and table."""
        x, y, z = self._at.standing.in_base(at_m)
        return (x, y, z) if self._is_base_nominal else self.effects.base_pose.in_world((x, y, z))

    def tip_pose(self) -> tuple[Point, tuple[Point, Point, Point]]:
        """True tip as `tip_m` has it, and the x, y and z axis of the last link there."""
        tip = self.tip_m()
        site = self._at.tip_site
        columns = self._data.site_xmat[site].reshape(3, 3).T
        axes = [self._in_world(self._data.site_xpos[site] + column) for column in columns]
        x, y, z = ((end[0] - tip[0], end[1] - tip[1], end[2] - tip[2]) for end in axes)
        return tip, (x, y, z)

    def set_payload(self, mass_kg: float) -> None:
        """Replace the point mass at the tip."""
        if not mass_kg >= 0.0:
            raise MockError(f"payload: the mass must not be negative, got {mass_kg} kg.")
        self._model.body_mass[self._at.payload_body] = mass_kg
        self._derive()

    def set_tool(self, tool: PlantTool) -> None:
        """Mount another tool; the payload goes with its tip."""
        at, model = self._at, self._model
        model.site_pos[at.tip_site] = model.body_pos[at.payload_body] = tool.tip_m - at.end_shift_m
        model.body_pos[at.tool_body] = tool.com_m - at.end_shift_m
        model.body_mass[at.tool_body] = tool.mass_kg
        self._derive()

    def _derive(self) -> None:
        """Derived constants go through a scratch state: mj_setConst leaves it at the reference pose."""
        mujoco.mj_setConst(self._model, mujoco.MjData(self._model))

    def energy_J(self) -> tuple[float, float]:
        """Potential and kinetic energy, rotors included."""
        mujoco.mj_forward(self._model, self._data)
        mujoco.mj_energyPos(self._model, self._data)
        mujoco.mj_energyVel(self._model, self._data)
        return float(self._data.energy[0]), float(self._data.energy[1])

    def push(self, j: int, torque_Nm: float) -> None:
        """Apply an external torque on the link side of joint j, until it is changed."""
        self._data.qfrc_applied[self._at.link_hinge[j]] = torque_Nm - self._offset_Nm(self._at.link_hinge[j])

    def block(self, j: int, is_blocked: bool, by: str = "jam") -> None:
        """Jam the gear of joint j, or free it again. What moved has stopped at once: no damping could take that up in a step."""
        holders = self._blocked_by.setdefault(j, set())
        if is_blocked:
            self._data.qvel[[self._at.motor_hinge[j], self._at.link_hinge[j]]] = 0.0
        (holders.add if is_blocked else holders.discard)(by)
        self._damp(j)

    def carry(self, is_carried: bool) -> None:
        """Take the weight off all links, as a person who supports them does, or leave it to the joints again."""
        self._model.opt.gravity[:] = 0.0 if is_carried else self._gravity_m_s2

    def _damp(self, j: int) -> None:
        """Give the dofs of joint j the damping that they have now."""
        for dof in {self._at.motor_hinge[j], self._at.link_hinge[j]}:
            free = self._free_damping[dof] + self._steadying[dof]
            self._model.dof_damping[dof] = _JAMMED_Nm_s_rad if self._blocked_by.get(j) else free

    def _steady(self) -> None:
        """What the operator's other hand does: while the tip is held, no link falls fast under its own weight.

        The grip leaves joints beyond the third free; without friction in their gears they would swing.
        """
        self._is_steadied = self.hand.is_gripping
        for j in range(self.joints):
            weight_Nm = self._weight_Nm(j) if self._is_steadied else 0.0
            self._steadying[self._at.link_hinge[j]] = weight_Nm / _FALL_rad_s
            self._damp(j)

    def _weight_Nm(self, j: int) -> float:
        """Largest gravity torque on joint j that any posture of the base could give, with the links beyond it as they are."""
        hinge = int(self._model.dof_jntid[self._at.link_hinge[j]])
        body = int(self._model.jnt_bodyid[hinge])
        lever_m = math.dist(self._data.subtree_com[body], self._data.xanchor[hinge])
        return float(self._model.body_subtreemass[body]) * lever_m * math.hypot(*self._model.opt.gravity)

    def _post(self, j: int, mode: int, value: float) -> None:
        if self._delay_steps == 0:
            self.bridges.command(j, mode, value)
        else:
            self._pending.append((self._steps + self._delay_steps, j, mode, value))

    def load(self) -> None:
        """Set what acts on the arm during the next steps: outputs of the bridges, friction under load."""
        self.bridges.settle([self._v[k] for k in self._at.motor_hinge])
        for j in self._load_friction:
            self._raise_friction(j)

    def advance(self, steps: int) -> None:
        """Let time pass in the world; all arms in it must have been loaded."""
        mujoco.mj_step(self._model, self._data, steps)

    def passed(self, steps: int) -> None:
        """Read the state after these steps."""
        self._steps += steps
        self._read()

    def _read(self) -> None:
        """Read angles, speeds and currents of one time: a step moves the angles with the speeds at its end.

        MuJoCo's Euler steps are a leapfrog of currents, half a step later speeds, and another half step later angles.
        Angles one step back are those of the time at which bridges are switched and currents read, to second order.
        """
        step_s, speeds = self.timestep_s, self._data.qvel.tolist()
        # As plain floats: arrays of six numbers are slower.
        self._q: list[float] = [q - step_s * v for q, v in zip(self._data.qpos.tolist(), speeds, strict=True)]
        self._v: list[float] = speeds
        if not math.isfinite(sum(self._v)):
            raise MockError(f"plant: the physics became unstable at {self.time_s:.4f} s; take a smaller timestep_s.")

    def _pose(self, arm: ArmParts, start_rad: Sequence[float]) -> None:
        if len(start_rad) != self.joints:
            raise MockError(f"start pose: expected {self.joints} joint angles, got {len(start_rad)}.")
        for j, (drive, angle) in enumerate(zip(arm.drives, start_rad, strict=True)):
            if not drive.joint_lower_rad <= angle <= drive.joint_upper_rad:
                raise MockError(
                    f"start pose: joint {j + 1} at {angle:g} rad is outside its limits "
                    f"{drive.joint_lower_rad:g} to {drive.joint_upper_rad:g}."
                )
            self._data.qpos[self._at.motor_hinge[j]] = angle
            self._data.qpos[self._at.link_hinge[j]] = angle
        if self.joints >= 3:
            motor = self._at.motor_hinge[2]
            if motor != self._at.link_hinge[2]:
                self._data.qpos[motor] = start_rad[2] - self.effects.belt_ratio * start_rad[1]

    def _bend(self) -> None:
        """Start bending links in static equilibrium, so that they do not oscillate."""
        bends = list(self._at.bends)
        for _ in range(_BENDING_ROUNDS if bends else 0):
            mujoco.mj_forward(self._model, self._data)
            stiffness = self._model.jnt_stiffness[bends]
            self._data.qpos[bends] = -self._data.qfrc_bias[bends] / stiffness

    def _offset_Nm(self, dof: int) -> float:
        """Asymmetric friction is Coulomb friction plus a constant torque against the positive direction."""
        return sum(
            effect.asymmetry_Nm * share
            for effect, rows in zip(self.effects.joints, self._at.friction_dofs, strict=True)
            for row, share in rows
            if row == dof
        )

    def _apply_asymmetry(self) -> None:
        for dof in {row for rows in self._at.friction_dofs for row, _ in rows}:
            self._data.qfrc_applied[dof] = -self._offset_Nm(dof)

    def _raise_friction(self, j: int) -> None:
        """Load-dependent friction: Coulomb level plus a fraction of the torque transmitted to the link."""
        effect, data = self.effects.joints[j], self._data
        link, motor = self._at.link_hinge[j], self._at.motor_hinge[j]
        passed = float(data.qfrc_passive[link] + data.qfrc_actuator[link] + data.qfrc_applied[link] + data.qfrc_constraint[link])
        if link == motor:
            passed -= float(self._model.dof_armature[link] * data.qacc[link])
        level = effect.coulomb_Nm + effect.load_fraction * abs(passed)
        if self._at.bristles[j]:
            for actuator, share in self._at.bristles[j]:
                self._model.actuator_biasprm[actuator, 3] = level * share
                self._model.actuator_biasprm[actuator, 4] = (level + effect.stribeck_Nm) * share
            return
        for dof, share in self._at.friction_dofs[j]:
            self._model.dof_frictionloss[dof] = level * share


def step_together(plants: Sequence[Plant], steps: int) -> None:
    """Advance arms of one world: one call of MuJoCo, more only if a delayed command becomes due."""
    for plant in plants:
        plant.move_hand()
    done = plants[0].steps
    end = done + steps
    while done < end:
        until = end
        for plant in plants:
            plant.take_due(done)
            plant.load()
            if (due := plant.next_due()) < until:
                until = int(due)
        plants[0].advance(until - done)
        for plant in plants:
            plant.passed(until - done)
        done = until


class Shaft:
    """Angle of what the encoder is on, in joint radians -> encoder angle. With eccentricity and drift, the joint leads."""

    __slots__ = ("_amplitude_rad", "_drift_rad", "_phase_rad", "_scale", "_time_constant_s", "is_true")

    def __init__(self, effect: JointEffects) -> None:
        self._scale = 1.0 + effect.encoder_scale
        self._amplitude_rad, self._phase_rad = effect.eccentricity_rad, effect.eccentricity_phase_rad
        self._drift_rad, self._time_constant_s = effect.drift_rad, effect.drift_time_constant_s
        self.is_true = effect.encoder_scale == effect.eccentricity_rad == effect.drift_rad == 0.0

    def reading_rad(self, motor_rad: float, time_s: float) -> float:
        """The encoder's angle e of motor = (1 + scale) e + amplitude sin(e + phase) + drift (1 - exp(-t/T))."""
        rest_rad = motor_rad
        if self._drift_rad != 0.0:
            rest_rad += self._drift_rad * math.expm1(-time_s / self._time_constant_s)
        reading = rest_rad / self._scale
        if self._amplitude_rad != 0.0:
            for _ in range(4):  # contracts by the amplitude, a few mrad, each time
                reading = (rest_rad - self._amplitude_rad * math.sin(reading + self._phase_rad)) / self._scale
        return reading
