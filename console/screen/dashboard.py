"""The contents of the main screen's panels: text and the arm are updated three times a second, plots once."""

import functools
from collections.abc import Callable, Iterator, Sequence

from console.screen.drawing import (
    BinnedSeries,
    DrawnScene,
    History,
    Panel,
    Plot,
    Row,
    Skeleton,
    clock,
    plot_rows,
    row,
    side_view,
    top_view,
)
from console.screen.jogging import Jogger
from console.screen.link import Message, RuntimeLink
from console.screen.operator import ScreenOperator
from console.screen.texts import (
    Event,
    end_rows,
    events_between,
    headline,
    joint_rows,
    stale_s,
    status_rows,
    tip_row,
)
from console.user_config import shows_degrees
from control.model.arm import Arm

TEXT_S, VIEW_S, PLOT_S = 0.3, 0.3, 0.9  # multiples, so that updates coincide and are drawn in one pass
STILL_rad = 1e-3  # smaller changes of pose are not redrawn
PanelSize = Callable[[str], tuple[int, int]]  # columns and rows inside a panel
Drawn = tuple[str, Sequence[Row]]  # a panel's name and its rows


class Dashboard:
    """Computes from each status the rows of the panels that are due."""

    def __init__(self, arm: Arm, operator: ScreenOperator, jogger: Jogger) -> None:
        self.override = 1.0
        self.in_degrees = shows_degrees()
        self._arm, self._operator, self._jogger = arm, operator, jogger
        self._link: RuntimeLink = operator.link
        self._skeleton = Skeleton(arm)
        self._history = History()
        self._last: Message | None = None
        self._drawn_s: dict[str, float] = {}
        self._view: tuple[object, ...] = ()
        joints = tuple(str(j + 1) for j in range(arm.joint_count))
        self._plots: dict[str, tuple[BinnedSeries, Callable[[BinnedSeries, int], Plot]]] = {
            "error": (self._history.error_mrad, functools.partial(_plot, joints, 1.0, True)),
            "current": (self._history.current_A, functools.partial(_plot, joints, 0.5, True)),
            "speed": (self._history.tip_mm_s, functools.partial(_plot, ("",), 10.0, False)),
            "late": (self._history.late_us, functools.partial(_plot, ("",), 100.0, False)),
        }

    def panels(self) -> Iterator[Panel]:
        """The panels of the arm and of its values over time."""
        yield Panel("side", "Side: x, z m")
        yield Panel("top", "Top: x, y m")
        yield Panel("error", f"Error mrad, limit {1e3 * self._arm.limits.following_error_rad:g}")
        yield Panel("current", f"Current A, limit {max(d.current_limit_A for d in self._arm.drives):g}")
        yield Panel("speed", "Tip speed mm/s")
        yield Panel("late", "Loop lateness p99 us")

    def hurry(self) -> None:
        """Update all panels with the next status, after a key."""
        self._drawn_s.clear()

    def events(self, status: Message | None) -> list[Event]:
        """Events since the last status; stores this one."""
        events = events_between(self._last, status, self._link.why_lost)
        self._last = status
        return events

    def changed(self, status: Message | None, room: PanelSize, now_s: float) -> Iterator[Drawn]:
        """The panels that are due, with their rows."""
        if status is not None:
            self._history.add(status)
            self.override = status["override"]
        if self._is_due("texts", TEXT_S, now_s) or status is None:
            yield from self._texts(status, room)
        if status is not None and self._is_due("views", VIEW_S, now_s):
            yield from self._views(status, room)
        if status is not None and self._is_due("plots", PLOT_S, now_s):
            yield from self._drawn_plots(room)

    def _is_due(self, what: str, period_s: float, now_s: float) -> bool:
        if now_s - self._drawn_s.get(what, -1e9) < period_s:
            return False
        self._drawn_s[what] = now_s
        return True

    def _texts(self, status: Message | None, room: PanelSize) -> Iterator[Drawn]:
        arm, selected, why_lost = self._arm, self._jogger.selected.name, self._link.why_lost
        yield "head", [headline(status, arm, why_lost, room("head")[0], clock())]
        yield "status", status_rows(status, why_lost, room("status")[0])
        if status is not None:
            width = room("joints")[0]
            joints = joint_rows(status, arm, selected, width, self.in_degrees)
            yield "joints", [*joints, tip_row(status, selected), *end_rows(status, width)]
        yield "jog", [self._jog_row()]

    def _jog_row(self) -> Row:
        command = self._operator.running.partition(" ")[0]
        running = row(("  running: ", "muted"), command) if command else ()
        return (
            *self._jogger.describe(),
            *row(("  override ", "muted"), f"{100 * self.override:g} %"),
            *running,
        )

    def _views(self, status: Message, room: PanelSize) -> Iterator[Drawn]:
        is_stale = [age is not None for age in stale_s(status)]
        pose = [round(q / STILL_rad) for q in status["joint_rad"]] if status["is_homed"] else []
        selected = self._jogger.selected.joint
        view = (pose, is_stale, selected, room("side"), room("top"))
        if view == self._view:
            return
        self._view = view
        scene = DrawnScene([], [], self._skeleton.board)
        if status["is_homed"]:
            scene = self._skeleton.scene(status["joint_rad"], selected and selected - 1, is_stale)
        for name, draw in (("side", side_view), ("top", top_view)):
            columns, rows = room(name)
            if columns > 8 and rows > 2:
                yield name, draw(scene, columns, rows, self._skeleton.reach_m)

    def _drawn_plots(self, room: PanelSize) -> Iterator[Drawn]:
        for name, (series, plot) in self._plots.items():
            if room(name)[0]:
                yield name, plot_rows(plot(series, (self._jogger.selected.joint or 1) - 1), *room(name))


def _plot(signs: Sequence[str], least: float, is_signed: bool, series: BinnedSeries, chosen: int) -> Plot:
    return Plot(series.bins, signs, chosen if len(signs) > 1 else 0, least, is_signed)
