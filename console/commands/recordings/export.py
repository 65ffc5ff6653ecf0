"""`armwright export`: a recording as log.csv.gz and MCAP, or that of a cell as one table."""

import argparse
import json
import sys
from pathlib import Path

from console.commands.progress import Bar
from control.errors import ArmError
from control.files import make_whole
from control.model.description import load_arm
from control.recording.cell_folder import recordings_in
from control.recording.export import export
from control.recording.joined import FILE_NAME, join
from control.recording.reading import Recording
from control.recording.recorded_arm import recorded_arm


def run(given: argparse.Namespace) -> int:
    """Export and print the written files."""
    recording, out = _existing(given.recording), Path(given.out)
    written = _joined(recording, out, given) if recording.is_dir() else _exported(given, recording, out)
    if given.json:
        files = {name: {"file": str(out / name), "cycles": rows} for name, rows in written.items()}
        sys.stdout.write(json.dumps(files, indent=2) + "\n")
    else:
        sys.stdout.write("".join(f"{out / name}: {rows} cycles\n" for name, rows in written.items()))
    return 0


def _existing(text: str) -> Path:
    recording = Path(text)
    if not recording.exists():
        raise ArmError(f"{recording}: no such recording; `armwright serve` writes them to its --log folder")
    return recording


def _joined(folder: Path, out: Path, given: argparse.Namespace) -> dict[str, int]:
    """One table of all arms of a cell."""
    recordings, file = recordings_in(folder), out / FILE_NAME
    if given.arm:
        raise ArmError("--arm: not for a cell's folder, which has every arm's description")
    if given.every < 1:
        raise ArmError(f"--every: expected a cycle count of 1 or more, got {given.every}")
    if file.exists():
        raise ArmError(f"{file} already exists: choose another folder or remove it first")
    out.mkdir(parents=True, exist_ok=True)
    total = max(1, min(one.row_count for one in recordings))
    with Bar("export") as bar:
        rows = make_whole(
            file,
            lambda part: join(recordings, part, given.every, lambda row: bar.advance("export", row / total)),
        )
    return {FILE_NAME: rows}


def _exported(given: argparse.Namespace, recording: Path, out: Path) -> dict[str, int]:
    arm = load_arm(given.arm) if given.arm else recorded_arm(Recording.open(recording))
    if arm is None:
        sys.stderr.write(
            "armwright: warning: the arm of this recording is unknown, so log.mcap has no 3-D view: give it with --arm\n"
        )
    with Bar("export") as bar:
        return export(recording, out, given.every, arm, lambda done: bar.advance("export", done))
