"""Nameless blocks: what a joint, the tip or a holding current may follow without anything of the list doing it.

The single shapes are those of `of_joints` and `of_the_tip`; beside them each block has the smooth function of its variable,
columns of one unknown scale.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import combinations

import numpy as np

from calib.arm_problem.arm_model import ArmModel
from calib.arm_problem.link_frames import link_frames
from calib.arrays import Array
from calib.gap.effects.pose_scene import Scene
from calib.gap.poses.nameless.of_joints import of_joints
from calib.gap.poses.nameless.of_the_tip import field_of_the_tip, of_the_tip
from calib.gap.poses.nameless.shape import edges, is_still, smooth_of_joint
from calib.gap.posterior.constants import SAME
from calib.gap.posterior.term import Block, Term, on_joint, smooth

SHARE = 0.1  # of a joint's torque: the size of a block in holding currents


def blocks_of(scene: Scene, names: Sequence[Term]) -> tuple[Term, ...]:
    """All of them for these poses, but those that are the law of one of the `names`: what follows a law is that effect."""
    single = [one for one in (*of_the_tip(scene), *of_joints(scene)) if not is_still(one)]
    found = [*_without_laws(single, names), *_smooth(scene)]
    if np.isfinite(scene.points.tip_m).all():
        columns = field_of_the_tip(link_frames(ArmModel(scene.arm), scene.arm.dh, scene.points.q_rad).tip_m)
        words = "everywhere: the measured places are off by a smooth field"
        found.append(Term(Block(0, "place"), words, len(columns), 0, 1.0, slope_m=columns))
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


def _smooth(scene: Scene) -> Iterator[Term]:
    """Any smooth function of an angle, the load, or time, for each joint; of angle and load by direction."""
    points, load = scene.points, scene.gravity_Nm
    n, time = points.joint_count, points.t_s
    for j in range(n):
        ways = [
            (f"q{i + 1}" if i == j else "other angles", points.q_rad[:, i], f"follows q{i + 1} smoothly")
            for i in range(n)
        ]
        if load is not None:
            ways += [
                (
                    "load" if i == j else "other loads",
                    load[:, i],
                    f"follows the load of joint {i + 1} smoothly",
                )
                for i in range(n)
            ]
        if np.isfinite(time).all() and np.ptp(time) > 0.0:
            ways.append(("time", time, "wanders with time"))
            steps = np.array([np.sign(time - edge) for edge in edges(time)])
            yield smooth_of_joint(n, j, "time steps", "steps at several times", steps)
        for variable, values, words in ways:
            if np.ptp(values) > 1e-9:
                yield smooth_of_joint(n, j, variable, words, smooth(values))
        last = points.direction[:, j]
        if len(set(last.tolist())) > 1:
            own = [("angle", points.q_rad[:, j]), *([] if load is None else [("load", load[:, j])])]
            for what, values in own:
                if np.ptp(values) > 1e-9:
                    both = np.concatenate((last[None], last * smooth(values)))
                    yield smooth_of_joint(
                        n, j, "direction", f"follows its last direction and its {what}", both
                    )


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
