"""The tolerance study: arms are drawn, calibrated many at once as `calibrate` does for one, and compared with
what their files say.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from calib.arm_problem.arm_model import ANGLE_BOUND_rad, LENGTH_BOUND_m
from calib.arrays import Array
from calib.design.candidates import workspace_poses
from calib.errors import CalibrationError
from calib.studies import Results, task_rng
from calib.tolerances.making import STEPS, MadeArms, MadePoses, TolerancesFile, TolerancesFileError
from calib.trust.discrepancy import Conditions
from calib.trust.prediction import UNIFORM
from control.model.arm import Arm

# Identifies many made arms at once, as `calibrate` does for one: bounded deviations, full kinematics, every
# pose.
#
# The most probable deviations given the measured tips, with the identification's bounds as a uniform
# prior's variance. All arms of a study have the same poses, so that one factored normal matrix at
# arm.toml's values serves them all (the simplified Newton method); the tips of each step are exact.


NOISE_LEAST_m: Final = 1e-6  # below it, rounding decides what poses do not determine
SAMPLE: Final = 2000  # arms that say how large an effect may be
LOOSE: Final = 3.0  # an effect's prior is this many times as wide as its tolerance
DONE_m: Final = 1e-8  # a step that moves no tip by more
STEPS_MOST: Final = 12


class StudyIdentification:
    """Finds the parameters at `places` of z from tips at `poses`; the others stay as arm.toml says."""

    def __init__(self, made: MadeArms, poses: MadePoses, places: list[int], noise_m: float) -> None:
        """`noise_m`: standard deviation of one axis of a measured tip."""
        self._poses, self._places, self._start = poses, places, made.file_z
        scale = _prior(made)[places]
        by_place = poses.slopes(made.file_z)[:, :, places] * scale  # (3, m, places)
        squares = max(noise_m, NOISE_LEAST_m) ** 2
        normal = np.einsum("imk,iml->kl", by_place, by_place) + squares * np.eye(len(places))
        inverse = np.linalg.inv(normal)
        self._gain = np.einsum("kl,iml->ikm", inverse, by_place)
        self._pull, self._scale = inverse * squares, scale
        self._largest_m = float(np.abs(by_place).sum(axis=2).max())  # of a tip by a step of 1 in every place

    def found(self, tips_m: Array) -> Array:
        """Z (arms, k) from measured tips (3, arms, m)."""
        z = np.tile(self._start, (tips_m.shape[1], 1))
        x = np.zeros((len(z), len(self._places)))  # deviations over their prior
        for _ in range(STEPS_MOST):
            residual_m = tips_m - self._poses.tips(z)
            # einsum, not BLAS: the same bits on any number of threads
            step = np.einsum("iam,ikm->ak", residual_m, self._gain) - np.einsum("al,kl->ak", x, self._pull)
            x += step
            z[:, self._places] = self._start[self._places] + x * self._scale
            if np.abs(step).max() * self._largest_m < DONE_m:
                break
        return z


def _prior(made: MadeArms) -> Array:
    """Standard deviation of each parameter before anything is measured, (k,)."""
    geometry = np.tile([LENGTH_BOUND_m, ANGLE_BOUND_rad], 2 * len(made.arm.links))
    tool = np.full(3, LENGTH_BOUND_m)
    off = made.drawn(np.random.default_rng(0), SAMPLE) - made.file_z
    effects = LOOSE * np.sqrt(np.mean(off[:, len(geometry) + 3 :] ** 2, axis=0))
    bounds = np.sqrt(UNIFORM) * np.concatenate((geometry, tool))
    return np.concatenate((bounds, effects))


# The tolerance study: arms are drawn, calibrated and compared with what their files say, over the
# workspace.
#
# Tasks 0 .. a - 1 draw the arms in blocks of CHUNK. The others draw the first arms again, each time with
# one factor exact: what their errors are smaller by is what the factor costs.


STAGES: Final = ("as built", "calibrated", "corrected")
MEASURING: Final = "measuring noise"
CHUNK: Final = 500  # arms of a task
BLOCK: Final = 50  # arms at once: their arrays stay in a processor's cache
MAP_ARMS: Final = 2000  # first arms, whose error at every pose is kept for the map
COST_ARMS: Final = 300  # first arms, drawn again with each factor exact
MAP_POSES: Final = 250  # where errors count; the calibration has others
DRAWN_MOST: Final = 50  # poses drawn for each one that is wanted: most arms keep a half of them
SHARE: Final = 0.95  # of the poses, which keep an arm's accuracy
POSES_SEED: Final = 20161771
TRIED: Final = 100  # arms that say whether a study holds
FAR: Final = 0.1  # of the reach: beyond it small deflections are none, and calibrations that start from nominal run astray


@dataclass(frozen=True, slots=True)
class StudyDesign:
    """What is studied; it is all that a task needs.

    calibration: the poses that will be recorded; map: those whose error counts. seed: of the arms.
    """

    arm: Arm
    tolerances: TolerancesFile
    calibration: Conditions
    map: Conditions
    arms_count: int
    seed: int = 0

    @property
    def chunks(self) -> int:
        """Tasks that draw arms."""
        return math.ceil(self.arms_count / CHUNK)

    @property
    def factors(self) -> tuple[str, ...]:
        """Everything that costs accuracy, by name."""
        return (*(one.name for one in MadeArms(self.arm, self.tolerances).factors), STEPS, MEASURING)

    @property
    def tasks(self) -> int:
        """Of the whole study."""
        return self.chunks + len(self.factors)


def design_of(
    arm: Arm, tolerances: TolerancesFile, arms_count: int, payload_kg: float = 0.0, recorded_q: Array | None = None, seed: int = 0
) -> StudyDesign:
    """A study of `arms_count` arms. `recorded_q` (m, n): poses of the calibration; else they are spread over the workspace."""
    rng = np.random.default_rng(POSES_SEED)
    spread_q = _spread(arm, tolerances.poses + MAP_POSES)
    calibration_q = spread_q[: tolerances.poses] if recorded_q is None else recorded_q
    calibration = _approached(calibration_q, 0.0, rng)
    at_map = _approached(spread_q[tolerances.poses :], payload_kg, rng)
    return StudyDesign(arm, tolerances, calibration, at_map, arms_count, seed)


def require_near(design: StudyDesign, where: str) -> None:
    """TolerancesFileError, naming the part, where such arms are so far from nominal that the study does not hold."""
    made = MadeArms(design.arm, design.tolerances)
    poses = MadePoses(design.arm, made.terms, design.map)
    nominal = poses.tips(made.file_z[None])
    reach_m = float(np.sqrt(np.sum(nominal**2, axis=0)).max())

    def off_m(exact: str) -> float:
        tips = poses.tips(made.drawn(np.random.default_rng(1), TRIED, exact))
        return float(np.sqrt(np.mean(_distances(tips, nominal) ** 2)))

    found_m = off_m("")
    if found_m <= FAR * reach_m:
        return
    worst = min((one.name for one in made.factors), key=off_m)
    raise TolerancesFileError(
        f"{where}: such arms miss by {1e3 * found_m:.3g} mm (root mean square), mostly by {worst}; expected at most"
        f" {1e3 * FAR * reach_m:.3g} mm, a tenth of the reach. Units are m, rad, Nm/rad and Nm^2: 0.2 mm are 2e-4"
    )


def _spread(arm: Arm, count: int) -> Array:
    """`count` poses without collision, spread evenly over the joints' ranges."""
    for drawn in (2 * count, DRAWN_MOST * count):
        poses = workspace_poses(arm, (), drawn)
        if len(poses) >= count:
            return poses[:count]
    raise CalibrationError(
        f"arm {arm.name}: {len(poses)} of {drawn} poses over the joints' ranges are clear of the floor, expected {count}:"
        " see [limits] floor_z_m and the joints' limits"
    )


def _approached(q_rad: Array, payload_kg: float, rng: np.random.Generator) -> Conditions:
    """Each joint comes from a random side."""
    direction = rng.choice((-1.0, 1.0), q_rad.shape)
    return Conditions(q_rad, direction, np.full(len(q_rad), payload_kg))


def study_task(design: StudyDesign, number: int) -> Results:
    """The task of this number; see the top of this file."""
    if number < design.chunks:
        count = min(CHUNK, design.arms_count - number * CHUNK)
        return _Study(design).errors(number, count)
    exact = design.factors[number - design.chunks]
    found = _Study(design, exact).errors(0, min(COST_ARMS, design.arms_count))
    return {"mean_square_m2": found["mean_square_m2"]}


class _Study:
    """The arms of a design, with one factor exact."""

    def __init__(self, design: StudyDesign, exact: str = "") -> None:
        self._design, self._exact = design, exact
        made = self._made = MadeArms(design.arm, design.tolerances)
        self._seen = MadePoses(design.arm, made.terms, design.calibration)
        self._map = MadePoses(design.arm, made.terms, design.map)
        self._noise_m = 0.0 if exact == MEASURING else design.tolerances.noise_m
        geometry = list(range(4 * len(design.arm.links)))
        if not design.arm.tool.known:
            geometry += range(len(geometry), len(geometry) + 3)
        noise_m = design.tolerances.noise_m
        self._identified = tuple(
            StudyIdentification(made, self._seen, places, noise_m) for places in (geometry, [*geometry, *made.correctable])
        )

    def errors(self, number: int, count: int) -> Results:
        """Of each arm and stage: mean square over the map, the distance that SHARE of the poses keep; distances of first arms."""
        rng = task_rng(self._design.seed, number)
        blocks = [self._block(rng, min(BLOCK, count - k)) for k in range(0, count, BLOCK)]
        distances = np.concatenate(blocks, axis=1)  # (stages, arms, poses)
        results = {"mean_square_m2": np.mean(distances**2, axis=2), "kept_m": np.quantile(distances, SHARE, axis=2)}
        mapped = max(0, MAP_ARMS - number * CHUNK)
        return results | ({"distance_m": distances[:, :mapped]} if mapped else {})

    def _block(self, rng: np.random.Generator, count: int) -> Array:
        """Distances of the tip from where the file puts it, (stages, count, poses of the map)."""
        made, exact = self._made, self._exact
        z = made.drawn(rng, count, exact)
        seen_m = self._seen.tips(z, made.scatter_rad(rng, self._seen, z, exact))
        seen_m += self._noise_m * rng.standard_normal(seen_m.shape)
        true_m = self._map.tips(z, made.scatter_rad(rng, self._map, z, exact))
        files = (made.file_z[None], *(one.found(seen_m) for one in self._identified))
        return np.array([_distances(true_m, self._map.tips(file)) for file in files])


def _distances(true_m: Array, modelled_m: Array) -> Array:
    left = true_m - modelled_m
    return np.asarray(np.sqrt(np.einsum("iam,iam->am", left, left)))
