"""Tables `[limits]` and `[recording]` of an arm.toml (see `control.model.arm`)."""

from dataclasses import dataclass
from typing import Annotated, Literal

from control.model.drive import NonNegative, Positive
from control.model.rules import (
    BOARD_SIZE,
    CLEARANCE,
    FOLLOWING,
    HEIGHT,
    JOINT_SPEED,
    LAG,
    PAYLOAD,
    ROTATE_BYTES,
    SHARE_ABOVE_1,
    SHARE_BELOW_1,
    STALE,
    TIP_SPEED,
    WATCHDOG,
    ZERO_OR_MORE,
)


@dataclass(frozen=True, slots=True)
class Limits:
    """Limits that the loop enforces (docs/safety.md)."""

    tip_speed_m_s: Annotated[Positive, TIP_SPEED, "of the tip, in plans"] = 1.0
    tip_turn_speed_rad_s: Annotated[Positive, JOINT_SPEED, "of the tip's orientation, in plans"] = 2.0
    tip_turn_acceleration_rad_s2: Annotated[Positive, "of the tip's orientation, in plans"] = 20.0
    following_error_rad: Annotated[float, FOLLOWING, "largest error of a joint at rest"] = 0.05
    following_error_per_speed_s: Annotated[
        float, LAG, "this much more with every rad/s of set-point speed; dies away in this time"
    ] = 0.05
    floor_z_m: Annotated[float, HEIGHT, "height in the base frame that the arm stays above"] = 0.0
    floor_clearance_m: Annotated[NonNegative, CLEARANCE, "distance kept from the floor"] = 0.0
    floor_tolerance_m: Annotated[NonNegative, CLEARANCE, "error of the model before calibration"] = 0.01
    base_radius_m: Annotated[
        NonNegative, BOARD_SIZE, "of the arm's own base about axis 1, up to joint 2; 0: not checked"
    ] = 0.0
    watchdog_s: Annotated[
        float,
        WATCHDOG,
        "a board without commands for this long goes to FAULT; hosts pause for 40 to 170 ms",
    ] = 0.2
    stale_s: Annotated[float, STALE, "an older value is a fault"] = 0.02
    jog_tip_speed_m_s: Annotated[
        Positive, TIP_SPEED, "reduced speed for people beside the arm (ISO 10218-1)"
    ] = 0.25
    payload_limit_kg: Annotated[NonNegative, PAYLOAD, "largest that a client may state"] = 5.0
    jog_silence_s: Annotated[
        Positive, "a jog that is not renewed for this long comes to rest; at most 0.5"
    ] = 0.2
    speed_contradiction_rad_s: Annotated[
        Positive, JOINT_SPEED, "between motor and encoder, at rest (docs/safety.md)"
    ] = 0.02
    transmission_slack_rad: Annotated[
        NonNegative,
        "play and springs between motor and joint: by so much they may differ, where an encoder is on the joint",
    ] = 0.05
    unexplained_torque: Annotated[Positive, "share of the torque at the current limit (docs/safety.md)"] = 0.3
    supply_low: Annotated[float, SHARE_BELOW_1, "of the drive's supply_V"] = 0.75
    supply_high: Annotated[float, SHARE_ABOVE_1, "of the drive's supply_V"] = 1.4
    temperature_degC: Annotated[Positive, "of a power stage; boards also trip at their own rating"] = 95.0


@dataclass(frozen=True, slots=True)
class RecordingPolicy:
    """Size of recordings, and what happens while the disk takes none."""

    rotate_bytes: Annotated[int, ROTATE_BYTES, "size at which a new file begins"] = 500_000_000
    keep_bytes: Annotated[
        int,
        ZERO_OR_MORE,
        "above this total the oldest recordings of this arm are removed; 0: none is ever removed; at least"
        " twice rotate_bytes",
    ] = 0
    unrecorded: Annotated[
        Literal["refuse", "allow"],
        'while the disk takes no rows: "refuse": no motion begins, one that runs is stopped, jogs and hand guiding are'
        ' free; "allow": motions go on',
    ] = "refuse"


USUAL_LIMITS, USUAL_RECORDING = Limits(), RecordingPolicy()
