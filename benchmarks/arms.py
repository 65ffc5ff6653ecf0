"""Serial arms of two to seven joints beside the reference arm: both DH conventions, with and without home switches.

Light links that the reference arm's drives can hold; the same table, camera and boards. Encoders of absolute zero (no home
switches) on all but the arm of four joints.
"""

from collections.abc import Sequence
from dataclasses import replace
from math import pi

import numpy as np

from control.kinematics import rotation
from control.kinematics.kinematics import ForwardKinematics, PoseKinematics
from control.kinematics.pose_inverse import TipPose
from control.model.arm import Arm, CanBus, Convention, EncoderBoardPort, Home, Limits, Link, Rest, Tool
from control.model.description import load_arm
from control.motion.waypoints import Waypoints

RIGHT = load_arm("right")
_BOARD = {"port": "/dev/serial/by-id/usb-armwright-encoders"}
Row = tuple[float, float, float, float]  # d_m, theta_rad, L_m, alpha_rad


def arm_of(
    name: str,
    rows: Sequence[Row],
    convention: Convention,
    rest_rad: Sequence[float],
    tool_m: tuple[float, float, float] = (0.0, 0.0, 0.0),
    homes: bool = False,
) -> Arm:
    """A whole arm: every joint with a drive like the reference arm's first, 5.2 rad of travel."""
    links = tuple(Link("revolute", *row, *_body(row, convention, rows[k + 1 : k + 2])) for k, row in enumerate(rows))
    drives = tuple(
        replace(
            RIGHT.drives[0],
            joint=j,
            motor_node=j,
            encoder_board=(j - 1) // 3,
            encoder_channel=(j - 1) % 3,
            home=Home(0.1, 0.1314159) if homes else None,
        )
        for j in range(1, len(rows) + 1)
    )
    boards = tuple(EncoderBoardPort(f"encoders {k + 1}", f"{_BOARD['port']}-{k + 1}") for k in range((len(rows) + 2) // 3))
    return replace(
        RIGHT,
        name=name,
        links=links,
        dh_convention=convention,
        drives=drives,
        encoder_boards=boards,
        can=CanBus("socketcan", "can0"),
        tool=Tool(tool_m),
        rest=Rest(tuple(rest_rad)),
        limits=Limits(),
        path=None,
    )


def _body(
    row: Row, convention: Convention, after: Sequence[Row]
) -> tuple[float, tuple[float, float, float], tuple[float, float, float]]:
    """Mass, centre of mass and inertia of a link: a slim rod of 1.2 kg/m along its length, 0.3 kg at least."""
    d, _, length, _ = row
    if convention == "modified":  # the rod leads to the next frame: x by its L, then by its d along the turned z
        following = after[0] if after else (0.0, 0.0, 0.0, 0.0)
        com = (0.5 * following[2], 0.0, 0.0)
        span = abs(following[2]) + 0.5 * abs(following[0])
    else:
        com = (-0.5 * length, 0.0, 0.0)
        span = abs(length) + 0.5 * abs(d)
    mass = max(0.3, 1.2 * span)
    moment = max(mass * span**2 / 12.0, 4e-4)
    return mass, com, (moment, moment, moment)


TWO = arm_of("two", [(0.2, 0.0, 0.0, pi / 2), (0.0, 0.0, 0.3, 0.0)], "standard", (0.2, 0.9))
FOUR = arm_of(
    "four",
    [(0.2, 0.0, 0.0, pi / 2), (0.0, 0.0, 0.32, 0.0), (0.0, 0.0, 0.26, 0.0), (0.0, 0.0, 0.1, 0.0)],
    "standard",
    (0.0, 1.3, -1.5, -0.9),
    homes=True,
)
FIVE = arm_of(
    "five",
    [(0.2, 0.0, 0.0, pi / 2), (0.0, 0.0, 0.32, 0.0), (0.0, 0.0, 0.26, 0.0), (0.0, pi / 2, 0.0, pi / 2), (0.1, 0.0, 0.0, 0.0)],
    "standard",
    (0.0, 1.3, -1.5, -0.9, 0.1),
)
SIX = arm_of(
    "six",
    [
        (0.3, 0.0, 0.0, 0.0),
        (0.0, 0.0, 0.0, pi / 2),
        (0.0, 0.0, 0.35, 0.0),
        (0.32, 0.0, 0.02, pi / 2),
        (0.0, 0.0, 0.0, -pi / 2),
        (0.08, 0.0, 0.0, pi / 2),
    ],
    "modified",
    (0.0, 1.3, -0.3, 0.1, 0.9, 0.0),
    tool_m=(0.0, 0.0, 0.05),
)
SEVEN = arm_of(
    "seven",
    [
        (0.3, 0.0, 0.0, 0.0),
        (0.0, 0.0, 0.0, -pi / 2),
        (0.3, 0.0, 0.0, pi / 2),
        (0.0, 0.0, 0.0, pi / 2),
        (0.3, 0.0, 0.0, -pi / 2),
        (0.0, 0.0, 0.0, -pi / 2),
        (0.1, 0.0, 0.0, pi / 2),
    ],
    "modified",
    (0.0, 0.5, 0.1, -1.4, 0.1, 1.0, 0.0),
)
ARMS = {arm.name: arm for arm in (TWO, FOUR, FIVE, SIX, SEVEN)}


def arm_named(name: str) -> Arm:
    """One of these, an arm that ships, or that of an arm.toml."""
    return ARMS[name] if name in ARMS else load_arm(name)


# Way-points around where an arm rests.


def tip_of(arm: Arm) -> TipPose:
    """Position and orientation of the tip in the rest pose."""
    assert arm.rest is not None
    tip = PoseKinematics(ForwardKinematics(arm)).batch([arm.rest.q_rad])
    return TipPose.of(tip.position_m[0], rotation.quaternions(tip.rotation)[0])


def circle_in_place(arm: Arm, radius_m: float = 0.05, tilt_rad: float | None = None, points: int = 12) -> Waypoints:
    """A level circle that begins where the tip rests; the orientation is free, or rocks by `tilt_rad` on the way."""
    here = tip_of(arm)
    turn = np.linspace(0.0, 2.0 * np.pi, points + 1)
    around = radius_m * np.column_stack((np.cos(turn) - 1.0, np.sin(turn), 0.0 * turn)) + here.position_m
    orientations = None
    if tilt_rad is not None:
        rocked = tilt_rad * np.column_stack((0.0 * turn, np.sin(turn), 0.5 * np.sin(turn)))
        at = rotation.matrices(np.array([here.orientation]))
        turned = rotation.quaternions(rotation.exponentials(rocked) @ at)
        orientations = tuple(rotation.checked_quaternion(q) for q in turned)
    return Waypoints(tuple((float(x), float(y), float(z)) for x, y, z in around), None, (), orientations)


def turned_in_place(arm: Arm, angle_rad: float) -> Waypoints:
    """Turn about y in place, then back while the tip moves 10 mm."""
    here = tip_of(arm)
    assert here.orientation is not None
    at = rotation.matrices(np.array([here.orientation]))
    turned = rotation.quaternions(rotation.exponentials(np.array([[0.0, angle_rad, 0.0]])) @ at)[0]
    x, y, z = here.position_m
    orientations = (here.orientation, rotation.checked_quaternion(turned), here.orientation)
    return Waypoints(((x, y, z), (x, y, z), (x + 0.01, y, z)), None, (), orientations)
