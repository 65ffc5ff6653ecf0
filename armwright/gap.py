"""The gap workflow: which effects are missing in the model."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from armwright.calibration import points_for
from calib.gap.finding import GapFinding
from calib.gap.report import GapOutcome
from calib.gap.words import in_words
from calib.gap.workflow import Recordings, find_gap_in, read_recordings, write_gap
from calib.points.points import Points
from control.model.arm import Arm

Files = str | Path | Sequence[str | Path]


@dataclass(frozen=True, slots=True)
class Gap:
    """The result; `str()` gives it in sentences, the conclusion first."""

    arm: Arm
    recordings: Recordings
    outcome: GapOutcome

    @property
    def finding(self) -> GapFinding:
        """Effects with parameters and evidence, ambiguous or unknown ones, the gap before and after."""
        return self.outcome.finding

    @property
    def named(self) -> tuple[str, ...]:
        """The named effects, such as "backlash on joint 2"."""
        return tuple(str(effect.name) for effect in self.finding.effects)

    @property
    def warnings(self) -> tuple[str, ...]:
        """Sentences about the measurements, and about sizes that poses and time series cannot share."""
        return self.outcome.warnings

    def save(self, folder: str | Path) -> Arm:
        """Write gap.json, arm.toml and report.html; return the model with the named effects.

        ArmError if one of them exists; then nothing is written.
        """
        return write_gap(self.outcome, self.arm, self.recordings, Path(folder))

    def __str__(self) -> str:
        return "\n".join(in_words(self.finding))


def find_gap(
    arm: Arm,
    points: Points | Files | None = None,
    log: Files | None = None,
    *,
    without: Sequence[str] = (),
    current_unit: str = "A",
    with_maps: bool = False,
) -> Gap:
    """Find effects that the model of `arm` lacks, from static poses, time series, or both.

    Args:
        arm: the model.
        points: Points, or one or more points.csv.
        log: one or more log.csv.
        without: names of effects to exclude.
        current_unit: what the files' columns i1_A ... are: "A", "mA", "percent" of the drives' current limits, "Nm" (torques
            of the joints), "motor_Nm".
        with_maps: measure the residual as maps, which the controller corrects; they stand in the new arm where they help
            measurements that were not fitted.

    Raises:
        CalibrationError: a file names its line and column; or the measurements are too few.
    """
    recordings = _recordings(arm, points, log, current_unit)
    outcome = find_gap_in(arm, recordings, without=without, with_maps=with_maps)
    return Gap(arm, recordings, outcome)


def _recordings(arm: Arm, points: Points | Files | None, log: Files | None, current_unit: str) -> Recordings:
    if not isinstance(points, Points):
        return read_recordings(arm, _files(points), _files(log), current_unit)
    points_for(arm, points)
    if log is None:
        return Recordings(points, None, (), (), ())
    return dataclasses.replace(read_recordings(arm, (), _files(log), current_unit), points=points)


def _files(files: Files | None) -> Sequence[str | Path]:
    if files is None:
        return ()
    return (files,) if isinstance(files, str | Path) else files
