"""`tool`, `gripper`, `digital`: what they print, their exit status, and what they refuse."""

from collections.abc import Callable, Iterator
from dataclasses import replace

import pytest

from console.commands import end_effector
from console.commands.status import described
from console.main import main
from console.screen.drawing import Row
from console.screen.texts import end_rows
from control.model.arm import Tool
from control.model.can_bus import bus_load
from control.model.end_effector import Digital
from tests.cell import GRIPPER, RIGHT, Cell, holding_cell, scenario

SHORT = replace(GRIPPER, travel_m=0.04)
ARM = replace(
    RIGHT,
    tool=Tool(name="pen"),
    spare_tools=(Tool((0.0, 0.0, 0.1), name="cup"),),
    gripper=SHORT,
    digital=(Digital("valve", 1, 0, "output"), Digital("part", 2, 1, "input")),
)
Call = Callable[[str], tuple[int, str, str]]


@pytest.fixture(scope="module")
def shared() -> Iterator[Cell]:
    with holding_cell(scenario(), ARM) as cell:
        yield cell


@pytest.fixture
def call(shared: Cell, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Call:
    """Run a command; returns exit status, output and errors."""
    monkeypatch.setattr(end_effector, "connected", lambda given: shared.client)

    def run(line: str) -> tuple[int, str, str]:
        status = main(line.split())
        out, err = capsys.readouterr()
        return status, out, err

    return run


def test_tools_are_listed_and_changed(call: Call) -> None:
    assert call("tool") == (0, "* pen\n  cup\n", "")
    assert call("tool cup") == (0, "tool cup is on\n", "")
    assert call("tool")[1] == "  pen\n* cup\n"
    status, _, err = call("tool saw")
    assert (status, "expected one of pen, cup" in err) == (2, True)


def test_the_gripper_says_where_it_has_come_to(call: Call, shared: Cell) -> None:
    assert call("gripper")[1] == "gripper holds its opening\n"
    assert call("gripper open")[:2] == (0, "gripper open, 40.0 mm\n")
    shared.rig.set_object(0.02)
    status, out, _ = call("gripper close --force 20 --must-hold")
    assert status == 0
    assert out.startswith(("gripper holds something, 18.", "gripper holds something, 19."))
    assert "with 20 N" in out or "with 19 N" in out or "with 21 N" in out
    shared.rig.set_object(None)
    assert call("gripper --to 0.03")[0] == 0
    assert call("gripper close --must-hold")[0] == 1
    assert '"state": "CLOSED"' in call("gripper --json")[1]


@pytest.mark.parametrize(
    ("line", "says"),
    [
        ("gripper open --to 0.01", "either open, close, stop, or --to"),
        ("gripper --force 3", "need open, close or --to"),
        ("gripper --to 25", "0 to 0.04 m"),
        ("digital valve on --until on", "either a level, or --until"),
        ("digital --until on", "needs the NAME"),
        ("digital pump", "expected one of valve, part"),
        ("digital part on", "is an input"),
    ],
)
def test_what_cannot_be_is_refused_in_words(call: Call, line: str, says: str) -> None:
    status, out, err = call(line)
    assert (status, out) == (2, "")
    assert says in err


def test_pins_are_set_awaited_and_listed(call: Call, shared: Cell) -> None:
    assert call("digital valve on") == (0, "", "")
    assert call("digital valve --until on --timeout 1") == (0, "valve (output): on\n", "")
    assert call("digital part --until on --timeout 0.05")[:2] == (1, "part (input): off\n")
    shared.rig.set_pin("part", True)
    assert call("digital part --until on")[0] == 0
    assert call("digital")[1] == "valve (output): on\npart (input): on\n"


def test_status_and_console_show_the_end_of_the_arm(call: Call, shared: Cell) -> None:
    shared.rig.set_pin("part", True)
    shared.client.set_output("valve", False)
    shared.client.tool("pen")
    shared.run(0.1)
    status = {**shared.client.status(), "arm": "right", "in_control": None}
    text = described(status)
    assert "tool pen is on" in text
    assert "gripper " in text
    assert "part (input): on" in text
    (row,) = end_rows(status, 100)
    assert text_of(row).startswith("tool pen  gripper ")
    assert text_of(row).endswith("valve 0  part 1")


def text_of(row: Row) -> str:
    return "".join(text for text, _ in row)


def test_the_load_of_the_bus_counts_gripper_and_pins() -> None:
    """4 frames each 10 ms, and 2 each 20 ms for two boards, of 135 bits at 1 Mbit/s."""
    assert bus_load([ARM], 500.0) - bus_load([RIGHT], 500.0) == pytest.approx((400 + 200) * 135e-6)
