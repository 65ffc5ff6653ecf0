"""`armwright bringup`: joint by joint, from a draft of arm.toml to one that fits the real arm.
`armwright tune`: gains from a measured response with stability margins, tested on the arm before and after.
`armwright doctor`: checks an arm before it is switched on. Nothing is energised and nothing moves.
"""

import argparse
import contextlib
import math
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path

from console.commands.progress import Bar, answer, say
from control.errors import ArmError
from control.model.arm import Arm, Drive
from control.model.description import save_arm
from control.plain_text import aligned
from firmware_iface.clock import Clock
from procedures.bringup.bench import Setting, open_bench, opened
from procedures.bringup.diagnosis import Diagnosis
from procedures.bringup.procedure import BringupOptions, BringupOutcome, Journal, bring_up, brought_up, caution_of
from procedures.bringup.workbench import BringupOperator, Stopped, TerminalOperator
from procedures.doctor.boards import open_boards, sample
from procedures.doctor.finding import Finding, Level, as_json, as_text, verdict, worst
from procedures.doctor.host import look_at_host, look_at_last_recording, look_at_links, look_at_ports
from procedures.doctor.judging import judge
from procedures.folders import require_new
from procedures.tuning import NotTuned, TuningOptions, TuningResult, require_loop, tunable, tune

FASTEST_rad_s = 1.0
PREFACE = """Bring-up of arm {name}. One motor at a time gets a low current; all others stay off, with shorted windings,
or are held by their boards.
Keep the emergency stop in hand and the range of every joint clear. Put the arm near an upright pose and support its links.
"""

SHOWN = (  # figures of a joint, what they are called, and the factor from SI
    (("index_spacing_counts",), "{:.0f} counts per turn", 1.0),
    (("gear_ratio",), "gear {:.2f}", 1.0),
    (("coulomb_Nm", "viscous_Nm_s_rad"), "friction {:.2f} Nm + {:.2f} Nm s/rad", 1.0),
    (("lower_stop_rad", "upper_stop_rad"), "stops {:+.1f} to {:+.1f} deg", math.degrees(1.0)),
    (("torque_constant_Nm_A",), "k {:.4f} Nm/A", 1.0),
    (("resistance_ohm",), "{:.3f} ohm", 1.0),
)


def run_bringup(args: argparse.Namespace) -> int:
    """Measure, then write the new arm.toml."""
    out = Path(args.out)
    require_new(out.parent, [out.name])
    if not 0.02 <= args.speed <= FASTEST_rad_s:
        raise ArmError(f"--speed: expected 0.02 to {FASTEST_rad_s:g} rad/s, got {args.speed:g}")
    with opened(args) as setting:
        journal = Journal(out.with_suffix(".bringup.json"), setting.draft)
        options = _options(args, setting.draft, journal)
        with _operator(args, setting) as operator:
            return _bring_up(setting, operator, journal, options, out)


def _options(args: argparse.Namespace, arm: Arm, journal: Journal) -> BringupOptions:
    known = [drive.joint for drive in arm.drives]
    wanted = args.joint or [joint for joint in known if joint not in journal.passed()]
    for joint in wanted:
        if joint not in known:
            raise ArmError(f"--joint {joint}: the draft has joints {', '.join(map(str, known))}")
    if args.current is not None:
        largest = min(drive.current_limit_A for drive in arm.drives)
        if not 0.05 <= args.current <= largest:
            raise ArmError(f"--current: expected 0.05 to {largest:g} A (the smallest current_limit_A), got {args.current:g}")
    return BringupOptions(tuple(wanted), args.current, args.speed, not args.no_stops)


@contextlib.contextmanager
def _operator(args: argparse.Namespace, setting: Setting) -> Iterator[BringupOperator]:
    if setting.rig is not None:
        from procedures.bringup.workbench import MockOperator

        yield MockOperator(setting.rig)
        return
    with TerminalOperator(args.yes) as operator:
        yield operator


def _bring_up(setting: Setting, operator: BringupOperator, journal: Journal, options: BringupOptions, out: Path) -> int:
    operator.say(PREFACE.format(name=setting.draft.name))
    if journal.passed():
        operator.say(f"From {journal.path}: joints {', '.join(map(str, journal.passed()))} have already passed.")
    try:
        currents_A = {drive.joint: caution_of(setting.arm, drive, options).current_A for drive in setting.arm.drives}
        with open_bench(setting.arm, setting.clock, operator, currents_A) as bench:
            outcome = BringupOutcome()
            if options.joints:
                outcome = bring_up(setting.arm, bench, operator, journal, options)
            serials = bench.serials()
    except Stopped as stopped:
        sys.stderr.write(f"armwright: {stopped}; the drives are off. The same command continues from {journal.path}\n")
        return 1
    for joint, result in sorted(outcome.diagnoses.items()):
        operator.say(figures_in_words(joint, result))
    if outcome.problems:
        _say_problems(outcome, journal, out)
        return 1
    save_arm(brought_up(setting.draft, journal, serials), out)
    left = [drive.joint for drive in setting.draft.drives if drive.joint not in journal.passed()]
    unchecked = f" Not checked, taken from the draft: joint {', '.join(map(str, left))}." if left else ""
    operator.say(f"\nwritten: {out} (the draft is unchanged; measured values in {journal.path}).{unchecked}")
    return 0


def _say_problems(outcome: BringupOutcome, journal: Journal, out: Path) -> None:
    sys.stderr.write(f"armwright: {len(outcome.problems)} to fix first, so {out} was not written:\n")
    for problem in outcome.problems:
        sys.stderr.write(f"  - {problem}\n")
    sys.stderr.write(f"Joints that passed are saved in {journal.path}: the same command continues with the others.\n")


def _wired(drive: Drive) -> str:
    """Where its motor and its encoder are, with their signs."""
    motor, encoder = f"({drive.motor_direction:+d})", f"({drive.encoder_direction:+d})"
    if drive.board:
        return f'board "{drive.board}", output {drive.board_channel} {motor}, encoder {encoder}'
    return f"node {drive.motor_node} {motor}, channel {drive.encoder_channel} {encoder}"


def figures_in_words(joint: int, result: Diagnosis) -> str:
    """One line of measured values."""
    figures, drive = result.figures, result.drive
    parts = [f"joint {joint}: {_wired(drive)}"]
    for keys, text, scale in SHOWN:
        values = [scale * figures.get(key, math.nan) for key in keys]
        if all(map(math.isfinite, values)):
            parts.append(text.format(*values))
    return ", ".join(parts)


LOWEST_Hz, HIGHEST_Hz = 2.0, 40.0


def run_tune(args: argparse.Namespace) -> int:
    """Measure, design, test and write."""
    out = Path(args.out)
    page = out.with_name(f"{out.stem}_report.html")
    require_new(out.parent, [out.name, page.name])
    with opened(args) as setting:
        options = _tuning_options(args, setting.draft)
        try:
            require_loop(setting.draft, options.joints)
            if setting.rig is None and not args.yes and not _may_swing(setting.draft, options):
                sys.stderr.write("armwright: cancelled; nothing moved\n")
                return 2
            with Bar("tuning") as bar:
                result = tune(setting.arm, setting.clock, options, bar.advance)
        except NotTuned as reason:
            sys.stderr.write(f"armwright: {reason}\nNothing was written; the gains are unchanged.\n")
            return 1
        _written(result, setting.draft, out, page)
    return 0


def _tuning_options(args: argparse.Namespace, arm: Arm) -> TuningOptions:
    known = [drive.joint for drive in arm.drives]
    for joint in args.joint or ():
        if joint not in known:
            raise ArmError(f"--joint {joint}: the arm has joints {', '.join(map(str, known))}")
    if args.bandwidth is not None and not LOWEST_Hz <= args.bandwidth <= HIGHEST_Hz:
        raise ArmError(f"--bandwidth: expected {LOWEST_Hz:g} to {HIGHEST_Hz:g} Hz, got {args.bandwidth:g}")
    if not 0.02 <= args.amplitude <= 0.8:
        raise ArmError(f"--amplitude: expected 0.02 to 0.8 of the current limit, got {args.amplitude:g}")
    if args.pose is not None and len(args.pose) != arm.joint_count:
        raise ArmError(f"--pose: expected {arm.joint_count} joint angles in rad, got {len(args.pose)}")
    pose = tuple(args.pose) if args.pose is not None else None
    return TuningOptions(tuple(args.joint or tunable(arm)), args.bandwidth, args.amplitude, pose)


def _may_swing(arm: Arm, options: TuningOptions) -> bool:
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


def _written(result: TuningResult, draft: Arm, out: Path, page: Path) -> None:
    from dataclasses import replace

    from procedures.tuning import header, rows, worst_pose, write_report

    pids = {drive.joint: drive.pid for drive in result.arm.drives}
    drives = tuple(replace(drive, pid=pids[drive.joint]) for drive in draft.drives)
    save_arm(replace(draft, drives=drives), out)
    write_report(result, page, f"from {draft.path}; armwright {version('armwright')}")
    table = aligned((header(draft), *(row for tuned in result.joints for row in rows(tuned))), left=2)
    say(table)
    for tuned in result.joints:
        say(worst_pose(tuned))
        for caution in tuned.cautions:
            say(f"  {caution}")
    say(f"\nwritten: {out} ([drive.pid] of the joints above), {page}")


LONGEST_S = 600.0


def run_doctor(args: argparse.Namespace) -> int:
    """Check everything and print the findings."""
    if not 0.1 <= args.seconds <= LONGEST_S:
        raise ArmError(f"--seconds: expected 0.1 to {LONGEST_S:g}, got {args.seconds:g}")
    if args.rate is not None and not 20.0 <= args.rate <= 1200.0:
        raise ArmError(f"--rate: expected 20 to 1200 Hz, got {args.rate:g}")
    with opened(args) as setting, _recordings(args) as log_folder:
        rate_Hz = args.rate or setting.arm.usual_rate_Hz
        findings = examine(setting.arm, setting.clock, 1.0 / rate_Hz, args.seconds, log_folder)
    name = setting.arm.name
    answer(args, as_json(name, findings), f"{as_text(findings)}\narm {name}: {verdict(findings)}")
    return 1 if worst(findings) is Level.BAD else 0


@contextmanager
def _recordings(args: argparse.Namespace) -> Iterator[Path]:
    """The folder that is meant. A mock arm has an empty one, for the recordings in `log` are of another arm."""
    if args.log is not None or not args.mock:
        yield Path(args.log or "log")
        return
    with tempfile.TemporaryDirectory(prefix="armwright-doctor-") as made:
        yield Path(made)


def examine(arm: Arm, clock: Clock, period_s: float, duration_s: float, log_folder: Path) -> list[Finding]:
    """Check this machine, then ports, boards, timing and signals; all of them, even if one fails."""
    findings = look_at_host(period_s, arm.limits.watchdog_s, arm.joint_count, log_folder)
    findings += look_at_last_recording(log_folder) + look_at_ports() + look_at_links(arm)
    boards = open_boards(arm, clock, period_s)
    try:
        judged = list(judge(sample(boards, clock, period_s, duration_s), arm))
    finally:
        boards.close()
    findings += boards.findings
    return findings + sorted(judged, key=lambda finding: finding.group == "signals")
