"""Scores the gap workflow: `make gap-score`. Confusion matrix and figures for poses, time series and the mock arm.

New cases with seeds not used for thresholds, on two cores; some ten minutes with the default counts, `--cases N` of each kind
for more. Needs nothing outside the project.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Literal

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # the matrices are small: more threads only wait

from benchmarks.gap.dynamic import score as dynamic_score
from benchmarks.gap.matrix import Answer, score_text
from benchmarks.gap.mock import score as mock_score
from benchmarks.gap.mock.cases import Level
from benchmarks.gap.static import answers as static_answers
from benchmarks.studies import add_options
from calib.studies import executor
from console.commands.progress import Bar
from control.model.description import load_arm

Half = Literal["poses", "time series", "mock arm, poses", "mock arm, time series"]
TARGET: dict[Half, float] = {  # gap after naming, over the floor
    "poses": 1.1,
    "time series": 1.3,
    "mock arm, poses": 1.1,
    "mock arm, time series": 1.3,
}
COUNTS: dict[Half, int] = {"poses": 20, "time series": 40, "mock arm, poses": 8, "mock arm, time series": 5}
WORDS: dict[str, tuple[Half, ...]] = {
    "static": ("poses",),
    "dynamic": ("time series",),
    "mock": ("mock arm, poses", "mock arm, time series"),
}
DYNAMIC_SORTS = 5  # of cases, that `answers` of the time series takes in turns


@dataclass(frozen=True, slots=True)
class Job:
    """A task for a separate process, its estimated duration in seconds, and its section."""

    half: Half
    what: str
    run: Callable[[], list[Answer]]
    seconds: float


def main() -> int:
    """Print the scores of the halves that were asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("halves", nargs="*", metavar="HALF", help=f"{', '.join(WORDS)}; all by default")
    parser.add_argument("--cases", type=int, help="of each sort, in place of the default counts")
    add_options(parser)
    given = parser.parse_args()
    strange = [word for word in given.halves if word not in WORDS]
    if strange or (given.cases is not None and given.cases < 1):
        parser.error(f"expected {', '.join(WORDS)}, and counts of at least 1; got {' '.join(sys.argv[1:])}")
    halves = [half for word in given.halves or WORDS for half in WORDS[word]]
    began = time.perf_counter()
    found = _answers([job for half in halves for job in _jobs(half, given.cases)], given)
    for half in halves:
        sys.stdout.write(score_text(half, found[half], TARGET[half]) + "\n")
    sys.stdout.write(f"{time.perf_counter() - began:.0f} s\n")
    return 0


def _answers(jobs: Sequence[Job], given: argparse.Namespace) -> dict[Half, list[Answer]]:
    """All jobs, the longest first."""
    ordered = sorted(jobs, key=lambda job: -job.seconds)
    found: dict[Half, list[Answer]] = {job.half: [] for job in jobs}
    whole, done = sum(job.seconds for job in jobs), 0.0
    with executor(len(jobs), given.workers, given.cluster) as runs, Bar("gap-score") as bar:
        for number, answers in runs.results(_answered, ordered, range(len(ordered))):
            job = ordered[number]
            found[job.half] += answers
            done += job.seconds
            bar.advance(job.what, done / whole)
    return {half: sorted(some, key=lambda one: one.case) for half, some in found.items()}


def _answered(jobs: Sequence[Job], number: int) -> list[Answer]:
    return jobs[number].run()


def _jobs(half: Half, cases: int | None) -> list[Job]:
    count = cases or COUNTS[half]
    match half:
        case "poses":
            plan = static_answers.plan(count)
            return [Job(half, str(one), partial(static_answers.asked, one), 3.0) for one in plan]
        case "time series":
            total = count * DYNAMIC_SORTS if cases else count
            return [Job(half, half, partial(dynamic_score.answers, total, _tell), 12.0 * total)]
        case _:
            level: Level = "static" if half == "mock arm, poses" else "dynamic"
            arm = load_arm("right")
            plan_of_mock = mock_score.plan(level, arm, count)
            seconds = {"static": 9.0, "dynamic": 30.0}[level]
            return [Job(half, str(one), partial(mock_score.asked, one, arm), seconds) for one in plan_of_mock]


def _tell(what: str, share: float) -> None:
    """From another process, between the bar's lines."""
    sys.stderr.write(f"time series: {share:4.0%}: {what}\n")


if __name__ == "__main__":
    sys.exit(main())
