"""What the panels show of a status: pure text, and the layout at each size of a terminal."""

from __future__ import annotations

import asyncio
import dataclasses
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from console.screen.app import ArmAtDesk, ConsoleApp
from console.screen.drawing import (
    BINS,
    SIDE,
    THEME,
    TOP,
    BIN_s,
    DrawnScene,
    History,
    Panel,
    Plot,
    Skeleton,
    ascii_of,
    axis_end,
    is_plain,
    plot_rows,
    text_of,
    view,
    width_of,
)
from console.screen.operating import Files
from console.screen.texts import events_between, headline, joint_rows, status_rows, tip_row
from control.model.arm import Arm
from tests.cell import RIGHT
from tests.thirds import third_of

SIZES = [(80, 24), (120, 40), (200, 50), (80, 50), (120, 24)]


def arm_of(joint_count: int) -> Arm:
    """The reference arm's parts in a row."""
    links = tuple(dataclasses.replace(RIGHT.links[j % 2], L_m=0.1) for j in range(joint_count))
    drives = tuple(
        dataclasses.replace(RIGHT.drives[j % 3], joint=j + 1, encoder_board=j // 3, encoder_channel=j % 3, motor_node=j + 1)
        for j in range(joint_count)
    )
    return dataclasses.replace(RIGHT, links=links, drives=drives)


def status_of(joint_count: int = 3, **changes: Any) -> dict[str, Any]:
    """An arm that holds."""
    zeros = [0.0] * joint_count
    return {
        "mode": "HOLDING",
        "run": 1,
        "is_homed": True,
        "t_s": 10.0,
        "q_rad": zeros,
        "joint_rad": zeros,
        "speed_rad_s": zeros,
        "following_error_rad": zeros,
        "count": [-12345678] * joint_count,
        "current_A": zeros,
        "supply_V": [24.0] * joint_count,
        "temperature_C": [125.0] * joint_count,
        "tip_m": (0.5, -0.2, 0.3),
        "drive_state": ["OPERATION ENABLED"] * joint_count,
        "tip_set_m": (0.5, -0.2, 0.3),
        "camera_m": (0.5, -0.2, 0.3),
        "progress": 0.0,
        "was_stopped": False,
        "override": 1.0,
        "faults": [],
        "warnings": [],
        "period_s": 0.002,
        "missed_cycles": 0,
        "late_p99_s": 1e-4,
        "encoder_stale_s": [None] * joint_count,
        "drive_stale_s": [None] * joint_count,
    } | changes


# ---- stale joints


def test_a_stale_joint_has_a_sign_and_its_age_and_the_others_have_not() -> None:
    status = status_of(encoder_stale_s=[None, 1.26, None])
    rows = text_of(joint_rows(status, RIGHT, "J1", 78)).splitlines()
    assert "J2?" in rows[2]
    assert "STALE for 1.3 s" in rows[2]
    assert "?" not in rows[1] + rows[3]
    scene = Skeleton(RIGHT).scene(status["joint_rad"], 0, [False, True, False])
    assert [sign for _, sign, _ in scene.joints] == ["1", "?", "3"]


def test_no_joint_is_beyond_its_range_before_homing_tells_where_it_is() -> None:
    far = {"q_rad": [9.0, 0.0, 0.0]}
    known, unknown = (text_of(joint_rows(status_of(is_homed=is_homed, **far), RIGHT, "J1", 140)) for is_homed in (True, False))
    assert "!+9.0000" in known
    assert "!" not in unknown
    assert unknown.count("not homed") == 3
    views = (view(DrawnScene([], [], []), axes, 23, 8, 0.5) for axes in (SIDE, TOP))
    assert all("pose not known" in text_of(rows) for rows in views)


def test_a_runtime_that_does_not_tell_ages_shows_no_joint_as_stale() -> None:
    assert "STALE" not in text_of(joint_rows(status_of(), RIGHT, "J1", 78))


def test_a_loop_that_is_a_little_early_is_not_late() -> None:
    assert " late 0 us " in text_of([headline(status_of(late_p99_s=-1e-7), RIGHT, "", 80, "12:00:00")])


# ---- events


@pytest.mark.parametrize(
    ("before", "after", "events"),
    [
        ({}, {"mode": "HOMING"}, ["HOLDING → HOMING"]),
        ({"mode": "MOVING"}, {"was_stopped": True}, ["MOVING → HOLDING, stopped"]),
        ({}, {"mode": "MOVING", "run": 2}, ["motion 2 began", "HOLDING → MOVING"]),
        ({"is_homed": False}, {}, ["homed"]),
        ({}, {"encoder_stale_s": [None, None, 0.5]}, ["J3: no new data for 0.5 s"]),
        ({"encoder_stale_s": [None, None, 0.5]}, {}, ["J3: new data again"]),
        ({"faults": [{"code": "x", "where": "joint 2", "message": "hot"}]}, {}, ["faults acknowledged"]),
        ({}, {"faults": [{"code": "x", "where": "joint 2", "message": "hot"}]}, ["fault: joint 2: hot"]),
        ({}, {"t_s": 11.0}, []),
    ],
)
def test_what_differs_between_two_statuses_is_an_event(
    before: Mapping[str, Any], after: Mapping[str, Any], events: list[str]
) -> None:
    assert [text for text, _ in events_between(status_of(**before), status_of(**after))] == events


def test_a_lost_link_is_one_event_and_its_return_another() -> None:
    assert events_between(status_of(), None, "gone") == [("link lost: gone", True)]
    assert events_between(None, None, "gone") == []
    assert events_between(None, status_of()) == [("connected: HOLDING, homed", False)]


# ---- values over time


def test_a_bin_keeps_the_value_furthest_from_zero_and_what_was_not_heard_stays_empty() -> None:
    history = History()
    for t_s, current_A in ((10.0, 1.0), (10.1, -3.0), (10.2, 2.0), (10.2 + 3 * BIN_s, 0.5)):
        history.add(status_of(t_s=t_s, current_A=[current_A, 0.0, 0.0]))
    newest = list(history.current_A.bins)[-4:]
    assert [values and values[0] for values in newest] == [-3.0, None, None, 0.5]
    history.add(status_of(t_s=1.0))  # another runtime's clock
    assert sum(values is not None for values in history.current_A.bins) == 1


@pytest.mark.parametrize(("largest", "end"), [(0.0, 1.0), (1.0, 1.0), (1.01, 2.0), (4.9, 5.0), (51.0, 100.0)])
def test_the_value_axis_ends_at_1_2_or_5_of_a_decade(largest: float, end: float) -> None:
    assert axis_end(Plot([[largest]], "1", 0, 1.0)) == pytest.approx(end)


def test_joints_on_one_line_are_told_apart_by_their_signs() -> None:
    text = text_of(plot_rows(Plot([[0.0] * 7] * BINS, "1234567", 0, 1.0), 60, 9))
    for sign in "234567":
        assert sign in text
    lines = text.splitlines()
    assert [line[:6].strip() for line in (lines[0], lines[3], lines[7])] == ["1┤", "0┤", "-1┤"]
    assert lines[-1].split() == ["-30", "s", "-15", "s", "now"]
    assert {len(line) for line in lines} == {60}


# ---- pictures and plain terminals


@pytest.mark.parametrize("axes", [SIDE, TOP])
@pytest.mark.parametrize(("columns", "rows"), [(18, 5), (38, 16), (60, 30)])
def test_a_view_fills_its_room_and_names_axes_joints_and_tip(axes: tuple[int, int], columns: int, rows: int) -> None:
    scene = Skeleton(RIGHT).scene([0.3, -0.5, 0.4], 0, [False] * 3)
    drawn = view(scene, axes, columns, rows, 0.9)
    assert [width_of(spans) for spans in drawn] == [columns] * rows
    text = text_of(drawn)
    assert all(sign in text for sign in ("x", "z" if axes == SIDE else "y", "1", "3", "◆"))


@pytest.mark.parametrize("columns", range(14, 60))
def test_the_numbers_of_an_axis_are_whole_and_have_their_sign(columns: int) -> None:
    scene = Skeleton(RIGHT).scene([0.0, 0.0, math.pi], 0, [False] * 3)  # folded back over the base
    words = text_of(view(scene, SIDE, columns, 16, 0.9)).split()
    numbers = [float(word) for word in words if "." in word]
    assert numbers == sorted(set(numbers))


def test_every_sign_of_the_console_has_a_likeness_in_ascii() -> None:
    status = status_of(encoder_stale_s=[None, 2.0, None])
    scene = Skeleton(RIGHT).scene([0.3, -0.5, 0.4], 0, [False] * 3)
    plot = Plot([[math.sin(n / 9.0), 0.1, -0.5] for n in range(BINS)], "123", 0, 1.0)
    drawn = [*joint_rows(status, RIGHT, "J1", 120), *view(scene, SIDE, 40, 16, 0.9), *plot_rows(plot, 60, 9)]
    text = ascii_of(text_of(drawn))
    assert text.isascii()
    assert "?" not in text.replace("J2?", "")
    assert len(text) == len(text_of(drawn))


def test_a_terminal_without_braille_is_plain() -> None:
    assert is_plain({"TERM": "linux"})
    assert is_plain({"TERM": "vt100"})


# ---- layout


async def _laid_out(arm: Arm, size: tuple[int, int], status: Mapping[str, Any]) -> dict[str, tuple[Any, str]]:
    """Regions and texts of the panels that are shown, by name."""
    app = ConsoleApp([ArmAtDesk(arm, Path("/nowhere"), Files(Path("p.toml"), Path("t.csv")), {})])
    app.link.run = lambda: asyncio.sleep(0)  # type: ignore[method-assign] # no runtime: statuses are given
    async with app.run_test(size=size) as pilot:
        for _ in range(3):  # sizes follow from texts, and texts from sizes
            app.operating.on_resize()
            app.operating.show(dict(status))
            await pilot.pause()
        panels = [panel for panel in app.operating.query(Panel) if panel.region.area]
        shown = {str(panel.id): (panel.content_region, panel.text) for panel in panels}
        others = {str(one.id): (one.region, "") for one in app.operating.query("#events, #command, #targets")}
        buttons = {f"button{n}": (one.region, "") for n, one in enumerate(app.operating.query(".held"))}
        return shown | others | buttons


@pytest.mark.parametrize("joint_count", [3, 7])
@pytest.mark.parametrize("size", third_of(SIZES))
def test_nothing_is_clipped_at_any_size(size: tuple[int, int], joint_count: int) -> None:
    warning = ["joint 1 is 0.240 rad from the end of its range"]
    status = status_of(joint_count, warnings=warning)
    shown = asyncio.run(_laid_out(arm_of(joint_count), size, status))
    for name, (region, text) in shown.items():
        assert region.right <= size[0], name
        assert region.bottom <= size[1], name
        lines = text.splitlines() or [""]
        assert max(map(len, lines)) <= region.width, name
        assert len(lines) <= region.height, name
    assert shown["hints"][0].bottom == size[1]
    assert len([name for name in shown if name.startswith("button")]) == 2 * (joint_count + 3)
    assert shown["events"][0].height >= 4
    assert len(shown["joints"][1].splitlines()) == joint_count + 2
    is_large = size[0] >= 120 and size[1] >= 40
    assert ("error" in shown) == (is_large or size[1] >= 50)


def test_a_panel_follows_a_change_of_its_style_sheet() -> None:
    async def colours() -> list[Any]:
        app = ConsoleApp([ArmAtDesk(RIGHT, Path("/nowhere"), Files(Path("p.toml"), Path("t.csv")), {})])
        app.link.run = lambda: asyncio.sleep(0)  # type: ignore[method-assign] # no runtime
        async with app.run_test(size=(80, 24)) as pilot:
            found = []
            app.register_theme(dataclasses.replace(THEME, name="other", foreground="#102030", background="#ffffff"))
            for app.theme in (THEME.name, "other"):
                app.operating.show(status_of())
                await pilot.pause()
                strip = app.operating.query_one("#joints", Panel).render_line(1)
                found.append([segment.style for segment in strip])
            return found

    before, after = asyncio.run(colours())
    assert before != after


def test_the_table_of_joints_fits_80_columns_with_the_longest_values() -> None:
    status = status_of(
        3,
        q_rad=[-12.3456] * 3,
        following_error_rad=[-0.1234] * 3,
        count=[-2147483648] * 3,
        current_A=[-12.34] * 3,
        speed_rad_s=[-12.34] * 3,
        drive_state=["FAULT REACTION ACTIVE"] * 3,
    )
    for in_degrees in (False, True):
        rows = [*joint_rows(status, RIGHT, "J1", 78, in_degrees), tip_row(status, "X"), *status_rows(status, "", 78)]
        assert max(width_of(spans) for spans in rows) <= 78
        joints = text_of(rows[1:4]).splitlines()
        assert all(len(line.split()) >= 8 for line in joints)  # no two values touch
