"""Feed-forward torques of a motion: rigid body, rotors, the effects of the arm's file, and what the last link carries."""

from collections.abc import Sequence

from control.dynamics.feedforward import torque_model
from control.dynamics.loads import Loads, without_tool_mass
from control.model.arm import Arm
from control.motion.setpoint import SetPoint


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
        known: Sequence[float] = self._known(
            q_rad, speed_rad_s, acceleration_rad_s2, None if motors is None else motors.q_rad
        )
        if motors is not None:
            parts = zip(
                known, self._rotor_kg_m2, motors.acceleration_rad_s2, acceleration_rad_s2, strict=True
            )
            known = [torque + inertia * (motor - joint) for torque, inertia, motor, joint in parts]
        carried = self._loads.torques(q_rad, speed_rad_s, acceleration_rad_s2)
        return known if carried is None else [k + c for k, c in zip(known, carried, strict=True)]
