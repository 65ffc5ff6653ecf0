"""Before and after, on points that calibration did not use: SpringerPlus 5:1771, Tables 4 and 6.

In: two models of an arm; tips and orientations measured in other poses, now or on record, and paths. Out:
errors, their difference with a 95 % interval, and which points had been used before.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from calib.arm_problem.arm_model import ArmModel
from calib.arm_problem.assembly import BASE, CAMERA, Choice, base_frame_of, observations_of, started_tool
from calib.arm_problem.checks import require_of_arm
from calib.arm_problem.joint_effects import known_corrections
from calib.arm_problem.link_bending import known_bending
from calib.arm_problem.observations import Frame, mean_rotation
from calib.arrays import Array, frozen, norms
from calib.boards import best_motion
from calib.errors import CalibrationError
from calib.points.points import Points, read_points
from calib.results import input_file
from calib.validation.statistics import Difference, ErrorSummary, difference, improvement_percent, mean_half_width, summarise
from control.kinematics.kinematics import ForwardKinematics
from control.kinematics.rotation import exponentials, logarithms, matrices
from control.model import table as tables
from control.model.arm import Arm
from control.plain_text import aligned

# Detects points that the calibration has already used, by the file's hash and pose by pose.


USED_POSE_rad = 0.002  # difference of every joint, about a millimetre at the tip, below which a pose is not new


@dataclass(frozen=True, slots=True)
class Used:
    """Known number of poses that the calibration has used, and warnings."""

    count: int
    warnings: tuple[str, ...]


def already_used(calibrated: Arm, q_rad: Array, sha256: str = "") -> Used:
    """Check whether poses (m, n) were used; with the hash of their file, if any.

    The calibration's input files are searched beside the calibrated arm; missing ones cannot be compared.
    """
    made = calibrated.calibration
    if made is None:
        return Used(
            0, (f"arm {calibrated.name} does not name its calibration data: whether these points were used for it is unknown",)
        )
    name = next((name for name, digest in made.inputs.items() if sha256 and digest == sha256), None)
    if name is not None:
        return Used(len(q_rad), (f"these points are {name}, from which the arm was calibrated: they cannot verify it",))
    sentences, missing, total = [], [], 0
    for name, digest in made.inputs.items():
        if not name.endswith((".csv", ".csv.gz")):
            continue  # the nominal arm or a board's registration: no poses
        used = _poses_of(calibrated, name, digest)
        if used is None:
            missing.append(name)
        elif count := _same_count(q_rad, used):
            total = max(total, count)
            sentences.append(
                f"{count} of {len(q_rad)} poses are within {USED_POSE_rad:g} rad of a pose of {name}, from which the arm was"
                " calibrated"
            )
    if missing:
        sentences.append(
            f"missing beside the calibrated arm, or changed: {', '.join(missing)}; whether its poses were reused is unknown"
        )
    return Used(total, tuple(sentences))


def _poses_of(calibrated: Arm, name: str, digest: str) -> Array | None:
    """Joint angles of an input of the calibration; None if the file is not available."""
    path = (calibrated.path.parent if calibrated.path is not None else Path()) / Path(name).name
    if not path.is_file() or input_file(path, "").sha256 != digest:
        return None
    try:
        return read_points(path, calibrated.joint_count)[0].q_rad
    except CalibrationError:
        return np.zeros((0, calibrated.joint_count))  # the right file, but without poses, such as a board's registration


def _same_count(q_rad: Array, used_rad: Array) -> int:
    """Number of q_rad (m, n) that are near one of used_rad (k, n)."""
    if not len(used_rad):
        return 0
    from scipy.spatial import cKDTree

    distance, _ = cKDTree(used_rad).query(q_rad, p=np.inf)
    return int(np.sum(np.asarray(distance) <= USED_POSE_rad))


# Measured orientations against those of two models of an arm, from the encoders.


@dataclass(frozen=True, slots=True)
class TurnComparison:
    """Angles (r,) [rad] between measured and modelled orientation, before and after calibration.

    How the target sits on the last link is fitted for each model: only what varies with the pose counts.
    """

    before_rad: Array
    after_rad: Array

    def in_words(self) -> str:
        """A sentence for the operator."""
        before, after = (1e3 * float(np.mean(part)) for part in (self.before_rad, self.after_rad))
        return (
            f"Orientations of {len(self.after_rad)} poses: mean error {before:.2f} mrad before, {after:.2f} mrad after, with"
            " the target where it fits each model best."
        )

    def as_dict(self) -> dict[str, object]:
        """For verify.json."""
        return {
            "points": len(self.after_rad),
            "before": _figures_of_turns(self.before_rad),
            "after": _figures_of_turns(self.after_rad),
        }


def compare_turns(nominal: Arm, calibrated: Arm, points: Points) -> TurnComparison | None:
    """The comparison at all poses with a measured orientation; None with fewer than three."""
    if not _is_of_target(points):
        return None
    some = points.chosen(np.flatnonzero(np.isfinite(points.orientation).all(axis=1)))
    return TurnComparison(*(frozen(_angles_rad(arm, some)) for arm in (nominal, calibrated)))


def _angles_rad(arm: Arm, points: Points) -> Array:
    model = predicted_orientations(arm, points)
    measured = measuring_frame(arm, points).rotation @ matrices(points.orientation)
    target = mean_rotation(np.swapaxes(model, 1, 2) @ measured)
    return norms(logarithms(measured @ np.swapaxes(model @ target, 1, 2)))


def _figures_of_turns(angles_rad: Array) -> dict[str, float]:
    return {
        "mean_rad": float(np.mean(angles_rad)),
        "rms_rad": float(np.sqrt(np.mean(angles_rad**2))),
        "max_rad": float(np.max(angles_rad)),
    }


# Planned and measured paths, and their errors: SpringerPlus 5:1771, Figs. 6, 7, 10, Table 6.


# Errors of neighbouring camera frames are correlated: they are not independent measurements. A path counts as this
# many measurements, each the mean of one part.
PARTS = 12


@dataclass(frozen=True, slots=True)
class Track:
    """One run along a path: time_s (k,), planned_m and measured_m (k, 3) of the tip, base frame; NaN where not measured."""

    name: str
    time_s: Array
    planned_m: Array
    measured_m: Array

    def seen(self) -> Track:
        """The samples with a measured tip; CalibrationError if there are none."""
        rows = np.flatnonzero(np.isfinite(self.measured_m).all(axis=1))
        if not len(rows):
            raise CalibrationError(f"track {self.name}: the tip was never measured; omit it from the report")
        return self.chosen(rows)

    def chosen(self, rows: npt.NDArray[np.intp] | slice) -> Track:
        """The samples of these rows."""
        return Track(self.name, frozen(self.time_s[rows]), frozen(self.planned_m[rows]), frozen(self.measured_m[rows]))


@dataclass(frozen=True, slots=True)
class TrackPair:
    """The same path by the nominal and by the calibrated model, above one setup of the board."""

    name: str
    setup: str
    before: Track
    after: Track


def compare_tracks(pairs: Sequence[TrackPair]) -> Comparison | None:
    """Errors along paths, the parts of a path as points; None without paths."""
    if not pairs:
        return None
    setup, point, tips, before, after = [], [], [], [], []
    for pair in pairs:
        planned_m, first = parts_of(pair.before)
        _, second = parts_of(pair.after)
        for part in np.flatnonzero(np.isfinite(first[:, 0]) & np.isfinite(second[:, 0])):
            setup.append(pair.setup)
            point.append(f"{pair.name}, part {part + 1} of {PARTS}")
            tips.append(planned_m[part])
            before.append(first[part])
            after.append(second[part])
    return compare(setup, point, np.array(tips), np.array(before), np.array(after))


def parts_of(track: Track) -> tuple[Array, Array]:
    """Mean planned tip and mean error vector of each part of the path, (PARTS, 3); NaN where not measured."""
    seen = track.seen()
    steps = norms(np.diff(track.planned_m, axis=0))
    way = np.concatenate(([0.0], np.cumsum(steps)))
    rows = np.isfinite(track.measured_m).all(axis=1)
    share = way[rows] / max(float(way[-1]), 1e-12)
    part = np.minimum((share * PARTS).astype(int), PARTS - 1)
    planned, error = (np.full((PARTS, 3), np.nan) for _ in range(2))
    for k in np.unique(part):
        inside = part == k
        planned[k] = seen.planned_m[inside].mean(axis=0)
        error[k] = (seen.measured_m - seen.planned_m)[inside].mean(axis=0)
    return planned, error


ALL = "all"


@dataclass(frozen=True, slots=True)
class SetupComparison:
    """One setup (or `all`): errors before and after, and the improvement of the mean."""

    setup: str
    before: ErrorSummary
    after: ErrorSummary
    difference: Difference

    @property
    def improvement_percent(self) -> float:
        """100 (before - after) / before of the means; negative if worse, 0 if there was no error."""
        return improvement_percent(self.before.mean_m, self.after.mean_m)


@dataclass(frozen=True, slots=True)
class Comparison:
    """Points with their error vectors (measured minus target, base frame) before and after calibration.

    setup, point: m names; tip_m, before_m, after_m: (m, 3). Half widths (m,): of the 95 % interval of each point's
    distance, from repeats at the point; NaN without repeats. `cautions`: sentences about the points.
    """

    setup: tuple[str, ...]
    point: tuple[str, ...]
    tip_m: Array
    before_m: Array
    after_m: Array
    before_half_width_m: Array
    after_half_width_m: Array
    cautions: tuple[str, ...] = ()

    @property
    def setups(self) -> tuple[str, ...]:
        """Names of the setups in the order of their first point."""
        return tuple(dict.fromkeys(self.setup))

    def thinned(self, count: int) -> Comparison:
        """At most `count` points, spread evenly over all."""
        if len(self.setup) <= count:
            return self
        rows = np.linspace(0, len(self.setup) - 1, count).astype(np.intp)
        return Comparison(
            tuple(self.setup[k] for k in rows.tolist()),
            tuple(self.point[k] for k in rows.tolist()),
            frozen(self.tip_m[rows]),
            frozen(self.before_m[rows]),
            frozen(self.after_m[rows]),
            frozen(self.before_half_width_m[rows]),
            frozen(self.after_half_width_m[rows]),
            self.cautions,
        )

    def of(self, setup: str) -> SetupComparison:
        """One setup, or `all` for every point. CalibrationError if there is no such setup."""
        if setup not in (*self.setups, ALL):
            raise CalibrationError(f"setup: expected one of {', '.join((*self.setups, ALL))}, got {setup!r}")
        rows = [k for k, name in enumerate(self.setup) if setup in (name, ALL)]
        before_m, after_m = norms(self.before_m[rows]), norms(self.after_m[rows])
        return SetupComparison(setup, summarise(before_m), summarise(after_m), difference(before_m, after_m))

    def by_setup(self) -> tuple[SetupComparison, ...]:
        """Each setup, then all points together if there are several setups."""
        names = self.setups if len(self.setups) == 1 else (*self.setups, ALL)
        return tuple(self.of(name) for name in names)


def compare(setup: Sequence[str], point: Sequence[str], tip_m: Array, before_m: Array, after_m: Array) -> Comparison:
    """Compare errors; CalibrationError if the arrays do not match or are not finite."""
    shapes = {np.shape(tip_m), np.shape(before_m), np.shape(after_m), (len(setup), 3), (len(point), 3)}
    if len(shapes) != 1 or not len(setup):
        raise CalibrationError(f"names, tips and errors: expected equal shapes and at least one point, got {sorted(shapes)}")
    if not all(np.isfinite(values).all() for values in (tip_m, before_m, after_m)):
        raise CalibrationError("a tip or an error is not a finite number: remove points that were not measured")
    unknown = frozen(np.full(len(setup), np.nan))
    return Comparison(tuple(setup), tuple(point), frozen(tip_m), frozen(before_m), frozen(after_m), unknown, unknown)


def compare_repeated(setup: Sequence[str], point: Sequence[str], tip_m: Array, before_m: Array, after_m: Array) -> Comparison:
    """As `compare`, with several rows per point: its error is the mean vector of its repeats.

    The interval of a point's distance is that of the repeats' parts along the mean error: t s / sqrt(k).
    """
    rows: dict[tuple[str, str], list[int]] = {}
    for row, name in enumerate(zip(setup, point, strict=True)):
        rows.setdefault(name, []).append(row)
    groups = list(rows.values())
    setups, points = [name for name, _ in rows], [name for _, name in rows]
    tips = np.array([tip_m[k].mean(axis=0) for k in groups])
    (before, before_half), (after, after_half) = (_of_repeats(errors_m, groups) for errors_m in (before_m, after_m))
    compared = compare(setups, points, tips, before, after)
    return replace(compared, before_half_width_m=before_half, after_half_width_m=after_half)


def _of_repeats(errors_m: Array, groups: Sequence[list[int]]) -> tuple[Array, Array]:
    """Mean error vectors (p, 3) of groups of rows, and half the 95 % intervals of their lengths (p,)."""
    means = np.array([errors_m[k].mean(axis=0) for k in groups])
    lengths = [float(np.linalg.norm(mean)) for mean in means]
    along = zip(groups, means, lengths, strict=True)
    halves = [mean_half_width(errors_m[k] @ (mean / length)) if length > 0.0 else math.nan for k, mean, length in along]
    return means, frozen(np.array(halves))


def comparison_text(comparison: Comparison) -> str:
    """The comparison as a table of plain text, in mm."""
    rows: list[tuple[str, ...]] = [("setup", "points", "", "mean [mm]", "95 % interval", "RMS", "max", "sd", "improvement")]
    for entry in comparison.by_setup():
        rows.append((entry.setup, str(entry.before.count), "before", *_figures(entry.before), ""))
        rows.append(("", "", "after", *_figures(entry.after), f"{entry.improvement_percent:.1f} %"))
    return aligned(rows)


def _figures(summary: ErrorSummary) -> tuple[str, ...]:
    """Mean, interval, RMS, largest, standard deviation, in mm."""
    low, high = summary.mean_m - summary.mean_half_width_m, summary.mean_m + summary.mean_half_width_m
    return (
        f"{1e3 * summary.mean_m:.3f}",
        f"{1e3 * low:.3f} to {1e3 * high:.3f}" if math.isfinite(low) else "unknown",
        f"{1e3 * summary.rms_m:.3f}",
        f"{1e3 * summary.max_m:.3f}",
        f"{1e3 * summary.sd_m:.3f}",
    )


def findings(comparison: Comparison) -> tuple[str, ...]:
    """Significance of the difference for each setup, and for all together."""
    return tuple(f"{entry.setup}: {entry.difference.in_words()}" for entry in comparison.by_setup())


# Compares two models of an arm on recorded poses: predictions from the encoders against measured tips.
#
# The tip is measured by the camera, or given by the table if its pose is known. A board of unknown pose,
# with the tip seated in its cavities repeatedly, still distinguishes models: for each model the board is
# placed where its predictions fit best, and the residual is its inconsistency. Static effects of a model
# (backlash, scale, ...) are included.


SAME_POSE_rad = 0.02  # rows of one name that differ more are different poses, not repeats
LEAST_POSES = 5  # of a setup whose board is fitted: with fewer poses any board fits


def compare_arms(nominal: Arm, calibrated: Arm, points: Points) -> Comparison:
    """Errors by two models; rows of the same name and pose are repeats, other poses of the same name separate points.

    Rows are omitted if their tip is neither measured nor in a cavity of a board with enough poses; CalibrationError
    if none is left, UnusablePointsError for points in other units or of another arm. Copies count once.
    """
    cautions = (*require_of_arm(calibrated, points), *_about_frames((nominal, calibrated), points))
    points = points.chosen(_first_of_copies(points))
    if nominal.tool.position_m != calibrated.tool.position_m and _is_of_target(points):
        nominal = _with_target(nominal, points)
        cautions += (
            f"the tool of {nominal.path or nominal.name} is not where the target was measured: it was put where the model fits"
            " best",
        )
    errors = [errors_of(arm, points) for arm in (nominal, calibrated)]
    rows = np.flatnonzero(np.isfinite(errors[0]).all(axis=1) & np.isfinite(errors[1]).all(axis=1))
    if not len(rows):
        raise CalibrationError(
            f"no measured tips: expected x_m, y_m, z_m, or a setup with {LEAST_POSES} poses in named cavities of the arm's"
            " [table]"
        )
    used = points.chosen(rows)
    tips = np.where(np.isfinite(used.tip_m), used.tip_m, predicted_tips(calibrated, used))
    found = compare_repeated(used.setup, _names(used), tips, errors[0][rows], errors[1][rows])
    return replace(found, cautions=cautions)


def _is_of_target(points: Points) -> bool:
    """Whether what was measured is a target with axes, not the tip: where it sits on the last link is a matter of its mount."""
    return int(np.isfinite(points.orientation).all(axis=1).sum()) >= 3


def _with_target(arm: Arm, points: Points) -> Arm:
    """The arm with its tool where the target fits this model best, as `calibrate` does before it identifies anything."""
    observed = observations_of(arm, points, Choice().for_points(arm, points))
    x_m, y_m, z_m = started_tool(ArmModel(arm), observed).tolist()
    return replace(arm, tool=replace(arm.tool, position_m=(x_m, y_m, z_m)))


def _about_frames(arms: Sequence[Arm], points: Points) -> tuple[str, ...]:
    """Which models' frames were placed where they fit best, as a calibration does."""
    placed = list(dict.fromkeys(str(arm.path or arm.name) for arm in arms if _is_unplaced(arm, points)))
    if not placed or not np.isfinite(points.tip_m).any():
        return ()
    return (
        f"nothing in {' and '.join(placed)} says where the frame of the measured tips stands: it was put where the model fits"
        " them best, as `calibrate` does",
    )


def _is_unplaced(arm: Arm, points: Points) -> bool:
    """Whether a calibration of this arm would identify the frame of the tips; too few tips for that are taken for the base's."""
    if np.isfinite(points.tip_m).all(axis=1).sum() < LEAST_POSES and not points.in_camera_frame:
        return False
    return not {BASE, CAMERA}.isdisjoint(Choice().for_points(arm, points).freed)


def _first_of_copies(points: Points) -> list[int]:
    """Rows without those whose angles and tips an earlier row has to the last digit: copies tell nothing of scatter."""
    first: dict[bytes, int] = {}
    for row in range(len(points)):
        name = f"{points.setup[row]}:{points.point[row]}" if np.isnan(points.tip_m[row]).any() else ""
        first.setdefault(name.encode() + points.q_rad[row].tobytes() + points.tip_m[row].tobytes(), row)
    return list(first.values())


def predicted_tips(arm: Arm, points: Points) -> Array:
    """Tips (m, 3) in the base frame from the encoders, with the static effects of the arm's model."""
    joint_rad = points.q_rad + known_corrections(arm, points)
    tips = ForwardKinematics(arm).tips(joint_rad)
    bent = known_bending(arm, joint_rad, points.payload_kg)
    return tips if bent is None else np.asarray(tips + bent.shift)


def predicted_orientations(arm: Arm, points: Points) -> Array:
    """Orientations (m, 3, 3) of the last link in the base frame, as `predicted_tips`."""
    joint_rad = points.q_rad + known_corrections(arm, points)
    turned = ForwardKinematics(arm).link_transforms(joint_rad)[:, -1, :3, :3]
    bent = known_bending(arm, joint_rad, points.payload_kg)
    return turned if bent is None else np.asarray(exponentials(bent.turn) @ turned)


def errors_of(arm: Arm, points: Points) -> Array:
    """Measured minus predicted tips, (m, 3) in the model's base frame; NaN without a reference."""
    tips = predicted_tips(arm, points)
    was = measuring_frame(arm, points).to_base(points.tip_m)
    for setup in dict.fromkeys(points.setup):
        rows = [k for k, name in enumerate(points.setup) if name == setup and np.isnan(was[k]).any()]
        if rows:
            was[rows] = _on_fitted_board(arm, [points.point[k] for k in rows], tips[rows])
    return np.asarray(was - tips)


def measuring_frame(arm: Arm, points: Points) -> Frame:
    """The frame of the measured tips in the arm's base frame; one of unknown place is put where this model fits best."""
    if not _is_unplaced(arm, points):
        return base_frame_of(arm)
    rows = np.isfinite(points.tip_m).all(axis=1)
    if rows.sum() < LEAST_POSES:
        raise CalibrationError(f"{int(rows.sum())} tips in a frame of unknown place, {LEAST_POSES} are needed to place it")
    motion = best_motion(points.tip_m[rows], predicted_tips(arm, points)[rows])
    return Frame(CAMERA if points.in_camera_frame else BASE, frozen(motion.rotation), frozen(motion.shift_m))


def _on_fitted_board(arm: Arm, names: list[str], tips: Array) -> Array:
    """Cavities (m, 3) of a board fitted to these tips; NaN if there are too few, or no such cavity."""
    cavities = tables.board_cavities(arm.table) if arm.table is not None else {}
    known = [k for k, name in enumerate(names) if name in cavities]
    was = np.full(tips.shape, np.nan)
    if len(known) >= LEAST_POSES:
        on_board = np.array([cavities[names[k]] for k in known])
        was[known] = best_motion(on_board, tips[known]).of(on_board)
    return was


def _names(points: Points) -> list[str]:
    """The points' names, with a number if poses of one name differ."""
    poses: dict[tuple[str, str], list[Array]] = {}
    numbers = []
    for k, name in enumerate(zip(points.setup, points.point, strict=True)):
        known = poses.setdefault(name, [])
        near = (n for n, pose in enumerate(known) if np.abs(pose - points.q_rad[k]).max() <= SAME_POSE_rad)
        number = next(near, len(known))
        if number == len(known):
            known.append(points.q_rad[k])
        numbers.append(number)
    several = {name for name, known in poses.items() if len(known) > 1}
    return [
        f"{point}, pose {number + 1}" if (setup, point) in several else point
        for setup, point, number in zip(points.setup, points.point, numbers, strict=True)
    ]
