"""Client commands: what they ask of the operator, and what they say of an arm that they wait for."""

from __future__ import annotations

import argparse
import io
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from console.commands import progress as waiting
from console.commands import requests, script
from console.main import main
from control.errors import ArmError
from control.safety.modes import Mode
from control.server.client import ArmClient
from tests.cell import Cell, handled, holding_cell, restarted, scenario
from tests.kinds import ON_BOARDS


class Typed(io.StringIO):
    """A terminal at which somebody types."""

    def isatty(self) -> bool:
        return True


@pytest.fixture
def client(cell: Cell, monkeypatch: pytest.MonkeyPatch) -> ArmClient:
    """The client that every command gets."""
    monkeypatch.setattr(requests, "listening", lambda given: cell.client)
    return cell.client


def test_guide_without_a_terminal_and_without_yes_is_refused(
    client: ArmClient, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "stdin", io.StringIO())
    assert main(["guide"]) == 2
    assert "give --yes" in capsys.readouterr().err
    assert client.status()["mode"] == "HOLDING"


@pytest.mark.parametrize(("answer", "mode"), [("\n", "HOLDING"), ("no\n", "HOLDING"), ("", "HOLDING")])
def test_guide_keeps_the_arm_where_it_is_not_confirmed(
    client: ArmClient, monkeypatch: pytest.MonkeyPatch, answer: str, mode: str
) -> None:
    monkeypatch.setattr(sys, "stdin", Typed(answer))
    monkeypatch.setattr(sys, "stderr", Typed())
    assert main(["guide"]) == 2
    assert client.status()["mode"] == mode


def test_guide_lets_the_arm_go_where_it_is_confirmed_until_a_line_is_typed(
    client: ArmClient, cell: Cell, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "stdin", Typed("y\n\n"))
    monkeypatch.setattr(sys, "stderr", Typed())
    modes: list[str] = []
    cell.watchers.append(lambda: modes.append(cell.mode.name))
    monkeypatch.setattr(waiting.select, "select", lambda *_: ([sys.stdin] if len(modes) > 50 else [], [], []))
    assert main(["guide"]) == 0
    assert "GUIDING" in modes
    assert client.status()["mode"] == "HOLDING"


def test_guide_with_yes_does_not_ask_and_ends_when_somebody_holds_the_arm(
    client: ArmClient, cell: Cell, capsys: pytest.CaptureFixture[str]
) -> None:
    modes: list[str] = []

    def hold_later() -> None:
        modes.append(cell.mode.name)
        if modes.count("GUIDING") == 50:
            assert handled(cell, {"do": "hold"}, 9)["ok"]

    cell.watchers.append(hold_later)
    assert main(["guide", "--yes"]) == 0
    assert modes.count("GUIDING") >= 50
    assert "hand-guiding has ended" in capsys.readouterr().out


def test_off_asks_before_boards_let_an_arm_go_that_they_held(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    on = ON_BOARDS["dynamixel"]
    with (
        holding_cell(scenario(q_rad=None), on.arm, period_s=on.period_s) as before,
        restarted(before, on.arm, on.period_s) as cell,
    ):
        cell.run(0.1)
        monkeypatch.setattr(requests, "listening", lambda given: cell.client)
        monkeypatch.setattr(sys, "stdin", io.StringIO())
        assert main(["off"]) == 2
        assert "off: releases the arm" in capsys.readouterr().err
        assert cell.mode is Mode.HELD
        assert main(["off", "--yes"]) == 0
        cell.run(0.3)
        assert (cell.mode, cell.torques()) == (Mode.OFF, [False] * 3)


def test_guide_that_a_fault_ends_has_status_1_and_says_why(
    client: ArmClient, cell: Cell, capsys: pytest.CaptureFixture[str]
) -> None:
    modes: list[str] = []

    def fail_later() -> None:
        modes.append(cell.mode.name)
        if modes.count("GUIDING") == 50:
            cell.inject("silent", "encoder")

    cell.watchers.append(fail_later)
    assert main(["guide", "--yes"]) == 1
    assert "the arm is in FAULT" in capsys.readouterr().err


def test_enable_and_home_say_that_there_was_nothing_to_do(client: ArmClient, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["enable"]) == 0
    assert "already on" in capsys.readouterr().out
    assert main(["home"]) == 0
    assert "already homed" in capsys.readouterr().out


def test_acknowledge_has_status_1_while_the_cause_lasts(
    client: ArmClient, cell: Cell, capsys: pytest.CaptureFixture[str]
) -> None:
    cell.inject("silent", "motor3")
    cell.until_fault(0.5)
    assert main(["acknowledge"]) == 1
    assert "joint 3" in capsys.readouterr().err


def answers() -> list[dict[str, Any]]:
    homing = [{"mode": "HOMING", "progress": 1.0, "step": f"joint {joint}"} for joint in (1, 1, 2)]
    return [*homing, *({"mode": "MOVING", "progress": done, "step": ""} for done in (0.1, 0.2, 0.5))]


def test_waiting_shows_each_step_once_where_there_is_no_terminal(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(waiting, "QUIET_S", 0.0)
    progress = waiting.Progress("home")
    for answer in answers():
        progress(answer)
    progress.close()
    assert capsys.readouterr().err.splitlines() == ["home: joint 1", "home: joint 2", "home: 10 %", "home: 50 %"]


def test_waiting_redraws_one_line_on_a_terminal_and_takes_it_away(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = Typed()
    monkeypatch.setattr(waiting, "QUIET_S", 0.0)
    monkeypatch.setattr(sys, "stderr", terminal)
    progress = waiting.Progress("home")
    for answer in answers():
        progress(answer)
    progress.close()
    drawn = terminal.getvalue()
    assert "\n" not in drawn
    assert drawn.count("\r\x1b[K") == len(answers()) + 1
    assert drawn.endswith("\r\x1b[K")


def test_what_waiting_shows_never_wraps(monkeypatch: pytest.MonkeyPatch) -> None:
    """A wrapped line is not erased: each redraw would scroll the terminal."""
    terminal = Typed()
    monkeypatch.setenv("COLUMNS", "40")
    monkeypatch.setattr(waiting, "QUIET_S", 0.0)
    monkeypatch.setattr(sys, "stderr", terminal)
    waiting.Progress("home")({"mode": "HOMING", "progress": 0.0, "step": "joint 1 (1 of 4): backing off its switch once more"})
    assert len(terminal.getvalue().removeprefix("\r\x1b[K")) == 39


def test_a_job_says_once_that_it_is_done_and_one_that_fails_does_not(capsys: pytest.CaptureFixture[str]) -> None:
    with waiting.Bar("job") as bar:
        bar.advance("part", 0.4)
        bar.advance("rest", 1.0)
    assert [line.rpartition(" ")[2] for line in capsys.readouterr().err.splitlines()] == ["part", "rest"]
    with waiting.Bar("job") as bar:
        bar.advance("part", 0.4)
    assert capsys.readouterr().err.endswith("job: 100% after 0 s: done\n")
    with pytest.raises(KeyError), waiting.Bar("job") as bar:
        bar.advance("part", {}["how far"])
    assert "done" not in capsys.readouterr().err


def by_a_command(cell: Cell, tmp_path: Path) -> None:
    with waiting.shown(cell.client, argparse.Namespace(command="move")):
        cell.client.move_joints((0.4, -0.4, 0.6), 0.5)


def by_a_script(cell: Cell, tmp_path: Path) -> None:
    (tmp_path / "day.txt").write_text("wait 0.1\nmove --joints 0.4 -0.4 0.6\n")
    assert main(["script", str(tmp_path / "day.txt")]) == 0


@pytest.mark.parametrize("moved", [by_a_command, by_a_script])
def test_enter_resumes_a_motion_that_another_client_paused_and_what_was_typed_before_does_not(
    moved: Callable[[Cell, Path], None], cell: Cell, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    typed, terminal, paused = ["typed ahead"], Typed(), 0
    monkeypatch.setattr(sys, "stderr", terminal)
    monkeypatch.setattr(sys, "stdin", Typed())
    monkeypatch.setattr(waiting, "QUIET_S", 0.0)
    monkeypatch.setattr(waiting, "has_line", lambda: bool(typed and typed.pop()))

    def watch() -> None:
        nonlocal paused
        if cell.mode is Mode.MOVING and not paused and cell.client.ask("mode")["progress"] > 0.3:
            assert handled(cell, {"do": "pause"}, 9)["ok"]
        paused += cell.mode is Mode.PAUSED
        if paused == 500:
            assert "(Enter)" in handled(cell, {"do": "resume"}, 9)["error"]
            typed.append("Enter")

    cell.watchers.append(watch)
    monkeypatch.setattr(script, "in_control", lambda args: cell.client)
    moved(cell, tmp_path)
    assert paused >= 500
    assert "Enter resumes" in terminal.getvalue()
    assert cell.mode is Mode.HOLDING
    assert np.abs(np.subtract(cell.rig.joint_rad(), (0.4, -0.4, 0.6))).max() < 0.01


def test_waiting_for_another_client_s_paused_motion_offers_no_enter(cell: Cell, monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = Typed()
    monkeypatch.setattr(sys, "stderr", terminal)
    monkeypatch.setattr(sys, "stdin", Typed())
    monkeypatch.setattr(waiting, "QUIET_S", 0.0)
    for command in ("wait", "move"):
        with waiting.shown(cell.client, argparse.Namespace(command=command)):
            assert cell.client.on_wait is not None
            monkeypatch.setattr(waiting, "has_line", lambda: False)
            cell.client.on_wait({"mode": "PAUSED", "progress": 0.4, "step": ""})
    assert [("Enter" in part) for part in terminal.getvalue().split("\r\x1b[K") if "paused" in part] == [False, True]


def test_a_script_s_line_shows_no_progress(cell: Cell) -> None:
    with waiting.shown(cell.client, argparse.Namespace(command="home", connect=lambda: cell.client)):
        assert cell.client.on_wait is None
    with waiting.shown(cell.client, argparse.Namespace(command="home")):
        assert cell.client.on_wait is not None
    assert cell.client.on_wait is None


def test_a_script_does_not_wait_for_a_motion_that_it_has_paused_itself(cell: Cell) -> None:
    cell.start_move((0.4, -0.4, 0.6), 0.3)
    cell.run(0.2)
    cell.client.pause()
    with pytest.raises(ArmError, match="write `resume` before"):
        requests.REQUESTS["wait"](cell.client, argparse.Namespace(seconds=None, connect=lambda: cell.client))


def test_a_wait_beyond_a_day_is_refused(cell: Cell) -> None:
    with pytest.raises(ArmError, match="0 to 86400 s"):
        requests.REQUESTS["wait"](cell.client, argparse.Namespace(seconds=1e6))
