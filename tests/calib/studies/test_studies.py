"""Studies give the same bytes whoever runs them, go on where they were stopped, and refuse another study's results."""

import math
from collections.abc import Iterator, Sequence
from concurrent.futures import Future
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from calib.errors import CalibrationError
from calib.studies import ChunkStore, Executor, InProcess, ProcessPool, Results, S, T, Work, as_they_come, executor, run_study
from calib.validation.statistics import proportion, quantile
from tests.calib.studies.tasks import dies, drawn

TASKS = 7


def bytes_of(folder: Path) -> dict[str, bytes]:
    return {file.name: file.read_bytes() for file in sorted(folder.iterdir())}


def studied(folder: Path, runs: Executor, work: Work[int, Results] = drawn) -> ChunkStore:
    store = ChunkStore(folder, {"seed": 3})
    run_study(work, 3, TASKS, runs, store)
    return store


FRUGAL = {  # the workers share one import of the library, and nothing is sampled beside the tasks
    "distributed.worker.multiprocessing-method": "forkserver",
    "distributed.worker.profile.enabled": False,
    "distributed.admin.system-monitor.interval": "5s",
}


@contextmanager
def dask_cluster() -> Iterator[str]:
    dask, distributed = pytest.importorskip("dask"), pytest.importorskip("distributed")
    with (
        dask.config.set(FRUGAL),
        distributed.LocalCluster(n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None) as cluster,
    ):
        yield cluster.scheduler_address


def test_two_processes_give_the_bytes_of_one(tmp_path: Path) -> None:
    studied(tmp_path / "one", InProcess())
    with ProcessPool(2) as pool:
        studied(tmp_path / "two", pool)
    assert bytes_of(tmp_path / "one") == bytes_of(tmp_path / "two")
    assert len(bytes_of(tmp_path / "one")) == TASKS + 1


@pytest.mark.filterwarnings("default")  # of the cluster's own libraries
def test_two_dask_workers_give_the_bytes_of_one(tmp_path: Path) -> None:
    with dask_cluster() as address, executor(TASKS, cluster=address) as runs:
        assert runs.workers == 2
        studied(tmp_path / "cluster", runs)
    studied(tmp_path / "one", InProcess())
    assert bytes_of(tmp_path / "cluster") == bytes_of(tmp_path / "one")


class Stopped(InProcess):
    """Is interrupted after three tasks."""

    def results(self, work: Work[S, T], shared: S, numbers: Sequence[int]) -> Iterator[tuple[int, T]]:
        for number in numbers[:3]:
            yield number, work(shared, number)
        raise KeyboardInterrupt


class Counted(InProcess):
    """Knows which tasks were asked for."""

    asked: Sequence[int] = ()

    def results(self, work: Work[S, T], shared: S, numbers: Sequence[int]) -> Iterator[tuple[int, T]]:
        self.asked = numbers
        return super().results(work, shared, numbers)


def test_a_stopped_study_goes_on_where_it_was(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        studied(tmp_path / "stopped", Stopped())
    again = Counted()
    studied(tmp_path / "stopped", again)
    studied(tmp_path / "whole", InProcess())
    assert again.asked == [3, 4, 5, 6]
    assert bytes_of(tmp_path / "stopped") == bytes_of(tmp_path / "whole")


def test_what_is_finished_comes_before_what_failed_at_the_same_moment() -> None:
    futures: dict[int, Future[int]] = {number: Future() for number in range(8)}
    for number, one in futures.items():
        one.set_result(number) if number % 2 else one.set_exception(BrokenProcessPool())
    came = as_they_come(futures.__getitem__, 8, range(8))
    assert sorted(next(came)[1] for _ in range(4)) == [1, 3, 5, 7]
    with pytest.raises(BrokenProcessPool):
        next(came)


def test_a_killed_process_is_one_sentence_and_loses_no_finished_task(tmp_path: Path) -> None:
    with ProcessPool(1) as pool, pytest.raises(CalibrationError, match="was killed"):
        studied(tmp_path / "study", pool, dies)
    assert (tmp_path / "study" / "000000.npz").exists()
    assert not (tmp_path / "study" / "000001.npz").exists()


@pytest.mark.parametrize("content", ["{}", "[1]", "{", '{"key": "other"}'])
def test_results_of_another_study_are_refused(tmp_path: Path, content: str) -> None:
    (tmp_path / "study.json").write_text(content)
    with pytest.raises(CalibrationError, match="another study"):
        ChunkStore(tmp_path, {"seed": 3})
    assert (tmp_path / "study.json").read_text() == content


def test_every_task_has_its_own_random_numbers(tmp_path: Path) -> None:
    store = studied(tmp_path / "study", InProcess())
    values = np.array([store.read(number)["values"] for number in range(TASKS)])
    assert len(np.unique(values)) == values.size


def test_what_runs_a_study_is_chosen_by_the_options() -> None:
    with executor(1) as one, executor(5, 1) as asked, executor(5, 3) as three:
        assert (one.workers, asked.workers, three.workers) == (1, 1, 3)
    with pytest.raises(CalibrationError, match="--workers: expected 1 or more"), executor(5, 0):
        pass
    with pytest.raises(CalibrationError, match="give one"), executor(5, 2, "tcp://127.0.0.1:1"):
        pass


@pytest.mark.filterwarnings("default")
def test_a_cluster_that_does_not_answer_is_one_sentence() -> None:
    with pytest.raises(CalibrationError, match="--cluster nonsense://x"), executor(5, None, "nonsense://x"):
        pass


def test_intervals_hold_the_value_and_shrink_with_the_count() -> None:
    few, many = proportion(9, 10), proportion(900, 1000)
    assert few.lower < many.lower < 0.9 < many.upper < few.upper < 1.0
    assert proportion(0, 20).lower == 0.0
    assert proportion(20, 20).upper == 1.0
    normal = np.random.default_rng(0).standard_normal(4000)
    found = quantile(normal, 0.95)
    assert found.lower < 1.645 < found.upper
    assert math.isclose(found.value, float(np.quantile(normal, 0.95)))
