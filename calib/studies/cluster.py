"""Runs tasks on a Dask cluster (the extra `cluster`): `dask scheduler` and `dask worker` with armwright installed."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from importlib.metadata import version
from types import TracebackType
from typing import Final

from calib.errors import CalibrationError
from calib.studies.executor import AHEAD, Executor, InProcess, ProcessPool, S, T, Work, usual_workers

CONNECT_s: Final = 10.0  # a scheduler in the same building answers in milliseconds


class DaskCluster(AbstractContextManager["DaskCluster"]):
    """The workers of a scheduler at `address`, such as tcp://10.0.0.5:8786; a context manager.

    CalibrationError if distributed is not installed, if nothing answers, or if the workers have another armwright.
    """

    def __init__(self, address: str) -> None:
        try:
            import distributed
        except ImportError:
            raise CalibrationError(
                f"--cluster {address}: needs the package distributed: install armwright with its extra `cluster`"
            ) from None
        self._dask, self._address = distributed, address
        try:
            self._client = distributed.Client(address, timeout=CONNECT_s, set_as_default=False)
        except (OSError, ValueError) as error:
            reason = " ".join(str(error).split()) or type(error).__name__
            raise CalibrationError(
                f"--cluster {address}: no scheduler answers there ({reason}); expected an address such as tcp://HOST:8786"
            ) from None
        self.workers = sum(self._client.nthreads().values())
        self._require_same_program()

    def results(self, work: Work[S, T], shared: S, numbers: Sequence[int]) -> Iterator[tuple[int, T]]:
        """At most AHEAD tasks a worker are handed out, so that results do not pile up."""
        waiting = iter(numbers)
        running = {}
        for number in itertools.islice(waiting, AHEAD * self.workers):
            running[self._client.submit(work, shared, number, pure=False)] = number
        done = self._dask.as_completed(list(running), loop=self._client.loop)
        for future in done:
            try:
                yield running.pop(future), future.result()
            except self._dask.KilledWorker:
                raise CalibrationError(
                    f"--cluster {self._address}: workers died at the same task (by a lack of memory?): what was finished is"
                    " kept; run the command again"
                ) from None
            for number in itertools.islice(waiting, 1):
                another = self._client.submit(work, shared, number, pure=False)
                running[another] = number
                done.add(another)

    def _require_same_program(self) -> None:
        if not self.workers:
            raise CalibrationError(
                f"--cluster {self._address}: the scheduler has no workers: start `dask worker`"
            )
        ours = version("armwright")
        theirs = set(self._client.run(version, "armwright").values())
        if theirs != {ours}:
            raise CalibrationError(
                f"--cluster {self._address}: the workers have armwright {', '.join(sorted(theirs))}, expected {ours}"
            )

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """The cluster goes on; its tasks of this study are dropped."""
        self._client.close()


# Chooses what runs a study.
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
