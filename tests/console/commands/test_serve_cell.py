"""`armwright serve --cell`: rates that a shared bus carries, and options that are of one arm."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from console.commands import serve
from console.main import main
from control.model.can_bus import bus_load
from control.model.cell import Cell
from control.server.process import ServeOptions
from procedures.arm_sheet import sheet, warnings
from tests.pair import PAIR


@pytest.fixture
def served(monkeypatch: pytest.MonkeyPatch) -> list[tuple[Cell, ServeOptions]]:
    """What would be served."""
    asked: list[tuple[Cell, ServeOptions]] = []
    monkeypatch.setattr(serve, "serve", lambda *given: asked.append(given))
    return asked


def test_six_boards_on_one_bus_are_served_at_a_rate_that_it_carries(served: list[Any]) -> None:
    assert main(["serve", "--cell", "pair"]) == 0
    ((cell, options),) = served
    assert 1.0 / options.period_s == pytest.approx(400.0)
    assert sorted(options.sockets) == ["left", "right"]
    assert options.camera_ports == {"left": 47310, "right": 47311}
    # 12 frames of 135 bits a cycle.
    assert bus_load([placed.arm for placed in cell.arms], 400.0) == pytest.approx(12 * 400 * 135e-6)


def test_six_boards_of_one_arm_are_served_as_fast_as_those_of_two(tmp_path: Path, served: list[Any]) -> None:
    assert main(["new", "--out", str(tmp_path / "my.toml"), "--joints", "6", "--yes"]) == 0
    assert main(["serve", "--arm", str(tmp_path / "my.toml")]) == 0
    ((cell, options),) = served
    assert 1.0 / options.period_s == pytest.approx(400.0)
    assert cell.arms[0].arm.usual_rate_Hz == 400.0
    assert not [said for said in warnings(sheet(cell.arms[0].arm)) if "bus" in said]


def test_two_arms_of_bought_boards_on_one_bus_are_served_as_fast_as_it_carries(tmp_path: Path, served: list[Any]) -> None:
    arm = ["--joints", "6", "--boards", "cia402", "--yes"]
    for name in ("a", "b"):
        assert main(["new", "--out", str(tmp_path / f"{name}.toml"), *arm]) == 0
    b = tmp_path / "b.toml"
    b.write_text(b.read_text().replace("\naddress = ", "\naddress = 1"))
    cell = tmp_path / "cell.toml"
    arms = '[[arm]]\nfile = "a.toml"\n[[arm]]\nfile = "b.toml"\norigin_m = [2.0, 0.0, 0.0]\n'
    cell.write_text(f'name = "two"\n[can]\ninterface = "socketcan"\nchannel = "can0"\n{arms}')
    assert main(["serve", "--cell", str(cell)]) == 0
    assert 1.0 / served[0][1].period_s == pytest.approx(100.0)


def test_with_a_bus_for_each_arm_nothing_is_slower() -> None:
    left, right = PAIR.arms
    assert right.arm.can is not None
    alone = replace(right, arm=replace(right.arm, can=replace(right.arm.can, channel="can1")))
    assert bus_load([left.arm, alone.arm], 500.0) == pytest.approx(6 * 500 * 135e-6)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--rate", "600"], "--rate: at 600 Hz the arms' boards would need 97 % of their CAN bus (at most 95 %)"),
        (["--socket", "x.sock"], "--socket: not together with --cell"),
        (["--can-channel", "can1"], "--can-channel: not together with --cell"),
        (["--rate", "5"], "--rate: expected 50 to 1200 Hz, got 5"),
    ],
)
def test_what_does_not_fit_a_cell_is_refused(
    served: list[Any], capsys: pytest.CaptureFixture[str], arguments: list[str], said: str
) -> None:
    assert main(["serve", "--cell", "pair", *arguments]) == 2
    assert said in capsys.readouterr().err
    assert served == []


def test_without_a_runtime_the_commands_of_a_cell_name_what_starts_all_its_arms(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["follow", "--leader", "left", "--follower", "right"]) == 2
    assert "start one with `armwright serve --cell pair`" in capsys.readouterr().err


def test_a_rate_that_is_much_for_the_bus_of_one_arm_is_said(served: list[Any], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["serve", "--arm", "right", "--rate", "1000"]) == 0
    said = capsys.readouterr().err
    assert "--rate 1000: the boards need 81 % of their CAN bus, good is up to 70 % (--rate 864)" in said
    assert main(["serve", "--arm", "right", "--rate", "800"]) == 0
    assert capsys.readouterr().err == ""
    assert len(served) == 2
