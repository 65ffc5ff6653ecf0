"""Mutation testing: `python -m tests.mutants.run [MODULE ...]` (`make mutants`) of what keeps the arm safe, every change;
`python -m tests.mutants.run --sample 300 --seed 1` (`make mutants SAMPLE=300`) of the whole product, changes drawn by chance.

Each mutant runs in a forked process in which the mutated module is imported in place of the real one, with the tests of that
module. One that no test fails has survived: tests/mutants/survivors.toml lists the known ones of the safety layer with reasons;
others are an error. A sample is an error where fewer than nine in ten are killed.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib.abc
import importlib.util
import os
import random
import signal
import sys
import time
import tomllib
from collections.abc import Iterable, Sequence
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import ModuleType

import hypothesis
import numpy as np
import pytest

from firmware_iface.installation import PACKAGES
from tests.mutants.mutator import Mutant, mutants_of, sites_of

ROOT = Path(__file__).parents[2]
LIST = Path(__file__).with_name("survivors.toml")
TIMEOUT_s = 300
TESTS: dict[str, tuple[str, ...]] = {
    "control.safety.limits": ("tests/control/safety/test_limits.py", "tests/property/test_limits_properties.py"),
    "control.safety.modes": ("tests/control/safety/test_monitor.py", "tests/control/loop/test_reactions.py"),
    "control.safety.motor_checks": ("tests/control/safety/test_motor_checks.py", "tests/control/loop/test_reactions.py"),
    "control.safety.workspace": ("tests/control/safety/test_workspace.py",),
    "control.safety.collision": ("tests/control/safety/test_collision.py",),
    "control.loop.drives": ("tests/control/loop/test_drives.py",),
    "control.loop.standstill": ("tests/control/loop/test_standstill.py",),
    "control.motion.lookout": ("tests/control/motion/test_lookout.py",),
    "control.loop.watch": ("tests/control/loop/test_reactions.py", "tests/control/loop/test_watch.py"),
    "control.loop.cross_checks": ("tests/control/loop/test_reactions.py",),
}
WIDER = {  # of rooms whose promises others show
    "control.hardware": "tests/contract",
    "firmware_iface": "tests/contract",
    "hil_mocks": "tests/contract",
    "console.commands": "tests/console",
}
AT_ONCE = os.cpu_count() or 1
KILLED_SHARE = 0.9  # asked of a sample


class _Mutated(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Imports one module from a mutant's source."""

    def __init__(self, name: str, source: str) -> None:
        self._name, self._source = name, source

    def find_spec(self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None) -> ModuleSpec | None:
        if fullname != self._name:
            return None
        return importlib.util.spec_from_loader(fullname, self, origin="mutant")

    def exec_module(self, module: ModuleType) -> None:
        exec(compile(self._source, "mutant", "exec"), module.__dict__)


def survivors(name: str) -> tuple[list[Mutant], int]:
    """The mutants of a module that no test fails, and how many there are."""
    source = _file(name).read_text("utf-8")
    found = list(mutants_of(source))
    require_green(name, source)
    alive = [mutant for _, mutant in survivors_of((name, mutant) for mutant in found)]
    return sorted(alive, key=lambda mutant: mutant.line), len(found)


def _file(name: str) -> Path:
    return (ROOT / Path(*name.split("."))).with_suffix(".py")


def require_green(name: str, source: str) -> None:
    """SystemExit unless the tests of a module pass as it is."""
    _, status = os.waitpid(_started(name, Mutant(0, "", "", source)), 0)
    if os.waitstatus_to_exitcode(status) != 0:
        raise SystemExit(f"{name}: its tests fail without a mutant, or do not run")


def survivors_of(mutants: Iterable[tuple[str, Mutant]]) -> list[tuple[str, Mutant]]:
    """Those of the mutants, each with its module, that no test fails."""
    running: dict[int, tuple[str, Mutant]] = {}
    alive: list[tuple[str, Mutant]] = []

    def collect() -> None:
        pid, status = os.wait()
        name, mutant = running.pop(pid)
        if os.waitstatus_to_exitcode(status) == 0:
            alive.append((name, mutant))
            print(f"  survives {name} {mutant}", flush=True)

    for name, mutant in mutants:
        if len(running) >= AT_ONCE:
            collect()
        running[_started(name, mutant)] = name, mutant
    while running:
        collect()
    return alive


def sampled(count: int, seed: int) -> list[tuple[str, Mutant]]:
    """So many mutants of the whole product, each place as likely as any other."""
    files = [file for package in PACKAGES for file in sorted((ROOT / package).rglob("*.py"))]
    places = [(file, site) for file in files for site in sites_of(file.read_text("utf-8"))]
    drawn = random.Random(seed).sample(places, min(count, len(places)))
    found = []
    for file, site in drawn:
        name = ".".join(file.relative_to(ROOT).with_suffix("").parts)
        found += [(name, mutant) for mutant in mutants_of(file.read_text("utf-8"), [site])]
    return found


def tests_of(name: str) -> tuple[str, ...]:
    """The tests of a module: those listed, or its own file and the folder that mirrors its room."""
    if name in TESTS:
        return TESTS[name]
    folder = Path("tests", *name.split(".")[:-1])
    while not any((ROOT / folder).rglob("test_*.py")):
        folder = folder.parent
    own = [str(file.relative_to(ROOT)) for file in (ROOT / folder).rglob(f"test_{name.split('.')[-1]}.py")]
    return (*own, str(folder), *(test for room, test in WIDER.items() if name.startswith(room)))


def _started(name: str, mutant: Mutant) -> int:
    if pid := os.fork():
        return pid
    signal.alarm(TIMEOUT_s)  # kills a mutant that never ends
    with contextlib.suppress(BaseException):
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        os.dup2(1, 2)
        sys.meta_path.insert(0, _Mutated(name, mutant.source))
        hypothesis.settings.register_profile("mutants", max_examples=40, derandomize=True, database=None)
        quiet = [
            "--hypothesis-profile=mutants",
            "-W",
            "ignore::pytest.PytestAssertRewriteWarning",
            "-p",
            "no:cacheprovider",
            "-p",
            "no:xdist",
        ]
        status = pytest.main(["-x", "-q", "-m", "not hardware and not nightly", *quiet, *tests_of(name)])
        os._exit(int(status))
    os._exit(1)


def _known() -> set[str]:
    modules = tomllib.loads(LIST.read_text("utf-8")).values()
    return {change for reasons in modules for changes in reasons.values() for change in changes}


def main(arguments: Sequence[str]) -> int:
    """Print the survivors; 1 if one is not listed in tests/mutants/survivors.toml, or too many of a sample live."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("modules", nargs="*", metavar="MODULE")
    parser.add_argument("--sample", type=int, help="how many changes of the whole product")
    parser.add_argument("--seed", type=int, default=1)
    args = parser.parse_args(arguments)
    assert np.__version__  # imported before the forks
    if args.sample is not None:
        return _run_sample(args.sample, args.seed)
    return _run_modules(args.modules or list(TESTS))


def _run_sample(count: int, seed: int) -> int:
    begun_s = time.monotonic()
    mutants = sampled(count, seed)
    alive = survivors_of(mutants)
    share = 1.0 - len(alive) / len(mutants)
    print(
        f"seed {seed}: {len(mutants) - len(alive)} of {len(mutants)} mutants killed, {100 * share:.0f} %"
        f" ({time.monotonic() - begun_s:.0f} s)"
    )
    return int(share < KILLED_SHARE)


def _run_modules(names: Sequence[str]) -> int:
    known, unknown = _known(), 0
    for name in names:
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
