"""`demo gap` for many hidden effects: named or not, sizes, tip error and following error before and after, time.

    python -m benchmarks.gap.demo_study OUT [--seeds 1 2] [--effects backlash ...]

One demo after the other, each in a process of its own; OUT/table.md holds the rows.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import time
from pathlib import Path

from procedures.demo.gap_hidden import SIZES

EFFECTS = (
    "backlash", "joint_compliance", "encoder_scale", "encoder_eccentricity", "belt_coupling", "coulomb_friction",
    "viscous_friction", "load_friction",
)  # fmt: skip
HEAD = "| hidden | right | finding | seconds |\n| --- | --- | --- | --- |\n"


def main() -> None:
    """Run them and write the table as it grows."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--seeds", type=int, nargs="+", default=[1])
    parser.add_argument("--effects", nargs="+", default=EFFECTS, choices=tuple(SIZES))
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    rows = []
    for effect in given.effects:
        for seed in given.seeds:
            rows.append(one(effect, seed, given.out))
            (given.out / "table.md").write_text(HEAD + "".join(rows), encoding="utf-8")
            sys.stdout.write(rows[-1])
            sys.stdout.flush()


def one(effect: str, seed: int, out: Path) -> str:
    """A row of the table."""
    began = time.monotonic()
    done = subprocess.run(
        [
            sys.executable, "-m", "console.main", "demo", "gap", "--effect", effect, "--seed", str(seed), "--out",
            str(out / f"{effect}_{seed}"),
        ],
        capture_output=True,
        text=True,
        check=False,
    )  # fmt: skip
    finding = " ".join(line for line in done.stdout.splitlines() if line and not line.startswith("  "))
    right = {0: "yes", 1: "no"}.get(done.returncode, f"status {done.returncode}")
    last = done.stderr.strip().splitlines()[-1] if done.stderr.strip() else ""
    return f"| {effect}, seed {seed} | {right} | {finding or last} | {time.monotonic() - began:.0f} |\n"


if __name__ == "__main__":
    main()
