"""`armwright tune`: gains from a measured response with stability margins, tested on the arm before and after."""

import argparse
import sys
from importlib.metadata import version
from pathlib import Path

from console.commands.progress import Bar
from control.errors import ArmError
from control.model.arm import Arm
from control.model.description import save_arm
from control.plain_text import aligned
from procedures.bringup.bench import opened
from procedures.folders import require_writable
from procedures.tuning.procedure import NotTuned, TuningOptions, TuningResult, require_loop, tunable, tune

LOWEST_Hz, HIGHEST_Hz = 2.0, 40.0


def run(given: argparse.Namespace) -> int:
    """Measure, design, test and write."""
    out = Path(given.out)
    page = out.with_name(f"{out.stem}_report.html")
    for path in (out, page):
        if path.exists():
            raise ArmError(f"--out: {path} exists already and is never overwritten: choose another name")
    require_writable(out.parent)
    with opened(given) as setting:
        options = _options(given, setting.draft)
        try:
            require_loop(setting.draft, options.joints)
            if setting.rig is None and not given.yes and not _allowed(setting.draft, options):
                sys.stderr.write("armwright: cancelled; nothing moved\n")
                return 2
            with Bar("tuning") as bar:
                result = tune(setting.arm, setting.clock, options, bar.advance)
        except NotTuned as reason:
            sys.stderr.write(f"armwright: {reason}\nNothing was written; the gains are unchanged.\n")
            return 1
        _write(result, setting.draft, out, page)
    return 0


def _options(given: argparse.Namespace, arm: Arm) -> TuningOptions:
    known = [drive.joint for drive in arm.drives]
    for joint in given.joint or ():
        if joint not in known:
            raise ArmError(f"--joint {joint}: the arm has joints {', '.join(map(str, known))}")
    if given.bandwidth is not None and not LOWEST_Hz <= given.bandwidth <= HIGHEST_Hz:
        raise ArmError(f"--bandwidth: expected {LOWEST_Hz:g} to {HIGHEST_Hz:g} Hz, got {given.bandwidth:g}")
    if not 0.02 <= given.amplitude <= 0.8:
        raise ArmError(f"--amplitude: expected 0.02 to 0.8 of the current limit, got {given.amplitude:g}")
    if given.pose is not None and len(given.pose) != arm.joint_count:
        raise ArmError(f"--pose: expected {arm.joint_count} joint angles in rad, got {len(given.pose)}")
    pose = tuple(given.pose) if given.pose is not None else None
    return TuningOptions(tuple(given.joint or tunable(arm)), given.bandwidth, given.amplitude, pose)


def _allowed(arm: Arm, options: TuningOptions) -> bool:
    joints = ", ".join(map(str, options.joints))
    sys.stdout.write(
        f"Arm {arm.name}: the drives turn on and the arm homes. Joints {joints} then swing by about 20 deg, excited"
        f" by up to {options.amplitude:.0%} of their current limit, and make a step and a move. Ctrl-C stops the arm"
        " under control.\nClear the range of the arm and keep a hand on the emergency stop. Enter begins, anything"
        " else cancels. "
    )
    sys.stdout.flush()
    line = sys.stdin.readline()
    return bool(line) and not line.strip()


def _write(result: TuningResult, draft: Arm, out: Path, page: Path) -> None:
    from dataclasses import replace

    from procedures.tuning.procedure import header, rows, worst_pose, write_report

    pids = {drive.joint: drive.pid for drive in result.arm.drives}
    drives = tuple(replace(drive, pid=pids[drive.joint]) for drive in draft.drives)
    save_arm(replace(draft, drives=drives), out)
    write_report(result, page, f"from {draft.path}; armwright {version('armwright')}")
    table = aligned((header(draft), *(row for tuned in result.joints for row in rows(tuned))), left=2)
    sys.stdout.write(f"{table}\n")
    for tuned in result.joints:
        sys.stdout.write(f"{worst_pose(tuned)}\n")
        for caution in tuned.cautions:
            sys.stdout.write(f"  {caution}\n")
    sys.stdout.write(f"\nwritten: {out} ([drive.pid] of the joints above), {page}\n")
