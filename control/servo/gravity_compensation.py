"""Hand guiding with gravity compensation: gravity torque as current, some damping, nothing else.

Position is not controlled, so the arm stays where it is left only as well as the masses are known; friction helps.
Errors in masses or payload show as drift, which the damping keeps slow and the speed limit ends.
"""

from collections.abc import Sequence

from control.safety.fault import Fault, Reaction
from control.servo.servo import Motor, TorqueModel

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
        self,
        motors: Sequence[Motor],
        torque_model: TorqueModel,
        joint_names: Sequence[str],
        free_limits_rad_s: Sequence[float],
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
