"""Chooses what runs a study."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from calib.errors import CalibrationError
from calib.studies.cluster import DaskCluster
from calib.studies.executor import Executor, InProcess, ProcessPool, usual_workers


@contextmanager
def executor(tasks: int, workers: int | None = None, cluster: str | None = None) -> Iterator[Executor]:
    """A cluster where its address is given; else `workers` processes (default: as many as processors, at most `tasks`)."""
    if cluster is not None and workers is not None:
        raise CalibrationError("--workers and --cluster: give one; a cluster has its own workers")
    if workers is not None and workers < 1:
        raise CalibrationError(f"--workers: expected 1 or more, got {workers}")
    if cluster is not None:
        with DaskCluster(cluster) as of_cluster:
            yield of_cluster
        return
    count = min(tasks, usual_workers() if workers is None else workers)
    if count <= 1:
        yield InProcess()
        return
    with ProcessPool(count) as pool:
        yield pool
