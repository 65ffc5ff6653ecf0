"""`make bench`: the measured claims as one table, row by row as they are measured, and as out/bench.json.

python -m benchmarks [section ...]
"""

import datetime
import importlib
import json
import math
import os
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path

from benchmarks.table import BenchRow

OUT = Path("out/bench.json")
SECTIONS = {  # name: title, module
    "kinematics": ("Kinematics and dynamics", "benchmarks.loop.kinematics"),
    "poses": ("Six and seven joints, with orientation", "benchmarks.loop.poses"),
    "collision": ("Two arms against each other", "benchmarks.loop.collision"),
    "control_cycle": ("One control cycle without waiting", "benchmarks.loop.control_cycle"),
    "cycle_by_joints": ("One control cycle by joints and boards", "benchmarks.loop.cycle_by_joints"),
    "wire": ("Frames", "benchmarks.loop.wire"),
    "identification": ("Identification: 16 parameters of the reference arm", "benchmarks.calibration.identification"),
    "tolerances": ("Tolerance study: arms made, calibrated, compared", "benchmarks.calibration.tolerance_throughput"),
    "tracking": ("Tip tracking: circle of 0.09 m at 0.15 m/s", "benchmarks.loop.tracking"),
    "pose_tracking": ("Tip tracking with orientation", "benchmarks.loop.pose_tracking"),
    "stepped": ("Stepped simulation of the whole loop", "benchmarks.loop.stepped"),
    "realtime": ("Real time, over the mock boards", "benchmarks.loop.realtime"),
    "console_load": ("The console beside the loop", "benchmarks.loop.console_load"),
}
NAME_WIDTH, PEER_WIDTH = 82, 48
INTERRUPTED = 130


def main(arguments: Sequence[str]) -> int:
    """Measure the named sections, or all; 1 if one failed. A missed target is not a failure: the machine may have been busy."""
    unknown = [name for name in arguments if name not in SECTIONS]
    if unknown:
        print(f"unknown section {unknown[0]!r}: expected some of {', '.join(SECTIONS)}", file=sys.stderr)
        return 2
    found: dict[str, list[BenchRow]] = {}
    failed: list[str] = []
    try:
        for name in arguments or SECTIONS:
            found[name] = []
            failed += _measured(name, found[name])
            _save(found, failed)
    except KeyboardInterrupt:
        print(f"\ninterrupted; results so far are in {OUT}")
        return INTERRUPTED
    _sum_up(found, failed)
    return 1 if failed else 0


def _measured(name: str, rows: list[BenchRow]) -> list[str]:
    """Print and collect a section's rows as they are measured. If it fails, print one line with the reason."""
    title, module = SECTIONS[name]
    print(f"\n{title}\n{_heading()}", flush=True)
    start_s = time.monotonic()
    failures: list[str] = []
    try:
        for row in importlib.import_module(module).rows():
            rows.append(row)
            print(_line(row), flush=True)
    except Exception as error:  # a failed section must not prevent the others
        reason = " ".join(str(error).split())
        failures.append(f"{name} failed: {type(error).__name__}: {reason}")
        print(failures[0])
    print(f"({time.monotonic() - start_s:.0f} s)", flush=True)
    return failures


def _sum_up(found: dict[str, list[BenchRow]], failed: Sequence[str]) -> None:
    rows = [row for section in found.values() for row in section if row.passed is not None]
    short = [row.name for row in rows if not row.passed]
    print(f"\n{len(rows) - len(short)} of {len(rows)} targets met; all figures in {OUT}")
    for line in [*(f"short: {name}" for name in short), *failed]:
        print(line)


def _heading() -> str:
    return f"{'':{NAME_WIDTH}} {'value':>9} {'unit':<7}{'ratio':>9} of {'peer or limit':<{PEER_WIDTH}} target"


def _line(row: BenchRow) -> str:
    ratio = "" if row.ratio is None else f"{row.ratio:.3g}"
    verdict = {None: "", True: ": passed", False: ": SHORT"}[row.passed]
    beside = row.peer if row.peer_value is None else f"{row.peer} ({row.peer_value:.4g})"
    return (
        f"{row.name:{NAME_WIDTH}} {row.value:9.4g} {row.unit:<7}{ratio:>9}    {beside:<{PEER_WIDTH}} {row.target}{verdict}"
    ).rstrip()


def _save(found: dict[str, list[BenchRow]], failed: Sequence[str]) -> None:
    """Save all rows and the software versions, but nothing that identifies the machine."""
    about = {
        "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
        "program": f"armwright {version('armwright')}",
        "python": ".".join(map(str, sys.version_info[:3])),
        "processors": os.cpu_count(),
        "load": round(os.getloadavg()[0], 2),
        "packages": {name: version(name) for name in ("mujoco", "numpy", "python-can", "pyserial", "ruckig")},
    }
    rows = {name: [asdict(row) for row in section] for name, section in found.items()}
    OUT.parent.mkdir(parents=True, exist_ok=True)
    OUT.write_text(json.dumps(_finite({**about, "failed": failed, "rows": rows}), indent=1) + "\n", encoding="utf-8")


def _finite(value: object) -> object:
    """JSON has no NaN."""
    if isinstance(value, dict):
        return {key: _finite(entry) for key, entry in value.items()}
    if isinstance(value, list):
        return [_finite(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
