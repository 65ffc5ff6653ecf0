"""One record: wait until the arm is at rest, average, measure with the camera."""

from __future__ import annotations

from dataclasses import dataclass

from calib.points.writer import Record
from calib.session.moves import ArmPort, Camera, Vector
from calib.session.plan import Target
from calib.session.standstill import wait_for_rest


@dataclass(frozen=True, slots=True)
class SessionSettings:
    """Settings for recording a point. The defaults suit encoders of some 0.03 mrad at the joint."""

    approach_m: float = 0.06  # an uncalibrated arm of half a metre is some 3 cm off
    still_limit_rad: float = 1e-4
    still_s: float = 0.1
    patience_s: float = 10.0
    window_s: float = 0.02
    average_s: float = 0.1
    payload_kg: float = 0.0


def take(
    target: Target,
    tip_m: Vector | None,
    arm: ArmPort,
    how: SessionSettings,
    camera: Camera | None,
    clock_offset_s: float = 0.0,
) -> Record:
    """Record the target at the arm's present pose; its tip is the camera's measurement, else tip_m.

    SessionError if the arm does not come to rest.
    """
    wait_for_rest(arm, how.still_limit_rad, how.still_s, how.patience_s, how.window_s)
    t_s = arm.now_s() + clock_offset_s
    sample = arm.average(how.average_s)
    seen = camera.measure(how.average_s) if camera is not None else None
    return Record(
        target.setup,
        target.point,
        target.repeat,
        sample.q_rad,
        sample.q_sd_rad,
        sample.direction,
        sample.current_A,
        t_s,
        how.payload_kg,
        tip_m if seen is None else seen.tip_m,
        sample.temperature_C,
        target.approach,
        orientation=None if seen is None else seen.orientation,
    )
