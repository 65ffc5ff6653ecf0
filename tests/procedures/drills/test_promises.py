"""docs/safety.md: what shows each promise exists, each drill shows a promise, and each fault of the product is one of them.

The drills of a fault are those that expect it, as docs/drills.md has them.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from control.errors import ArmError
from firmware_iface.installation import PACKAGES
from procedures.drills.catalogue import drills, drills_named
from procedures.drills.drill import Promise

ROOT = Path(__file__).parents[3]
PAGE = (ROOT / "docs" / "safety.md").read_text("utf-8")
CODE = re.compile(r"`([^`]+)`")
UNPROMISED = "undetected"  # the one table of what is not found


def tables() -> Iterator[list[list[str]]]:
    """The tables of the page: rows of cells, the head first."""
    for block in re.findall(r"(?:^\|.*\n)+", PAGE, re.MULTILINE):
        rows = [[cell.strip() for cell in line.strip("|").split(" | ")] for line in block.splitlines()]
        yield [rows[0], *rows[2:]]


PROMISES = [row for head, *rows in tables() if head[0] != UNPROMISED for row in rows]
FAULTS = {row[0]: row for head, *rows in tables() if head[0] == "fault" for row in rows}


def shown_by(row: list[str]) -> tuple[list[Promise], list[Path]]:
    """Drills and tests that the last cell of a row names, and the drills of a fault. ArmError for a drill that there is not."""
    names = CODE.findall(row[-1])
    tests = [ROOT / name for name in names if name.endswith(".py")]
    named = [drill for name in names if not name.endswith(".py") for drill in drills_named(name)]
    codes = set(CODE.findall(row[0])) if row in FAULTS.values() else set()
    return [*named, *(drill for drill in drills().values() if drill.codes & codes)], tests


def fault_codes() -> set[str]:
    """The codes of all Fault(...) of the product; where one is handed on, of the calls that hand it."""
    codes = set()
    for path in (path for package in PACKAGES for path in (ROOT / package).rglob("*.py")):
        text = path.read_text("utf-8")
        if "safety.modes import" not in text:
            continue
        tree = ast.parse(text)
        functions = [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)]
        makers = {"Fault"} | {f.name for f in functions for call in calls(f, {"Fault"}) if not constant(call)}
        codes |= {code for call in calls(tree, makers) if (code := constant(call))}
    return codes


def calls(tree: ast.AST, names: set[str]) -> list[ast.Call]:
    return [
        node
        for node in ast.walk(tree)
        if isinstance(node, ast.Call) and getattr(node.func, "id", getattr(node.func, "attr", "")) in names
    ]


def constant(call: ast.Call) -> str:
    return call.args[0].value if isinstance(call.args[0], ast.Constant) else ""  # type: ignore[return-value]


def test_every_table_of_promises_says_what_shows_them() -> None:
    assert {head[-1] for head, *_ in tables() if head[0] != UNPROMISED} == {"shown by"}
    assert len(PROMISES) > 40


@pytest.mark.parametrize("row", PROMISES, ids=lambda row: row[0][:30])
def test_a_promise_names_drills_and_tests_that_there_are(row: list[str]) -> None:
    shown, tests = shown_by(row)
    assert shown or tests
    assert [test for test in tests if not test.is_file()] == []


def test_tests_named_beside_the_tables_exist() -> None:
    named = [name for name in CODE.findall(PAGE) if name.endswith(".py")]
    assert [name for name in named if not (ROOT / name).is_file()] == []


def test_every_drill_shows_a_promise() -> None:
    named = {drill.name for row in PROMISES for drill in shown_by(row)[0]}
    assert sorted(set(drills()) - named) == []


def test_every_fault_of_the_product_is_on_the_page_and_no_other() -> None:
    assert {code for cell in FAULTS for code in CODE.findall(cell)} == fault_codes()


@pytest.mark.parametrize("row", FAULTS.values(), ids=FAULTS)
def test_a_fault_is_expected_by_its_drills_or_named_in_its_tests(row: list[str]) -> None:
    codes, (shown, tests) = set(CODE.findall(row[0])), shown_by(row)
    expected = {code for drill in shown for code in drill.codes}
    tested = {code for code in codes for test in tests if f'"{code}"' in test.read_text("utf-8")}
    assert codes - expected - tested == set()


def test_a_wrong_name_is_no_drill() -> None:
    with pytest.raises(ArmError, match="did you mean"):
        drills_named("encoder-silen")
