"""`armwright export`: a recording as log.csv.gz and MCAP."""

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path

from console.commands.progress import Bar
from control.errors import ArmError
from control.files import make_whole
from control.model.description import load_arm
from control.recording.export import export
from control.recording.joined import FILE_NAME, join
from control.recording.reading import Recording
from control.recording.recorded_arm import recorded_arm


def run(given: argparse.Namespace) -> int:
    """Export and print the written files."""
    recording, out = _existing(given.recording), Path(given.out)
    if given.beside:
        written = _joined([recording, *map(_existing, given.beside)], out, given.every)
    else:
        written = _exported(given, recording, out)
    if given.json:
        files = {name: {"file": str(out / name), "cycles": rows} for name, rows in written.items()}
        sys.stdout.write(json.dumps(files, indent=2) + "\n")
    else:
        sys.stdout.write("".join(f"{out / name}: {rows} cycles\n" for name, rows in written.items()))
    return 0


def _existing(text: str) -> Path:
    recording = Path(text)
    if not recording.is_file():
        what = "it is a folder" if recording.is_dir() else "no such recording"
        raise ArmError(f"{recording}: {what}; `armwright serve` writes them to its --log folder")
    return recording


def _joined(recordings: Sequence[Path], out: Path, every: int) -> dict[str, int]:
    """One table of several arms."""
    file = out / FILE_NAME
    if every < 1:
        raise ArmError(f"--every: expected a cycle count of 1 or more, got {every}")
    if file.exists():
        raise ArmError(f"{file} already exists: choose another folder or remove it first")
    out.mkdir(parents=True, exist_ok=True)
    total = max(1, min(Recording.open(one).row_count for one in recordings))
    with Bar("export") as bar:
        rows = make_whole(
            file, lambda part: join(recordings, part, every, lambda row: bar.advance("export", row / total))
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
