"""`armwright export`: a recording as log.csv.gz and MCAP."""

import argparse
import json
import sys
from pathlib import Path

from console.commands.progress import Bar
from control.errors import ArmError
from control.model.description import load_arm
from control.recording.export import export
from control.recording.reading import Recording
from control.recording.recorded_arm import recorded_arm


def run(given: argparse.Namespace) -> int:
    """Export and print the written files."""
    recording, out = Path(given.recording), Path(given.out)
    if not recording.is_file():
        what = "it is a folder" if recording.is_dir() else "no such recording"
        raise ArmError(f"{recording}: {what}; `armwright serve` writes them to its --log folder")
    arm = load_arm(given.arm) if given.arm else recorded_arm(Recording.open(recording))
    if arm is None:
        sys.stderr.write(
            "armwright: warning: the arm of this recording is unknown, so log.mcap has no 3-D view: give it with --arm\n"
        )
    with Bar("export") as bar:
        written = export(recording, out, given.every, arm, lambda done: bar.advance("export", done))
    if given.json:
        files = {name: {"file": str(out / name), "cycles": rows} for name, rows in written.items()}
        sys.stdout.write(json.dumps(files, indent=2) + "\n")
    else:
        sys.stdout.write("".join(f"{out / name}: {rows} cycles\n" for name, rows in written.items()))
    return 0
