"""From set-point to output: model-based feed-forward, and PID for the remaining error; the torque of a hand-guided arm.

Voltage of a brushed DC motor: u = R i + k_t N dq/dt (inductance is five times faster than a cycle), with i = tau / (N k_t) for
the torque tau that the model asks for. The PID acts on the joint's error and adds volts; in CURRENT mode it adds amperes
and the board supplies the back-EMF; in POSITION mode the board runs the PID on counts and takes the volts as feed-forward.
Each joint has a mode of its own. The PID of a joint runs on plain floats:

    output = feedforward + kp * error + ki * integral(error) + kd * filtered(error rate)

The derivative filter is of first order, discretised by backward Euler (stable for any filter time).
Anti-windup: the integral is frozen while it would push the output further into its limit, and it alone
never exceeds the limits. So it recovers with the error's sign and follows narrowed limits.
"""

from collections.abc import Sequence
from dataclasses import asdict
from typing import Protocol

from control.dynamics.feedforward import Loads, Motor, torque_model, without_tool_mass
from control.dynamics.gains import Gains
from control.errors import ArmError
from control.hardware.interface import OutputMode
from control.model.arm import Arm
from control.motion.setpoint import JointState, SetPoint
from control.safety.limits import voltage_range
from control.safety.modes import Fault, Reaction

# A finite bound: one chained comparison rejects NaN and both infinities at once.
_LARGEST = 1e300
# Members of an enumeration are slow to look up in Python 3.11, and each cycle asks for these at every joint.
_POSITION, _CURRENT = OutputMode.POSITION, OutputMode.CURRENT
FADE_S = 2.0  # slow compared with the boards' integrals: the arm moves by only a tenth of a milliradian


class NonFiniteInput(ArmError):
    """A NaN or infinite number reached the controller; its state is unchanged."""


class Pid:
    """One joint's controller; units are the caller's, e.g. [V/rad], [V/(rad s)], [V s/rad] on [rad].

    Raises:
        ArmError: a gain or limit is negative or not finite, or the period is not positive.
    """

    __slots__ = ("_blend", "_error", "_period_s", "_rate", "_step", "integral", "is_saturated", "kd", "ki", "kp", "output_limit")

    def __init__(self, gains: Gains, output_limit: float, period_s: float) -> None:
        _require_sane(gains, output_limit, period_s)
        self.kp, self.ki, self.kd, self.output_limit = gains.kp, gains.ki, gains.kd, output_limit
        self.integral = 0.0  # in units of the output: changing ki later causes no bump
        self.is_saturated = False
        self._period_s = period_s
        self._step = gains.ki * period_s
        self._blend = period_s / (gains.derivative_filter_s + period_s)
        self._rate = 0.0
        self._error: float | None = None

    def update(
        self,
        error: float,
        error_rate: float | None = None,
        feedforward: float = 0.0,
        lower: float | None = None,
        upper: float | None = None,
    ) -> float:
        """Output of this cycle for error = set - measured.

        `error_rate` is set speed minus measured speed; pass minus the measured speed to keep steps of the
        set-point out of the derivative, or None to difference the error. `lower` and `upper` replace the
        limits -output_limit and output_limit for this cycle.

        Raises:
            NonFiniteInput: any input is NaN or infinite; nothing is changed.
        """
        if error_rate is None:
            error_rate = 0.0 if self._error is None else (error - self._error) / self._period_s
        if lower is None:
            lower = -self.output_limit
        if upper is None:
            upper = self.output_limit
        rate = self._rate + self._blend * (error_rate - self._rate)
        step = self._step * error
        rest = feedforward + self.kp * error + self.kd * rate
        wanted = rest + self.integral + step
        if not (-_LARGEST < wanted < _LARGEST and -_LARGEST < lower <= upper < _LARGEST and rate - rate == 0.0):
            raise NonFiniteInput(_describe(error, error_rate, feedforward, lower, upper))
        self._rate = rate
        self._error = error
        if lower <= wanted <= upper:
            self.is_saturated = False
            self.integral += step
            return wanted
        self.is_saturated = True
        is_unwinding = (wanted > upper) == (step < 0.0)
        self._hold_integral(step if is_unwinding else 0.0, lower - feedforward, upper - feedforward)
        return upper if wanted > upper else lower

    def _hold_integral(self, step: float, lower: float, upper: float) -> None:
        """Integrate only if it unwinds, then clamp the integral to what the limits leave beside the feed-forward.

        The bounds include zero: the integral need not oppose feed-forward beyond a limit.
        """
        self.integral = min(max(self.integral + step, min(lower, 0.0)), max(upper, 0.0))

    def reset(self, output: float = 0.0, error: float = 0.0, feedforward: float = 0.0, error_rate: float = 0.0) -> None:
        """Start bump-less: the next update with these same inputs returns `output` (plus one step of ki).

        Without integral action (ki = 0) nothing could hold a bias, and the integral becomes zero.

        Raises:
            NonFiniteInput: any input is NaN or infinite; nothing is changed.
        """
        bias = output - feedforward - self.kp * error - self.kd * error_rate
        if not -_LARGEST < bias < _LARGEST:
            raise NonFiniteInput(_describe(error, error_rate, feedforward, output, output))
        self._rate, self._error, self.is_saturated = error_rate, error, False
        self.integral = bias if self.ki > 0.0 else 0.0


def _require_sane(gains: Gains, output_limit: float, period_s: float) -> None:
    """Raise ArmError for the first invalid parameter."""
    for name, value in (*asdict(gains).items(), ("output_limit", output_limit)):
        if not 0.0 <= value < _LARGEST:
            raise ArmError(f"PID: {name} must be finite and not negative, got {value}")
    if not 0.0 < period_s < _LARGEST:
        raise ArmError(f"PID: period_s must be positive, got {period_s}")


def _describe(error: float, error_rate: float, feedforward: float, lower: float, upper: float) -> str:
    """Message with every input, so that the log shows the invalid one."""
    return (
        f"PID: expected finite inputs, got error {error}, error rate {error_rate},"
        f" feed-forward {feedforward}, limits {lower} to {upper}; the output was not changed"
    )


class TorqueModel(Protocol):
    """Feed-forward joint torques in N m for angles, speeds and accelerations, with what the last link carries.

    `motors`: the set-point of the encoders, if it differs from the joints'.
    """

    def __call__(
        self,
        q_rad: Sequence[float],
        speed_rad_s: Sequence[float],
        acceleration_rad_s2: Sequence[float],
        motors: SetPoint | None = None,
        /,
    ) -> Sequence[float]: ...


class GainShares(Protocol):
    """Scale of each joint's gains in a pose; `unknown` if the pose is not known."""

    @property
    def unknown(self) -> Sequence[float]: ...

    def __call__(self, q_rad: Sequence[float]) -> Sequence[float]: ...


class Servo:
    """The controllers of all joints.

    After an update, one entry a joint: `output` in the unit of its mode, `feedforward_V` for POSITION mode, `volts` commanded or
    implied. `model_A` holds the currents that the model expects, None if nothing is controlled or the pose is not known.
    """

    def __init__(
        self,
        modes: Sequence[OutputMode],
        motors: Sequence[Motor],
        pids: Sequence[Pid],
        torque_model: TorqueModel,
        period_s: float,
        gain_shares: GainShares | None = None,
    ) -> None:
        """`modes`: of each joint. `gain_shares`: scales of the PID gains, by pose; full gains if None."""
        self.modes = tuple(modes)
        self._gain_shares = gain_shares
        self.output = [0.0] * len(motors)
        self.feedforward_V = [0.0] * len(motors)
        self.volts = [0.0] * len(motors)
        self.model_A: list[float] | None = None
        self._motors = motors
        self._pids = pids
        self.torque_model = torque_model
        self._share = 1.0  # of the model's torque that is fed forward to the joints in POSITION mode
        self._fade_step = period_s / FADE_S
        self._no_torque = tuple(0.0 for _ in motors)
        self._all = tuple(1.0 for _ in motors)

    def reset(self) -> None:
        """Reset integrals and filters: the next update starts bump-less from the feed-forward alone."""
        self._share = 1.0
        for pid in self._pids:
            pid.reset()

    def learn_pose(self) -> None:
        """The pose has become known: the feed-forward takes over the weight from the integrals.

        Integrals of this loop are reset at once; those on the boards cannot be, so there the feed-forward fades in.
        """
        self.reset()
        if OutputMode.POSITION in self.modes:
            self._share = 0.0

    def silence(self) -> None:
        """Zero all outputs, for modes without control."""
        for joint in range(len(self.output)):
            self.output[joint] = self.feedforward_V[joint] = self.volts[joint] = 0.0
        self.model_A = None

    def update(
        self,
        set_point: SetPoint,
        measured: JointState,
        knows_pose: bool,
        current_fraction: float = 1.0,
        joints: SetPoint | None = None,
    ) -> None:
        """Run one cycle. Without a known pose (before homing), the integral compensates gravity.

        `current_fraction` scales the current limit, so that homing uses little force. `set_point` is the encoders'; `joints`
        is that of the joints if the model distinguishes the two.
        """
        torque_Nm = self._torque_Nm(set_point, joints) if knows_pose else self._no_torque
        q_rad, speed_rad_s = measured.q_rad, measured.speed_rad_s
        shares = self._shares(q_rad, knows_pose)
        model_A: list[float] = []
        output, commanded_V = self.output, self.volts
        goals = zip(self._motors, self.modes, torque_Nm, set_point.q_rad, set_point.speed_rad_s, strict=True)
        for joint, (motor, mode, joint_Nm, goal_rad, goal_rad_s) in enumerate(goals):
            resistance_ohm, volts_per_rad_s = motor.resistance_ohm, motor.volts_per_rad_s
            amperes = joint_Nm * motor.amperes_per_Nm
            model_A.append(amperes)
            volts = amperes * resistance_ohm + volts_per_rad_s * goal_rad_s
            if mode is _POSITION:
                output[joint] = goal_rad
                self.feedforward_V[joint] = commanded_V[joint] = min(max(volts, -motor.supply_V), motor.supply_V)
                continue
            share, here_rad_s = shares[joint], speed_rad_s[joint]
            error, error_rate = share * (goal_rad - q_rad[joint]), share * (goal_rad_s - here_rad_s)
            limit_A = motor.current_limit_A * current_fraction
            back_emf_V = volts_per_rad_s * here_rad_s
            if mode is _CURRENT:
                amperes = self._pids[joint].update(error, error_rate, amperes, -limit_A, limit_A)
                output[joint] = amperes
                commanded_V[joint] = amperes * resistance_ohm + back_emf_V
                continue
            lower, upper = voltage_range(motor.supply_V, limit_A, resistance_ohm, back_emf_V)
            output[joint] = commanded_V[joint] = self._pids[joint].update(error, error_rate, volts, lower, upper)
        self.model_A = model_A if knows_pose and self._share == 1.0 else None

    def _torque_Nm(self, set_point: SetPoint, joints: SetPoint | None) -> Sequence[float]:
        """The feed-forward torque, faded in if the boards' integrals carried the weight before."""
        model = self.torque_model
        torque_Nm = model(*set_point) if joints is None else model(*joints, set_point)
        if self._share < 1.0:
            self._share = min(1.0, self._share + self._fade_step)
            torque_Nm = [
                self._share * torque if mode is OutputMode.POSITION else torque
                for torque, mode in zip(torque_Nm, self.modes, strict=True)
            ]
        return torque_Nm

    def _shares(self, q_rad: Sequence[float], knows_pose: bool) -> Sequence[float]:
        if self._gain_shares is None:
            return self._all
        return self._gain_shares(q_rad) if knows_pose else self._gain_shares.unknown


class MotionTorque:
    """The torques of one arm; `loads` may change at run time."""

    def __init__(self, arm: Arm, loads: Loads) -> None:
        """MissingModel if arm.toml lacks masses."""
        self._known = torque_model(without_tool_mass(arm))
        self._loads = loads
        self._rotor_kg_m2 = tuple(d.gear_ratio**2 * d.rotor_inertia_kg_m2 for d in arm.drives)

    def __call__(
        self,
        q_rad: Sequence[float],
        speed_rad_s: Sequence[float],
        acceleration_rad_s2: Sequence[float],
        motors: SetPoint | None = None,
        /,
    ) -> Sequence[float]:
        """Torques in N m.

        `motors` is their own set-point if it differs from the joints': it determines rotor inertia and cogging.
        """
        known: Sequence[float] = self._known(q_rad, speed_rad_s, acceleration_rad_s2, None if motors is None else motors.q_rad)
        if motors is not None:
            parts = zip(known, self._rotor_kg_m2, motors.acceleration_rad_s2, acceleration_rad_s2, strict=True)
            known = [torque + inertia * (motor - joint) for torque, inertia, motor, joint in parts]
        carried = self._loads.torques(q_rad, speed_rad_s, acceleration_rad_s2)
        return known if carried is None else [k + c for k, c in zip(known, carried, strict=True)]


# Hand guiding with gravity compensation: gravity torque as current, some damping, nothing else.
#
# Position is not controlled, so the arm stays where it is left only as well as the masses are known; friction helps.
# Errors in masses or payload show as drift, which the damping keeps slow and the speed limit ends.

CURRENT_FRACTION = 0.5  # of the limit: the reference arm's weight needs a quarter of it
DAMPING_Nm_s_rad = 4.0  # 4 N at 0.5 m from the axis and 0.5 rad/s
FASTEST_rad_s = 1.0  # of a hand-guided joint; faster is a fault

REMEDY = {
    True: "guide it slower; if nobody guided it, check masses and payload, or guide with the drives off",
    False: "guide it slower, and hold it before the drives are off",
}


class GravityCompensation:
    """Motor currents of all joints during hand guiding."""

    def __init__(
        self, motors: Sequence[Motor], torque_model: TorqueModel, joint_names: Sequence[str], free_limits_rad_s: Sequence[float]
    ) -> None:
        """`free_limits_rad_s`: of joints with open circuits, which a hand moves faster."""
        self._limits = {True: [FASTEST_rad_s] * len(motors), False: list(free_limits_rad_s)}
        self._motors = motors
        self._torque_model = torque_model
        self._names = joint_names
        self._rest = tuple(0.0 for _ in motors)
        self.amperes = [0.0] * len(motors)

    def update(self, q_rad: Sequence[float], speed_rad_s: Sequence[float]) -> list[float]:
        """Return the currents [A] for joint angles and measured speeds, within half of the limits."""
        torque_Nm = self._torque_model(q_rad, self._rest, self._rest)
        for joint, motor in enumerate(self._motors):
            wanted_Nm = torque_Nm[joint] - DAMPING_Nm_s_rad * speed_rad_s[joint]
            most_A = CURRENT_FRACTION * motor.current_limit_A
            self.amperes[joint] = min(max(wanted_Nm * motor.amperes_per_Nm, -most_A), most_A)
        return self.amperes

    def too_fast(self, speed_rad_s: Sequence[float], is_weightless: bool) -> Fault | None:
        """A fault for a joint that moves too fast for hand guiding: it falls, or is carried away."""
        for name, speed, limit in zip(self._names, speed_rad_s, self._limits[is_weightless], strict=True):
            if not abs(speed) <= limit:
                return Fault(
                    "guided_too_fast",
                    name,
                    f"it moves at {speed:.2f} rad/s during hand guiding (limit {limit:.2f} rad/s)",
                    REMEDY[is_weightless],
                    Reaction.BRAKE,
                )
        return None
