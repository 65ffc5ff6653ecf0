"""`armwright gap`: where simulation and measurement disagree, what is missing, and the model with it."""

import argparse
import dataclasses
import datetime
import json
import sys
from importlib.metadata import version
from pathlib import Path

from calib.errors import CalibrationError
from calib.gap.both import disagreements, merged
from calib.gap.dynamic.find import examine
from calib.gap.finding import GapFinding, gap_content, write_gap_json
from calib.gap.log import joined_logs, read_log
from calib.gap.model_update import updated_arm
from calib.gap.report import gap_page
from calib.gap.static.find import StaticGap, find
from calib.gap.words import in_words
from calib.points import joined, read_points
from calib.report_data import input_file
from console.commands.progress import Bar
from control.errors import ArmError
from control.model.arm import Arm, Calibration
from control.model.description import load_arm, save_arm
from control.model.effects import EFFECTS

RESULTS = ("gap.json", "arm.toml", "report.html")


def run(given: argparse.Namespace) -> int:
    """Read, look, name, write. Nothing is written before everything is read and found usable."""
    arm, out = load_arm(given.arm), Path(given.out)
    for name in RESULTS:
        if (out / name).exists():
            raise ArmError(f"{out / name} exists already and is never overwritten: choose another --out")
    without = _without(given.without or [])
    with Bar("gap") as bar:
        gap = _static(given, arm, without, bar) if given.points else None
        dynamic = _dynamic(given, arm, without, bar) if given.log else None
    finding = _together(gap, dynamic)
    _write(finding, gap, arm, given, out)
    if given.json:
        sys.stdout.write(json.dumps(gap_content(finding), indent=2, allow_nan=False) + "\n")
    else:
        sys.stdout.write("".join(f"{sentence}\n" for sentence in in_words(finding)))
        sys.stdout.write(f"\nreport  {out / 'report.html'}\nmodel   {out / 'arm.toml'}\n")
    return 0


def _together(gap: StaticGap | None, dynamic: GapFinding | None) -> GapFinding:
    """One finding; what the two halves disagree about is said."""
    if gap is None:
        if dynamic is None:
            raise CalibrationError("gap: give --points for static poses, --log for time series, or both")
        return dynamic
    if dynamic is None:
        return gap.finding
    for sentence in disagreements(gap.finding, dynamic):
        sys.stderr.write(f"armwright: warning: {sentence}\n")
    return merged(gap.finding, dynamic)


def _without(names: list[str]) -> tuple[str, ...]:
    for name in names:
        if name not in EFFECTS:
            raise CalibrationError(f'--without: expected some of {", ".join(EFFECTS)}, got "{name}"')
    return tuple(names)


def _static(given: argparse.Namespace, arm: Arm, without: tuple[str, ...], bar: Bar) -> StaticGap:
    """The poses of every points file together."""
    parts = []
    for name in given.points:
        part, warnings = read_points(Path(name), arm.joint_count)
        parts.append(part)
        sys.stderr.writelines(f"armwright: warning: {warning}\n" for warning in warnings)
    source = tuple(Path(name).name for name in given.points)
    found = find(arm, joined(parts), bar.advance, without)
    return dataclasses.replace(found, finding=dataclasses.replace(found.finding, data=source))


def _dynamic(given: argparse.Namespace, arm: Arm, without: tuple[str, ...], bar: Bar) -> GapFinding:
    """The runs of every log together."""
    logs = []
    for name in given.log:
        log, warnings = read_log(Path(name), arm.joint_count)
        logs.append(log)
        sys.stderr.writelines(f"armwright: warning: {warning}\n" for warning in warnings)
    tried = [name for name in EFFECTS if name not in without] if without else None
    outcome = examine(arm, joined_logs(tuple(logs)), bar.advance, tried)
    sys.stderr.writelines(f"armwright: warning: {warning}\n" for warning in outcome.warnings)
    return dataclasses.replace(outcome.finding, data=tuple(Path(name).name for name in given.log))


def _write(
    finding: GapFinding, gap: StaticGap | None, arm: Arm, given: argparse.Namespace, out: Path
) -> None:
    """gap.json, the model with what was named, report.html."""
    date = datetime.datetime.now(datetime.UTC).date().isoformat()
    program = f"armwright {version('armwright')}"
    files = [*(given.points or []), *(given.log or [])]
    inputs = {Path(name).name: input_file(Path(name), "").sha256 for name in files}
    source = arm.path.name if arm.path is not None else arm.name
    made = Calibration(source, inputs, date, "gap workflow", program)
    out.mkdir(parents=True, exist_ok=True)
    write_gap_json(out / "gap.json", finding)
    dh = gap.fit.solution.dh if gap is not None else None
    save_arm(updated_arm(arm, finding, dh, made), out / "arm.toml")
    (out / "report.html").write_text(gap_page(finding, gap, date, program), encoding="utf-8")
