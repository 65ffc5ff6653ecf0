"""Shapes of the tip that have no name and are no joint's: the camera, boards that are not where they should be, axes that
wobble, a tool that is loose.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations_with_replacement

import numpy as np

from calib.arm_problem.arm_model import ArmModel
from calib.arm_problem.link_frames import LinkFrames, link_frames
from calib.arm_problem.parallel_axes import frame_behind, parallel_joints
from calib.arrays import Array
from calib.gap.effects.pose_scene import Scene
from calib.gap.poses.nameless.of_joints import PER_TURN
from calib.gap.poses.nameless.shape import SIZE_m, edges, harmonic, of_tip, of_turns
from calib.gap.posterior.term import Term
from calib.points.points import Points
from control.model.arm import Arm

AXES = "xyz"
ELSEWHERE = "elsewhere"
SKEWED = "axis behind joint"
RIGID_STEPS = 12  # times at which a board or camera may have moved
RECORDING_STEPS = 3  # the same within one setup
RIGID_POSES_LEAST = 4


def of_the_tip(scene: Scene) -> Iterator[Term]:
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
    rigid = SIZE_m * np.array(
        [*(np.ones((len(unit), 1)) * a for a in axes), *(np.cross(a, unit) for a in axes)]
    )
    lower = field_of_the_tip(tip)  # beside a distortion: its lower orders

    def place(words: str, *moves: Array, manner: str, beside: Array) -> Term:
        return of_tip(
            "place", f"everywhere: the measured places are {words}", *moves, manner=manner, beside=beside
        )

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
        yield place(
            f"distorted about {AXES[c]}", across * (1.0 - axes[c]), manner="distorted about", beside=lower
        )


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
