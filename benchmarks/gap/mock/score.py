"""Scores the gap workflow on the mock arm's physics: `python -m benchmarks.gap.mock.score`.

New cases (seeds not used for thresholds), each analysed twice if something is hidden: with the whole list, and with the hidden
effects removed from it. `--grid` tests every effect on every joint in three sizes instead; `--save DIR` saves the cases.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path

from control.plain_text import Advance

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # the matrices are small: more threads only wait

from benchmarks.arms import arm_named
from benchmarks.gap.matrix import Answer, answer, score_text
from benchmarks.gap.mock.cases import Level, MockCase, arm_with_friction, drawn, grid, nulls, pairs, write_case
from benchmarks.gap.mock.motion import motion_case
from benchmarks.gap.mock.static import static_case
from calib.gap.finding import GapFinding
from calib.gap.log import Log
from calib.gap.poses.find import find as find_in_poses
from calib.gap.series.find import find as find_in_motion
from calib.points.points import Points
from control.model.arm import Arm
from control.model.effects import EFFECTS

FIRST_SEED = 7000  # thresholds and this benchmark's own sizes were fixed on seeds below 1000
GAP_TARGET: dict[Level, float] = {"static": 1.1, "dynamic": 1.3}
CASES: dict[Level, int] = {"static": 16, "dynamic": 8}  # of each sort


def recorded(case: MockCase, arm: Arm) -> tuple[Arm, Points | Log]:
    """The known arm, and the recording. The known properties of the arm vary between cases."""
    if case.level == "static":
        return arm, static_case(arm, case.hidden, case.seed)
    known = arm_with_friction(arm, case.seed)
    return known, motion_case(known, case.hidden, case.seed)


def asked(case: MockCase, arm: Arm, save: Path | None = None, both: bool = True) -> list[Answer]:
    """The answers to one case: with the whole list and, if something is hidden and `both`, without it."""
    known, recording = recorded(case, arm)
    if save is not None:
        write_case(save / str(case).replace(" ", "_").replace(",", ""), case, known, recording)
    answers = [_answer(case, known, recording, ())]
    if case.hidden and both:
        answers.append(_answer(case, known, recording, tuple(e.effect for e in case.hidden)))
    return answers


def _answer(case: MockCase, arm: Arm, recording: Points | Log, without: Sequence[str]) -> Answer:
    began = time.process_time()
    if isinstance(recording, Points):
        found: GapFinding = find_in_poses(arm, recording, without=without).finding
        could = {one.name for one in found.nameable if one.is_nameable}
    else:
        names = [name for name in EFFECTS if name not in without] if without else None
        found = find_in_motion(arm, recording, candidates=names)
        could = {one.name for one in found.nameable if one.is_nameable}
    truth = replace(case.truth, is_listed=not without)
    return answer(str(case), truth, found, could, time.process_time() - began)


def plan(level: Level, arm: Arm, count: int, first_seed: int = FIRST_SEED) -> list[MockCase]:
    """`count` cases that hide one effect, as many that hide nothing, and a quarter as many pairs."""
    return [
        *drawn(level, arm, count, first_seed),
        *nulls(level, count, first_seed + 1000),
        *pairs(level, arm, -(-count // 4), first_seed + 2000),
    ]


def answers(
    cases: Sequence[MockCase], arm: Arm, advance: Advance, save: Path | None = None, both: bool = True, processes: int = 2
) -> list[Answer]:
    """All cases, one process per core; `advance` gets the last step and the share done."""
    found: list[Answer] = []
    with ProcessPoolExecutor(processes) as pool:
        waiting = [pool.submit(asked, case, arm, save, both) for case in cases]
        for k, (case, future) in enumerate(zip(cases, waiting, strict=True), start=1):
            found += future.result()
            advance(str(case), k / len(cases))
    return found


def main() -> None:
    """Print a line a case, the confusion matrix and the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--level", choices=("static", "dynamic"), action="append")
    parser.add_argument("--cases", type=int, help="of each sort; default 16 static, 8 dynamic")
    parser.add_argument("--arm", default="right", help="arm.toml, an arm that ships, or one of benchmarks.arms (four, six ...)")
    parser.add_argument("--first-seed", type=int, default=FIRST_SEED)
    parser.add_argument("--grid", nargs="*", metavar="WORD", help="every effect, joint and size; only those that contain a WORD")
    parser.add_argument("--once", action="store_true", help="do not repeat without the hidden effects in the list")
    parser.add_argument("--save", type=Path, help="folder for the recordings, as docs/formats.md has them")
    parser.add_argument("--processes", type=int, default=2)
    given = parser.parse_args()
    arm = arm_named(given.arm)
    for level in given.level or ("static", "dynamic"):
        count = given.cases or CASES[level]
        if given.grid is None:
            cases = plan(level, arm, count, given.first_seed)
        else:
            cases = [one for one in grid(level, arm, given.first_seed) if all(w in str(one) for w in given.grid)]
        found = answers(cases, arm, _line, given.save, not given.once, given.processes)
        sys.stdout.write(score_text(f"mock arm, {level}", found, GAP_TARGET[level]) + "\n")


def _line(what: str, share: float) -> None:
    sys.stderr.write(f"{share:4.0%} {what}\n")


if __name__ == "__main__":
    main()
