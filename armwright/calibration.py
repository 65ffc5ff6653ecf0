"""Calibration from measured points, and verification of the result on others.
Recordings of the control loop are read as arrays, too.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calib.arm_problem.assembly import Choice
from calib.calibration import Calibrated, CalibrationPlan, LeaveOut, write_calibrated_arm, write_calibration_json
from calib.calibration import calibrate as calibrated
from calib.calibration_report import calibration_report, judgement_json, summary_text
from calib.errors import CalibrationError
from calib.identify.objective import objective_named
from calib.points.points import Points
from calib.points.points import make_points as made_points
from calib.points.points import read_points as points_of
from calib.report.report import write_report
from calib.results import made_today
from calib.validation.verify import Comparison, compare_arms
from console.visualisation.reading import read_series
from console.visualisation.series import Series
from control.model.arm import Arm
from control.model.description import load_arm

Array = NDArray[np.float64]
T = TypeVar("T")
RESULTS = ("arm.toml", "calibration.json", "report.html")


@dataclass(frozen=True, slots=True)
class CalibrationResult:
    """A calibrated arm and its uncertainty; `str()` is the summary that `armwright calibrate` prints."""

    calibrated: Calibrated

    @property
    def arm(self) -> Arm:
        """The calibrated arm."""
        return self.calibrated.arm

    @property
    def is_good(self) -> bool:
        """Whether the calibrated arm can be used."""
        return self.calibrated.verdict.is_good

    @property
    def verdict(self) -> tuple[str, ...]:
        """Sentences: the verdict, the reasons, and the next steps."""
        return self.calibrated.verdict.in_words()

    @property
    def parameters(self) -> Mapping[str, tuple[float, float]]:
        """Every identified parameter of the arm: value and standard deviation, in m, rad or its own unit.

        The standard deviation is NaN for a parameter at its bound.
        """
        return {one.parameter.name: (one.value, one.sd) for one in self.calibrated.found.estimates}

    @property
    def error_before_m(self) -> Array:
        """Error vectors (m, 3) [m] at the points by the nominal arm, measured minus modelled."""
        return self.calibrated.found.error_before_m

    @property
    def error_after_m(self) -> Array:
        """Error vectors (m, 3) [m] by the calibrated arm."""
        return self.calibrated.found.error_after_m

    @property
    def warnings(self) -> tuple[str, ...]:
        """Sentences about points and result."""
        return self.calibrated.warnings

    def save(self, folder: str | Path) -> None:
        """Write arm.toml, calibration.json and report.html. CalibrationError if one exists; then nothing is written."""
        out = Path(folder)
        for name in RESULTS:
            if (out / name).exists():
                raise CalibrationError(f"{out / name} exists already and is never overwritten: choose another folder")
        made, provenance = self.calibrated, made_today()
        nominal, identification = made.nominal, made.found
        write_calibrated_arm(out / "arm.toml", nominal, identification, provenance)
        more = judgement_json(made)
        write_calibration_json(out / "calibration.json", nominal.name, identification, provenance, more=more)
        write_report(out / "report.html", calibration_report(made, provenance))

    def __str__(self) -> str:
        return summary_text(self.calibrated)


def make_points(
    q_rad: ArrayLike,
    tip_m: ArrayLike | None = None,
    *,
    setup: str | Sequence[str] = "free",
    point: Sequence[str] | None = None,
    repeat: Sequence[int] | None = None,
    direction: ArrayLike | None = None,
    current_A: ArrayLike | None = None,
    payload_kg: ArrayLike | None = None,
) -> Points:
    """Points of a calibration from arrays: m static poses of an arm with n joints.

    Args:
        q_rad: (m, n) encoder angles [rad].
        tip_m: (m, 3) measured tip positions [m] in the base frame, NaN where not measured; None for none.
        setup: one name for all or one each: "normal", "roll", "pitch" for the calibration board's tilts, otherwise any name.
        point: (m,) names, those of the board's cavities if the tip was seated in one; "1" to "m" by default.
        repeat: (m,) number of the visit to the point, 1 by default.
        direction: (m, n) sign of each joint's last motion, 0 unknown; needed for backlash.
        current_A: (m, n) motor currents [A], NaN unknown.
        payload_kg: (m,) mass at the tip [kg], NaN unknown.

    Raises:
        CalibrationError: names the array, its shape and the expected shape.
    """
    angles = _array(q_rad, "q_rad")
    if angles.ndim != 2 or not len(angles) or not np.isfinite(angles).all():
        raise CalibrationError(f"q_rad: expected finite numbers of shape (m, n), got shape {angles.shape}")
    m, n = angles.shape
    return made_points(
        _listed([setup] * m if isinstance(setup, str) else setup, m, "setup"),
        _listed([str(k) for k in range(1, m + 1)] if point is None else point, m, "point"),
        _listed([1] * m if repeat is None else repeat, m, "repeat"),
        angles,
        np.full((m, 3), np.nan) if tip_m is None else _shaped(tip_m, (m, 3), "tip_m"),
        None if direction is None else _shaped(direction, (m, n), "direction"),
        None if current_A is None else _shaped(current_A, (m, n), "current_A"),
        payload_kg=None if payload_kg is None else _shaped(payload_kg, (m,), "payload_kg"),
    )


def read_points(path: str | Path, joint_count: int | None = None) -> Points:
    """Read a points.csv or points.csv.gz; unknown columns give Python warnings.

    CalibrationError names file, line and column; `joint_count` is checked if given.
    """
    points, notes = points_of(Path(path), joint_count)
    for sentence in notes:
        warnings.warn(sentence, stacklevel=2)
    return points


def calibrate(
    arm: Arm,
    points: Points | str | Path,
    *,
    effects: Sequence[str] = (),
    free: Sequence[str] = (),
    fixed: Sequence[str] = (),
    objective: str = "e2",
    accuracy_m: float | None = None,
    leave_out: LeaveOut = None,
    seed: int = 0,
) -> CalibrationResult:
    """Identify the geometry of `arm` from points, find outliers, cross-validate, and give a verdict. `arm` is unchanged.

    Args:
        arm: the nominal arm.
        points: with measured tips, or in cavities of the arm's calibration table; or a points.csv of them.
        effects: to identify as well: "backlash:2", "joint_compliance:2", "encoder_scale:1", "belt_coupling" ...
        free: frames to identify as well, of "base", "table", "tool".
        fixed: names of parameters that keep their value, such as "theta4".
        objective: "e2" sum of distances, "e1" sum of absolute coordinates, "lsq" least squares, "huber".
        accuracy_m: the required mean distance; the verdict says whether it is met.
        leave_out: "setup", or k for every k-th point, for the held-out error; by default setups, if there are several.
        seed: of the random starts of the search.

    Raises:
        CalibrationError: the points or the options are not usable.
    """
    points = points_for(arm, points)
    choice = Choice(fixed=tuple(fixed), freed=tuple(free), effects=tuple(effects))
    plan = CalibrationPlan(choice, objective_named(objective), accuracy_m, leave_out, seed=seed)
    return CalibrationResult(calibrated(arm, points, plan))


def verify(nominal: Arm, calibrated_arm: Arm, points: Points | str | Path) -> Comparison:
    """Compare errors of two models of one arm; use points, or a points.csv, that the calibration did not use.

    `of("all")` gives mean, RMS, largest and the significance of the difference; `of(setup)` that of one setup.
    CalibrationError if no point has a tip to compare with.
    """
    return compare_arms(nominal, calibrated_arm, points_for(calibrated_arm, points_for(nominal, points)))


def points_for(arm: Arm, points: Points | str | Path) -> Points:
    """Points of `arm`, read where they are a file. CalibrationError for those of an arm with another number of joints."""
    if not isinstance(points, Points):
        return read_points(points, arm.joint_count)
    if points.joint_count != arm.joint_count:
        raise CalibrationError(f"points: {points.joint_count} joints, but arm {arm.name} has {arm.joint_count}")
    return points


def _array(values: ArrayLike, what: str) -> Array:
    try:
        return np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError):
        raise CalibrationError(f"{what}: expected an array of numbers") from None


def _shaped(values: ArrayLike, shape: tuple[int, ...], what: str) -> Array:
    array = _array(values, what)
    if array.shape != shape:
        raise CalibrationError(f"{what}: expected shape {shape}, got {array.shape}")
    return array


def _listed(values: Sequence[T], count: int, what: str) -> list[T]:
    if len(values) != count:
        raise CalibrationError(f"{what}: expected {count} values, one for each pose, got {len(values)}")
    return list(values)


def read_recording(path: str | Path, arm: Arm | str | Path | None = None) -> Series:
    """Read a recording: `.armlog`, `log.csv`, `log.csv.gz` or MCAP, recognised by content.

    Args:
        path: the file.
        arm: the recorded arm (an Arm, file or name), if the file does not name it.

    Returns:
        Arrays over m samples, NaN where nothing was measured: `t_s` (m,) from 0 on; `q_rad`, `q_set_rad` of the encoders,
        `joint_rad`, `joint_set_rad` of the joints, `current_A`, `voltage_V` (m, n); `tip_m` (m, 3) by the camera in the
        base frame; `mode` (m,) indices into `modes`; `run` (m,) indices into `runs`. `notes` are problems of the file.

    Raises:
        ArmError: the file is missing, of another format, damaged, or has another number of joints than `arm`.
        CalibrationError: a log.csv with a wrong column or value; names file, line and column.
    """
    return read_series(Path(path), load_arm(arm) if isinstance(arm, str | Path) else arm)
