"""Runs the numbered tasks of a study: in this process, in a pool of processes, or on a Dask cluster.

A task is `work(shared, number)`: a module's function, what all tasks share (pickled), and the task's number, from which it
draws its seed (`task_rng`). Its result therefore does not depend on who runs it, or when.
"""

from __future__ import annotations

import hashlib
import io
import itertools
import json
import multiprocessing
import os
import shutil
import signal
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import AbstractContextManager, contextmanager
from functools import partial
from importlib.metadata import version
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Protocol, TypeVar
from zipfile import BadZipFile

import numpy as np

from calib.arrays import Array
from calib.errors import CalibrationError
from control.files import parsed_json, read_bytes, write_whole
from control.plain_text import Advance, silent
from firmware_iface.interrupts import NUMBERS, held, signal_on_death_of

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

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        """Tasks that run are finished, those that wait are dropped."""
        self._pool.shutdown(cancel_futures=True)


def as_they_come(submit: Callable[[int], Future[T]], limit: int, numbers: Sequence[int]) -> Iterator[tuple[int, T]]:
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


FORMAT = "study/1"


class ChunkStore:
    """A folder with a file for each finished task, and study.json, which says of what study."""

    def __init__(self, folder: Path, about: Mapping[str, object]) -> None:
        """`about` (JSON) is everything that results depend on. CalibrationError if the folder holds another study's."""
        self._folder = folder
        key = hashlib.sha256(json.dumps(about, sort_keys=True).encode()).hexdigest()
        file = folder / "study.json"
        if not file.exists():
            folder.mkdir(parents=True, exist_ok=True)
            content = {"format": FORMAT, "key": key, "about": about}
            write_whole(file, json.dumps(content, indent=2, sort_keys=True) + "\n")
        elif _key_in(file) != key:
            raise CalibrationError(
                f"{folder}: holds unfinished results of another study (its input or options differ): remove it, or choose"
                " another --out"
            )

    def has(self, number: int) -> bool:
        """Whether a task is finished."""
        return self._file(number).exists()

    def write(self, number: int, results: Results) -> None:
        """Store the results of a task, complete or not at all."""
        content = io.BytesIO()
        arrays: dict[str, Any] = dict(results)
        np.savez(content, **arrays)
        write_whole(self._file(number), content.getvalue())

    def read(self, number: int) -> Results:
        """The results of a finished task. CalibrationError if its file is damaged."""
        try:
            with self._file(number).open("rb") as file, np.load(file, allow_pickle=False) as content:
                return {name: content[name] for name in content.files}
        except (OSError, ValueError, KeyError, EOFError, NotImplementedError, MemoryError, BadZipFile, zlib.error) as error:
            raise CalibrationError(
                f"{self._file(number)}: damaged ({type(error).__name__}): remove it, and start the study again"
            ) from None

    def remove(self) -> None:
        """Delete the folder, once the study's own result is written."""
        shutil.rmtree(self._folder)

    def _file(self, number: int) -> Path:
        return self._folder / f"{number:06}.npz"


def run_study(
    work: Work[S, Results], shared: S, count: int, executor: Executor, store: ChunkStore, advance: Advance = silent
) -> None:
    """Run the tasks 0 .. count - 1 that the store does not have, and store them."""
    missing = [number for number in range(count) if not store.has(number)]
    done = count - len(missing)
    for number, results in executor.results(work, shared, missing):
        store.write(number, results)
        done += 1
        advance(f"task {done} of {count}", done / count)


def _key_in(file: Path) -> str | None:
    try:
        content = parsed_json(read_bytes(file))
    except (OSError, ValueError):
        return None
    return content.get("key") if isinstance(content, dict) else None


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
            raise CalibrationError(f"--cluster {self._address}: the scheduler has no workers: start `dask worker`")
        ours = version("armwright")
        theirs = set(self._client.run(version, "armwright").values())
        if theirs != {ours}:
            raise CalibrationError(
                f"--cluster {self._address}: the workers have armwright {', '.join(sorted(theirs))}, expected {ours}"
            )

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
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
