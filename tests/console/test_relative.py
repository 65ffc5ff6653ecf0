"""Way-points relative to another arm's tip, and the clients of a cell's arms: what is refused before anything moves."""

from __future__ import annotations

import argparse
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from console.commands.connection import connected_arms
from console.commands.moving import beside
from control.errors import ArmError
from control.model.fingerprint import fingerprint
from control.motion.waypoints import Waypoints
from control.server import channel
from control.server.server import Server
from tests.pair import PAIR

RIGHT = PAIR.placed("right").arm
STATUS: dict[str, Any] = {
    "ok": True,
    "mode": "HOLDING",
    "is_homed": True,
    "tip_set_m": (0.5, 0.1, 0.3),
    "fingerprint": fingerprint(PAIR.placed("left").arm),
}
Serve = Callable[[str, dict[str, Any]], None]


@pytest.fixture
def serve(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Serve]:
    """Starts runtimes that answer everything with one status."""
    (tmp_path / "s").mkdir(mode=0o700)
    monkeypatch.setattr(channel, "socket_folders", lambda: (tmp_path / "s",))
    ended, threads = threading.Event(), []

    def start(name: str, status: dict[str, Any]) -> None:
        server = Server(tmp_path / "s" / f"{name}.sock", lambda request, client: dict(status), lambda client: None)

        def run() -> None:
            while not ended.wait(0.001):
                server.poll()
            server.close()

        threads.append(threading.Thread(target=run))
        threads[-1].start()

    yield start
    ended.set()
    for thread in threads:
        thread.join()


def given(relative_to: str) -> argparse.Namespace:
    return argparse.Namespace(cell="pair", relative_to=relative_to)


def test_offsets_are_from_the_other_tip_along_the_axes_of_the_cell(serve: Serve) -> None:
    serve("left", STATUS)
    plan = beside(given("left"), RIGHT, Waypoints(((0.0, 0.0, 0.0), (0.0, -0.2, 0.1)), None))
    # The left base stands 0.5 m to the left of the right one.
    assert plan.points == (pytest.approx((0.5, 0.6, 0.3)), pytest.approx((0.5, 0.4, 0.4)))


@pytest.mark.parametrize(
    ("changed", "said"),
    [({"mode": "MOVING"}, "it is MOVING and homed"), ({"tip_set_m": None, "is_homed": False}, "it is HOLDING and not homed")],
)
def test_the_other_arm_must_be_homed_and_at_rest(serve: Serve, changed: dict[str, Any], said: str) -> None:
    serve("left", STATUS | changed)
    with pytest.raises(ArmError, match=said):
        beside(given("left"), RIGHT, Waypoints(((0.0, 0.0, 0.0),), None))


def test_another_arm_of_the_cell_is_needed_and_no_orientations() -> None:
    points = Waypoints(((0.0, 0.0, 0.0),), None)
    with pytest.raises(ArmError, match="expected another arm than 'right'"):
        beside(given("right"), RIGHT, points)
    with pytest.raises(ArmError, match="expected one of left, right"):
        beside(given("middle"), RIGHT, points)
    turned = Waypoints(points.points, None, orientations=((1.0, 0.0, 0.0, 0.0),))
    with pytest.raises(ArmError, match="without orientation"):
        beside(given("left"), RIGHT, turned)


def test_arms_that_are_served_alone_are_no_cell(serve: Serve) -> None:
    serve("left", STATUS)
    serve("right", STATUS)
    with (
        pytest.raises(ArmError, match="arm 'left' is served alone: stop its runtime"),
        connected_arms(given("left"), ("left", "right")),
    ):
        pass
