"""`armwright bringup`: joint by joint, from a draft of arm.toml to one that fits the real arm."""

import argparse
import contextlib
import math
import sys
from collections.abc import Iterator
from pathlib import Path

from control.errors import ArmError
from control.model.arm import Arm, Drive
from control.model.description import save_arm
from procedures.bringup.bench import Setting, open_bench, opened
from procedures.bringup.diagnosis import Diagnosis
from procedures.bringup.procedure import (
    BringupOptions,
    BringupOutcome,
    Journal,
    bring_up,
    brought_up,
    caution_of,
)
from procedures.bringup.workbench import BringupOperator, Stopped, TerminalOperator
from procedures.folders import require_writable

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


def run(given: argparse.Namespace) -> int:
    """Measure, then write the new arm.toml."""
    out = Path(given.out)
    if out.exists():
        raise ArmError(f"--out {out}: exists already and is never overwritten: choose another name")
    require_writable(out.parent)
    if not 0.02 <= given.speed <= FASTEST_rad_s:
        raise ArmError(f"--speed: expected 0.02 to {FASTEST_rad_s:g} rad/s, got {given.speed:g}")
    with opened(given) as setting:
        journal = Journal(out.with_suffix(".bringup.json"), setting.draft)
        options = _options(given, setting.draft, journal)
        with _operator(given, setting) as operator:
            return _bring_up(setting, operator, journal, options, out)


def _options(given: argparse.Namespace, arm: Arm, journal: Journal) -> BringupOptions:
    known = [drive.joint for drive in arm.drives]
    wanted = given.joint or [joint for joint in known if joint not in journal.passed()]
    for joint in wanted:
        if joint not in known:
            raise ArmError(f"--joint {joint}: the draft has joints {', '.join(map(str, known))}")
    if given.current is not None:
        largest = min(drive.current_limit_A for drive in arm.drives)
        if not 0.05 <= given.current <= largest:
            raise ArmError(
                f"--current: expected 0.05 to {largest:g} A (the smallest current_limit_A), got {given.current:g}"
            )
    return BringupOptions(tuple(wanted), given.current, given.speed, not given.no_stops)


@contextlib.contextmanager
def _operator(given: argparse.Namespace, setting: Setting) -> Iterator[BringupOperator]:
    if setting.rig is not None:
        from procedures.bringup.workbench import MockOperator

        yield MockOperator(setting.rig)
        return
    with TerminalOperator(given.yes) as operator:
        yield operator


def _bring_up(
    setting: Setting, operator: BringupOperator, journal: Journal, options: BringupOptions, out: Path
) -> int:
    operator.say(PREFACE.format(name=setting.draft.name))
    if journal.passed():
        operator.say(
            f"From {journal.path}: joints {', '.join(map(str, journal.passed()))} have already passed."
        )
    try:
        currents_A = {
            drive.joint: caution_of(setting.arm, drive, options).current_A for drive in setting.arm.drives
        }
        with open_bench(setting.arm, setting.clock, operator, currents_A) as bench:
            outcome = BringupOutcome()
            if options.joints:
                outcome = bring_up(setting.arm, bench, operator, journal, options, operator.say)
            serials = bench.serials()
    except Stopped as stopped:
        sys.stderr.write(
            f"armwright: {stopped}; the drives are off. The same command continues from {journal.path}\n"
        )
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
    sys.stderr.write(
        f"Joints that passed are saved in {journal.path}: the same command continues with the others.\n"
    )


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
