"""The tolerance study's throughput: the executor with its results on disk against plain numpy, and two processes against one."""

from __future__ import annotations

import resource
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from time import perf_counter

from benchmarks.table import BenchRow
from calib.studies import ChunkStore, Executor, InProcess, ProcessPool, run_study
from calib.tolerances.making import parse_tolerances, tolerances_text
from calib.tolerances.study import CHUNK, StudyDesign, design_of, study_task
from control.model.description import load_arm

ARMS = 6000
WORKERS = 2
OVERHEAD_MOST = 1.15  # of processor time, for the executor, seeds and files


def rows() -> Iterator[BenchRow]:
    """Arms drawn, calibrated twice and compared at 250 poses, without the costs of single tolerances."""
    arm = load_arm("right")
    design = design_of(arm, parse_tolerances(tolerances_text("right"), "right", arm), ARMS)
    plain_s, plain_cpu_s = _timed(lambda: _plain(design))
    alone_s, _ = _timed(lambda: _stored(design, InProcess()))
    start_cpu_s, _ = _in_pool(replace(design, arms_count=CHUNK + 1))
    pool_cpu_s, both_s = _in_pool(design)
    yield BenchRow("arms a second, one process", ARMS / alone_s, "1/s", "plain numpy", ARMS / plain_s, plain_s / alone_s)
    overhead = (pool_cpu_s - start_cpu_s) / plain_cpu_s
    yield BenchRow(
        "processor time of two processes, without their start",
        pool_cpu_s - start_cpu_s,
        "s",
        "plain numpy",
        plain_cpu_s,
        overhead,
        f"<= {OVERHEAD_MOST}",
        overhead <= OVERHEAD_MOST,
    )
    yield BenchRow(
        "speed-up of two processes", alone_s / both_s, "", "ideal, two free processors", WORKERS, alone_s / both_s / WORKERS
    )


def _in_pool(design: StudyDesign) -> tuple[float, float]:
    """Seconds of all processors of a pool from its start to its end, and of the study without the start of the pool."""
    before_s = _children_s()
    with ProcessPool(WORKERS) as pool:
        _stored(replace(design, arms_count=CHUNK + 1), pool)  # starts the processes
        passed_s, _ = _timed(lambda: _stored(design, pool))
    return _children_s() - before_s, passed_s


def _plain(design: StudyDesign) -> None:
    for number in range(design.chunks):
        study_task(design, number)


def _stored(design: StudyDesign, runs: Executor) -> None:
    with tempfile.TemporaryDirectory() as folder:
        run_study(study_task, design, design.chunks, runs, ChunkStore(Path(folder), {}))


def _timed(work: Callable[[], None]) -> tuple[float, float]:
    """Seconds, and seconds of this process's processor."""
    begun_s, cpu_s = perf_counter(), resource.getrusage(resource.RUSAGE_SELF)
    work()
    now = resource.getrusage(resource.RUSAGE_SELF)
    return perf_counter() - begun_s, now.ru_utime + now.ru_stime - cpu_s.ru_utime - cpu_s.ru_stime


def _children_s() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime
