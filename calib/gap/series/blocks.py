"""Nameless blocks: what a joint's torque, its winding or the tip may follow without anything of the list doing it.

Each is a few smooth functions of one variable, with one unknown scale. Where one explains more than any effect, that much of
the gap has no name; what is named stands beside it.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from calib.arrays import Array
from calib.gap.effects.motor import COULOMB
from calib.gap.posterior.constants import USUAL
from calib.gap.posterior.term import Block, smooth
from calib.gap.residuals.scene import OperatingPoint, Responses, RowConditions, SeriesScene, SeriesTerm, stacked
from calib.gap.signals.terms import typical

ZERO_rad, PLACE_m, CAMERA_s = 3e-4, 3e-4, 5e-4  # sizes worth a word, as those of forms
PRESLIDING_rad = (0.001, 0.003, 0.01)
ACCELERATION = "acceleration"  # of a block: what a rotor does that the file does not know


def blocks_of(point: OperatingPoint) -> Iterator[SeriesTerm]:
    """All of them for these channels."""
    scene = point.scene
    for joint in range(1, scene.arm.joint_count + 1):
        yield from _torques(scene, joint)
        yield from _windings(scene, joint)
        if scene.recording.has_tip:
            yield from _angles(scene, joint)
    if scene.recording.has_tip:
        yield from _fields(scene)
    yield from _clocks(point)


def _unit(columns: Array) -> Array:
    """Each row of columns (c, m) over its root mean square."""
    sizes = np.sqrt(np.mean(columns**2, axis=1, keepdims=True))
    return np.asarray(columns / np.where(sizes > 0.0, sizes, 1.0))


def _beside(columns: Array, laws: Array) -> Array:
    """Rows of columns (c, m) without what laws (l, m) explain of them."""
    return np.asarray(columns - np.linalg.lstsq(laws.T, columns.T, rcond=None)[0].T @ laws)


def _block(joint: int, variable: str, words: str, response: Responses) -> Iterator[SeriesTerm]:
    if not response:
        return
    width = next(iter(response.values())).shape[1]
    yield SeriesTerm(Block(joint, variable), words, width, response=stacked([response]))


def torque_size(scene: SeriesScene, j: int) -> float:
    """Root mean square of a block's torque on a joint (0-based) [N m]."""
    return USUAL * typical(scene.given_Nm, COULOMB, j)


def _torques(scene: SeriesScene, joint: int) -> Iterator[SeriesTerm]:
    """Of the current that the motion of a joint needs."""
    number = scene.number("current_A", joint - 1)
    if number is None:
        return
    at, j = scene.whole, joint - 1
    size = torque_size(scene, j)
    for variable, words, columns in _of_torque(at, j, scene.arm.joint_count):
        if columns.size and np.ptp(columns) > 0.0:
            sentence = f"the current of joint {joint}, {words}"
            yield from _block(joint, variable, sentence, scene.torque(j, size * _unit(columns)))


def _of_torque(at: RowConditions, j: int, n: int) -> Iterator[tuple[str, str, Array]]:
    """Variable, words and shapes (c, m) of torques on a joint."""
    q, v, a, load, way = (signal[:, j] for signal in (at.q, at.speed, at.acceleration, at.load_Nm, at.direction))
    current = at.current_A[:, j]
    speed = v / max(float(np.sqrt(np.mean(v**2))), 1e-9)
    even = np.ones((1, len(q)))  # friction that changes has a mean, too, which is not Coulomb's
    yield "angle", "a torque that depends on its angle, as of a spring", smooth(q)
    yield "turn", "a torque that depends on its angle, once a turn", np.array([np.sin(q), np.cos(q)])
    yield "offset", "constant", np.ones((1, len(q)))
    yield "friction angle", "friction that changes with its angle", way * np.vstack([even, smooth(q, 8)])
    yield "speed", "growing with the square of its speed", np.array([speed * np.abs(speed)])
    yield "speed", "growing with the cube of its speed", np.array([speed**3])
    roots = np.array([way * np.abs(speed) ** 0.5, speed * np.abs(speed), speed**3, way * np.exp(-np.abs(speed))])
    # what is left of it beside the two laws of every gear, so that it stands beside them and not for them
    yield "speed", "a smooth function of its speed", _beside(roots, np.array([way, speed]))
    yield "slow", "changing near rest", np.array([way * np.exp(-np.abs(v) / s) for s in (0.015, 0.05, 0.15)])
    driven = way * np.array([np.maximum(load * way, 0.0), np.maximum(-load * way, 0.0)])
    yield "load", "friction that follows its load one way", driven
    yield "load", "a smooth function of its load", np.vstack([smooth(load, 3), way * smooth(np.abs(load), 3)])
    yield "time", "changing during a run", np.vstack([way, way * smooth(at.t_s, 3), smooth(at.t_s, 3)])
    yield ACCELERATION, "in proportion to its acceleration", np.array([a])
    turned = at.turned_rad[:, j]
    hysteresis = [way * np.exp(-turned / reach) for reach in PRESLIDING_rad]
    yield "turned", "as if friction built up again after each turning", np.array(hysteresis)
    yield ("sensor", "a curved function of the current itself", np.array([current * np.abs(current), current**3]))
    runs = np.unique(at.run)
    if len(runs) > 2:
        yield "run", "other in each run", np.array([(at.run == k) * 1.0 for k in runs])
        yield "run", "friction, other in each run", np.array([(at.run == k) * way for k in runs])
    yield from _of_others(at, j, n)


def _of_others(at: RowConditions, j: int, n: int) -> Iterator[tuple[str, str, Array]]:
    """The same with what other joints do."""
    way, even = at.direction[:, j], np.ones((1, len(at.run)))
    for i in range(n):
        if i != j:
            yield (f"joint {i + 1}", f"as a smooth function of the angle of joint {i + 1}", smooth(at.q[:, i], 4))
            others = [at.speed[:, i], at.acceleration[:, i], at.direction[:, i], at.load_Nm[:, i]]
            yield f"joint {i + 1}", f"following the motion of joint {i + 1}", np.array(others)
            yield (
                f"joint {i + 1}",
                f"friction that changes with the angle of joint {i + 1}",
                way * np.vstack([even, smooth(at.q[:, i], 4)]),
            )


def _windings(scene: SeriesScene, joint: int) -> Iterator[SeriesTerm]:
    """Of the current that the voltage drives."""
    number = scene.number("voltage_as_A", joint - 1)
    if number is None or not len(scene.beside[number].run):  # no driver was on
        return
    at, j = scene.beside[number], joint - 1
    current, v, q = at.current_A[:, j], at.speed[:, j], at.q[:, j]
    size = SHARE * max(float(np.sqrt(np.mean(current**2))), 1e-3) / scene.cells[number].floor
    # a current's slope is rough: between the rows it is another
    slopes = np.concatenate([run.current_slope[:, j] for run in scene.columns.recording.runs])
    slope = scene.filtered(number, slopes[None])[:, 0]
    for variable, words, columns in (
        ("resistance", "in proportion to its current: another winding resistance", np.array([current])),
        ("current offset", "constant: an offset of its current sensor", np.ones((1, len(q)))),
        ("inductance", "in proportion to its current's slope: another inductance", np.array([slope])),
        ("dead time", "by the sign of its current", np.array([np.tanh(current / 0.05), np.tanh(current / 0.3)])),
        ("current", "a curved function of its current", np.array([current * np.abs(current), current**3])),
        # in proportion to speed it is the motor's constant
        ("speed", "a curved function of its speed", np.array([v * v, v * np.abs(v), v**3])),
        ("angle", "a smooth function of its angle", smooth(q, 4)),
        ("time", "changing during a run", np.vstack([smooth(at.t_s, 3), current * smooth(at.t_s, 3)])),
    ):
        yield from _block(
            joint, f"winding {variable}", f"the voltage of joint {joint}, {words}", {number: size * _unit(columns).T}
        )


SHARE = 0.1  # of a joint's current: the size of a block of its winding


def _angles(scene: SeriesScene, joint: int) -> Iterator[SeriesTerm]:
    """Of the tip, as if a joint were elsewhere than its encoder says."""
    number = scene.number("tip_m")
    if number is None:
        return
    at, j = scene.beside[number], joint - 1
    size = USUAL * ZERO_rad
    for variable, words, columns in _of_an_angle(at, j, scene.arm.joint_count):
        sentence = f"the tip, {words}" if words.startswith("as if") else f"the tip, as if joint {joint} were elsewhere, {words}"
        yield from _block(
            joint, f"tip {variable}", sentence.replace("its", f"joint {joint}'s"), scene.ahead(j, size * _unit(columns))
        )
    for k in range(2, 38, 6):  # harmonics of its turn, a few at a time
        waves = np.array([wave(n * at.q[:, j]) for n in (k, k + 2, k + 4) for wave in (np.sin, np.cos)])
        yield from _block(
            joint,
            "tip ripple",
            f"the tip, as if joint {joint} were elsewhere, in waves of its angle",
            scene.ahead(j, size * waves),
        )


def _of_an_angle(at: RowConditions, j: int, n: int) -> list[tuple[str, str, Array]]:
    """Variable, words and shapes (c, m) of what a joint may be off by."""
    q, way, load = at.q[:, j], at.direction[:, j], at.load_Nm[:, j]
    half = [np.where(at.t_s > share * at.t_s.max(), 1.0, 0.0) for share in (0.25, 0.5, 0.75)]
    shapes = [
        ("zero", "as if its zero were another", np.ones((1, len(q)))),
        ("angle", "following its angle", smooth(q)),
        ("direction", "following its direction", np.vstack([way[None], way * smooth(q, 3)])),
        ("load", "following its load", smooth(load, 3)),
        ("speed", "following its speed", smooth(at.speed[:, j], 3)),
        ("acceleration", "following its acceleration", np.array([at.acceleration[:, j]])),
        ("time", "wandering with time", smooth(at.t_s)),
        ("steps", "stepping during a run", np.array(half)),
    ]
    runs = np.unique(at.run)
    if len(runs) > 2:
        shapes.append(("run", "as if its zero were other in each run", np.array([(at.run == k) * 1.0 for k in runs])))
    shapes += [
        (f"angle of joint {i + 1}", f"following the angle of joint {i + 1}", smooth(at.q[:, i])) for i in range(n) if i != j
    ]
    return shapes


def _fields(scene: SeriesScene) -> Iterator[SeriesTerm]:
    """The measured places off by any smooth field: products of two coordinates along every axis."""
    number = scene.number("tip_m")
    if number is None:
        return
    tip = np.concatenate([run.tip_m for run in scene.recording.runs])
    unit = (tip - tip.mean(axis=0)) / max(float(np.ptp(tip, axis=0).max()), 1e-9)
    ways = [unit[:, a] * unit[:, b] for a in range(3) for b in range(a, 3)]
    columns = np.array([(way[:, None] * axis).ravel() for way in ways for axis in np.eye(3)])
    size = USUAL * PLACE_m / scene.cells[number].floor
    yield from _block(0, "tip field", "the tip: the measured places are off by a smooth field", {number: size * columns.T})


def _clocks(point: OperatingPoint) -> Iterator[SeriesTerm]:
    """Clocks that differ: the camera's, and the moment at which a sample is read."""
    scene = point.scene
    number = scene.number("tip_m")
    if number is not None:
        speeds = scene.beside[number].speed
        moved = sum(scene.lever_m(j) * speeds[:, j] for j in range(scene.arm.joint_count))
        size = USUAL * CAMERA_s
        columns = size / scene.cells[number].floor * np.asarray(moved)[:, None]
        yield SeriesTerm(Block(0, "camera time"), CAMERA, size=size, response=stacked([{number: columns}]))


CAMERA = "the tip, in proportion to its speed: the camera's times are offset"
