"""Which tests run a place of the code, and how long each keeps the processor: measured once, so that a mutant runs no others.

The drawn modules are imported with calls before each drawn place and at the head of every function. Only the tests nearest to a
module are asked: its own file, and those that import it from the folder that mirrors its room. A process that a test starts
is not seen, and `realtime` tests, which look at such, are left out.
"""

from __future__ import annotations

import ast
import re
import time
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

import pytest

from tests.mutants.mutator import located

ROOT = Path(__file__).parents[2]
NEAREST = 1, 3  # files of tests for one module: at first, and where these do not run a place
FILE_s = 6.0  # of processor, of one file, before the rest of it is left out
MUTANT_s = 10.0  # of processor, for the tests of one mutant
FILES = 6  # that one mutant imports
WITHOUT = "not hardware and not nightly and not realtime"


@dataclass(frozen=True, slots=True, eq=False)  # pytest hashes its plugins
class Chosen:
    """The tests of one mutant and the seconds of each, of the nearest file first; `beyond` more would have run its place."""

    seconds: Mapping[str, float]
    beyond: int
    files: Sequence[str]

    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        """Leave out the others."""
        items[:] = [item for item in items if item.nodeid in self.seconds]


@dataclass(slots=True, eq=False)
class Reach:
    """A pytest plugin: notes what each test runs. `seconds` and `marks` are of the tests that pass."""

    seconds: dict[str, float] = field(default_factory=dict)
    marks: dict[str, set[str]] = field(default_factory=dict)
    _spent_s: dict[str, float] = field(default_factory=lambda: defaultdict(float))
    _now: set[str] = field(default_factory=set)
    _begun_s: float = 0.0
    _has_passed: bool = True

    def note(self, mark: str) -> None:
        """Called by the code under test."""
        self._now.add(mark)

    def pytest_runtest_setup(self, item: pytest.Item) -> None:
        """Leave out the rest of a file that takes long."""
        if self._spent_s[_file_of(item.nodeid)] > FILE_s:
            pytest.skip("its file takes long")

    def pytest_runtest_logstart(self) -> None:
        """A test begins."""
        self._now.clear()
        self._begun_s = time.process_time()
        self._has_passed = True

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """It only counts if it passes."""
        self._has_passed &= report.passed

    def pytest_runtest_logfinish(self, nodeid: str) -> None:
        """What it took, and what it ran."""
        taken_s = time.process_time() - self._begun_s
        self._spent_s[_file_of(nodeid)] += taken_s
        if self._has_passed:
            self.seconds[nodeid], self.marks[nodeid] = taken_s, set(self._now)

    def runs(self, mark: str) -> bool:
        """Whether a test does."""
        return any(mark in marks for marks in self.marks.values())

    def chosen(self, module: str, mark: str) -> Chosen:
        """Of the files nearest to the module: tests that run a place, then others, which may share what the first made."""
        there = {test for test, marks in self.marks.items() if mark in marks}
        reaching = {_file_of(test) for test in there}
        files = [str(file) for file in _ranked(module) if str(file) in reaching]
        files = [*files, *sorted(reaching - {*files})][:FILES]
        taken: dict[str, float] = {}
        for file in files:
            of_file = [test for test in self.seconds if _file_of(test) == file]
            for test in sorted(of_file, key=lambda test: (test not in there, self.seconds[test])):
                if not taken or sum(taken.values()) + self.seconds[test] <= MUTANT_s:
                    taken[test] = self.seconds[test]
        return Chosen(taken, len(there - {*taken}), files)


def _file_of(test: str) -> str:
    return test.split("::")[0]


def probed(source: str, numbers: Mapping[int, str], module: str) -> tuple[str, dict[int, str]]:
    """A module that calls `_reached` with the mark of each node about to run, and the marks by number.

    What runs at import, before any test, has the mark of the module: that of all its functions.
    """
    tree = ast.parse(source)
    nodes = located(tree)
    wanted = {id(nodes[number]): number for number in numbers}
    marks: dict[int, str] = {}

    def walk(node: ast.AST, block: tuple[list[ast.stmt], ast.stmt] | None, is_inside: bool) -> None:
        if (number := wanted.get(id(node))) is not None:
            marks[number] = numbers[number] if is_inside and block else module
            if is_inside and block:
                statements, statement = block
                statements.insert(next(i for i, s in enumerate(statements) if s is statement), _call(numbers[number]))
        for name, value in ast.iter_fields(node):
            deeper = is_inside or (isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and name == "body")
            for child in [*value] if isinstance(value, list) else [value]:
                if isinstance(child, ast.stmt):
                    walk(child, (value, child), deeper)
                elif isinstance(child, ast.AST):
                    walk(child, block, deeper)

    walk(tree, None, False)
    for node in nodes:
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            node.body.insert(int(ast.get_docstring(node) is not None), _call(module))
    return ast.unparse(ast.fix_missing_locations(tree)), marks


def _call(mark: str) -> ast.stmt:
    return ast.Expr(ast.Call(ast.Name("_reached", ast.Load()), [ast.Constant(mark)], []))


def nearest(modules: Iterable[str], count: int) -> set[str]:
    """The files of tests nearest to the modules, so many of each."""
    return {str(file) for module in modules for file in _ranked(module)[:count]}


def _ranked(module: str) -> list[Path]:
    room, _, name = module.rpartition(".")
    home = Path("tests", *room.split("."))
    imports = re.compile(rf"\b{re.escape(module)}\b|\bfrom {re.escape(room)} import (\([^)]*|[^\n(]*)\b{name}\b")

    def distance(file: Path) -> tuple[bool, bool, int, int]:
        common = sum(a == b for a, b in zip(file.parts, home.parts, strict=False))
        hops = len(file.parts) + len(home.parts) - 2 * common
        return file.stem != f"test_{name}", not imports.search(_texts()[file]), hops, len(_texts()[file])

    while not (beside := [file for file in _texts() if home in file.parents]):
        home = home.parent
    return sorted({*beside, *(file for file, text in _texts().items() if imports.search(text))}, key=distance)


@cache
def _texts() -> dict[Path, str]:
    return {file.relative_to(ROOT): file.read_text("utf-8") for file in sorted((ROOT / "tests").rglob("test_*.py"))}
