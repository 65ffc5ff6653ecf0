"""Mutation testing of what keeps the arm safe: `python -m tests.mutants.run [MODULE ...]` (`make mutants`).

Each mutant runs in a forked process in which the mutated module is imported in place of the real one, with the tests of that
module. One that no test fails has survived: tests/mutants/survivors.md lists the known ones with reasons; others are an error.
"""

from __future__ import annotations

import contextlib
import importlib.abc
import importlib.util
import os
import signal
import sys
import time
from collections.abc import Sequence
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import ModuleType

import hypothesis
import numpy as np
import pytest

from tests.mutants.mutator import Mutant, mutants_of

ROOT = Path(__file__).parents[2]
LIST = Path(__file__).with_name("survivors.md")
TIMEOUT_s = 300
TESTS: dict[str, tuple[str, ...]] = {
    "control.safety.limits": (
        "tests/control/safety/test_limits.py",
        "tests/property/test_limits_properties.py",
    ),
    "control.safety.monitor": ("tests/control/safety/test_monitor.py",),
    "control.safety.table": ("tests/control/safety/test_monitor.py",),
    "control.safety.fault": ("tests/control/safety/test_monitor.py", "tests/control/loop/test_reactions.py"),
    "control.safety.motor_checks": (
        "tests/control/safety/test_motor_checks.py",
        "tests/control/loop/test_reactions.py",
    ),
    "control.safety.workspace": ("tests/control/safety/test_workspace.py",),
    "control.safety.body": ("tests/control/safety/test_collision.py",),
    "control.safety.collision": ("tests/control/safety/test_collision.py",),
    "control.loop.readiness": ("tests/control/loop/test_readiness.py",),
    "control.loop.standstill": ("tests/control/loop/test_standstill.py",),
    "control.motion.lookout": ("tests/control/motion/test_lookout.py",),
    "control.loop.watch": ("tests/control/loop/test_reactions.py", "tests/control/loop/test_watch.py"),
    "control.loop.cross_checks": ("tests/control/loop/test_reactions.py",),
}
AT_ONCE = os.cpu_count() or 1


class _Mutated(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Imports one module from a mutant's source."""

    def __init__(self, name: str, source: str) -> None:
        self._name, self._source = name, source

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if fullname != self._name:
            return None
        return importlib.util.spec_from_loader(fullname, self, origin="mutant")

    def exec_module(self, module: ModuleType) -> None:
        exec(compile(self._source, "mutant", "exec"), module.__dict__)


def survivors(name: str) -> tuple[list[Mutant], int]:
    """The mutants of a module that no test fails, and how many there are."""
    source = (ROOT / Path(*name.split("."))).with_suffix(".py").read_text("utf-8")
    found = list(mutants_of(source))
    _, status = os.waitpid(_started(name, Mutant(0, "", "", source)), 0)
    if os.waitstatus_to_exitcode(status) != 0:
        raise SystemExit(f"{name}: its tests fail without a mutant, or do not run")
    running: dict[int, Mutant] = {}
    alive: list[Mutant] = []

    def collect() -> None:
        pid, status = os.wait()
        mutant = running.pop(pid)
        if os.waitstatus_to_exitcode(status) == 0:
            alive.append(mutant)
            print(f"  survives {mutant}", flush=True)

    for mutant in found:
        if len(running) >= AT_ONCE:
            collect()
        running[_started(name, mutant)] = mutant
    while running:
        collect()
    return sorted(alive, key=lambda mutant: mutant.line), len(found)


def _started(name: str, mutant: Mutant) -> int:
    if pid := os.fork():
        return pid
    signal.alarm(TIMEOUT_s)  # kills a mutant that never ends
    with contextlib.suppress(BaseException):
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        os.dup2(1, 2)
        sys.meta_path.insert(0, _Mutated(name, mutant.source))
        hypothesis.settings.register_profile("mutants", max_examples=40, derandomize=True, database=None)
        hypothesis.settings.load_profile("mutants")
        quiet = [
            "-W",
            "ignore::pytest.PytestAssertRewriteWarning",
            "-p",
            "no:cacheprovider",
            "-p",
            "no:xdist",
        ]
        status = pytest.main(["-x", "-q", *quiet, *TESTS[name]])
        os._exit(int(status))
    os._exit(1)


def _known() -> str:
    return LIST.read_text("utf-8") if LIST.exists() else ""


def main(names: Sequence[str]) -> int:
    """Print the survivors of each module; 1 if one is not listed in tests/mutants/survivors.md."""
    known, unknown = _known(), 0
    assert np.__version__  # imported before the forks
    for name in names or TESTS:
        begun_s = time.monotonic()
        alive, count = survivors(name)
        print(
            f"{name}: {count - len(alive)} of {count} mutants killed, {len(alive)} survive ({time.monotonic() - begun_s:.0f} s)",
            flush=True,
        )
        unknown += sum(mutant.change not in known for mutant in alive)
    print(f"{unknown} of the survivors are not in {LIST.relative_to(ROOT)}")
    return 1 if unknown else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
