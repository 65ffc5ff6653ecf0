"""The arm in MuJoCo's own viewer: a recording played back, or the live arm.

The viewer has its own thread in this process, which is neither the loop nor its writer.
"""

from __future__ import annotations

import os
import sys
import threading
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager
from typing import Any, Final, Protocol

import numpy as np

from console.visualisation.scene import Scene
from console.visualisation.series import Series
from console.visualisation.snapshots import Snapshot, TipPath, snapshot_at, traces_of
from control.errors import ArmError
from firmware_iface.clock import Clock

SPACE, RIGHT, LEFT, UP, DOWN, HOME = 32, 262, 263, 265, 264, 268  # GLFW's key codes
CLOSING_LIMIT_s: Final = 3.0
STEP_s: Final = 1.0
FASTEST, SLOWEST = 64.0, 1.0 / 64.0
REMEDY: Final = "use --render FILE.png, FILE.gif or a folder, or a machine with a screen"


class Handle(Protocol):
    """The part of MuJoCo's viewer that is used here."""

    user_scn: Any
    cam: Any

    def is_running(self) -> bool: ...

    def lock(self) -> AbstractContextManager[Any]: ...

    def sync(self) -> None: ...

    def close(self) -> None: ...


Open = Callable[[Scene, Callable[[int], None]], Handle]


def open_window(scene: Scene, on_key: Callable[[int], None]) -> Handle:
    """MuJoCo's viewer; ArmError if no window can be opened, instead of waiting for ever."""
    _require_display()
    import mujoco.viewer

    before = set(threading.enumerate())
    try:
        handle: Handle = mujoco.viewer.launch_passive(
            scene.model, scene.data, key_callback=on_key, show_left_ui=False, show_right_ui=False
        )
    except RuntimeError as error:  # on macOS
        raise ArmError(f"MuJoCo's viewer does not start ({error}): run it as `mjpython -m console.main view ...`") from error
    aim(handle.cam, scene)
    return _Window(handle, [thread for thread in threading.enumerate() if thread not in before])


class _Window:
    """MuJoCo's handle; closing waits for its threads, because a process that ends before them may crash."""

    def __init__(self, handle: Handle, drawing: Sequence[threading.Thread]) -> None:
        self._handle, self._drawing = handle, drawing
        self.user_scn, self.cam = handle.user_scn, handle.cam

    def is_running(self) -> bool:
        return self._handle.is_running()

    def lock(self) -> AbstractContextManager[Any]:
        return self._handle.lock()

    def sync(self) -> None:
        self._handle.sync()

    def close(self) -> None:
        self._handle.close()
        for thread in self._drawing:
            thread.join(CLOSING_LIMIT_s)


def aim(at: Any, scene: Scene) -> None:
    """Aim the viewer's camera at the whole arm."""
    camera = scene.camera()
    at.lookat[:] = camera.lookat
    at.distance, at.azimuth, at.elevation = camera.distance, camera.azimuth, camera.elevation


def _require_display() -> None:
    if sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise ArmError(f"no display (neither DISPLAY nor WAYLAND_DISPLAY is set): {REMEDY}")
    import glfw

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        is_ready = glfw.init()
        glfw.terminate()  # the context must belong to the viewer's own thread
    if not is_ready:
        why = "; ".join(str(one.message) for one in caught) or "GLFW gives no reason"
        raise ArmError(f"cannot open a window on this display ({why}): {REMEDY}")


class Player:
    """Playback position in a recording; keys: space, arrows, home."""

    def __init__(self, rows: Sequence[int], times_s: Sequence[float], speed: float) -> None:
        """`rows` of the recording are shown, each from its time on."""
        self._rows, self._times_s = rows, np.asarray(times_s)
        self.at_s, self.speed, self.is_paused = float(self._times_s[0]), speed, False

    def key(self, code: int) -> None:
        """Process a key: pause, a second forward or back, faster or slower, restart."""
        if code == SPACE:
            self.is_paused = not self.is_paused
        elif code in (LEFT, RIGHT):
            self.at_s += STEP_s if code == RIGHT else -STEP_s
        elif code in (UP, DOWN):
            self.speed = min(FASTEST, max(SLOWEST, self.speed * (2.0 if code == UP else 0.5)))
        elif code == HOME:
            self.at_s = float(self._times_s[0])

    def on(self, passed_s: float) -> int:
        """Advance the time; return the row that is shown now. Stops at the end."""
        if not self.is_paused:
            self.at_s += passed_s * self.speed
        self.at_s = min(max(self.at_s, float(self._times_s[0])), float(self._times_s[-1]))
        return self._rows[int(np.searchsorted(self._times_s, self.at_s, side="right")) - 1]


PLAY_PERIOD_s = 1.0 / 60.0


def play(scene: Scene, series: Series, player: Player, clock: Clock, open_: Open) -> None:
    """Show a recording until the window is closed."""
    traces = traces_of(series, scene.tips)
    handle = open_(scene, player.key)
    before_s = clock.now_s()
    try:
        while handle.is_running():
            now_s = clock.now_s()
            snapshot = snapshot_at(series, player.on(now_s - before_s))
            before_s = now_s
            with handle.lock():
                scene.pose(snapshot.joint_rad, snapshot.joint_set_rad)
                scene.trace(handle.user_scn, traces)
            handle.sync()
            clock.wait_until_s(now_s + PLAY_PERIOD_s)
    finally:
        handle.close()


def follow(scene: Scene, snapshots: Iterator[Snapshot], open_: Open) -> None:
    """Show live snapshots until the window is closed, with the measured and the commanded path of the tip."""
    handle = open_(scene, lambda code: None)
    path = TipPath(scene.tips)
    try:
        for snapshot in snapshots:
            if not handle.is_running():
                break
            with handle.lock():
                scene.pose(snapshot.joint_rad, snapshot.joint_set_rad)
                scene.trace(handle.user_scn, path.add(snapshot))
            handle.sync()
    finally:
        handle.close()
