"""Mutation testing: `python -m tests.mutants.run [MODULE ...]` (`make mutants`) of what keeps the arm safe, every change;
`python -m tests.mutants.run --sample 300 --seed 1` (`make mutants SAMPLE=300`) of the whole product, changes drawn by chance.

Each mutant runs in a forked process in which the mutated module is imported in place of the real one, with the tests of that
module. One that no test fails has survived: tests/mutants/survivors.toml lists the known ones of the safety layer with reasons;
others are an error, and so is one that is listed and does not survive. Of a sample, tests/mutants/reach.py chooses the tests of
each change, and what none of them runs has survived; it is an error where fewer than nine in ten are killed.
"""

from __future__ import annotations

import argparse
import contextlib
import faulthandler
import importlib.abc
import importlib.util
import os
import pickle
import random
import sys
import tempfile
import time
import tomllib
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import ModuleType

import hypothesis
import pytest

from firmware_iface.installation import PACKAGES
from tests.mutants.mutator import Mutant, mutants_of, sites_of
from tests.mutants.reach import NEAREST, ROOT, WITHOUT, Chosen, MUTANT_s, Reach, nearest, probed

LIST = Path(__file__).with_name("survivors.toml")
TIMEOUT_s = 300
TESTS: dict[str, tuple[str, ...]] = {
    "control.safety.limits": ("tests/control/safety/test_limits.py", "tests/property/test_limits_properties.py"),
    "control.safety.modes": ("tests/control/safety/test_monitor.py", "tests/control/loop/test_reactions.py"),
    "control.safety.motor_checks": ("tests/control/safety/test_motor_checks.py", "tests/control/loop/test_reactions.py"),
    "control.safety.workspace": ("tests/control/safety/test_workspace.py",),
    "control.safety.collision": ("tests/control/safety/test_collision.py",),
    "control.loop.drives": ("tests/control/loop/test_drives.py", "tests/control/loop/test_standstill.py"),
    "control.motion.setpoint": ("tests/control/motion/test_lookout.py", "tests/control/motion/test_joint_move.py"),
    "control.loop.watch": ("tests/control/loop/test_reactions.py", "tests/control/loop/test_watch.py"),
    "control.loop.cross_checks": ("tests/control/loop/test_reactions.py",),
}
AT_ONCE = int(os.environ.get("AT_ONCE", os.cpu_count() or 1))
KILLED_SHARE = 0.9  # asked of a sample
OTHERS = (
    "numpy",
    "scipy.optimize",
    "scipy.stats",
    "scipy.spatial.transform",
    "mujoco",
    "matplotlib.figure",
    "textual.app",
    "ruckig",
)

Run = Callable[[], int]  # in a forked process: the exit status, 0 where no test fails


class _Mutated(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Imports modules from other sources."""

    def __init__(self, sources: Mapping[str, str], names: Mapping[str, object]) -> None:
        self._sources, self._names = sources, names

    def find_spec(self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None) -> ModuleSpec | None:
        if fullname not in self._sources:
            return None
        file = _file(fullname)
        folder = [str(file.parent)] if file.name == "__init__.py" else None
        spec = importlib.util.spec_from_file_location(fullname, file, loader=self, submodule_search_locations=folder)
        assert spec is not None
        return spec

    def exec_module(self, module: ModuleType) -> None:
        module.__dict__.update(self._names)
        exec(compile(self._sources[module.__name__], "mutant", "exec"), module.__dict__)


def survivors(name: str) -> tuple[list[Mutant], int]:
    """The mutants of a module that no test fails, and how many there are."""
    source = _file(name).read_text("utf-8")
    found = list(mutants_of(source))
    _, status = os.waitpid(_forked(partial(_tested, name, source), TIMEOUT_s), 0)
    if os.waitstatus_to_exitcode(status) != 0:
        raise SystemExit(f"{name}: its tests fail without a mutant, or do not run")
    alive = survivors_of((name, mutant, partial(_tested, name, mutant.source)) for mutant in found)
    return sorted(alive, key=lambda mutant: mutant.line), len(found)


def _file(name: str) -> Path:
    path = ROOT / Path(*name.split("."))
    module = path.with_suffix(".py")
    return module if module.exists() else path / "__init__.py"


def survivors_of(mutants: Iterable[tuple[str, Mutant, Run]], limit_s: int = TIMEOUT_s) -> list[Mutant]:
    """Those of the mutants, each with its module and its tests, that no test fails."""
    running: dict[int, tuple[str, Mutant]] = {}
    alive: list[Mutant] = []

    def collect() -> None:
        pid, status = os.wait()
        name, mutant = running.pop(pid)
        if os.waitstatus_to_exitcode(status) == 0:
            alive.append(mutant)
            print(f"  survives {name} {mutant}", flush=True)

    for name, mutant, run in mutants:
        if len(running) >= AT_ONCE:
            collect()
        running[_forked(run, limit_s)] = name, mutant
    while running:
        collect()
    return alive


def _forked(run: Run, limit_s: int) -> int:
    if pid := os.fork():
        return pid
    with contextlib.suppress(BaseException):
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        os.dup2(1, 2)
        if limit_s:  # ends a mutant that never ends; not by SIGALRM, which is the product's (firmware_iface/interrupts.py)
            faulthandler.dump_traceback_later(limit_s, exit=True, file=2)
        for name in [name for name in sys.modules if name.split(".")[0] in PACKAGES]:
            del sys.modules[name]  # what says PACKAGES may be changed as well
        os._exit(run())
    os._exit(1)


def _tested(name: str, source: str) -> int:
    sys.meta_path.insert(0, _Mutated({name: source}, {}))
    return _pytest(["-x", "-m", "not hardware and not nightly", *TESTS[name]], [])


def _pytest(arguments: Sequence[str], plugins: Sequence[object]) -> int:
    hypothesis.settings.register_profile("mutants", max_examples=40, derandomize=True, database=None, deadline=None)
    quiet = ["-q", "--hypothesis-profile=mutants", "-W", "ignore::pytest.PytestAssertRewriteWarning"]
    return int(pytest.main([*quiet, "-o", "cache_dir=.pytest_cache/mutants", "-p", "no:xdist", *arguments], plugins))


def places(count: int, seed: int) -> list[tuple[str, tuple[int, int]]]:
    """So many places of the whole product, each as likely as any other: the module, and as `sites_of` numbers them."""
    files = [file for package in PACKAGES for file in sorted((ROOT / package).rglob("*.py"))]
    found = [(file, site) for file in files for site in sites_of(file.read_text("utf-8"))]
    drawn = random.Random(seed).sample(found, min(count, len(found)))
    return [(".".join(file.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"), site) for file, site in drawn]


def reach_of(drawn: Sequence[tuple[str, tuple[int, int]]]) -> tuple[Reach, dict[tuple[str, int], str]]:
    """What the nearest tests run of the places, and the mark of each."""
    numbers: dict[str, dict[int, str]] = defaultdict(dict)
    for name, (number, _) in drawn:
        numbers[name][number] = f"{name}:{number}"
    sources: dict[str, str] = {}
    marks: dict[tuple[str, int], str] = {}
    for name, wanted in numbers.items():
        sources[name], found = probed(_file(name).read_text("utf-8"), wanted, name)
        marks |= {(name, number): mark for number, mark in found.items()}
    reach, asked = Reach(), set[str]()
    for count in NEAREST:
        missed = {name for (name, _), mark in marks.items() if not reach.runs(mark)}
        files = nearest(missed, count) - asked
        asked |= files
        if files:
            _look(reach, sources, sorted(files))
    return reach, marks


def _look(reach: Reach, sources: Mapping[str, str], files: Sequence[str]) -> None:
    """Add what the tests of the files run."""
    with tempfile.NamedTemporaryFile() as noted:

        def run() -> int:
            sys.meta_path.insert(0, _Mutated(sources, {"_reached": reach.note}))
            status = _pytest(["-m", WITHOUT, *files], [reach])
            Path(noted.name).write_bytes(pickle.dumps((reach.seconds, reach.marks)))
            return status

        _, status = os.waitpid(_forked(run, 0), 0)
        if os.waitstatus_to_exitcode(status) not in (0, 1):
            raise SystemExit("the tests do not run without a mutant")
        reach.seconds, reach.marks = pickle.loads(Path(noted.name).read_bytes())


def _sampled(name: str, source: str, chosen: Chosen) -> int:
    if not chosen.seconds:
        return 0
    sys.meta_path.insert(0, _Mutated({name: source}, {}))
    return _pytest(["-x", "-m", WITHOUT, *chosen.files], [chosen])


def main(arguments: Sequence[str]) -> int:
    """Print the survivors; 1 if one is not listed in tests/mutants/survivors.toml, or too many of a sample live."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("modules", nargs="*", metavar="MODULE")
    parser.add_argument("--sample", type=int, help="how many changes of the whole product")
    parser.add_argument("--seed", type=int, default=[1], nargs="+", help="one sample of each")
    args = parser.parse_args(arguments)
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    for other in OTHERS:  # nothing of ours, which each fork imports with its change
        importlib.import_module(other)
    if args.sample is not None:
        return _run_samples(args.sample, args.seed)
    return _run_modules(args.modules or list(TESTS))


def _run_samples(count: int, seeds: Sequence[int]) -> int:
    begun_s = time.monotonic()
    drawn = {seed: places(count, seed) for seed in seeds}
    reach, marks = reach_of([place for sample in drawn.values() for place in sample])
    print(f"{len(reach.seconds)} tests looked at ({time.monotonic() - begun_s:.0f} s)", flush=True)
    least = 1.0
    for seed, sample in drawn.items():
        mutants: list[tuple[str, Mutant, Run]] = []
        unreached = 0
        for name, site in sample:
            chosen = reach.chosen(name, marks[name, site[0]])
            for mutant in mutants_of(_file(name).read_text("utf-8"), [site]):
                unreached += not chosen.seconds
                told = f"{name}, {len(chosen.seconds)} tests, {chosen.beyond} left out:"
                mutants.append((told, mutant, partial(_sampled, name, mutant.source, chosen)))
        killed = len(mutants) - len(survivors_of(mutants, int(10 * MUTANT_s) + 30))
        least = min(least, killed / len(mutants))
        print(
            f"seed {seed}: {killed} of {len(mutants)} mutants killed, {killed / len(mutants):.0%};"
            f" no test runs {unreached} ({time.monotonic() - begun_s:.0f} s)",
            flush=True,
        )
    return int(least < KILLED_SHARE)


def _run_modules(names: Sequence[str]) -> int:
    lists, wrong = tomllib.loads(LIST.read_text("utf-8")), 0
    for name in names:
        begun_s = time.monotonic()
        alive, count = survivors(name)
        known = {change for changes in lists.get(name.split(".")[-1], {}).values() for change in changes}
        gone = known - {mutant.change for mutant in alive}
        print(
            f"{name}: {count - len(alive)} of {count} mutants killed, {len(alive)} survive ({time.monotonic() - begun_s:.0f} s)",
            *(f"  listed, and does not survive: {change}" for change in sorted(gone)),
            sep="\n",
            flush=True,
        )
        wrong += len(gone) + sum(mutant.change not in known for mutant in alive)
    print(f"{wrong} changes differ from {LIST.relative_to(ROOT)}")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
