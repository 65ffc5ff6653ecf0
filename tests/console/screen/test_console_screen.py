"""The real console, headless, on a mock arm: what its keys do, and that the arm rests when they are let go."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from textual import events
from textual.pilot import Pilot
from textual.widgets import Input

from console.screen.app import ConsoleApp
from console.screen.dashboard import BOX_HINT, BOX_HINT_FOCUSED, CommandBox
from console.screen.operating import Choose
from console.screen.operator import RuntimeLink
from console.user_config import shows_degrees
from control.model.arm import Table
from control.safety.modes import Fault, Mode, Reaction
from tests.cell import RIGHT, STRETCHED, Cell, handled, holding_cell
from tests.console.screen.console_rig import Served, console_on, hold_key, mouse, press, said, shown, until

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


def jogs(served: Served) -> bool:
    return served.cell.mode is Mode.JOGGING


def start_move(served: Served) -> None:
    """A motion of somebody else, 3 s long."""
    answer = handled(served.cell, {"do": "move_joints", "q_rad": [1.2, -0.2, 0.9], "speed": 0.3, "detached": True}, 99)
    assert answer["ok"], answer


# ---- the dead man's switch


def test_a_held_key_jogs_and_the_arm_rests_when_its_repeats_cease(tmp_path: Path) -> None:
    recorded = tmp_path / "kept.txt"

    def is_recorded(served: Served) -> bool:
        """Whether the last line is a move to where the arm rests."""
        lines = recorded.read_text().splitlines() if recorded.exists() else [""]
        angles = " ".join(f"{q:.5f}" for q in served.cell.runtime.joint_rad()[0])
        words = lines[-1].split()
        return words[:2] == ["move", "--joints"] and all(
            abs(float(word) - float(angle)) < 2e-3 for word, angle in zip(words[2:], angles.split(), strict=False)
        )

    async def play(app: ConsoleApp, pilot: Pilot[Any], served: Served) -> None:
        rig = served.cell.rig
        before = rig.joint_rad()
        await hold_key(pilot, "right", lambda: jogs(served) and rig.joint_rad()[0] - before[0] > 0.01)
        await rested(pilot, served)
        await until(pilot, lambda: is_recorded(served))
        after = rig.joint_rad()
        assert after[1:] == pytest.approx(before[1:], abs=2e-3)
        await press(pilot, "z")
        height = rig.tip_m()[2]
        await hold_key(pilot, "left", lambda: jogs(served) and rig.tip_m()[2] < height - 0.003)
        await rested(pilot, served)
        await until(pilot, lambda: is_recorded(served))

    played(tmp_path, play)


def test_a_status_from_before_a_jog_says_nothing_of_its_end(tmp_path: Path) -> None:
    """It is answered while the jog's request is on its way, and shows the arm at rest, too."""
    recorded = tmp_path / "kept.txt"

    async def play(app: ConsoleApp, pilot: Pilot[Any], served: Served) -> None:
        before = app.link.status
        assert before is not None
        app.jogger.run = before["run"] + 1
        await app.desk._on_status(before)
        assert not recorded.exists()
        await app.desk._on_status({**before, "run": before["run"] + 1})
        assert recorded.read_text().startswith("move --joints")
        assert app.jogger.run is None

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


def test_a_button_jogs_while_the_mouse_holds_it_and_a_lost_focus_lets_go(tmp_path: Path) -> None:
    async def play(app: ConsoleApp, pilot: Pilot[Any], served: Served) -> None:
        app.jogger.unseen_s = 1e9  # it is not the silent mouse that lets go
        buttons = list(app.operating.query(".held"))
        mouse(pilot, buttons[1], events.MouseDown)
        # further than one press moves it: the button renews the jog
        await until(pilot, lambda: served.cell.runtime.set_point.q_rad[0] > STRETCHED[0] + 0.05)
        mouse(pilot, buttons[1], events.MouseUp)
        await rested(pilot, served)
        mouse(pilot, buttons[0], events.MouseDown)
        await until(pilot, lambda: jogs(served))
        app.post_message(events.AppBlur())
        await rested(pilot, served)
        at = served.cell.runtime.set_point.q_rad
        cycles = served.cell.runtime.cycles
        await until(pilot, lambda: served.cell.runtime.cycles > cycles + 150)  # 0.3 s of the arm's time
        assert served.cell.runtime.set_point.q_rad == at

    played(tmp_path, play)


def test_a_mouse_that_says_nothing_any_more_lets_go_by_itself(tmp_path: Path) -> None:
    async def play(app: ConsoleApp, pilot: Pilot[Any], served: Served) -> None:
        app.jogger.unseen_s = 0.3
        mouse(pilot, list(app.operating.query(".held"))[1], events.MouseDown)
        await moved(pilot, served, 1)
        await until(pilot, lambda: "jog button released" in said(app))
        await rested(pilot, served)

    played(tmp_path, play)


def test_a_console_that_dies_leaves_the_arm_held(tmp_path: Path) -> None:
    async def play(app: ConsoleApp, pilot: Pilot[Any], served: Served) -> None:
        await hold_key(pilot, "right", lambda: jogs(served))
        app.link._hang_up()  # what the kernel does with a dead process' connection
        await until(pilot, lambda: served.cell.mode is not Mode.JOGGING)
        assert served.cell.runtime.was_stopped
        await rested(pilot, served)

    played(tmp_path, play)


@pytest.mark.parametrize("key", ["ctrl+q", "ctrl+c"])
def test_leaving_stops_what_the_console_began(tmp_path: Path, key: str) -> None:
    async def play(app: ConsoleApp, pilot: Pilot[Any], served: Served) -> None:
        await hold_key(pilot, "right", lambda: jogs(served))
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


def test_every_dialog_and_the_box_s_hint_are_whole_on_80_by_24(tmp_path: Path) -> None:
    async def play(app: ConsoleApp, pilot: Pilot[Any], served: Served) -> None:
        for key in ("question_mark", "h", "o", "u", "k", "f", "c"):
            await press(pilot, key)
            await until(pilot, lambda: any(part.size for part in app.screen.query(".dialog")))
            dialog = app.screen.query_one(".dialog")
            for part in dialog.children:
                assert dialog.content_region.contains_region(part.region), key
            await press(pilot, "escape")
            await until(pilot, lambda: app.screen is app.operating)

    played(tmp_path, play)
    assert max(map(len, (BOX_HINT, BOX_HINT_FOCUSED))) < 80


@pytest.mark.parametrize(("table", "plan"), [(RIGHT.table, "--setups normal,roll,pitch"), (None, "--camera --free 24")])
def test_a_session_is_proposed_that_the_arm_can_take(table: Table | None, plan: str, tmp_path: Path) -> None:
    async def run(cell: Cell) -> None:
        async with console_on(cell, tmp_path, arm=replace(RIGHT, table=table)) as (app, pilot, _):
            await press(pilot, "c")
            await until(pilot, lambda: any(box.value.endswith(plan) for box in app.screen.query(".dialog Input").results(Input)))

    with holding_cell() as cell:
        asyncio.run(run(cell))


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
        assert "The link to the runtime is lost" in shown(app, "status")
        await press(pilot, "right", "n")  # nothing happens, and it is said
        await until(pilot, lambda: "armwright serve" in said(app) or "closed the connection" in said(app))
        served.return_()
        await until(pilot, lambda: "HOLDING" in shown(app, "head"))

    played(tmp_path, play)


def test_a_runtime_with_another_arm_is_watched_and_stopped_and_not_commanded(tmp_path: Path) -> None:
    another = replace(RIGHT, links=(RIGHT.links[0], replace(RIGHT.links[1], L_m=0.35), *RIGHT.links[2:]))

    async def run(cell: Cell) -> None:
        async with console_on(cell, tmp_path, (110, 40), another) as (app, pilot, served):
            await until(pilot, lambda: "link 2, L_m" in shown(app, "status"))
            await press(pilot, "right")
            await until(pilot, lambda: "another arm" in said(app) or "has changed" in said(app))
            assert served.cell.mode is Mode.HOLDING
            start_move(served)
            await until(pilot, lambda: served.cell.mode is Mode.MOVING)
            await press(pilot, "space")
            await rested(pilot, served)
            assert served.cell.runtime.was_stopped

    with holding_cell() as cell:
        asyncio.run(run(cell))


def test_a_runtime_with_another_number_of_joints_is_a_lost_link_that_says_so(tmp_path: Path) -> None:
    seen: list[object] = []

    async def hear(status: object) -> None:
        seen.append(status)

    async def run(cell: Cell) -> None:
        served = Served(cell, tmp_path)
        link = RuntimeLink(served.path, replace(RIGHT, links=RIGHT.links[:2], drives=RIGHT.drives[:2]), hear)
        pump, talk = asyncio.create_task(served.run()), asyncio.create_task(link.run())
        while not seen:
            await asyncio.sleep(0.01)
        for task in (pump, talk):
            task.cancel()
        await asyncio.gather(pump, talk, return_exceptions=True)
        served.vanish()
        assert "has changed since the runtime read it" in link.why_lost

    with holding_cell() as cell:
        asyncio.run(run(cell))
    assert set(seen) == {None}


def test_a_runtime_that_is_there_and_does_not_answer_is_a_lost_link(tmp_path: Path) -> None:
    async def play(app: ConsoleApp, pilot: Pilot[Any], served: Served) -> None:
        app.link.answer_s = 0.2
        for _ in range(2):  # what was asked before has its answer: the next one is asked under the new limit
            answered = app.link.status
            await until(pilot, lambda answered=answered: app.link.status is not answered)
        served.is_frozen = True
        await until(pilot, lambda: "does not answer" in shown(app, "status"))
        app.link.answer_s, served.is_frozen = 2.0, False  # a request that was lost in between is asked again
        await until(pilot, lambda: "HOLDING" in shown(app, "head"))

    played(tmp_path, play)


def test_a_fault_is_said_with_its_remedy_and_acknowledged_by_hand(tmp_path: Path) -> None:
    async def play(app: ConsoleApp, pilot: Pilot[Any], served: Served) -> None:
        fault = Fault("x", "joint 2", "following error 0.2 rad", "check for a collision", Reaction.CONTROLLED)
        served.cell.runtime.fail(fault)
        await until(pilot, lambda: "FAULT" in shown(app, "head"))
        news = shown(app, "status")
        assert "joint 2: following error 0.2 rad; check for a collision" in news
        assert "`a` acknowledges" in news
        await press(pilot, "right")
        assert served.cell.mode is Mode.FAULT
        await press(pilot, "a")
        await rested(pilot, served)

    played(tmp_path, play)


@pytest.mark.parametrize("size", [(80, 24), (120, 40), (40, 12)])
def test_every_panel_is_there_and_says_what_the_arm_does(tmp_path: Path, size: tuple[int, int]) -> None:
    async def play(app: ConsoleApp, pilot: Pilot[Any], served: Served) -> None:
        await until(pilot, lambda: "x" in shown(app, "side") or size[1] < 20)
        await until(pilot, lambda: "tip" in shown(app, "joints"))
        joints = shown(app, "joints")
        assert joints.count("OPERATION ENABLED") == 3
        assert "+0.1000" in joints
        assert "tip" in joints
        head = shown(app, "head")
        assert all(word in head for word in ("HOLDING", "homed", "loop 2 ms", "bus 40 %"))
        if size == (120, 40):
            await until(pilot, lambda: "now" in shown(app, "error") and "now" in shown(app, "current"))

    played(tmp_path, play, size)


# ---- lines and keys


def test_what_is_typed_before_a_line_is_handled_belongs_to_the_next_line(tmp_path: Path) -> None:
    async def play(app: ConsoleApp, pilot: Pilot[Any], served: Served) -> None:
        await press(pilot, "colon")
        await until(pilot, lambda: app.focused is not None)
        box = app.screen.query_one(CommandBox)
        for line in ("override 0.5", "override 0.7"):  # no message is handled in between
            box.value = line
            await box.action_submit()
        await until(pilot, lambda: served.cell.runtime.override == 0.7)
        transcript = tmp_path / "kept.txt"
        await until(pilot, lambda: transcript.read_text().splitlines() == ["override 0.5", "override 0.7"])

    played(tmp_path, play)


def test_keys_and_the_command_box_do_what_lines_do(tmp_path: Path) -> None:
    async def play(app: ConsoleApp, pilot: Pilot[Any], served: Served) -> None:
        await press(pilot, "colon", *"override", "space", *"0.5", "enter")
        await until(pilot, lambda: served.cell.runtime.override == 0.5)
        await until(pilot, lambda: "override 50 %" in shown(app, "jog"))  # the next press counts from there
        box = app.operating.query_one(CommandBox)
        assert app.focused is box  # what is typed next is no key
        assert "an empty Enter gives them back" in str(box.placeholder)
        await press(pilot, "enter")
        await until(pilot, lambda: "Enter" not in str(box.placeholder))
        assert app.focused is None
        await press(pilot, "colon", "escape")
        await until(pilot, lambda: app.focused is None)
        await press(pilot, ">", ">")
        await until(pilot, lambda: served.cell.runtime.override == 1.0)
        await press(pilot, "d")
        await until(pilot, lambda: "angle deg" in shown(app, "joints") and "+5.73" in shown(app, "joints"))
        assert shows_degrees()  # the next console, too
        await press(pilot, "d")
        await until(pilot, lambda: "+0.1000" in shown(app, "joints"))
        assert not shows_degrees()
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
        await until(pilot, lambda: "unknown command" in said(app))
        assert (tmp_path / "kept.txt").read_text().splitlines()[:5] == [
            "override 0.5",
            "override 0.7",
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
