"""`armwright export`: a recording as log.csv.gz and MCAP."""

import argparse
import sys
from pathlib import Path

from control.errors import ArmError
from control.loop.export import export


def run(given: argparse.Namespace) -> int:
    """Export and say what was written."""
    recording = Path(given.recording)
    if not recording.is_file():
        raise ArmError(
            f"{recording}: there is no such recording; `armwright serve` writes them to its --log folder"
        )
    for name, rows in export(recording, Path(given.out), given.every).items():
        sys.stdout.write(f"{Path(given.out) / name}: {rows} cycles\n")
    return 0
