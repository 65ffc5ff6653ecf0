"""Runs the numbered tasks of a study: in this process, in a pool of processes, or on a Dask cluster.

A task is `work(shared, number)`: a module's function, what all tasks share (pickled), and the task's number, from which it
draws its seed (`task_rng`). Its result therefore does not depend on who runs it, or when.
"""

from __future__ import annotations

import itertools
import multiprocessing
import os
import signal
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import AbstractContextManager
from functools import partial
from types import TracebackType
from typing import Final, Protocol, TypeVar

import numpy as np

from calib.arrays import Array
from calib.errors import CalibrationError
from control.parent_death import signal_on_death_of
from firmware_iface.interrupts import NUMBERS, held

Results = Mapping[str, Array]
T = TypeVar("T")
S = TypeVar("S")
Work = Callable[[S, int], T]
AHEAD: Final = 2  # tasks handed out for each worker: one runs, one waits


class Executor(Protocol):
    """What runs tasks."""

    @property
    def workers(self) -> int:
        """How many tasks run at once."""

    def results(self, work: Work[S, T], shared: S, numbers: Sequence[int]) -> Iterator[tuple[int, T]]:
        """The results with their numbers, in the order in which they come."""


def task_rng(seed: int, number: int) -> np.random.Generator:
    """The random numbers of one task: independent of those of the others (numpy's SeedSequence)."""
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(number,)))


class InProcess:
    """One task after the other, in this process."""

    workers = 1

    def results(self, work: Work[S, T], shared: S, numbers: Sequence[int]) -> Iterator[tuple[int, T]]:
        """In the order of the numbers."""
        for number in numbers:
            yield number, work(shared, number)


class ProcessPool(AbstractContextManager["ProcessPool"]):
    """Processes of this machine; a context manager. CalibrationError if one is killed."""

    def __init__(self, workers: int) -> None:
        """The processes start with the first task; they are not forked, since this process may have threads of BLAS."""
        self.workers = workers
        context = multiprocessing.get_context("spawn")
        self._pool = ProcessPoolExecutor(workers, context, _prepare_worker, (os.getpid(),))

    def results(self, work: Work[S, T], shared: S, numbers: Sequence[int]) -> Iterator[tuple[int, T]]:
        """At most AHEAD tasks a worker are handed out, so that results do not pile up."""
        try:
            yield from as_they_come(partial(self._submit, work, shared), AHEAD * self.workers, numbers)
        except BrokenProcessPool:
            raise CalibrationError(
                "a worker process was killed (by a lack of memory?): what was finished is kept; run the command again,"
                " with fewer --workers"
            ) from None

    def _submit(self, work: Work[S, T], shared: S, number: int) -> Future[T]:
        with held():  # it may start a process
            return self._pool.submit(work, shared, number)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Tasks that run are finished, those that wait are dropped."""
        self._pool.shutdown(cancel_futures=True)


def as_they_come(
    submit: Callable[[int], Future[T]], limit: int, numbers: Sequence[int]
) -> Iterator[tuple[int, T]]:
    """Results of futures, with at most `limit` of them unfinished or unread; what is finished comes before what failed."""
    waiting = iter(numbers)
    running = {submit(number): number for number in itertools.islice(waiting, limit)}
    while running:
        done = wait(running, return_when=FIRST_COMPLETED).done
        for one in sorted(done, key=lambda future: future.exception() is not None):
            yield running.pop(one), one.result()
            for number in itertools.islice(waiting, 1):
                running[submit(number)] = number


def _prepare_worker(parent: int) -> None:
    """Ctrl-C is the parent's to handle, and no worker outlives it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, NUMBERS)
    signal_on_death_of(parent, signal.SIGKILL)()


def usual_workers() -> int:
    """The processors that this process may use."""
    return len(os.sched_getaffinity(0))
