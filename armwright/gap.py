"""The gap workflow: where a model and measurements disagree, and which effect is missing in the model."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from calib.errors import CalibrationError
from calib.gap.finding import GapFinding
from calib.gap.words import in_words
from calib.points.points import Points
from control.model.arm import Arm
from procedures.gap.workflow import Inputs, Outcome, known_effects, look, read_inputs, write

Files = str | Path | Sequence[str | Path]


@dataclass(frozen=True, slots=True)
class Gap:
    """What was found; `str()` gives it in sentences, the answer first."""

    arm: Arm
    inputs: Inputs
    outcome: Outcome

    @property
    def finding(self) -> GapFinding:
        """Effects with parameters and evidence, what stays ambiguous or unknown, the gap before and after."""
        return self.outcome.finding

    @property
    def named(self) -> tuple[str, ...]:
        """The effects that are named, as "backlash on joint 2"."""
        return tuple(str(effect.name) for effect in self.finding.effects)

    @property
    def warnings(self) -> tuple[str, ...]:
        """Sentences about the measurements, and about where poses and time series disagree."""
        return (*self.outcome.warnings, *self.outcome.agreement)

    def save(self, folder: str | Path) -> Arm:
        """Write gap.json, arm.toml and report.html; returns the model with what was named.

        ArmError where one of them is there already; nothing is written then.
        """
        return write(self.outcome, self.arm, self.inputs, Path(folder))

    def __str__(self) -> str:
        return "\n".join(in_words(self.finding))


def find_gap(
    arm: Arm, points: Points | Files | None = None, log: Files | None = None, *, without: Sequence[str] = ()
) -> Gap:
    """Look for effects that the model of `arm` lacks: in static poses, in time series, or in both.

    Args:
        arm: the model.
        points: Points, or one or more points.csv.
        log: one or more log.csv.
        without: names of effects that are not tried.

    Raises:
        CalibrationError: a file names its line and column; or the measurements are too few.
    """
    inputs = _inputs(arm, points, log)
    return Gap(arm, inputs, look(arm, inputs, known_effects(without), _unheard))


def _inputs(arm: Arm, points: Points | Files | None, log: Files | None) -> Inputs:
    if not isinstance(points, Points):
        return read_inputs(arm, _files(points), _files(log))
    if points.joint_count != arm.joint_count:
        raise CalibrationError(
            f"points: {points.joint_count} joints, but arm {arm.name} has {arm.joint_count}"
        )
    if log is None:
        return Inputs(points, None, (), (), ())
    series = read_inputs(arm, (), _files(log))
    return Inputs(points, series.log, (), series.log_files, series.warnings)


def _files(files: Files | None) -> Sequence[str | Path]:
    if files is None:
        return ()
    return (files,) if isinstance(files, str | Path) else files


def _unheard(what: str, done: float) -> None:
    """Progress that nobody watches."""
