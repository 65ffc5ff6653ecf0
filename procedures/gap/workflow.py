"""The gap workflow from files to files: read, look at poses and at time series, bring both together, write."""

from __future__ import annotations

import dataclasses
import datetime
import sys
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

from calib.errors import CalibrationError
from calib.gap.both import brought_together
from calib.gap.dynamic.find import DynamicOutcome, examine
from calib.gap.finding import GapFinding, write_gap_json
from calib.gap.log import Log, joined_logs, read_log
from calib.gap.model_update import updated_arm
from calib.gap.report import GapReport, gap_page
from calib.gap.static.find import StaticGap, find
from calib.inputs import input_file
from calib.points.points import Points, joined, read_points
from control.errors import ArmError
from control.files import write_whole
from control.model.arm import Arm, Calibration
from control.model.description import save_arm
from control.model.effects import EFFECTS
from procedures.iso9283.recording import Advance

RESULTS = ("gap.json", "arm.toml", "report.html")
POSES_SHARE = 0.3  # of the time, where there are both


@dataclass(frozen=True, slots=True)
class Inputs:
    """What was measured, and the files that it stands in; `warnings` are sentences about them."""

    points: Points | None
    log: Log | None
    point_files: tuple[Path, ...]
    log_files: tuple[Path, ...]
    warnings: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Outcome:
    """The finding of both levels together, each level's own, and what was said about how they agree."""

    finding: GapFinding
    static: StaticGap | None
    dynamic: DynamicOutcome | None
    agreement: tuple[str, ...]
    warnings: tuple[str, ...]


def require_free(out: Path) -> None:
    """ArmError where a result is there already: nothing is ever overwritten."""
    for name in RESULTS:
        if (out / name).exists():
            raise ArmError(f"{out / name} exists already and is never overwritten: choose another --out")


def known_effects(names: Sequence[str]) -> tuple[str, ...]:
    """The effects that --without names; CalibrationError where one is not of the list."""
    for name in names:
        if name not in EFFECTS:
            raise CalibrationError(f'--without: expected some of {", ".join(EFFECTS)}, got "{name}"')
    return tuple(names)


def read_inputs(arm: Arm, points: Sequence[str | Path], logs: Sequence[str | Path]) -> Inputs:
    """All files, read strictly; CalibrationError where one cannot be used, or where there is none."""
    if not points and not logs:
        raise CalibrationError(
            "gap: give --points for static poses, --log for time series, or both; --record records them"
        )
    point_files, log_files = tuple(map(Path, points)), tuple(map(Path, logs))
    poses: list[Points] = []
    runs: list[Log] = []
    warnings: list[str] = []
    for path in point_files:
        part, said = read_points(path, arm.joint_count)
        poses.append(part)
        warnings += said
    for path in log_files:
        log, said = read_log(path, arm.joint_count)
        runs.append(log)
        warnings += said
    return Inputs(
        joined(poses) if poses else None,
        joined_logs(tuple(runs)) if runs else None,
        point_files,
        log_files,
        tuple(warnings),
    )


def look(arm: Arm, inputs: Inputs, without: Collection[str], advance: Advance) -> Outcome:
    """What is missing in the model of `arm`. Time series are looked at with the geometry that the poses gave."""
    static = dynamic = None
    split = POSES_SHARE if inputs.points is not None and inputs.log is not None else None
    if inputs.points is not None:
        upto = split or 1.0
        static = find(arm, inputs.points, lambda what, done: advance(what, upto * done), without)
        static = dataclasses.replace(static, finding=_from(static.finding, inputs.point_files))
    if inputs.log is not None:
        base = split or 0.0
        tried = [name for name in EFFECTS if name not in without] if without else None
        shaped = arm if static is None else arm.with_dh(static.fit.solution.dh)
        dynamic = examine(
            shaped, inputs.log, lambda what, done: advance(what, base + (1.0 - base) * done), tried
        )
        dynamic = dataclasses.replace(dynamic, finding=_from(dynamic.finding, inputs.log_files))
    finding, agreement = brought_together(
        static.finding if static else None, dynamic.finding if dynamic else None
    )
    warnings = (
        *inputs.warnings,
        *(static.warnings if static is not None else ()),
        *(dynamic.warnings if dynamic is not None else ()),
    )
    return Outcome(finding, static, dynamic, agreement, warnings)


def write(outcome: Outcome, arm: Arm, inputs: Inputs, out: Path) -> Arm:
    """gap.json, the model with what was named, report.html; returns the model."""
    require_free(out)
    date = datetime.datetime.now(datetime.UTC).date().isoformat()
    program = f"armwright {version('armwright')}"
    hashes = {path.name: input_file(path, "").sha256 for path in (*inputs.point_files, *inputs.log_files)}
    source = arm.path.name if arm.path is not None else arm.name
    made = Calibration(source, hashes, date, "gap workflow", program)
    out.mkdir(parents=True, exist_ok=True)
    write_gap_json(out / "gap.json", outcome.finding)
    dh = outcome.static.fit.solution.dh if outcome.static is not None else None
    model = updated_arm(arm, outcome.finding, dh, made)
    save_arm(model, out / "arm.toml")
    report = GapReport(
        outcome.finding,
        outcome.static,
        outcome.dynamic,
        (*outcome.agreement, *outcome.warnings),
        date,
        program,
    )
    write_whole(out / "report.html", gap_page(report))
    return model


def say_warnings(outcome: Outcome) -> None:
    """On standard error, one a line."""
    for sentence in (*outcome.warnings, *outcome.agreement):
        sys.stderr.write(f"armwright: warning: {sentence}\n")


def _from(finding: GapFinding, files: Sequence[Path]) -> GapFinding:
    return dataclasses.replace(finding, data=tuple(path.name for path in files))
