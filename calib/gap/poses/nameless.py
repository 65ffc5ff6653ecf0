"""Nameless blocks: what a joint, the tip or a holding current may follow without anything of the list doing it.

In: the arm at the recorded poses and the terms that have names. Out: blocks of columns that compete with them, so that an
effect which is not in the list is noticed. None is ever reported as an effect; where one explains what is left, its words say
where. All shapes of one thing that moves, one variable and one manner are variants of one block: a joint may do more than one
of them. Beside them each block has the smooth function of its variable, columns of one unknown scale.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import combinations, combinations_with_replacement

import numpy as np

from calib.arm_problem.arm_model import ArmModel
from calib.arm_problem.link_bending import LinkFrames, link_frames
from calib.arm_problem.parallel_axes import frame_behind, parallel_joints
from calib.arrays import Array
from calib.gap.effects.record import PoseScene
from calib.gap.posterior.constants import SAME
from calib.gap.posterior.term import Block, Term, on_joint, smooth
from calib.points.points import Points
from control.model.arm import Arm

SHARE = 0.1  # of a joint's torque: the size of a block in holding currents


def blocks_of(scene: PoseScene, names: Sequence[Term]) -> tuple[Term, ...]:
    """All of them for these poses, but those that are the law of one of the `names`: what follows a law is that effect."""
    single = [one for one in (*of_the_tip(scene), *of_joints(scene)) if not is_still(one)]
    blocks = [*_without_laws(single, names), *_smooth(scene)]
    if np.isfinite(scene.points.tip_m).all():
        columns = field_of_the_tip(link_frames(ArmModel(scene.arm), scene.arm.dh, scene.points.q_rad).tip_m)
        words = "everywhere: the measured places are off by a smooth field"
        blocks.append(Term(Block(0, "place"), words, len(columns), slope_m=columns))
    if np.isfinite(scene.points.current_A).any():
        blocks += _currents(scene)
    return tuple(blocks)


def _without_laws(shapes_: list[Term], names: Sequence[Term]) -> list[Term]:
    """Without shapes of one column that are the law of a name of one, as the last direction is play where nothing hangs."""
    laws = [term.slope_rad[0] for term in names if term.laws == 1 and term.slope_rad is not None]
    tried = [k for k, term in enumerate(shapes_) if term.count == 1 and term.slope_rad is not None]
    courses = [slope[0] for k in tried if (slope := shapes_[k].slope_rad) is not None]
    if not laws or not courses:
        return shapes_
    alike = np.abs(_unit(courses) @ _unit(laws).T) > SAME
    out = {tried[k] for k in np.flatnonzero(alike.any(axis=1)).tolist()}
    return [term for k, term in enumerate(shapes_) if k not in out]


def _unit(slopes: Sequence[Array]) -> Array:
    flat = np.array([slope.ravel() for slope in slopes])
    return np.asarray(flat / np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-300))


def _smooth(scene: PoseScene) -> Iterator[Term]:
    """Any smooth function of an angle, the load, or time, for each joint; of angle and load by direction."""
    points, load = scene.points, scene.gravity_Nm
    n, time = points.joint_count, points.t_s
    has_time = bool(np.isfinite(time).all() and np.ptp(time) > 1e-9)
    for j in range(n):
        ways = [(f"q{i + 1}" if i == j else "other angles", points.q_rad[:, i], f"q{i + 1}") for i in range(n)]
        if load is not None:
            names = ["load" if i == j else "other loads" for i in range(n)]
            ways += [(names[i], load[:, i], f"the load of joint {i + 1}") for i in range(n)]
        if has_time:
            steps = np.array([np.sign(time - edge) for edge in edges(time)])
            yield smooth_of_joint(n, j, "time steps", "steps at several times", steps)
        for variable, values, what in ways:
            if np.ptp(values) > 1e-9:
                yield smooth_of_joint(n, j, variable, f"follows {what} smoothly", smooth(values))
        if has_time:
            yield smooth_of_joint(n, j, "time", "wanders with time", smooth(time))
        last, variables = points.direction[:, j], [("angle", points.q_rad[:, j])]
        variables += [] if load is None else [("load", load[:, j])]
        for what, values in variables if np.ptp(last) > 0.0 else ():
            if np.ptp(values) > 1e-9:
                both = np.concatenate((last[None], last * smooth(values)))
                yield smooth_of_joint(n, j, "direction", f"follows its last direction and its {what}", both)


def _currents(scene: PoseScene) -> Iterator[Term]:
    """The holding torque of one joint with the sine and cosine of any angle, or of sums of two."""
    q, n = scene.points.q_rad, scene.points.joint_count
    load = scene.gravity_Nm
    if load is None:
        return
    angles = [(f"q{i + 1}", q[:, i]) for i in range(n)]
    angles += [(f"q{i + 1} + q{k + 1}", q[:, i] + q[:, k]) for i, k in combinations(range(n), 2)]
    for j in range(n):
        size = SHARE * max(float(np.abs(load[:, j]).max()), 0.1)
        for name, angle in angles:
            columns = on_joint(size * np.array([np.sin(angle), np.cos(angle)]), j, n)
            words = f"the holding current of joint {j + 1} follows {name} in a way that no single load explains"
            yield Term(Block(j + 1, "current"), words, 2, slope_Nm=columns)


# Shapes of joints.

PER_TURN = "times per turn"
HARMONICS = (4, 5, 6, 7, 8, 9, 10, 12)  # per turn, of a joint's own angle
MOTOR_HARMONICS = (1.0, 2.0, 0.5)  # per motor turn
TIME_PERIODS = (0.5, 1, 1.5, 2, 3, 4, 6, 8)  # of a session


def of_joints(scene: PoseScene) -> Iterator[Term]:
    """All of them for these poses, but those that are the law of an effect: what follows a law is that effect."""
    points, gravity = scene.points, scene.gravity_Nm
    held = None if scene.pose is None else scene.pose.held_Nm
    for j in range(points.joint_count):
        yield from _of_angles(points, j)
        yield from _of_the_motor(scene.arm, points, j)
        yield from _of_direction(points, gravity, held, j)
        yield from _of_time(points, j)
        yield from _of_load(points, gravity, j)


def _of_angles(points: Points, j: int) -> Iterator[Term]:
    """Powers and harmonics of every angle, steps in it, and products of two."""
    q, n = points.q_rad, points.joint_count
    for i in range(n):
        name, angle = f"q{i + 1}", q[:, i]
        variable = name if i == j else "other angles"
        if i != j:  # of its own angle that is an encoder's scale or eccentricity
            yield of_joint(n, j, variable, f"follows {name} (linearly)", angle)
            yield of_joint(n, j, variable, f"follows the sine of {name}", *harmonic(angle, 1))
        yield of_joint(n, j, variable, f"follows the square of {name}", angle**2)
        yield of_joint(n, j, variable, f"follows the cube of {name}", angle**3)
        yield of_joint(n, j, variable, f"follows {name} twice per turn", *harmonic(angle, 2))
        orders = (3, *HARMONICS) if i == j else (3,)
        for order in orders:
            words = f"follows {name} {'three' if order == 3 else order} times per turn"
            yield of_joint(n, j, variable, words, *harmonic(angle, order), manner=PER_TURN)
        for edge in edges(angle) if i == j else ():  # other angles have their smooth functions
            words = f"steps where {name} passes {edge:.2f} rad"
            yield of_joint(n, j, variable, words, np.sign(angle - edge), manner="steps")
    for i, k in combinations(range(n), 2):
        yield of_joint(n, j, "other angles", f"follows q{i + 1} times q{k + 1}", q[:, i] * q[:, k])


def _of_the_motor(arm: Arm, points: Points, j: int) -> Iterator[Term]:
    """What comes round with the motor's shaft."""
    for drive in arm.drives:
        if drive.joint == j + 1:
            for order in MOTOR_HARMONICS:
                courses = harmonic(points.q_rad[:, j], order * drive.gear_ratio)
                words = f"follows its motor's angle {order:g} times per turn"
                yield of_joint(points.joint_count, j, f"q{j + 1}", words, *courses, manner=PER_TURN)


def _of_direction(points: Points, gravity: Array | None, held: Array | None, j: int) -> Iterator[Term]:
    """Direction of the last motion of any joint, alone, with its own angle, and with its own load."""
    n = points.joint_count
    for i in range(n):
        words = f"follows the last direction of joint {i + 1}"
        yield of_joint(n, j, "direction", words, points.direction[:, i])
    last, variable = points.direction[:, j], "direction"
    yield of_joint(n, j, variable, "follows its last direction times its angle", last * points.q_rad[:, j], last)
    if gravity is not None:
        load = np.abs(gravity[:, j])
        yield of_joint(n, j, variable, "follows its last direction, more so under load", last * load, last)
    if held is not None:  # a soft gear that friction winds up: without gravity nobody can tell its stiffness
        yield of_joint(n, j, variable, "follows the friction that its motor holds", held[:, j])


def _of_time(points: Points, j: int) -> Iterator[Term]:
    """Drifts, periods and steps in time, and what adds up with the way that the joint goes."""
    if not np.isfinite(points.t_s).all() or np.ptp(points.t_s) == 0.0:
        return
    n = points.joint_count
    time = (points.t_s - points.t_s.min()) / np.ptp(points.t_s)
    yield of_joint(n, j, "time", "drifts with time", time)
    yield of_joint(n, j, "time", "drifts with time and its square", time, time**2)
    for periods in TIME_PERIODS:
        courses = harmonic(time, 2.0 * np.pi * periods)
        yield of_joint(n, j, "time", f"swings {periods:g} times in the session", *courses, manner="swings")
    order, way = np.argsort(points.t_s, kind="stable"), np.empty(len(points))
    way[order] = np.concatenate(([0.0], np.cumsum(np.abs(np.diff(points.q_rad[order, j])))))
    yield of_joint(n, j, "time", "follows the way that it has gone", way)
    for edge in edges(points.t_s):
        yield of_joint(n, j, "time", f"steps at {edge:.0f} s", np.sign(points.t_s - edge), manner="steps")


def _of_load(points: Points, gravity: Array | None, j: int) -> Iterator[Term]:
    """Stated payload, holding currents, and the load in other ways than in proportion, which is a soft gear."""
    n = points.joint_count
    if np.isfinite(points.payload_kg).all():
        yield of_joint(n, j, "payload", "follows the payload", points.payload_kg)
    for i in range(n):
        current = points.current_A[:, i]
        if np.isfinite(current).all():
            words = f"follows the square of the current of joint {i + 1}"
            yield of_joint(n, j, "currents", words, current**2)
    if gravity is None:
        return
    load_Nm = gravity[:, j]
    yield of_joint(n, j, "load", "follows its load's size, whatever its sign", np.abs(load_Nm))
    yield of_joint(n, j, "load", "follows its load, more than in proportion", load_Nm, load_Nm * np.abs(load_Nm))
    yield of_joint(n, j, "load", "follows its load and that cubed", load_Nm, load_Nm**3)
    root = np.sign(load_Nm) * np.sqrt(np.abs(load_Nm))
    yield of_joint(n, j, "load", "follows its load, less than in proportion", root)
    yield of_joint(n, j, "load", "follows its load, softer one way", np.maximum(load_Nm, 0), np.minimum(load_Nm, 0))
    for i in range(n):
        if i != j:
            yield of_joint(n, j, "other loads", f"follows the load of joint {i + 1}", gravity[:, i])


# Shapes of the tip that are no joint's: the camera, boards that are not where they should be, axes that wobble, a loose tool.

AXES = "xyz"
ELSEWHERE = "elsewhere"
SKEWED = "axis behind joint"
RIGID_STEPS = 12  # times at which a board or camera may have moved
RECORDING_STEPS = 3  # the same within one setup
RIGID_POSES_LEAST = 4


def of_the_tip(scene: PoseScene) -> Iterator[Term]:
    """All of them, at the fitted geometry."""
    arm, points = scene.arm, scene.points
    frames = link_frames(ArmModel(arm), arm.dh, points.q_rad)
    if np.isfinite(points.tip_m).all():
        yield from _of_the_camera(frames.tip_m)
    if np.isfinite(points.orientation).any():
        yield from _of_the_target(arm, frames)
    yield from _of_setups(points, frames.tip_m)
    yield from _of_the_axes(arm, points, frames)
    yield from _of_parallel_axes(arm, frames)
    yield from _of_the_tool(arm, frames)
    if len(points) > 1:
        before = np.roll(frames.tip_m, 1, axis=0) - frames.tip_m
        before[0] = 0.0
        yield of_tip("time", "everywhere: the places lag behind, towards those of the pose before", before)


def field_of_the_tip(tip: Array) -> Array:
    """Places (m, 3) off by what is of first and second order in them, (27, m, 3).

    Without its constant part: where all places are off by the same, that is `base_frame`.
    """
    unit = _unit_places(tip)
    ways = [*unit.T, *(unit[:, a] * unit[:, b] for a in range(3) for b in range(a, 3))]
    return SIZE_m * np.array([way[:, None] * axis for way in ways for axis in np.eye(3)])


def _unit_places(tip: Array) -> Array:
    return np.asarray((tip - tip.mean(axis=0)) / max(float(np.ptp(tip, axis=0).max()), 1e-9))


def _of_the_camera(tip: Array) -> Iterator[Term]:
    """Scale, skew and distortion: what the measured place itself decides. The camera's frame and centre are unknown beside it."""
    centred, axes, unit = tip - tip.mean(axis=0), np.eye(3), _unit_places(tip)
    rigid = SIZE_m * np.array([*(np.ones((len(unit), 1)) * a for a in axes), *(np.cross(a, unit) for a in axes)])
    lower = field_of_the_tip(tip)  # beside a distortion: its lower orders

    def place(words: str, *moves: Array, manner: str, beside: Array) -> Term:
        return of_tip("place", f"everywhere: the measured places are {words}", *moves, manner=manner, beside=beside)

    yield place("scaled", centred, manner="", beside=rigid)
    for a, b in combinations_with_replacement(range(3), 2):
        strain = centred[:, a : a + 1] * axes[b] + centred[:, b : b + 1] * axes[a]
        words = f"stretched along {AXES[a]}" if a == b else f"skewed between {AXES[a]} and {AXES[b]}"
        yield place(words, strain, manner=words.split()[0], beside=rigid)
        bent = [(centred[:, a] * centred[:, b])[:, None] * axes[c] for c in range(3)]
        yield place(f"distorted with {AXES[a]} times {AXES[b]}", *bent, manner="distorted with", beside=lower)
    square = np.sum(centred**2, axis=1, keepdims=True)
    yield place("distorted with their distance", centred * square, manner="distance", beside=lower)
    for c in range(3):
        across = centred * (np.delete(centred, c, axis=1) ** 2).sum(axis=1, keepdims=True)
        yield place(f"distorted about {AXES[c]}", across * (1.0 - axes[c]), manner="distorted about", beside=lower)


def _stands_elsewhere(variable: str, words: str, tip: Array, course: Array, manner: str = ELSEWHERE) -> Term:
    """The six moves and turns of poses (m, 3) as one body, each times a course (m,)."""
    weight = course[:, None]
    about = tip - tip[course != 0.0].mean(axis=0) if (course != 0.0).any() else tip
    units = [weight * np.broadcast_to(u, tip.shape) for u in np.eye(3)]
    turned = [weight * np.cross(u, about) for u in np.eye(3)]
    turns = [*(np.zeros_like(tip) for _ in units), *units]
    return of_tip(variable, words, *units, *turned, manner=manner, turns=turns)


def _of_setups(points: Points, tip: Array) -> Iterator[Term]:
    """Boards and cameras that stand elsewhere in one setup, from some time on, or more and more."""
    setups = np.array(points.setup)
    has_time = bool(np.isfinite(points.t_s).all()) and float(np.ptp(points.t_s)) > 0.0
    names = list(dict.fromkeys(points.setup))
    for name in names if len(names) > 1 else ():
        words = f"setup {name} stands elsewhere"
        yield _stands_elsewhere("setup", words, tip, (setups == name) * 1.0)
    if not has_time:
        return
    time = (points.t_s - points.t_s.min()) / np.ptp(points.t_s)
    yield _stands_elsewhere("time", "everywhere: drifts with time as one body", tip, time, "")
    for edge in edges(points.t_s, RIGID_STEPS):
        words = f"everywhere: from {edge:.0f} s on all stands elsewhere"
        yield _stands_elsewhere("time", words, tip, (points.t_s > edge) * 1.0)
    for name in names:
        for edge in edges(points.t_s[setups == name], RECORDING_STEPS):
            course = ((setups == name) & (points.t_s > edge)) * 1.0
            if RIGID_POSES_LEAST <= course.sum() <= (setups == name).sum() - RIGID_POSES_LEAST:
                words = f"setup {name} stands elsewhere from {edge:.0f} s on"
                yield _stands_elsewhere("time", words, tip, course)


def _of_the_axes(arm: Arm, points: Points, frames: LinkFrames) -> Iterator[Term]:
    """Joints whose axis wobbles or whose bearing runs out of round, once and twice per turn."""
    turning = [k for k, link in enumerate(arm.links) if link.joint == "revolute"]
    is_modified = arm.dh_convention == "modified"
    for j, link in enumerate(turning):
        axis = frames.axes[:, link + 1 if is_modified else link, :, 2]
        first = frames.axes[:, link, :, 0]
        beyond = frames.tip_m - frames.origin_m[:, link + 1 if is_modified else link]
        across = (first, np.cross(axis, first))
        for order in (1, 2):
            courses = harmonic(points.q_rad[:, j], order)
            turns = [course[:, None] * a for a in across for course in courses]
            tilts = [np.cross(turn, beyond) for turn in turns]
            words = f"joint {j + 1}: its axis wobbles {order} times per turn"
            yield of_tip(f"q{j + 1}", words, *tilts, manner=PER_TURN, turns=turns)
            words = f"joint {j + 1}: its axis runs out of round {order} times per turn"
            yield of_tip(f"q{j + 1}", words, *turns, manner=PER_TURN)


def _of_parallel_axes(arm: Arm, frames: LinkFrames) -> Iterator[Term]:
    """Axes that DH rows hold parallel in one plane: a tilt in the other is none of their parameters."""
    for joint in parallel_joints(arm):
        frame = frame_behind(arm, joint)
        turn, beyond = frames.axes[:, frame, :, 1], frames.tip_m - frames.origin_m[:, frame]
        words = f"the axes of joints {joint} and {joint + 1} are not parallel"
        yield of_tip(f"{SKEWED} {joint}", words, np.cross(turn, beyond), turns=[turn])


def _of_the_target(arm: Arm, frames: LinkFrames) -> Iterator[Term]:
    """Measured orientations that are off with the place, or with how gravity pulls at the target."""
    unit, axes, down = _unit_places(frames.tip_m), frames.axes[:, -1], np.asarray(arm.gravity_m_s2)
    ways = [*unit.T, *(unit[:, a] * unit[:, b] for a in range(3) for b in range(a, 3))]
    field = np.array([way[:, None] * axis for way in ways for axis in np.eye(3)])
    yield of_turns("place turned", "everywhere: the measured orientations are off by a smooth field", field)
    pull = axes.transpose(0, 2, 1) @ (down / max(float(np.linalg.norm(down)), 1e-12))
    hang = np.array([pull[:, k : k + 1] * axes[:, :, c] for k in range(3) for c in range(3)])
    yield of_turns("target", "the target: gives way to gravity", hang)


def _of_the_tool(arm: Arm, frames: LinkFrames) -> Iterator[Term]:
    """A tool that is loose: it falls to one side or the other as gravity turns round."""
    axes, down = frames.axes[:, -1], np.asarray(arm.gravity_m_s2)
    for k in range(3):
        side = np.sign(axes[:, :, k] @ down)[:, None]
        words = f"the tool: slides from side to side with gravity along its {AXES[k]}"
        yield of_tip("tool", words, side * axes[:, :, k])
        moves = [side * axes[:, :, c] for c in range(3)]
        words = f"the tool: falls from side to side with gravity along its {AXES[k]}"
        yield of_tip("tool", words, *moves)
    hang = [(axes[:, :, k] @ down)[:, None] * axes[:, :, c] for k in range(3) for c in range(3)]
    yield of_tip("tool", "the tool: gives way to gravity", *hang)


SIZE_rad = 0.003  # typical, at the shape's own scale
SIZE_m = 0.001
STEPS_COUNT = 24  # of times and of angles where something may have changed


def of_joint(n: int, j: int, variable: str, words: str, *courses: Array, manner: str = "") -> Term:
    """`courses` (m,) scaled to SIZE_rad, acting on joint j (0-based) of n."""
    scaled = [SIZE_rad * course / max(1e-12, float(np.abs(course).max())) for course in courses]
    key, slope = Block(j + 1, f"{variable} {manner}".strip()), on_joint(np.stack(scaled), j, n)
    return Term(key, f"joint {j + 1}: {words}", len(courses), slope_rad=slope)


def smooth_of_joint(n: int, j: int, variable: str, words: str, courses: Array) -> Term:
    """Functions (c, m) of a variable, of one unknown scale, acting on joint j (0-based) of n."""
    slope = SIZE_rad * on_joint(courses, j, n)
    return Term(Block(j + 1, variable), f"joint {j + 1}: {words}", len(courses), slope_rad=slope)


def of_tip(
    variable: str, words: str, *moves: Array, manner: str = "", beside: Array | None = None, turns: Sequence[Array] = ()
) -> Term:
    """`moves` (m, 3) of the tip, whatever the joints do, scaled to SIZE_m; `beside` (c, m, 3): columns that come along.

    `turns` (m, 3) [rad per the move's own unit]: how the last link turns with each move; none: not at all.
    """
    sizes = [SIZE_m / max(1e-12, float(np.abs(move).max())) for move in moves]
    slope = np.stack([size * move for size, move in zip(sizes, moves, strict=True)])
    slope = slope if beside is None else np.concatenate((slope, beside))
    turned = np.zeros_like(slope)
    for k, turn in enumerate(turns):
        turned[k] = sizes[k] * turn
    key = Block(0, f"{variable} {manner}".strip())
    return Term(key, words, len(slope), slope_m=slope, turn_rad=turned if turns else None)


def of_turns(variable: str, words: str, turns: Array) -> Term:
    """`turns` (c, m, 3) of the measured orientation alone, of one unknown scale."""
    return Term(Block(0, variable), words, len(turns), turn_rad=SIZE_rad * turns)


def is_still(term: Term) -> bool:
    """Whether a shape is constant at these poses."""
    moved = [float(np.ptp(slope, axis=1).max()) for slope in (term.slope_rad, term.slope_m, term.turn_rad) if slope is not None]
    return not any(moved)


def edges(values: Array, count: int = STEPS_COUNT) -> Array:
    """Quantiles between which a step is looked for."""
    return np.unique(np.quantile(values, np.linspace(0.0, 1.0, count + 2)[1:-1]))


def harmonic(angle: Array, order: float) -> tuple[Array, Array]:
    """Sine and cosine of order times the angle."""
    return np.sin(order * angle), np.cos(order * angle)
