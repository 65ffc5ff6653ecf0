"""The loop in real time at 500 Hz beside processors that are kept busy: missed deadlines are counted, false faults reported.

python -m benchmarks.soak.realtime [--minutes 60] [--busy 2]

The arm moves to and fro between two poses for the whole time. In between its process is paused (SIGSTOP) for 20 to 100 ms,
which must trip nothing. Whatever ends a motion is counted, acknowledged, and the arm goes on. The mock boards share the
machine, so they have the patience of procedures.mock.
"""

from __future__ import annotations

import argparse
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from contextlib import suppress
from pathlib import Path

import numpy as np

from control.errors import ArmError
from control.model.description import load_arm
from control.recording.reading import Recording
from control.recording.recorder_state import parts_from
from control.server.client import ArmClient
from procedures.mock import RealTimeBench

POSES = ((-0.6, -0.6, 0.2), (0.6, -0.6, 0.2))
SPEED = 0.4
PAUSE_EVERY_S = 15.0
PAUSES_s = (0.02, 0.05, 0.1)
BUSY = "while True: pass"
WANTED = ("missed", "late_s", "switches", "page_faults", "age_s")
SCENARIO = "[start]\nq_rad = [-0.6, -0.6, 0.2]\nhomed = true\n"


def main(arguments: list[str] | None = None) -> int:
    """Run it; 1 if there was a fault."""
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    options.add_argument("--minutes", type=float, default=60.0)
    options.add_argument("--busy", type=int, default=os.cpu_count() or 1, help="programs beside it")
    args = options.parse_args(arguments)
    crowd = [subprocess.Popen([sys.executable, "-c", BUSY]) for _ in range(args.busy)]
    try:
        with tempfile.TemporaryDirectory(prefix="armwright-soak-") as folder:
            scenario = Path(folder) / "soak.toml"
            scenario.write_text(f'name = "soak"\n{SCENARIO}')
            bench = RealTimeBench("right", scenario, Path(folder) / "log")
            try:
                moves, pauses, faults = _play(bench, 60.0 * args.minutes)
                recording = bench.stop()
            finally:
                bench.close()
            _report(recording, moves, pauses, faults)
    finally:
        for one in crowd:
            one.kill()
            one.wait()
    return 1 if faults else 0


def _play(bench: RealTimeBench, duration_s: float) -> tuple[int, int, Counter[str]]:
    client = bench.start(load_arm("right"))
    client.enable()
    source, faults, moves, pauses = random.Random(1), Counter[str](), 0, 0
    end_s, pause_at_s = time.monotonic() + duration_s, time.monotonic() + PAUSE_EVERY_S
    while time.monotonic() < end_s:
        try:
            client.move_joints(POSES[moves % 2], SPEED, waits=False)
            time.sleep(0.3)
            if time.monotonic() > pause_at_s:
                pause_at_s += PAUSE_EVERY_S
                pauses += 1
                _pause(bench.runtime_pid, source.choice(PAUSES_s))
            client.arrive(30.0)
            moves += 1
        except ArmError:
            faults[_mended(client)] += 1
    return moves, pauses, faults


def _pause(pid: int, duration_s: float) -> None:
    os.kill(pid, signal.SIGSTOP)
    time.sleep(duration_s)
    os.kill(pid, signal.SIGCONT)


def _mended(client: ArmClient) -> str:
    """The first fault's code; it is acknowledged."""
    found = client.status()["faults"]
    with suppress(ArmError):
        client.acknowledge()
        client.enable()
        client.home()  # a fault may take the zero away
    return str(found[0]["code"]) if found else "stopped"


def _report(recording: Path, moves: int, pauses: int, faults: Counter[str]) -> None:
    names = Recording.open(recording).layout.names
    at = [names.index(name) for name in WANTED]
    parts = [[row[i] for i in at] for part in parts_from(recording) for row in Recording.open(part).rows()]
    missed, late_s, switches, page_faults, age_s = np.array(parts).T
    lost = int(missed[-1] - missed[0])
    print(f"{len(missed)} cycles, {moves} moves, {pauses} pauses of 20 to 100 ms")
    print(f"missed deadlines: {lost} ({100.0 * lost / (len(missed) + lost):.3f} %)")
    for name, values in (("lateness", late_s), ("age of counts", age_s[np.isfinite(age_s)])):
        quantiles = np.percentile(1e6 * values, (50.0, 99.0, 99.9, 100.0))
        print(f"{name} [us]: p50 {quantiles[0]:.0f}, p99 {quantiles[1]:.0f}, p99.9 {quantiles[2]:.0f}, max {quantiles[3]:.0f}")
    print(f"involuntary switches {int(switches.sum())}, page faults {int(page_faults.sum())}")
    print(f"faults: {', '.join(f'{code} {count}' for code, count in faults.items()) or 'none'}")


if __name__ == "__main__":
    sys.exit(main())
