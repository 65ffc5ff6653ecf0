"""Values that no arm should have together: a file in degrees, grams or millimetres.

Rules look at one value (`control.model.rules`); these look at what the arm itself says of it. The factors leave room for every
real arm: a mass in grams is a thousand times too heavy, an angle in degrees 57 times too large. Constants on the joint's side,
with a gear ratio of 1, are as good as the motor's. These are guesses, and the file moves an arm: `as_given = true` in it
overrides them.
"""

import math
from typing import Final

from control.model.arm import Arm, Drive
from control.model.reader import Rejected
from control.model.rules import Rule

TOO_FAST: Final = 10.0  # times the speed without load: joints are limited to a fraction of it
TOO_QUICK: Final = 10.0  # times what the motor can give its own rotor
TOO_SLOW_rad_s2: Final = 0.01  # with all its torque on its rotor alone: the rotor's inertia is no motor's
TOO_HEAVY: Final = 50.0  # times what the strongest joint holds stretched; with balancing springs, arms reach 3
TOO_DENSE_kg_m3: Final = 5000.0  # mass over the cube of reach: 10 to 400 for arms, from hobby to industrial
LEAST_REACH_m: Final = 0.1  # below it, the mass is that of the joints and says nothing
UPRIGHT_rad: Final = 0.1  # an axis nearer than this to gravity's direction lifts next to nothing
LARGEST_GYRATION_m: Final = 5.0  # root of inertia over mass; kg mm^2 for kg m^2 makes it 1000 times larger
FARTHEST_FRAME_m: Final = 100.0  # of a tracker from the arm: they measure up to 80 m
OVERRIDE: Final = "write as_given = true beside the arm's name"
GRAVITY_m_s2: Final = 9.81
_RAD_PER_DEG: Final = math.pi / 180


def check_plausible(arm: Arm) -> None:
    """Raise Rejected for the first value that looks a unit off."""
    for index, effect in enumerate(arm.effects):
        for name, value in effect.parameters.items():
            _check_parameter(("effect", index, "parameters", name), effect.effect, name, value)
    for index, drive in enumerate(arm.drives):
        _check_home_speed(drive, index)
    if arm.as_given:
        return
    for index, drive in enumerate(arm.drives):
        _check_rotor(drive, index)
        _check_speed(drive, index)
        _check_acceleration(drive, index)
    _check_inertia(arm)
    _check_masses(arm)


def _refused(path: tuple[str | int, ...], value: float, expected: str, unit: str, factor: float) -> Rejected:
    rule = Rule(expected, lambda _: False, "", unit, factor)
    return Rejected(path, expected, f"{value:g}", rule.remedy(value))


def _doubted(path: tuple[str | int, ...], value: float, expected: str, unit: str, factor: float) -> Rejected:
    """A refusal that rests on other values of the file, which may be what is wrong."""
    refusal = _refused(path, value, expected, unit, factor)
    refusal.hint += f"; if all values are meant as they stand, {OVERRIDE}"
    return refusal


def _check_rotor(drive: Drive, index: int) -> None:
    rotor = drive.gear_ratio * drive.gear_ratio * drive.rotor_inertia_kg_m2
    most = drive.torque_limit_Nm / rotor if rotor > 0.0 else math.inf
    if most < TOO_SLOW_rad_s2:
        expected = f"an inertia that its motor can turn (its joint would gain {most:.2g} rad/s each second)"
        path = ("drive", index, "rotor_inertia_kg_m2")
        raise _doubted(path, drive.rotor_inertia_kg_m2, expected, "g cm^2", 1e-7)


def _check_speed(drive: Drive, index: int) -> None:
    free_rad_s = drive.supply_V / (drive.torque_constant_Nm_A * drive.gear_ratio)
    limit = drive.joint_speed_limit_rad_s
    if math.isfinite(limit) and limit > TOO_FAST * free_rad_s:
        expected = f"a speed in rad/s that its motor can reach ({free_rad_s:.3g} rad/s without load)"
        path = ("drive", index, "joint_speed_limit_rad_s")
        raise _doubted(path, limit, expected, "degrees per second", _RAD_PER_DEG)


def _check_home_speed(drive: Drive, index: int) -> None:
    limit = drive.joint_speed_limit_rad_s
    if drive.home is not None and drive.home.speed_rad_s > limit:
        expected = f"a speed in rad/s up to joint_speed_limit_rad_s, {limit:g}"
        path = ("drive", index, "home")
        unit = "degrees per second"
        raise _refused((*path, "speed_rad_s"), drive.home.speed_rad_s, expected, unit, _RAD_PER_DEG)


def _check_acceleration(drive: Drive, index: int) -> None:
    limit = drive.joint_acceleration_limit_rad_s2
    rotor = drive.gear_ratio * drive.gear_ratio * drive.rotor_inertia_kg_m2  # `**` raises where this is infinite
    if not math.isfinite(limit) or rotor == 0.0:
        return
    most = drive.torque_limit_Nm / rotor
    if limit > TOO_QUICK * most:
        expected = f"an acceleration in rad/s^2 that its motor can give its rotor alone ({most:.3g})"
        path = ("drive", index, "joint_acceleration_limit_rad_s2")
        raise _doubted(path, limit, expected, "degrees per s^2", _RAD_PER_DEG)


def _check_parameter(path: tuple[str | int, ...], effect: str, name: str, value: float) -> None:
    """An effect's lengths and angles are small: errors of parts. A frame's place is none of them: a tracker stands apart."""
    farthest_m = FARTHEST_FRAME_m if effect == "base_frame" else 1.0
    if name.endswith("_m") and abs(value) > farthest_m:
        raise _refused(path, value, f"a length within +-{farthest_m:g} m", "millimetres", 1e-3)
    if name.endswith("_rad") and "Nm" not in name and abs(value) > 2.0 * math.pi:
        raise _refused(path, value, "an angle within +-2 pi rad", "degrees", _RAD_PER_DEG)


def _check_inertia(arm: Arm) -> None:
    for index, link in enumerate(arm.links):
        if link.inertia_kg_m2 is None or not link.mass_kg:
            continue
        largest = max(link.inertia_kg_m2)
        if math.sqrt(largest / link.mass_kg) > LARGEST_GYRATION_m:
            most = LARGEST_GYRATION_m**2 * link.mass_kg
            expected = f"moments in kg m^2 below {most:.3g} for its mass_kg of {link.mass_kg:g}"
            path = ("link", index, "inertia_kg_m2")
            raise _doubted(path, largest, expected, "kg mm^2 (or the mass is not in kg)", 1e-6)


def _check_masses(arm: Arm) -> None:
    """The heaviest link is named; what the arm weighs is compared with its motors, or without any with its size."""
    lifted = arm.links[_column(arm) :]
    reach_m = sum(abs(k.L_m) + abs(k.d_m) for k in lifted) + math.hypot(*arm.tool.position_m)
    total_kg = sum(k.mass_kg or 0.0 for k in lifted)
    strongest_Nm = max((drive.torque_limit_Nm for drive in arm.drives), default=0.0)
    if len(arm.drives) == arm.joint_count:
        is_too_heavy = 0.5 * total_kg * GRAVITY_m_s2 * reach_m > TOO_HEAVY * strongest_Nm
        what = f"the strongest joint gives {strongest_Nm:.3g} N m"
    else:
        is_too_heavy = total_kg > TOO_DENSE_kg_m3 * reach_m**3 and reach_m > LEAST_REACH_m
        what = f"the arm is {reach_m:.2g} m long"
    if is_too_heavy:
        masses = [k.mass_kg or 0.0 for k in lifted]
        heaviest = len(arm.links) - len(lifted) + masses.index(max(masses))
        expected = f"a mass in kg ({what}; the links weigh {total_kg:.4g} kg together)"
        raise _doubted(("link", heaviest, "mass_kg"), max(masses), expected, "grams", 1e-3)


def _column(arm: Arm) -> int:
    """How many rows of the table turn about gravity's own direction alone: no joint lifts them. 0 if the base is tilted."""
    x, y, z = arm.gravity_m_s2
    if len(arm.drives) < arm.joint_count or math.hypot(x, y) > UPRIGHT_rad * abs(z):
        return 0
    tilt_rad = 0.0  # of the row's axis
    for row, link in enumerate(arm.links):
        tilt_rad += link.alpha_rad if arm.dh_convention == "modified" else 0.0
        if link.joint == "revolute" and abs(math.sin(tilt_rad)) > UPRIGHT_rad:
            return row
        tilt_rad += link.alpha_rad if arm.dh_convention == "standard" else 0.0
    return len(arm.links)
