"""Scores the dynamic half of the gap workflow on labelled cases: `python -m benchmarks.gap_dynamic_score DIR...`.

Each DIR holds arm.toml, log.csv(.gz) and truth.json. `--without NAME` takes an effect off the list before each case that
hides it, so that the right answer is `unknown`; `--all-without` does that with every case's own effect.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # the matrices are small: more threads only wait

from calib.gap.dynamic.find import find
from calib.gap.finding import GapFinding
from calib.gap.log import read_log
from control.model.description import load_arm
from control.model.effects import EFFECTS

WITHOUT_JOINT = {"payload", "command_delay", "supply_sag", "belt_coupling", "link_geometry", "base_frame"}
Key = tuple[str, int | None]


@dataclass(frozen=True, slots=True)
class Score:
    """One case: what was hidden, what was said, and how well."""

    case: str
    hidden: tuple[Key, ...]
    verdict: str
    said: str
    worst_parameter: float
    gap_before: float
    gap_after: float
    seconds: float


def score(case: Path, without: bool = False) -> Score:
    """Run one case; `without`: with its own effects taken off the list."""
    began = time.process_time()
    arm = load_arm(case / "arm.toml")
    path = next(p for p in (case / "log.csv.gz", case / "log.csv") if p.exists())
    log, _ = read_log(path, arm.joint_count)
    truth = json.loads((case / "truth.json").read_text())["effects"]
    hidden = [entry["effect"] for entry in truth]
    names = [name for name in EFFECTS if name not in hidden] if without else None
    found = find(arm, log, candidates=names)
    listed = [] if without else [entry for entry in truth if entry["effect"] in EFFECTS]
    return Score(
        case.name,
        tuple(_key(entry) for entry in truth),
        _verdict(listed, truth, found),
        _said(found),
        _worst(listed, found),
        found.gap_before,
        found.gap_after,
        time.process_time() - began,
    )


def _key(entry: dict[str, Any]) -> Key:
    return entry["effect"], None if entry["effect"] in WITHOUT_JOINT else entry["joint"]


def _verdict(listed: Sequence[dict[str, Any]], truth: Sequence[dict[str, Any]], found: GapFinding) -> str:
    named = {(e.name.effect, e.name.joint) for e in found.effects}
    right = {_key(entry) for entry in listed}
    if named - right:
        return "WRONG NAME"
    if not truth:
        return "null kept" if found.unknown is None and not found.ambiguous else "null: doubts"
    if named == right and len(listed) == len(truth):
        return "right" if found.unknown is None else "right, and unknown"
    if any((n.effect, n.joint) in right for names in found.ambiguous for n in names):
        return "ambiguous with it"
    if not listed:
        return "unknown" if found.unknown is not None else ("doubts" if found.ambiguous else "MISSED")
    return "part" if named else ("unknown instead" if found.unknown is not None else "MISSED")


def _said(found: GapFinding) -> str:
    parts = [str(effect.name) for effect in found.effects]
    parts += ["{" + ", ".join(str(name) for name in names) + "}" for names in found.ambiguous]
    if found.unknown is not None:
        near = (
            f"; nearest {found.unknown.nearest}, {found.unknown.explained:.0%}"
            if found.unknown.nearest
            else ""
        )
        parts.append(f"unknown ({found.unknown.where}{near})")
    return "; ".join(parts) or "nothing"


def _worst(listed: Sequence[dict[str, Any]], found: GapFinding) -> float:
    """The largest relative error of the named effects' parameters; phases in units of a radian."""
    worst = 0.0
    for entry in listed:
        for effect in found.effects:
            if (effect.name.effect, effect.name.joint) != _key(entry):
                continue
            for name, true in entry["parameters"].items():
                if name not in effect.parameters:
                    worst = max(worst, 1.0)
                    continue
                error = abs(effect.parameters[name][0] - true)
                worst = max(worst, error if name == "phase_rad" else error / abs(true))
    return worst


def main() -> None:
    """Print one line a case and the sums."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("cases", nargs="+", type=Path)
    parser.add_argument(
        "--all-without", action="store_true", help="take each case's own effects off the list"
    )
    given = parser.parse_args()
    with ProcessPoolExecutor(2) as pool:
        scores = list(pool.map(score, given.cases, [given.all_without] * len(given.cases)))
    for one in scores:
        hidden = "+".join(f"{effect}{joint or ''}" for effect, joint in one.hidden) or "none"
        print(
            f"{one.verdict:18} {hidden:38} gap {one.gap_before:7.2f} -> {one.gap_after:6.2f}  "
            f"worst parameter {one.worst_parameter:6.1%}  {one.seconds:4.0f} s  {one.said}"
        )
    print()
    for verdict in sorted({one.verdict for one in scores}):
        print(f"{sum(one.verdict == verdict for one in scores):4d} {verdict}")


if __name__ == "__main__":
    main()
