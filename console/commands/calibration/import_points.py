"""`armwright import-points`: points.csv of a table that another program wrote; asks what the table does not tell."""

import argparse
import shlex
import sys
from pathlib import Path

from calib.points.spreadsheet import ANGLES, LENGTHS, Unclear, Understood, read_sheet, understood
from calib.points.writer import write_points
from control.errors import ArmError
from control.model.description import load_arm
from procedures.folders import require_new

SHOWN = 3


def run(given: argparse.Namespace) -> int:
    """Read, show what was understood, write; with a line that repeats it without questions."""
    file = Path(given.out) / "points.csv"
    if Path(given.out).suffix == ".csv":
        raise ArmError(f"--out {given.out}: expected a folder, in which points.csv is written")
    require_new(Path(given.out), ["points.csv"])
    columns = dict(pair.partition("=")[::2] for pair in given.columns or [])
    found = _asked(given, columns)
    write_points(file, found.points)
    named = [f"{ours}={name}" for ours, name in columns.items()]
    line = ["armwright", "import-points", given.file, "--arm", given.arm, "--out", given.out]
    line += [*(["--columns", *named] if named else []), *(["--angles", given.angles] if given.angles else [])]
    line += ["--lengths", given.lengths] if given.lengths else []
    rows = file.read_text(encoding="utf-8").splitlines()[: SHOWN + 1]
    sys.stdout.write(
        "\n".join([*found.in_words, "", *rows, "...", f"written: {file}", "Again: " + shlex.join(line)])
        + "\n"
    )
    return 0


def _asked(given: argparse.Namespace, columns: dict[str, str]) -> Understood:
    """What the table says, with the answers to what it does not."""
    arm, sheet = load_arm(given.arm), read_sheet(Path(given.file))
    for option, units in (("angles", ANGLES), ("lengths", LENGTHS)):
        if getattr(given, option) not in (None, *units):
            raise ArmError(f"--{option}: expected one of {', '.join(units)}, got {getattr(given, option)}")
    while True:
        try:
            return understood(sheet, arm, columns, given.angles, given.lengths)
        except Unclear as unclear:
            if not sys.stdin.isatty():
                raise
            answer = input(f"{unclear.question}? ({', '.join(unclear.choices)}) ").strip()
            if answer not in unclear.choices:
                continue
            if unclear.option == "--columns":
                columns[unclear.key.rstrip("=")] = answer
            else:
                setattr(given, unclear.option.removeprefix("--"), answer)
