"""Encoder set-points for joint set-points, on an arm with known backlash, compliance, belt coupling or encoder errors.

    joint = rigid(encoder) - offset,    offset = flank width / 2 + transmitted torque / stiffness - map(load, direction)

`rigid` has scale, eccentric discs, the belt, and measured maps over the angle; it goes both ways, with speeds and accelerations:

    rigid_j = (1 + scale_j) e_j + a_j sin e_j + b_j cos e_j + map_j(e_j)  [+ ratio joint_2 for joint 3]

with a, b = amplitude cos(phase), amplitude sin(phase). The belt counts where the encoder is on the motor.

The offset is motor minus joint angle; there is none of an encoder on the joint.
It is computed from set-point and model, never from measurements (`Gear`). The transmitted torque
is that of the links without the rotors, plus the link-side share of the dry friction, which is an assumption.
Plain floats: all of it runs every cycle.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from math import copysign, cos, inf, isfinite, sin, sqrt
from typing import Final, Self

from control.dynamics.dynamics import Dynamics
from control.dynamics.feedforward import links_alone, own_payload_kg, torque_constants_Nm_A
from control.errors import ArmError
from control.model.arm import Arm
from control.model.effects import COUPLED, COUPLED_TO, corrected, linear_values
from control.model.maps import SmoothTable

RIGID_EFFECTS: Final = corrected("encoder")
_COUPLED, _COUPLED_TO = COUPLED - 1, COUPLED_TO - 1
_ROUNDS = 3  # Newton's; each squares an error that begins below 1e-2 rad
Floats = tuple[float, ...]


class EncoderChain:
    """The rigid part of the map between encoder and joint angles, one of each per joint."""

    __slots__ = ("_cosine", "_gain", "_ratio", "_sine", "_table")

    def __init__(self, arm: Arm) -> None:
        n = arm.joint_count
        self._gain, self._sine, self._cosine = [1.0] * n, [0.0] * n, [0.0] * n
        self._ratio = 0.0
        self._table: list[SmoothTable | None] = [None] * n
        for entry in arm.maps:
            if entry.corrects == entry.over == "angle_rad":
                self._table[entry.joint - 1] = SmoothTable.of(entry)
        for effect in arm.effects:
            if not arm.is_behind_encoder(effect.effect, effect.joint):
                continue
            p, j = effect.parameters, (effect.joint or 0) - 1
            match effect.effect:
                case "encoder_scale":
                    self._gain[j] += p["scale"]
                case "encoder_eccentricity":
                    sine, cosine = linear_values(effect.effect, p)
                    self._sine[j] += sine
                    self._cosine[j] += cosine
                case "belt_coupling":
                    self._ratio += p["ratio"]

    def joint_of(self, joint: int, e: float) -> float:
        """Angle of one joint (0-based) without the belt's share."""
        table = self._table[joint]
        measured = 0.0 if table is None else table(e)
        return self._gain[joint] * e + self._sine[joint] * sin(e) + self._cosine[joint] * cos(e) + measured

    def joints(self, encoder_rad: Sequence[float], offset_rad: Sequence[float]) -> Floats:
        """Joint angles if each motor leads its joint by `offset_rad`."""
        q = [self.joint_of(j, e) - offset_rad[j] for j, e in enumerate(encoder_rad)]
        if self._ratio:
            q[_COUPLED] += self._ratio * q[_COUPLED_TO]
        return tuple(q)

    def encoders(
        self, q_rad: Sequence[float], speed_rad_s: Sequence[float], acceleration_rad_s2: Sequence[float]
    ) -> tuple[Floats, Floats, Floats]:
        """Encoder angles, speeds and accelerations at angles, speeds and accelerations of the motors (unbelted joints)."""
        q, speed, acceleration = list(q_rad), list(speed_rad_s), list(acceleration_rad_s2)
        for j, wanted in enumerate(q):
            q[j], speed[j], acceleration[j] = self._encoder(j, wanted, speed[j], acceleration[j])
        return tuple(q), tuple(speed), tuple(acceleration)

    def unbelted(self, values: Sequence[float]) -> list[float]:
        """Angles, speeds or accelerations of the joints without the belt's share in joint 3."""
        unbelted = list(values)
        if self._ratio:
            unbelted[_COUPLED] -= self._ratio * unbelted[_COUPLED_TO]
        return unbelted

    def belt(self, second: float) -> float:
        """The belt's share in joint 3 for an angle, speed or acceleration of joint 2."""
        return self._ratio * second

    def _encoder(self, j: int, q: float, speed: float, acceleration: float) -> tuple[float, float, float]:
        gain = self._gain[j]
        if self._sine[j] == self._cosine[j] == 0.0 and self._table[j] is None:
            return q / gain, speed / gain, acceleration / gain
        e = q / gain
        for _ in range(_ROUNDS):
            value, slope, _ = self._derivatives(j, e)
            e -= (value - q) / slope
        _, slope, bend = self._derivatives(j, e)
        turned = speed / slope
        return e, turned, (acceleration - bend * turned * turned) / slope

    def _derivatives(self, j: int, e: float) -> tuple[float, float, float]:
        """The joint's angle without the belt's share, and its first and second derivative by the encoder's."""
        gain, a, b = self._gain[j], self._sine[j], self._cosine[j]
        sine, cosine, table = sin(e), cos(e), self._table[j]
        value, slope, bend = (gain * e + a * sine + b * cosine, gain + a * cosine - b * sine, -a * sine - b * cosine)
        if table is None:
            return value, slope, bend
        own = table.derivatives(e)
        return value + own[0], slope + own[1], bend + own[2]


# One gear with backlash or compliance: its contact flank, and the offset of the motor from the joint.
#
# The sign of the transmitted torque determines the contact flank. For a planned set-point:
#
# - in motion: the sign of the links' torque + link-side friction times direction;
# - at rest: the sign of gravity if it exceeds friction, else the flank on which the joint came to rest;
# - near zero: the last flank, because the model is not exact.
#
# What was measured beyond play and spring, by load and by the direction of the last motion, is added as a map
# (control.model.maps). The offset follows flank, spring and map critically damped, with limited speed and acceleration,
# so it never jumps.
DOUBT: Final = 0.05  # of the friction: a smaller torque does not change the flank
PACE_rad_s: Final = 100.0  # bandwidth of the offset: faster than the position loop (40 rad/s)
STEP_S, MOST_STEPS = 0.002, 100  # largest step; after a pause of the host it need not be exact
_STILL_rad_s = 1e-6


@dataclass(frozen=True, slots=True)
class GearLaw:
    """Parameters of a gear; dry friction and load friction are the link-side shares."""

    width_rad: float
    compliance_rad_Nm: float
    friction_Nm: float
    load_fraction: float
    speed_rad_s: float  # limits of the offset's own motion
    acceleration_rad_s2: float
    measured: "MeasuredLag | None" = None


@dataclass(frozen=True, slots=True)
class MeasuredLag:
    """How far a joint is ahead of its motor by maps: over the load, and in positive motion over angle and load."""

    over_load: SmoothTable | None = None
    directed_over_load: SmoothTable | None = None
    directed_over_angle: SmoothTable | None = None

    def ahead_rad(self, q_rad: float, torque_Nm: float, direction: float) -> float:
        """At this angle under this torque of the links; direction 1 or -1, 0 while unknown."""
        ahead = 0.0 if self.over_load is None else self.over_load(torque_Nm)
        if self.directed_over_load is not None:
            ahead += direction * self.directed_over_load(torque_Nm)
        if self.directed_over_angle is not None:
            ahead += direction * self.directed_over_angle(q_rad)
        return ahead

    @property
    def largest_rad(self) -> float:
        """That a joint may be ahead."""
        tables = self.over_load, self.directed_over_load, self.directed_over_angle
        return sum(table.largest for table in tables if table is not None)


class Gear:
    """The state of one gear. `offset_rad` is motor minus joint angle, with its two derivatives."""

    __slots__ = ("_direction", "_flank", "_law", "acceleration_rad_s2", "offset_rad", "speed_rad_s")

    def __init__(self, law: GearLaw) -> None:
        self._law = law
        self._flank = 0.0  # 0: not known yet
        self._direction = 0.0  # of the last motion
        self.offset_rad = self.speed_rad_s = self.acceleration_rad_s2 = 0.0

    @property
    def flank(self) -> int:
        """Sign of the torque from motor to joint; 0 while unknown."""
        return int(self._flank)

    def rest(self, torque_Nm: float, q_rad: float = 0.0) -> None:
        """Initialise at rest at this angle with this torque of the links."""
        self.offset_rad = self._wanted(torque_Nm, q_rad, 0.0, 0.0)
        self.speed_rad_s = self.acceleration_rad_s2 = 0.0

    def follow(
        self, torque_Nm: float, speed_rad_s: float, acceleration_rad_s2: float, elapsed_s: float, q_rad: float = 0.0
    ) -> None:
        """Advance by `elapsed_s` with the joint's set-point and this torque of the links."""
        wanted = self._wanted(torque_Nm, q_rad, speed_rad_s, acceleration_rad_s2)
        if wanted == self.offset_rad and self.speed_rad_s == 0.0:
            self.acceleration_rad_s2 = 0.0
            return
        steps = min(max(round(elapsed_s / STEP_S), 1), MOST_STEPS)
        for _ in range(steps):
            self._approach(wanted, min(elapsed_s / steps, STEP_S))

    def _wanted(self, torque: float, q: float, speed: float, acceleration: float) -> float:
        law = self._law
        friction = law.friction_Nm + law.load_fraction * abs(torque)
        is_still = -_STILL_rad_s < speed < _STILL_rad_s
        if not is_still:
            self._direction = copysign(1.0, speed)
        if is_still and acceleration == 0.0:
            if abs(torque) > friction * (1.0 + DOUBT):
                self._flank = copysign(1.0, torque)
        else:
            way = copysign(1.0, acceleration) if is_still else self._direction
            pushed = torque + friction * way
            if abs(pushed) > DOUBT * friction:
                self._flank = copysign(1.0, pushed)
        transmitted = torque + friction * self._direction
        known = 0.5 * law.width_rad * self._flank + law.compliance_rad_Nm * transmitted
        return known if law.measured is None else known - law.measured.ahead_rad(q, torque, self._direction)

    def _approach(self, wanted: float, step_s: float) -> None:
        """One step of a critically damped follower, with its speed limited so that it can still brake."""
        law, off = self._law, wanted - self.offset_rad
        most = min(law.speed_rad_s, sqrt(law.acceleration_rad_s2 * abs(off)))
        target = min(max(0.5 * PACE_rad_s * off, -most), most)
        a = 2.0 * PACE_rad_s * (target - self.speed_rad_s)
        limit = law.acceleration_rad_s2
        a = min(max(a, -limit), limit)
        self.acceleration_rad_s2 = a
        self.speed_rad_s += a * step_s
        self.offset_rad += self.speed_rad_s * step_s
        if abs(off) < 1e-9 and abs(self.speed_rad_s) < 1e-7:
            self.offset_rad, self.speed_rad_s, self.acceleration_rad_s2 = wanted, 0.0, 0.0


GEAR_EFFECTS: Final = corrected("gear")
SIDE_EFFECTS: Final = RIGID_EFFECTS | GEAR_EFFECTS
LINK_SHARE: Final = 0.5  # of a joint's dry friction on the link side: the middle of the possible range
UNKNOWN_FRICTION: Final = 0.01  # on the link side, of the torque at the current limit, if the arm's file gives none
SHARE_OF_SPEED, SHARE_OF_ACCELERATION = 0.25, 0.5  # of a joint's limits, for the offset's own motion

State = tuple[Floats, Floats, Floats]  # angles, speeds, accelerations
Carried = Callable[[Sequence[float], Sequence[float], Sequence[float]], Sequence[float] | None]
LinkTorque = Callable[[Sequence[float], Sequence[float], Sequence[float], float], Sequence[float]]


class JointSide:
    """Maps between joints and encoders of one arm. Keeps the state of the gears, so call `aim` once a cycle, in order of time."""

    def __init__(self, arm: Arm, carried: Carried | None = None) -> None:
        """`carried`: torques of masses that change at run time, beside the arm's own and `payload_kg`."""
        self._carried = carried
        self._rigid = EncoderChain(arm)
        self._offset = [0.0] * arm.joint_count
        laws = gear_laws(arm)
        self._gears = tuple((joint - 1, Gear(law)) for joint, law in laws.items())
        self._torque = link_torque(arm) if laws else None
        self._still = (0.0,) * arm.joint_count

    @classmethod
    def of(cls, arm: Arm, carried: Carried | None = None) -> Self | None:
        """The joint side of an arm whose file has such effects, else None. MissingModel if gears lack masses or drives."""
        return cls(arm, carried) if has_joint_side(arm) else None

    @property
    def flanks(self) -> Mapping[int, int]:
        """Sign of the transmitted torque by joint (1-based) with backlash or compliance; 0 while unknown."""
        return {joint + 1: gear.flank for joint, gear in self._gears}

    def stand(self, encoder_rad: Sequence[float], payload_kg: float = 0.0) -> Floats:
        """Joint angles of an arm at rest at these encoder angles; `aim` continues from there without a step."""
        joints = self.joint_rad(encoder_rad)
        if self._torque is None:
            return joints
        for _ in range(2):  # gravity at the joints' angles; one iteration is accurate to a thousandth
            torques = self._transmitted((joints, self._still, self._still), payload_kg)
            for joint, gear in self._gears:
                gear.rest(torques[joint], joints[joint])
                self._offset[joint] = gear.offset_rad
            joints = self.joint_rad(encoder_rad)
        return joints

    def aim(self, wanted: State, elapsed_s: float, payload_kg: float = 0.0) -> State:
        """Encoder set-points for the joint set-points `wanted`, `elapsed_s` after the last call."""
        q, speed, acceleration = wanted
        if self._torque is not None:
            torques = self._transmitted(wanted, payload_kg)
            for joint, gear in self._gears:
                gear.follow(torques[joint], speed[joint], acceleration[joint], elapsed_s, q[joint])
                self._offset[joint] = gear.offset_rad
        return self._rigid.encoders(*self._motors(q, speed, acceleration))

    def joint_rad(self, encoder_rad: Sequence[float]) -> Floats:
        """Joint angles at encoder angles, with the present state of the gears."""
        return self._rigid.joints(encoder_rad, self._offset)

    def _transmitted(self, state: State, payload_kg: float) -> Sequence[float]:
        """Torques [N m] that the gears pass on, without friction."""
        known = self._torque(*state, payload_kg) if self._torque is not None else self._still
        more = None if self._carried is None else self._carried(*state)
        return known if more is None else [k + m for k, m in zip(known, more, strict=True)]

    def _motors(self, q: Floats, speed: Floats, acceleration: Floats) -> tuple[list[float], ...]:
        """The joints' motion minus the belt's share, plus the gears' offsets."""
        parts = [self._rigid.unbelted(values) for values in (q, speed, acceleration)]
        for joint, gear in self._gears:
            parts[0][joint] += gear.offset_rad
            parts[1][joint] += gear.speed_rad_s
            parts[2][joint] += gear.acceleration_rad_s2
        return tuple(parts)


def has_joint_side(arm: Arm) -> bool:
    """Whether the arm has effects or measured maps between encoders and joints."""
    return any(one.effect in SIDE_EFFECTS and arm.is_behind_encoder(one.effect, one.joint) for one in arm.effects) or any(
        one.corrects == "angle_rad" for one in arm.maps
    )


def link_torque(arm: Arm) -> LinkTorque:
    """`torque(q, speed, acceleration, payload_kg)` [N m] of the links alone: the transmitted torque without friction."""
    links, own_kg = links_alone(arm), own_payload_kg(arm)
    known, laden = Dynamics(links, own_kg).inverse, Dynamics(links, own_kg + 1.0).inverse

    def torque(q: Sequence[float], speed: Sequence[float], acceleration: Sequence[float], payload_kg: float) -> Sequence[float]:
        empty = known(q, speed, acceleration)
        if payload_kg == 0.0:
            return empty
        with_one = laden(q, speed, acceleration)
        return [e + payload_kg * (w - e) for e, w in zip(empty, with_one, strict=True)]

    return torque


def gear_laws(arm: Arm) -> dict[int, GearLaw]:
    """The gears with backlash, compliance, or a map over load or direction, by joint (1-based)."""
    laws = {}
    measured = measured_lags(arm)
    geared = {
        e.joint
        for e in arm.effects
        if e.effect in GEAR_EFFECTS and e.joint is not None and arm.is_behind_encoder(e.effect, e.joint)
    }
    for joint in sorted(geared | measured.keys()):
        drive = arm.drive(joint)
        stiffness = _sum(arm, joint, "joint_compliance", "stiffness_Nm_rad")
        dry_Nm = _sum(arm, joint, "coulomb_friction", "torque_Nm")
        unknown_Nm = UNKNOWN_FRICTION * torque_limit_Nm(arm, joint)
        laws[joint] = GearLaw(
            width_rad=_sum(arm, joint, "backlash", "width_rad"),
            compliance_rad_Nm=1.0 / stiffness if stiffness else 0.0,
            friction_Nm=LINK_SHARE * dry_Nm if dry_Nm else unknown_Nm,
            load_fraction=LINK_SHARE * _sum(arm, joint, "load_friction", "fraction"),
            speed_rad_s=SHARE_OF_SPEED * drive.joint_speed_limit_rad_s,
            acceleration_rad_s2=SHARE_OF_ACCELERATION * drive.joint_acceleration_limit_rad_s2,
            measured=measured.get(joint),
        )
    return laws


def measured_lags(arm: Arm) -> dict[int, MeasuredLag]:
    """What maps say beyond a joint's angle alone, which is the encoder chain's, by joint (1-based)."""
    lags: dict[int, MeasuredLag] = {}
    for entry in arm.maps:
        before, directed = lags.get(entry.joint, MeasuredLag()), SmoothTable.of_direction(entry)
        if entry.corrects == "angle_rad" and entry.over == "load_Nm":
            lags[entry.joint] = replace(before, over_load=SmoothTable.of(entry), directed_over_load=directed)
        elif entry.corrects == "angle_rad" and directed is not None:
            lags[entry.joint] = replace(before, directed_over_angle=directed)
    return lags


def torque_limit_Nm(arm: Arm, joint: int) -> float:
    """A joint's torque at its current limit; 0 if it has none."""
    limit_A = arm.drive(joint).current_limit_A
    return torque_constants_Nm_A(arm)[joint - 1] * limit_A if isfinite(limit_A) else 0.0


def _sum(arm: Arm, joint: int, effect: str, parameter: str) -> float:
    """Of the effects between the joint and its encoder, and of torques."""
    return sum(
        e.parameters[parameter]
        for e in arm.effects
        if e.effect == effect and e.joint == joint and arm.is_behind_encoder(effect, joint)
    )


def usable_range_rad(arm: Arm) -> tuple[tuple[float, float], ...]:
    """The range of each joint in which joint and encoder both stay within its limits, for any state of the gear.

    ArmError if that range is empty.
    """
    rigid, laws = EncoderChain(arm), gear_laws(arm)
    second = arm.limits_rad[COUPLED_TO - 1] if arm.joint_count >= COUPLED_TO else (0.0, 0.0)
    belt = [rigid.belt(q) if isfinite(q) else inf for q in second]
    ranges_rad = []
    for j, (lower, upper) in enumerate(arm.limits_rad):
        law = laws.get(j + 1)
        off = 0.0 if law is None else _largest_offset_rad(arm, j + 1, law)
        low, high = (min(belt), max(belt)) if j + 1 == COUPLED else (0.0, 0.0)
        room = (max(lower, rigid.joint_of(j, lower) + off + high), min(upper, rigid.joint_of(j, upper) - off + low))
        if not room[0] < room[1]:
            raise ArmError(f"arm {arm.name}: with its effects, joint {j + 1} has no range left within its limits")
        ranges_rad.append(room)
    return tuple(ranges_rad)


def _largest_offset_rad(arm: Arm, joint: int, law: GearLaw) -> float:
    """By which the motor may be ahead of the joint, either way."""
    known = 0.5 * law.width_rad + law.compliance_rad_Nm * torque_limit_Nm(arm, joint)
    return known + (law.measured.largest_rad if law.measured is not None else 0.0)
