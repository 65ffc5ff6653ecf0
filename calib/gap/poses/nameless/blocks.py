"""Nameless blocks: what a joint, the tip or a holding current may follow without anything of the list doing it.

The single shapes are those of `of_joints` and `of_the_tip`. All shapes of one thing that moves and one variable are one
block, whose variants they are; beside them each block has the smooth function of its variable, columns of one unknown scale.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import combinations

import numpy as np

from calib.arm_problem.arm_model import ArmModel
from calib.arm_problem.link_frames import link_frames
from calib.arrays import Array
from calib.gap.poses.effects.scene import Scene
from calib.gap.poses.nameless.of_joints import shapes
from calib.gap.poses.nameless.shape import SIZE_m, SIZE_rad, edges
from calib.gap.posterior.constants import SAME
from calib.gap.posterior.term import Block, Term, on_joint

SMOOTH = 5  # columns of a smooth function
SHARE = 0.1  # of a joint's torque: the size of a block in holding currents

# Laws of the list itself: what follows them is that effect.
OWN_LAWS = (
    "follows q{j} (linearly)",
    "follows the sine of q{j}",
    "follows its load",
    "follows the sign of its load",
)

# Of one variable these are blocks of their own: a joint may do more than one of them.
MANNERS = (
    "steps",
    "elsewhere",
    "times per turn",
    "swings",
    "distance",
    "distorted about",
    "distorted with",
    "stretched",
    "skewed",
)


def blocks_of(scene: Scene, names: Sequence[Term]) -> tuple[Term, ...]:
    """All of them for these poses, but those that are the law of one of the `names`: what follows a law is that effect."""
    found = [*_without_laws(list(_single(scene)), names), *_smooth(scene), *_fields(scene)]
    if np.isfinite(scene.points.current_A).any():
        found += _currents(scene)
    return tuple(found)


def _without_laws(shapes_: list[Term], names: Sequence[Term]) -> list[Term]:
    """Without shapes of one column that are the law of a name of one, as the last direction is play where nothing hangs."""
    laws = [one.slope_rad[0] for one in names if one.laws == 1 and one.slope_rad is not None]
    tried = [k for k, one in enumerate(shapes_) if one.count == 1 and one.slope_rad is not None]
    own = [slope[0] for k in tried if (slope := shapes_[k].slope_rad) is not None]
    if not laws or not own:
        return shapes_
    alike = np.abs(_unit(own) @ _unit(laws).T) > SAME
    out = {tried[k] for k in np.flatnonzero(alike.any(axis=1)).tolist()}
    return [one for k, one in enumerate(shapes_) if k not in out]


def _unit(slopes: Sequence[Array]) -> Array:
    flat = np.array([slope.ravel() for slope in slopes])
    return np.asarray(flat / np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-300))


def block(joint: int, variable: str, words: str) -> Block:
    """The block of a shape: its own angle, other angles, direction, load, other loads, time, currents; in which manner."""
    if joint and variable[0] in "qi" and variable != f"q{joint}":
        variable = "other angles" if variable[0] == "q" else "currents"
    elif variable.startswith("dir"):
        variable = "direction"
    elif joint and variable.startswith("load") and variable != "load":
        variable = "other loads"
    manner = next((key for key in MANNERS if key in words), "")
    return Block(joint, f"{variable} {manner}".strip())


def _single(scene: Scene) -> Iterator[Term]:
    for shape in shapes(scene.arm, scene.points):
        if any(shape.words.endswith(words.format(j=shape.joint)) for words in OWN_LAWS):
            continue
        if (
            shape.words.startswith(f"joint {shape.joint}: steps where")
            and shape.variable != f"q{shape.joint}"
        ):
            continue  # of its own angle only: other angles have their smooth functions
        slope_m = shape.slope_m
        if slope_m is not None and shape.variable == "place":
            slope_m = np.concatenate((slope_m, _of_the_camera(scene, "distorted" in shape.words)))
        yield Term(
            block(shape.joint, shape.variable, shape.words), shape.words, len(shape.slope_rad if slope_m is None else slope_m),
            0, 1.0, slope_rad=shape.slope_rad if slope_m is None else None, slope_m=slope_m,
        )  # fmt: skip


def _smooth(scene: Scene) -> Iterator[Term]:
    """Any smooth function of an angle, the load, or time, for each joint; of angle and load by direction."""
    points, load = scene.points, scene.gravity_Nm
    n, time = points.joint_count, points.t_s
    for j in range(n):
        ways = [(f"q{i + 1}", points.q_rad[:, i], f"follows q{i + 1} smoothly") for i in range(n)]
        if load is not None:
            ways += [(f"load{i + 1}" if i != j else "load", load[:, i], f"follows the load of joint {i + 1} smoothly")
                     for i in range(n)]  # fmt: skip
        if np.isfinite(time).all() and np.ptp(time) > 0.0:
            ways.append(("time", time, "wanders with time"))
            steps = np.array([np.sign(time - edge) for edge in edges(time)])
            yield _block(j, n, "time", "steps at several times", steps)
        for variable, values, words in ways:
            if np.ptp(values) > 1e-9:
                yield _block(j, n, variable, words, polynomials(values))
        last = points.direction[:, j]
        if len(set(last.tolist())) > 1:
            ways = [
                ("q", points.q_rad[:, j], "angle"),
                *([] if load is None else [("load", load[:, j], "load")]),
            ]
            for _, values, words in ways:
                if np.ptp(values) > 1e-9:
                    both = np.concatenate((last[None], last * polynomials(values)))
                    yield _block(j, n, f"dir{j + 1}", f"follows its last direction and its {words}", both)


def polynomials(values: Array) -> Array:
    """Legendre polynomials of degrees 1 to SMOOTH over the range of values (m,): (SMOOTH, m)."""
    low, high = float(values.min()), float(values.max())
    unit = (2.0 * values - low - high) / (high - low)
    return np.asarray(np.polynomial.legendre.legvander(unit, SMOOTH)[:, 1:].T)


def _block(j: int, n: int, variable: str, words: str, courses: Array) -> Term:
    columns = SIZE_rad * on_joint(courses, j, n)
    return Term(
        block(j + 1, variable, words), f"joint {j + 1}: {words}", len(columns), 0, 1.0, slope_rad=columns
    )


def _fields(scene: Scene) -> Iterator[Term]:
    """The measured places off by any smooth field: all products of up to two coordinates along every axis.

    Without its constant part: where all places are off by the same, that is `base_frame`.
    """
    if np.isfinite(scene.points.tip_m).all():
        columns = _field(scene)
        words = "everywhere: the measured places are off by a smooth field"
        yield Term(Block(0, "place"), words, len(columns), 0, 1.0, slope_m=columns)


def _of_the_camera(scene: Scene, is_bent: bool) -> Array:
    """What comes along where a camera's frame and centre are unknown, (c, m, 3): a rigid move, or lower orders if it distorts."""
    if is_bent:
        return _field(scene)
    unit = _unit_places(scene)
    moves = [np.ones((len(unit), 1)) * axis for axis in np.eye(3)]
    return SIZE_m * np.array([*moves, *(np.cross(axis, unit) for axis in np.eye(3))])


def _field(scene: Scene) -> Array:
    """Of first and second order, (27, m, 3)."""
    unit = _unit_places(scene)
    ways = [*unit.T, *(unit[:, a] * unit[:, b] for a in range(3) for b in range(a, 3))]
    return SIZE_m * np.array([way[:, None] * axis for way in ways for axis in np.eye(3)])


def _unit_places(scene: Scene) -> Array:
    tip = link_frames(ArmModel(scene.arm), scene.arm.dh, scene.points.q_rad).tip_m
    return np.asarray((tip - tip.mean(axis=0)) / max(float(np.ptp(tip, axis=0).max()), 1e-9))


def _currents(scene: Scene) -> Iterator[Term]:
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
            words = (
                f"the holding current of joint {j + 1} follows {name} in a way that no single load explains"
            )
            yield Term(Block(j + 1, "current"), words, 2, 0, 1.0, slope_Nm=columns)
