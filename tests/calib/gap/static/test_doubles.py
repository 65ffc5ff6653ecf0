"""When a shape without a name takes a name's place: by what the data says, and by how many such shapes there are."""

import numpy as np

from calib.gap.poses.candidate import Candidate, plain
from calib.gap.poses.evidence import Evidence
from calib.gap.poses.floor import noise_floor
from calib.gap.poses.shape import Shape, of_joint
from calib.gap.static.confounders import confounders
from calib.points.points import make_points
from control.model.description import load_arm

ROWS, SHAPES, NOISE_m = 300, 100, 0.00014
COURSE = np.ones(ROWS)
EFFECT: Candidate = plain("encoder_scale", 1, COURSE[:, None], 1.0, "scale")
SHAPE: Shape = of_joint(1, 0, "q1", "follows something", COURSE)


def replaced(alike: int, towards: float = 0.0) -> bool:
    """Whether one name goes beside 100 shapes, `alike` of them hardly another thing than the effect.

    `towards`: how much of what the shapes have beyond the effect is in the data, 0 to 1.
    """
    rng = np.random.default_rng(5)
    effect, beyond, other = (
        rng.normal(size=ROWS),
        rng.normal(size=ROWS),
        rng.normal(size=(ROWS, SHAPES - alike)),
    )
    near = effect[:, None] + 0.05 * beyond[:, None] * np.ones(alike)
    y = 12.0 * (effect + 0.05 * towards * beyond)  # without noise, half way is where both explain the same
    evidence = Evidence.of(np.zeros((ROWS, 1)), np.column_stack((effect, near, other)), y)
    places = [[1 + k] for k in range(SHAPES)]
    return bool(confounders(evidence, [[0]], places, [EFFECT], [0], [SHAPE] * SHAPES))


def test_a_shape_that_does_as_well_does_not_take_a_name_away() -> None:
    assert not replaced(alike=1, towards=0.5)


def test_many_shapes_that_do_as_well_do() -> None:
    assert replaced(alike=60, towards=0.5)


def test_one_shape_that_does_clearly_better_does() -> None:
    assert replaced(alike=1, towards=1.0)


def test_shapes_that_are_clearly_worse_do_not_however_many() -> None:
    assert not replaced(alike=90, towards=0.0)


def test_some_forty_repeats_are_not_mistaken_for_a_joint_that_slips() -> None:
    """What their quartile says by chance must not make the floor too low: then plain noise would be said to be left."""
    arm, floors, count = load_arm("right"), [], 86
    for seed in range(60):
        still, tip = np.zeros((count, 3)), np.random.default_rng(seed).normal(0.0, NOISE_m, (count, 3))
        names, up = [f"p{k // 2}" for k in range(count)], np.ones((count, 3))
        points = make_points(["normal"] * count, names, [1, 2] * 43, still, tip, up)
        floors.append(noise_floor(arm, points, tip).tip_m / NOISE_m)
    assert min(floors) > 0.85  # 129 differences know it to 6 %
    assert max(floors) < 1.15
