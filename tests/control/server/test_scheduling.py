"""What the loop asks of the system, and what it says about the time that was taken from it."""

from __future__ import annotations

import gc
import mmap
import os
import signal
import weakref
from collections.abc import Iterator
from pathlib import Path
from typing import cast

import pytest

from control.loop.arm_state import Punctuality
from control.loop.drives import Bound
from control.server.process import run
from control.server.scheduling import COLLECT_EVERY_S, MOST_YOUNG, Collector, isolated_cpus, needed_in_memory, strain
from control.server.server import Server
from tests.cell import open_cell


@pytest.mark.parametrize(("text", "cpus"), [("", set()), ("3", {3}), ("2-3", {2, 3}), ("1,4-6\n", {1, 4, 5, 6})], ids=str)
def test_isolated_processors_are_read_as_the_kernel_lists_them(tmp_path: Path, text: str, cpus: set[int]) -> None:
    (tmp_path / "isolated").write_text(text)
    assert isolated_cpus(tmp_path / "isolated") == cpus
    assert isolated_cpus(tmp_path / "absent") == set()


def test_page_faults_of_this_thread_are_counted() -> None:
    before = strain()
    with mmap.mmap(-1, 1 << 20) as untouched:  # from the kernel itself: malloc may give used pages
        for page in range(0, len(untouched), mmap.PAGESIZE):
            untouched[page] = 1
    assert strain()[0] > before[0]
    assert strain()[1] >= before[1]


def test_each_cycle_has_its_own_faults_and_switches() -> None:
    so_far = iter([(100, 7), (103, 7), (103, 9)])
    punctuality = Punctuality(0.002, lambda: 0.0, lambda: next(so_far))
    assert [punctuality.strain(), punctuality.strain()] == [(3, 0), (0, 2)]
    assert Punctuality(0.002, lambda: 0.0).strain() == (0, 0)


class Knot:
    """Holds itself: only the collector frees it."""

    def __init__(self) -> None:
        self.held = self


def knots(count: int) -> weakref.ref[Knot]:
    """Make garbage; the reference to the last of it tells whether it was collected."""
    for _ in range(count - 1):
        Knot()
    return weakref.ref(Knot())


@pytest.fixture
def no_collector() -> Iterator[None]:
    """As in the loop's process."""
    gc.collect()
    gc.freeze()
    gc.disable()
    yield
    gc.enable()
    gc.unfreeze()


@pytest.mark.usefixtures("no_collector", "nobody_below")
def test_garbage_is_collected_once_a_second_where_the_arm_stands_and_never_where_it_is_controlled() -> None:
    with open_cell() as cell:
        cell.client.enable()
        cell.run(1.0)
        gc.collect()  # what was imported on the way here counts as young
        collector, garbage = Collector(), knots(10)
        assert not collector.look(0.0, cell.runtime)
        assert garbage() is not None, "collected while the arm is held"
        cell.client.ask("brake")
        assert not collector.look(0.0, cell.runtime)
        assert garbage() is not None, "collected while the arm sinks"
        cell.run(1.0)
        assert not collector.look(0.0, cell.runtime)
        assert garbage() is None
        garbage = knots(10)
        collector.look(0.9 * COLLECT_EVERY_S, cell.runtime)
        assert garbage() is not None
        collector.look(1.1 * COLLECT_EVERY_S, cell.runtime)
        assert garbage() is None


@pytest.mark.usefixtures("no_collector", "nobody_below")
def test_what_would_make_a_cycle_late_is_collected_once_the_drives_are_off() -> None:
    with open_cell() as cell:
        cell.client.enable()
        cell.client.ask("brake")
        cell.run(1.0)
        collector, garbage = Collector(), knots(2 * MOST_YOUNG)
        collector.look(0.0, cell.runtime)
        assert garbage() is not None
        cell.client.off()
        cell.run(1.0)
        assert collector.look(2.0 * COLLECT_EVERY_S, cell.runtime), "the next deadline is a period from now"
        assert garbage() is None


def test_a_signal_that_comes_while_a_request_is_served_ends_the_runtime_after_it() -> None:
    """A request may wait for boards; nothing else is begun in the middle of it."""
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    with open_cell() as cell:

        class Serving:
            polls = 0

            def poll(self) -> None:
                self.polls += 1
                if self.polls == 5:
                    os.kill(os.getpid(), signal.SIGTERM)
                    assert cell.runtime.bound is Bound.NOWHERE

        serving = Serving()
        try:
            run(cell.assembly, cast(Server, serving), cell.rig.clock, cell.runtime.period_s, [])
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)
        assert (cell.runtime.bound, serving.polls) == (Bound.QUIT, 6)


def test_memory_is_locked_but_for_linear_algebra_and_its_buffers() -> None:
    text = (
        "7f9db2200000-7f9db4200000 rw-p 00000000 00:00 0 \n"  # a buffer of 32 MB
        "7f9db4200000-7f9db4300000 rw-p 00000000 00:00 0 \n"
        "7f9db5000000-7f9db5001000 ---p 00000000 00:00 0 \n"
        "7f9db6000000-7f9db6002000 r-xp 00001000 fe:00 1234    /a folder/libscipy_openblas64_-32a4.so\n"
        "7f9db7000000-7f9db9000000 r-xp 00001000 fe:00 1235    /a folder/libpython3.so\n"  # as large as the buffer
        "7ffc1000-7ffc2000 r--p 00000000 00:00 0              [vvar]\n"
        "7ffd1000-7ffd3000 rw-p 00000000 00:00 0              [stack]\n"
    )
    assert list(needed_in_memory(text)) == [(0x7F9DB4200000, 1 << 20), (0x7F9DB7000000, 32 << 20), (0x7FFD1000, 0x2000)]
