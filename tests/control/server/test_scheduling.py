"""What the loop asks of the system, and what it says about the time that was taken from it."""

from __future__ import annotations

from pathlib import Path

import pytest

from control.loop.punctuality import Punctuality
from control.server.scheduling import isolated_cpus, strain


@pytest.mark.parametrize(
    ("text", "cpus"), [("", set()), ("3", {3}), ("2-3", {2, 3}), ("1,4-6\n", {1, 4, 5, 6})], ids=str
)
def test_isolated_processors_are_read_as_the_kernel_lists_them(
    tmp_path: Path, text: str, cpus: set[int]
) -> None:
    (tmp_path / "isolated").write_text(text)
    assert isolated_cpus(tmp_path / "isolated") == cpus
    assert isolated_cpus(tmp_path / "absent") == set()


def test_page_faults_of_this_thread_are_counted() -> None:
    before = strain()
    touched = bytearray(1 << 24)  # pages that nobody has used yet
    touched[::4096] = bytes(1 << 12)
    assert strain()[0] > before[0]
    assert strain()[1] >= before[1]


def test_each_cycle_has_its_own_faults_and_switches() -> None:
    so_far = iter([(100, 7), (103, 7), (103, 9)])
    punctuality = Punctuality(0.002, lambda: 0.0, lambda: next(so_far))
    assert [punctuality.strain(), punctuality.strain()] == [(3, 0), (0, 2)]
    assert Punctuality(0.002, lambda: 0.0).strain() == (0, 0)
