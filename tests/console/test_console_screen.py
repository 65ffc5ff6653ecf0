"""The real console, headless, on a mock arm: what its keys do, and that the arm rests when they are let go."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import pytest
from textual import events
from textual.pilot import Pilot

from console.screen.app import ConsoleApp
from console.screen.dialogs import Choose
from console.screen.held import HeldKey, REPEAT_s
from console.screen.widgets import CommandBox
from control.safety.fault import Fault, Reaction
from control.safety.table import Mode
from tests.cell import STRETCHED, Cell, holding_cell
from tests.console.console_rig import Served, console_on, hold_key, mouse, press, said, shown, until

Play = Callable[[ConsoleApp, Pilot[Any], Served], Awaitable[None]]


def played(folder: Path, play: Play, size: tuple[int, int] = (80, 24)) -> None:
    """Open the console on an arm that holds, and play."""

    async def run(cell: Cell) -> None:
        async with console_on(cell, folder, size) as (app, pilot, served):
            await play(app, pilot, served)

    with holding_cell() as cell:
        asyncio.run(run(cell))


async def moved(pilot: Pilot[Any], served: Served, run: int) -> None:
    """The arm has begun this motion; it may have ended it."""
    await until(pilot, lambda: served.cell.runtime.run_number >= run)


async def rested(pilot: Pilot[Any], served: Served) -> None:
    await until(pilot, lambda: served.cell.mode is Mode.HOLDING)


def start_move(served: Served) -> None:
    """A motion of somebody else, 3 s long."""
    answer = served.cell.assembly.requests.handle(
        {"do": "move_joints", "q_rad": [1.2, -0.2, 0.9], "speed": 0.3}, 99
    )
    assert answer["ok"], answer


# ---- the dead man's switch


def test_a_held_key_jogs_and_the_arm_rests_when_its_repeats_cease(tmp_path: Path) -> None:
    kept = tmp_path / "kept.txt"

    def ends() -> int:
        return kept.read_text().count("move --joints") if kept.exists() else 0

    async def play(app: ConsoleApp, pilot: Pilot[Any], served: Served) -> None:
        before = served.cell.rig.joint_rad()
        await hold_key(pilot, "right", 0.6)
        assert served.cell.mode is Mode.JOGGING
        await rested(pilot, served)
        # a jog that follows before that is seen is one with the first
        await until(pilot, lambda: ends() == 1)
        after = served.cell.rig.joint_rad()
        assert after[0] - before[0] > 0.01
        assert after[1:] == pytest.approx(before[1:], abs=2e-3)
        await press(pilot, "z")
        height = served.cell.rig.tip_m()[2]
        await hold_key(pilot, "left", 0.4)
        await rested(pilot, served)
        assert served.cell.rig.tip_m()[2] < height - 0.003
        # where they ended, for replay
        await until(pilot, lambda: ends() == 2)

    played(tmp_path, play)


def test_one_press_moves_a_little_and_no_further(tmp_path: Path) -> None:
    async def play(app: ConsoleApp, pilot: Pilot[Any], served: Served) -> None:
        before = served.cell.rig.joint_rad()[0]
        await press(pilot, "right")
        await moved(pilot, served, 1)
        await rested(pilot, served)
        # 20 % of 0.297 rad/s for the 0.2 s of the dead man's switch, and what a poll takes
        assert 0.003 < served.cell.rig.joint_rad()[0] - before < 0.03

    played(tmp_path, play)


def test_a_step_ends_where_it_was_to_without_a_held_key(tmp_path: Path) -> None:
    async def play(app: ConsoleApp, pilot: Pilot[Any], served: Served) -> None:
        before = served.cell.runtime.set_point.q_rad[1]
        await press(pilot, "2", "t", "right")
        await moved(pilot, served, 1)
        await rested(pilot, served)
        assert served.cell.runtime.set_point.q_rad[1] - before == pytest.approx(0.005, abs=1e-6)
        await until(pilot, (tmp_path / "kept.txt").exists)
        assert (tmp_path / "kept.txt").read_text().startswith("jog --joint 2 --by 0.005")

    played(tmp_path, play)


def test_a_button_jogs_while_the_mouse_holds_it_and_a_lost_focus_lets_go(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("console.screen.operating.UNSEEN_S", 1e9)  # it is not the silent mouse that lets go

    async def play(app: ConsoleApp, pilot: Pilot[Any], served: Served) -> None:
        buttons = list(app.operating.query(".held"))
        mouse(pilot, buttons[1], events.MouseDown)
        await until(pilot, lambda: served.cell.runtime.set_point.q_rad[0] > STRETCHED[0] + 0.005)
        assert served.cell.mode is Mode.JOGGING
        mouse(pilot, buttons[1], events.MouseUp)
        await rested(pilot, served)
        mouse(pilot, buttons[0], events.MouseDown)
        await moved(pilot, served, 2)
        app.post_message(events.AppBlur())
        await rested(pilot, served)
        at = served.cell.runtime.set_point.q_rad
        await asyncio.sleep(0.3)
        assert served.cell.runtime.set_point.q_rad == at

    played(tmp_path, play)


def test_a_mouse_that_says_nothing_any_more_lets_go_by_itself(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("console.screen.operating.UNSEEN_S", 0.3)

    async def play(app: ConsoleApp, pilot: Pilot[Any], served: Served) -> None:
        mouse(pilot, list(app.operating.query(".held"))[1], events.MouseDown)
        await moved(pilot, served, 1)
        await rested(pilot, served)
        assert "let go by itself" in said(app)

    played(tmp_path, play)


def test_a_console_that_dies_leaves_the_arm_held(tmp_path: Path) -> None:
    async def play(app: ConsoleApp, pilot: Pilot[Any], served: Served) -> None:
        await hold_key(pilot, "right", 0.4)
        assert served.cell.mode is Mode.JOGGING
        app.link._hang_up()  # what the kernel does with a dead process' connection
        await until(pilot, lambda: served.cell.mode is not Mode.JOGGING)
        assert served.cell.runtime.was_stopped
        await rested(pilot, served)

    played(tmp_path, play)


@pytest.mark.parametrize("key", ["ctrl+q", "ctrl+c"])
def test_leaving_stops_what_the_console_began(tmp_path: Path, key: str) -> None:
    async def play(app: ConsoleApp, pilot: Pilot[Any], served: Served) -> None:
        await hold_key(pilot, "right", 0.3)
        assert served.cell.mode is Mode.JOGGING
        await press(pilot, key)
        await until(pilot, lambda: not app.is_running)
        await rested(pilot, served)

    played(tmp_path, play)


# ---- space stops, always


def test_space_stops_on_the_screen_in_the_command_box_and_in_a_dialog(tmp_path: Path) -> None:
    async def play(app: ConsoleApp, pilot: Pilot[Any], served: Served) -> None:
        async def stops() -> None:
            start_move(served)
            await until(pilot, lambda: app.link.status is not None and app.link.status["mode"] == "MOVING")
            await press(pilot, "space")
            await until(pilot, lambda: served.cell.mode is not Mode.MOVING)
            await rested(pilot, served)
            await until(pilot, lambda: app.link.status is not None and app.link.status["mode"] == "HOLDING")

        await stops()
        await press(pilot, "colon", "a")
        assert app.focused is not None
        await stops()
        box = app.operating.query_one(CommandBox)
        assert box.value == "a"
        await press(pilot, "space", "b")  # nothing moves: it is a letter like others
        await until(pilot, lambda: box.value == "a b")
        await press(pilot, "escape")
        await until(pilot, lambda: app.focused is None)
        await press(pilot, "u")
        await until(pilot, lambda: isinstance(app.screen, Choose))
        await stops()
        await press(pilot, "escape")
        await until(pilot, lambda: app.screen is app.operating)
        await press(pilot, "question_mark")
        await stops()

    played(tmp_path, play)


def test_space_ends_the_line_that_runs_and_its_motion(tmp_path: Path) -> None:
    async def play(app: ConsoleApp, pilot: Pilot[Any], served: Served) -> None:
        await app.operator.line("move --joints 1.2 -0.2 0.9 --speed 0.2")
        await until(pilot, lambda: served.cell.mode is Mode.MOVING)
        assert not await app.operator.line("home")
        assert "still runs" in said(app)
        await press(pilot, "space")
        await rested(pilot, served)
        await until(pilot, lambda: not app.operator.running)
        assert "ended with status" in said(app)

    played(tmp_path, play)


# ---- what it shows


def test_a_lost_link_is_said_and_the_console_comes_back_by_itself(tmp_path: Path) -> None:
    async def play(app: ConsoleApp, pilot: Pilot[Any], served: Served) -> None:
        assert "HOLDING" in shown(app, "head")
        served.vanish()
        await until(pilot, lambda: "NO LINK" in shown(app, "head"))
        assert "The link to the runtime is lost" in shown(app, "news")
        await press(pilot, "right", "n")  # nothing happens, and it is said
        await until(pilot, lambda: "armwright serve" in said(app) or "closed the connection" in said(app))
        served.return_()
        await until(pilot, lambda: "HOLDING" in shown(app, "head"))

    played(tmp_path, play)


def test_a_runtime_that_is_there_and_does_not_answer_is_a_lost_link(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("console.screen.link.ANSWER_S", 0.2)

    async def play(app: ConsoleApp, pilot: Pilot[Any], served: Served) -> None:
        served.is_frozen = True
        await until(pilot, lambda: "does not answer" in shown(app, "news"))
        served.is_frozen = False
        await until(pilot, lambda: "HOLDING" in shown(app, "head"))

    played(tmp_path, play)


def test_a_fault_is_said_with_its_remedy_and_acknowledged_by_hand(tmp_path: Path) -> None:
    async def play(app: ConsoleApp, pilot: Pilot[Any], served: Served) -> None:
        fault = Fault("x", "joint 2", "following error 0.2 rad", "look for a collision", Reaction.CONTROLLED)
        served.cell.runtime.fail(fault)
        await until(pilot, lambda: "FAULT" in shown(app, "head"))
        news = shown(app, "news")
        assert "joint 2: following error 0.2 rad; look for a collision" in news
        assert "`a` acknowledges" in news
        await press(pilot, "right")
        assert served.cell.mode is Mode.FAULT
        await press(pilot, "a")
        await rested(pilot, served)

    played(tmp_path, play)


@pytest.mark.parametrize("size", [(80, 24), (120, 40), (40, 12)])
def test_every_panel_is_there_and_says_what_the_arm_does(tmp_path: Path, size: tuple[int, int]) -> None:
    async def play(app: ConsoleApp, pilot: Pilot[Any], served: Served) -> None:
        await until(pilot, lambda: "side" in shown(app, "side") or size[1] < 20)
        await until(pilot, lambda: "tip" in shown(app, "joints"))
        joints = shown(app, "joints")
        assert joints.count("OPERATION ENABLED") == 3
        assert "+0.1000" in joints
        assert "tip" in joints
        head = shown(app, "head")
        assert all(word in head for word in ("HOLDING", "homed", "loop 2 ms", "bus 40 %"))
        if size == (120, 40):
            await until(pilot, lambda: "mrad" in shown(app, "charts"))

    played(tmp_path, play, size)


# ---- lines and keys


def test_keys_and_the_command_box_do_what_lines_do(tmp_path: Path) -> None:
    async def play(app: ConsoleApp, pilot: Pilot[Any], served: Served) -> None:
        await press(pilot, "colon", *"override", "space", *"0.5", "enter")
        await until(pilot, lambda: served.cell.runtime.override == 0.5)
        await press(pilot, "escape")
        await until(pilot, lambda: app.focused is None)
        await press(pilot, ">")
        await until(pilot, lambda: served.cell.runtime.override == 1.0)
        start_move(served)
        await moved(pilot, served, 1)
        await until(pilot, lambda: app.link.status is not None and app.link.status["mode"] == "MOVING")
        await press(pilot, "p")
        await until(pilot, lambda: app.link.status is not None and app.link.status["mode"] == "PAUSED")
        await press(pilot, "p")
        await until(pilot, lambda: served.cell.mode is Mode.MOVING)
        await press(pilot, "space")
        await rested(pilot, served)
        await press(pilot, "u")
        await until(pilot, lambda: isinstance(app.screen, Choose))
        await press(pilot, "escape")
        await until(pilot, lambda: app.screen is app.operating)
        assert served.cell.mode is Mode.HOLDING
        await press(pilot, "u")
        await until(pilot, lambda: isinstance(app.screen, Choose))
        await press(pilot, "down", "enter")
        await until(pilot, lambda: served.cell.mode is Mode.GUIDING and app.screen is app.operating)
        await press(pilot, "n")
        await rested(pilot, served)
        await press(pilot, "colon", *"dance", "enter")
        await until(pilot, lambda: "no such command" in said(app))
        assert (tmp_path / "kept.txt").read_text().splitlines()[:4] == [
            "override 0.5",
            "override 1",
            "pause",
            "resume",
        ]

    played(tmp_path, play)


def test_the_command_box_runs_a_subcommand_and_shows_what_it_says(tmp_path: Path) -> None:
    async def play(app: ConsoleApp, pilot: Pilot[Any], served: Served) -> None:
        await app.operator.line(f"mark here --places {tmp_path / 'places.toml'}")
        await app.operator.wait()
        await until(pilot, lambda: "mark: done" in said(app))
        assert "[here]" in (tmp_path / "places.toml").read_text()

    played(tmp_path, play)


# ---- the held key alone


def test_the_first_press_is_new_and_repeats_renew_at_most_25_times_a_second() -> None:
    key = HeldKey()
    assert key.press("J1+", 10.0).is_new
    assert not key.press("J1+", 10.03).is_new
    presses = [key.press("J1+", 10.03 + 0.01 * i) for i in range(1, 101)]
    assert not any(press.is_new for press in presses)
    assert 20 <= sum(press.is_due for press in presses) <= 25


def test_another_key_or_a_gap_begins_anew() -> None:
    key = HeldKey()
    key.press("J1+", 0.0)
    assert key.press("J1-", 0.01).is_new
    assert not key.press("J1-", 0.01 + REPEAT_s).is_new
    assert key.press("J1-", 0.02 + 2 * REPEAT_s).is_new
    key.forget()
    assert key.press("J1-", 0.03 + 2 * REPEAT_s).is_new


def test_repeats_come_often_enough_for_the_runtimes_dead_man() -> None:
    """Slow terminals repeat 11 times a second; the runtime waits 0.2 s by default."""
    from console.screen.held import THRIFT_s
    from tests.cell import RIGHT

    assert 1.0 / 11.0 + THRIFT_s < RIGHT.limits.jog_silence_s
