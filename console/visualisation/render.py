"""Renders the arm without a window: by MuJoCo if there is OpenGL, else as lines by matplotlib."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from console.visualisation.series import Array, Series
from console.visualisation.snapshots import Snapshot, Traces, snapshot_at
from control.errors import ArmError
from control.files import make_whole
from control.kinematics.kinematics import ForwardKinematics
from control.model.arm import Arm
from control.model.cell import Cell

Image = NDArray[np.uint8]
Painter = Callable[[Snapshot, Traces], Image]
SIZE_pixels: Final = (960, 720)
FRAMES_MOST: Final = 3000


def prefer_headless_gl() -> None:
    """Make MuJoCo use EGL without a display; must be called before it is imported."""
    has_display = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    if sys.platform == "linux" and not has_display:
        os.environ.setdefault("MUJOCO_GL", "egl")


def painter_of(shown: Arm | Cell, warn: Callable[[str], None], is_still: bool) -> Painter:
    """The available painter: MuJoCo's renderer, else lines by matplotlib after a call of `warn` with the reason.

    `is_still`: one picture, which is framed to the arm; pictures of a motion have the frame of all that the arm reaches.

    ArmError without MuJoCo's renderer for several arms.
    """
    prefer_headless_gl()
    try:
        return MujocoPainter(shown, is_still)
    except Exception as error:  # OpenGL platforms raise different errors, including missing libraries
        reason = str(error).strip().splitlines()
        if isinstance(shown, Cell):
            raise ArmError(
                f"MuJoCo finds no OpenGL ({reason[0] if reason else type(error).__name__}), without which several arms cannot be"
                " drawn: set MUJOCO_GL=egl or MUJOCO_GL=osmesa to try another backend"
            ) from None
        warn(
            f"MuJoCo finds no OpenGL ({reason[0] if reason else type(error).__name__}): matplotlib draws lines"
            " instead; set MUJOCO_GL=egl or MUJOCO_GL=osmesa to try another backend"
        )
        return _LinePainter(shown)


class MujocoPainter:
    """Renders with MuJoCo to memory."""

    def __init__(self, shown: Arm | Cell, is_still: bool) -> None:
        import mujoco

        from console.visualisation.scene import scene_of

        self._scene = scene_of(shown)
        width, height = SIZE_pixels
        self._renderer = mujoco.Renderer(self._scene.model, height, width)
        self._camera, self._is_still = self._scene.camera(), is_still

    def __call__(self, snapshot: Snapshot, traces: Traces) -> Image:
        self._scene.pose(snapshot.joint_rad, snapshot.joint_set_rad)
        if self._is_still:
            self._scene.look_at_arms(traces)
            self._camera = self._scene.camera()
        self._renderer.update_scene(self._scene.data, self._camera)
        self._scene.add_traces(self._renderer.scene, traces)
        image: Image = self._renderer.render().copy()
        return image


class _LinePainter:
    """Draws links as lines by matplotlib."""

    def __init__(self, arm: Arm) -> None:
        self._kinematics = ForwardKinematics(arm)

    def __call__(self, snapshot: Snapshot, traces: Traces) -> Image:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        width, height = SIZE_pixels
        figure = Figure(figsize=(width / 100, height / 100), dpi=100)
        canvas = FigureCanvasAgg(figure)
        axes: Any = figure.add_subplot(projection="3d")
        arms = [self.joints_m(snapshot.joint_set_rad), self.joints_m(snapshot.joint_rad)]
        for joints, colour, line, label in ((arms[0], "#D55E00", "-", "commanded"), (arms[1], "#0072B2", "--", "measured")):
            axes.plot(*joints.T, color=colour, linestyle=line, linewidth=4, marker="o", label=label)
        for points, colour in ((traces.commanded_m, "#D55E00"), (traces.measured_m, "#0072B2")):
            axes.plot(*points.T, color=colour, linewidth=0.8)
        axes.plot(*traces.camera_m.T, color="#009E73", marker=".", markersize=2, linestyle="none")
        _equal_axes(axes, np.concatenate([*arms, traces.commanded_m, traces.measured_m]))
        axes.set(xlabel="x [m]", ylabel="y [m]", zlabel="z [m]", title=f"t = {snapshot.t_s:.2f} s {snapshot.mode}")
        axes.legend(loc="upper right", frameon=False)
        canvas.draw()  # type: ignore[no-untyped-call]
        return np.asarray(canvas.buffer_rgba())[..., :3].copy()  # type: ignore[no-untyped-call]

    def joints_m(self, q_rad: Sequence[float]) -> Array:
        """Origins of the link frames and the tip (links + 2, 3) [m]."""
        origins = self._kinematics.link_transforms([q_rad])[0][:, :3, 3]
        return np.concatenate([origins, self._kinematics.tips([q_rad])])


def _equal_axes(axes: Any, points: Array) -> None:
    points = points[np.isfinite(points).all(axis=1)]
    middle, half = 0.5 * (points.min(axis=0) + points.max(axis=0)), 0.55 * np.ptp(points, axis=0).max() + 1e-3
    axes.set(
        xlim=(middle[0] - half, middle[0] + half),
        ylim=(middle[1] - half, middle[1] + half),
        zlim=(middle[2] - half, middle[2] + half),
    )
    axes.set_box_aspect((1, 1, 1))


def frames(series: Series, rows: Sequence[int], traces: Traces, paint: Painter) -> Iterator[tuple[float, Image]]:
    """Time [s] and image of each row."""
    for row in rows:
        snapshot = snapshot_at(series, int(row))
        yield snapshot.t_s, paint(snapshot, traces)


def write_images(out: Path, images: Iterator[tuple[float, Image]], period_s: float) -> list[Path]:
    """A .png of the last image, a .gif of all, or a folder with a PNG each; nothing is overwritten."""
    from PIL import Image as Pillow

    if out.exists() and (out.is_file() or any(out.iterdir())):
        raise ArmError(f"{out} exists already and is never overwritten: choose another --render")
    if out.suffix == ".png":
        out.parent.mkdir(parents=True, exist_ok=True)
        for _, image in images:
            make_whole(out, Pillow.fromarray(image).save)
        return [out]
    if out.suffix == ".gif":
        out.parent.mkdir(parents=True, exist_ok=True)
        pictures = [Pillow.fromarray(image).quantize(256) for _, image in images]
        each_ms = max(20, round(1e3 * period_s))
        make_whole(
            out, lambda beside: pictures[0].save(beside, save_all=True, append_images=pictures[1:], duration=each_ms, loop=0)
        )
        return [out]
    out.mkdir(parents=True, exist_ok=True)
    written = []
    for number, (_, image) in enumerate(images, start=1):
        written.append(out / f"frame-{number:05d}.png")
        make_whole(written[-1], Pillow.fromarray(image).save)
    return written
