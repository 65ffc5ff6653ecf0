"""Compensated motion without armwright: one Python file that turns wanted joint angles into those to command.

A program that knows the published model only asks for joint angles q. At the angles that `commanded(q)` returns, the tip of this
arm is where the published model has its tip at q: the least change of the joints that does it, by Newton's method with damping,
dq = J^T (J J^T + damping)^-1 (wanted - tip). Near singular poses it would take wide turns; there no joint leaves what was wanted
by more than 0.2 rad, and the tip stays short. Encoder scale and eccentricity are taken out last. Orientation follows as it comes.
"""

from __future__ import annotations

from collections.abc import Iterator

from calib.errors import CalibrationError
from control.model.arm import Arm

CORRECTED = ("encoder_scale", "encoder_eccentricity")
CODE = '''
from math import cos, sin

DAMPING_m2, STEPS = 1e-6, 6
FURTHEST_rad = 0.2  # that a joint is moved: beyond it the pose is singular


def commanded(wanted_rad):
    """Joint angles [rad] to command, so that the tip goes where the published model has it at `wanted_rad`."""
    target, _ = _tip(PUBLISHED, PUBLISHED_TOOL_m, PUBLISHED_IS_MODIFIED, wanted_rad)
    joints = list(wanted_rad)
    for _ in range(STEPS):
        tip, columns = _tip(ARM, TOOL_m, IS_MODIFIED, joints)
        gram = [[sum(c[i] * c[k] for c in columns) + DAMPING_m2 * (i == k) for k in range(3)] for i in range(3)]
        pull = _solved(gram, [a - b for a, b in zip(target, tip)])
        moved = [q + sum(a * b for a, b in zip(c, pull)) for q, c in zip(joints, columns)]
        joints = [min(max(q, w - FURTHEST_rad), w + FURTHEST_rad) for q, w in zip(moved, wanted_rad)]
    return [_encoder_rad(q, *error) for q, error in zip(joints, ENCODERS)]


def _encoder_rad(joint_rad, scale, amplitude_rad, phase_rad):
    """What the encoder says there: joint = (1 + scale) encoder + amplitude sin(encoder + phase)."""
    encoder_rad = joint_rad
    for _ in range(STEPS):
        encoder_rad = (joint_rad - amplitude_rad * sin(encoder_rad + phase_rad)) / (1.0 + scale)
    return encoder_rad


def _tip(rows, tool_m, is_modified, joints):
    """The tip [m] in the base frame, and how it moves with each joint [m/rad]."""
    x, y, z, origin = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (0.0, 0.0, 0.0)
    angles, axes = iter(joints), []
    for turns, d, theta, length, alpha in rows:
        angle = theta + next(angles) if turns else theta
        if is_modified:
            y, z = _turned(y, z, alpha)
            origin = _moved(_moved(origin, x, length), z, d)
        if turns:
            axes.append((z, origin))
        x, y = _turned(x, y, angle)
        if not is_modified:
            origin = _moved(_moved(origin, z, d), x, length)
            y, z = _turned(y, z, alpha)
    for axis, by in zip((x, y, z), tool_m):
        origin = _moved(origin, axis, by)
    return origin, [_cross(axis, [a - b for a, b in zip(origin, place)]) for axis, place in axes]


def _turned(a, b, angle):
    """Two axes of a frame after a turn about the third."""
    c, s = cos(angle), sin(angle)
    return [c * p + s * q for p, q in zip(a, b)], [c * q - s * p for p, q in zip(a, b)]


def _moved(place, axis, by):
    return [p + by * a for p, a in zip(place, axis)]


def _cross(a, b):
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


def _solved(m, right):
    """x of m x = right, for three unknowns."""
    adjugate = [_cross(m[1], m[2]), _cross(m[2], m[0]), _cross(m[0], m[1])]
    scale = 1.0 / sum(a * b for a, b in zip(m[0], adjugate[0]))
    return [scale * sum(adjugate[k][i] * right[k] for k in range(3)) for i in range(3)]
'''


def python_text(arm: Arm, published: Arm) -> str:
    """The file. CalibrationError if the two have other joints."""
    if arm.joint_count != published.joint_count:
        raise CalibrationError(
            f"arm {published.name} is another arm than {arm.name}: {published.joint_count} joints instead of {arm.joint_count}"
        )
    names = ", ".join(map(_plain, arm.joint_names))
    head = (
        f'"""Arm {_plain(arm.name)}: joint angles to command for those that a program plans with {_plain(published.name)}.\n\n'
        f'Written by armwright; needs Python alone. Lengths in m, angles in rad; joints from the base on: {names}.\n"""\n'
    )
    return head + CODE + "\n\n" + "\n".join(_values(arm, published)) + "\n"


def omitted(arm: Arm) -> tuple[str, ...]:
    """A sentence for what the file leaves out."""
    others = [effect for effect in arm.effects if effect.effect not in CORRECTED]
    names = sorted({effect.effect for effect in others})
    sentences = (
        (f"python corrects geometry, scale and eccentricity; not {', '.join(names)}",) if names else ()
    )
    return (*sentences, "python has no maps: omitted") if arm.maps else sentences


def _values(arm: Arm, published: Arm) -> Iterator[str]:
    for called, one in (("PUBLISHED", published), ("ARM", arm)):
        yield f"{called} = [  # turns, d, theta, L, alpha"
        for link in one.links:
            row = (link.joint == "revolute", link.d_m, link.theta_rad, link.L_m, link.alpha_rad)
            yield f"    {row!r},"
        yield "]"
    yield f"PUBLISHED_TOOL_m, TOOL_m = {published.tool.position_m!r}, {arm.tool.position_m!r}"
    yield f"PUBLISHED_IS_MODIFIED, IS_MODIFIED = {published.dh_convention == 'modified'}, {arm.dh_convention == 'modified'}"
    errors = {
        (effect.joint, key): value
        for effect in arm.effects
        if effect.effect in CORRECTED
        for key, value in effect.parameters.items()
    }
    yield "ENCODERS = [  # scale, amplitude, phase"
    for joint in range(1, arm.joint_count + 1):
        keys = ("scale", "amplitude_rad", "phase_rad")
        yield f"    {tuple(errors.get((joint, key), 0.0) for key in keys)!r},"
    yield "]"


def _plain(text: str) -> str:
    """A name within a docstring."""
    return "".join(c if c.isprintable() and c not in '"\\' else "_" for c in text)
