"""`armwright view`: the scene stands where kinematics says, plays, follows a live arm, needs no display, streams to Rerun."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest
from PIL import Image

from console.commands import view
from console.main import main
from console.visualisation import render
from console.visualisation.reading import read_series
from console.visualisation.scene import PREFIX, ArmScene, CellScene, Scene
from console.visualisation.snapshots import (
    CellSource,
    Snapshot,
    TipPath,
    Traces,
    live,
    recorded,
    snapshot_at,
    snapshot_of,
    tips_in,
    traces_of,
)
from console.visualisation.window import DOWN, HOME, LEFT, RIGHT, SPACE, UP, Player, follow, play
from control.errors import ArmError
from control.kinematics.kinematics import ForwardKinematics
from control.model.arm import Link, Tool
from control.model.cell import cell_of_one, load_cell
from control.model.description import arm_text, load_arm
from control.motion.joint_limits import reach_m
from control.server.channel import RuntimeGone
from tests.recordings import MODES, write_recording

ARM = load_arm("right")
OTHER = replace(
    ARM,
    dh_convention="modified",
    tool=Tool((0.01, 0.02, 0.03)),
    table=None,
    links=(
        Link("revolute", 0.3, 0.1, 0.0, 0.0),
        Link("revolute", 0.02, -0.4, 0.1, -1.2),
        Link("revolute", 0.0, 0.7, 0.25, 0.3),
        Link("fixed", 0.1, 0.2, 0.05, 1.6),
    ),
)


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_recording(tmp_path_factory.mktemp("log") / "a.armlog", 500, arm_toml=arm_text(ARM))


class Clock:
    """Time that runs when somebody waits."""

    def __init__(self) -> None:
        self.t = 100.0

    def now_s(self) -> float:
        return self.t

    def wait_until_s(self, t: float) -> None:
        self.t = max(self.t, t)


class Window:
    """MuJoCo's viewer without a window: takes the scene's lines, is closed after some frames."""

    def __init__(self, scene: ArmScene, frames: int) -> None:
        self.user_scn = mujoco.MjvScene(scene.model, maxgeom=2000)
        self.cam = mujoco.MjvCamera()
        self.scene, self.left, self.tips, self.geoms, self.is_closed = scene, frames, [], [], False

    def is_running(self) -> bool:
        self.left -= 1
        return self.left >= 0

    def lock(self) -> contextlib.AbstractContextManager[Any]:
        return contextlib.nullcontext()

    def sync(self) -> None:
        self.tips.append((self.scene.tip_m(PREFIX), self.scene.tip_m()))
        self.geoms.append(self.user_scn.ngeom)

    def close(self) -> None:
        self.is_closed = True


@pytest.mark.parametrize("arm", [ARM, OTHER, load_arm("so101")], ids=["standard", "modified", "joints with names"])
def test_both_arms_of_the_scene_stand_where_kinematics_says(arm: Any) -> None:
    scene = ArmScene(arm)
    rng = np.random.default_rng(2)
    for q, q_set in rng.uniform(-1.0, 1.0, (10, 2, arm.joint_count)):
        scene.pose(q, q_set)
        tips = ForwardKinematics(arm).tips([q, q_set])
        np.testing.assert_allclose(scene.tip_m(PREFIX), tips[0], atol=1e-9)
        np.testing.assert_allclose(scene.tip_m(), tips[1], atol=1e-9)


@pytest.mark.parametrize("count", [1, 2])
def test_the_view_holds_every_place_that_an_arm_reaches(count: int) -> None:
    cell = load_cell("pair") if count == 2 else cell_of_one(load_arm("right"))
    scene: Scene = CellScene(cell) if count == 2 else ArmScene(cell.arms[0].arm)
    camera = scene.camera()
    a, e = np.radians((camera.azimuth, camera.elevation))
    ahead = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    axes = np.array([[np.sin(a), -np.cos(a), 0.0], np.cross([np.sin(a), -np.cos(a), 0.0], ahead)])
    half_wide = np.tan(np.radians(scene.model.vis.global_.fovy) / 2.0) * np.array([4.0 / 3.0, 1.0])
    for placed in cell.arms:
        for way in ([0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, -1.0, 0.0]):
            place = np.array(placed.origin_m) + np.multiply(way, reach_m(placed.arm)) - camera.lookat
            assert (np.abs(axes @ place) <= (camera.distance + ahead @ place) * half_wide * 0.96).all(), (
                way
            )  # a line there is whole


@pytest.mark.parametrize("name", ["so101", "widowx250"])
def test_one_picture_is_framed_to_the_arm(name: str) -> None:
    arm = load_arm(name)
    scene = ArmScene(arm)
    scene.pose(arm.rest.q_rad, arm.rest.q_rad)
    far_m = scene.camera().distance
    scene.look_at_arms(Traces())
    camera = scene.camera()
    assert camera.distance < 0.7 * far_m
    origins_m = ForwardKinematics(arm).link_transforms([arm.rest.q_rad])[0][:, :3, 3]
    seen_m = origins_m - camera.lookat
    assert (np.linalg.norm(seen_m, axis=1) < camera.distance).all()


def test_the_arms_of_a_cell_stand_at_their_bases_and_each_leaves_a_path_of_its_own() -> None:
    pair = load_cell("pair")
    turned = replace(pair.arms[1], origin_m=(0.2, -0.6, 0.1), orientation=(0.6, 0.0, 0.0, 0.8))
    cell = replace(pair, arms=(pair.arms[0], turned))
    scene, trail = CellScene(cell), TipPath(tips_in(cell))
    poses = {"left": (0.1, -0.5, 0.4), "right": (-0.4, -0.2, 0.6)}
    source = CellSource([SimpleNamespace(status=lambda q=q: statuses_of(q)) for q in poses.values()])
    for _ in range(2):
        snapshot = snapshot_of(source.status())
        traces = trail.add(snapshot)
    scene.pose(snapshot.joint_rad, snapshot.joint_set_rad)
    tips = [placed.in_cell(ForwardKinematics(placed.arm).tip(*poses[placed.name])) for placed in cell.arms]
    for name, tip in zip(cell.names, tips, strict=True):
        for which in ("", PREFIX):
            np.testing.assert_allclose(scene.tip_m(f"{name}/{which}"), tip, atol=1e-9)
    gap = (np.nan,) * 3
    np.testing.assert_allclose(traces.measured_m, [tips[0], tips[0], gap, tips[1], tips[1], gap])


def statuses_of(q_rad: tuple[float, ...]) -> dict[str, Any]:
    """The status of an arm that holds a pose."""
    angles = dict.fromkeys(("q_rad", "q_set_rad", "joint_rad", "joint_set_rad", "current_A"), q_rad)
    return {"t_s": 1.0, "mode": "HOLDING", **angles}


def test_lines_are_thinned_gaps_stay_gaps_and_a_full_scene_is_no_error() -> None:
    scene = ArmScene(ARM)
    into = mujoco.MjvScene(scene.model, maxgeom=2000)
    path = np.stack([np.linspace(0.0, 1.0, 5000), np.zeros(5000), np.zeros(5000)], axis=1)
    scene.trace(into, Traces(commanded_m=path))
    assert 200 < into.ngeom <= 250
    broken = path[:100].copy()
    broken[50] = np.nan
    scene.trace(into, Traces(commanded_m=broken, camera_m=broken[:51]))
    assert into.ngeom == 97 + 50  # two pieces are gone, and one mark
    small = mujoco.MjvScene(scene.model, maxgeom=10)
    scene.trace(small, Traces(commanded_m=path, camera_m=path))
    assert small.ngeom == 10


def test_a_recording_plays_at_its_speed_and_the_window_ends_it(log: Path) -> None:
    series, scene, clock = read_series(log), ArmScene(ARM), Clock()
    rows, times = recorded(series, 1.0 / 60.0)
    windows: list[Window] = []

    def opened(scene: ArmScene, on_key: Any) -> Window:
        windows.append(Window(scene, 31))
        return windows[0]

    play(scene, series, Player(rows.tolist(), series.t_s[rows].tolist(), 2.0), clock, opened)
    window = windows[0]
    assert window.is_closed
    assert len(window.tips) == 31
    assert clock.t == pytest.approx(100.0 + 31 / 60)
    at = int(np.searchsorted(times, 2.0 * 30 / 60, side="right") - 1)  # 30 frames later, twice as fast
    q = series.q_rad[rows[at]]
    np.testing.assert_allclose(window.tips[-1][0], ForwardKinematics(ARM).tips([q])[0], atol=1e-9)
    assert min(window.geoms) > 100


def test_keys_pause_step_and_change_the_speed_within_the_recording() -> None:
    player = Player(range(4), [0.0, 1.0, 2.0, 3.0], 1.0)
    assert player.on(1.5) == 1
    player.key(SPACE)
    assert player.on(10.0) == 1
    player.key(RIGHT)
    assert player.on(0.0) == 2
    for _ in range(9):
        player.key(RIGHT)
    assert player.on(0.0) == 3
    player.key(LEFT)
    assert player.on(0.0) == 2
    player.key(HOME)
    assert player.on(0.0) == 0
    for _ in range(20):
        player.key(UP)
    assert player.speed == 64.0
    for _ in range(40):
        player.key(DOWN)
    assert player.speed == pytest.approx(1 / 64)
    player.key(999)


def statuses() -> Iterator[dict[str, Any]]:
    for k in range(5):
        yield {
            "t_s": 0.1 * k,
            "q_rad": [0.1 * k, 0.0, 0.0],
            "q_set_rad": [0.2 * k, 0.0, 0.0],
            "mode": "MOVING",
            "camera_m": [0.1, 0.2, 0.3] if k == 2 else None,
            "current_A": [1.0, None, 2.0],
        }


def test_a_live_arm_is_followed_with_a_trail_until_its_runtime_ends() -> None:
    answers, clock, scene = statuses(), Clock(), ArmScene(ARM)

    def status() -> dict[str, Any]:
        if (answer := next(answers, None)) is None:
            raise RuntimeGone("gone")
        return answer

    window = Window(scene, 1000)
    snapshots = live(SimpleNamespace(status=status), clock, 0.1)
    with pytest.raises(RuntimeGone):
        follow(scene, snapshots, lambda scene, key: window)
    assert window.is_closed
    assert len(window.tips) == 5
    assert clock.t == pytest.approx(100.5)
    np.testing.assert_allclose(window.tips[3][1], ForwardKinematics(ARM).tips([[0.6, 0.0, 0.0]])[0], atol=1e-9)
    assert window.geoms == [0, 2, 5, 7, 9]  # two lines a snapshot, and the mark


def test_a_trail_keeps_the_last_of_it() -> None:
    trail = TipPath(tips_in(ARM), most=3)
    for k in range(7):
        traces = trail.add(Snapshot(0.1 * k, (0.0,) * 3, (0.0,) * 3, (0.1 * k, 0.0, 0.0), (0.0, 0.0, 0.0)))
    np.testing.assert_allclose(traces.measured_m, ForwardKinematics(ARM).tips([[0.1 * k, 0, 0] for k in (4, 5, 6)]))


def test_moments_without_all_angles_are_passed_over(tmp_path: Path) -> None:
    changes = {k: {"q2_rad": float("nan")} for k in range(20, 40)} | {50: {"q1_set_rad": float("nan")}}
    series = read_series(write_recording(tmp_path / "a.armlog", 100, changes=changes))
    rows, times = recorded(series, 0.002)
    assert not set(range(20, 40)) & set(rows.tolist())
    assert (np.diff(times) > 0.0).all()
    snapshot = snapshot_at(series, 50)
    assert snapshot.q_set_rad == snapshot.q_rad


def test_what_means_nothing_before_homing_is_no_line(tmp_path: Path) -> None:
    homing = {k: {"mode": MODES.index("HOMING")} for k in range(30, 40)}
    series = read_series(write_recording(tmp_path / "a.armlog", 80, changes=homing))
    traces = traces_of(series, tips_in(ARM))
    assert np.isnan(traces.measured_m[:40]).all()
    assert np.isfinite(traces.measured_m[40:]).all()


@pytest.fixture
def no_gl(monkeypatch: pytest.MonkeyPatch) -> None:
    def none(*_: Any) -> Any:
        raise RuntimeError("no OpenGL")

    monkeypatch.setattr(render, "MujocoPainter", none)


@pytest.mark.usefixtures("no_gl")
def test_without_opengl_the_pictures_are_lines_and_it_is_said(
    log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "last.png"
    assert main(["view", str(log), "--render", str(out)]) == 0
    assert "MuJoCo finds no OpenGL (no OpenGL)" in capsys.readouterr().err
    image = np.asarray(Image.open(out))
    assert image.shape == (720, 960, 3)
    for colour in ((0xD5, 0x5E, 0x00), (0x00, 0x72, 0xB2)):  # commanded and measured are both seen
        assert (np.abs(image.astype(int) - colour).max(axis=2) < 12).sum() > 100
    assert main(["view", str(log), "--render", str(out)]) == 2  # nothing is overwritten


@pytest.mark.usefixtures("no_gl")
def test_a_folder_gets_a_picture_each_and_a_gif_all(log: Path, tmp_path: Path) -> None:
    part = ["--from", "0.2", "--to", "0.31", "--fps", "10"]
    assert main(["view", str(log), "--render", str(tmp_path / "frames"), *part]) == 0
    assert sorted(path.name for path in (tmp_path / "frames").iterdir()) == [f"frame-{k:05d}.png" for k in (1, 2)]
    assert main(["view", str(log), "--render", str(tmp_path / "a.gif"), *part]) == 0
    with Image.open(tmp_path / "a.gif") as gif:
        assert getattr(gif, "n_frames", 1) == 2
        assert gif.info["duration"] == 100


def refused(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    assert main(["view", *arguments]) == 2
    error = capsys.readouterr().err
    assert "Traceback" not in error
    return error


def test_without_a_display_the_way_without_a_window_is_named(
    log: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.setattr(sys, "platform", "linux")
    assert "--render FILE.png" in refused(capsys, str(log))


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--render", "film.mp4"], "ffmpeg"),
        (["--speed", "0"], "--speed"),
        (["--fps", "0"], "--fps"),
        (["--render", "a.png", "--rerun"], "contradict"),
        (["--render", "x"], "at most 3 pictures"),
        (["--from", "9"], "it contains"),
        (["--rerun", "b.armlog"], "expected FILE.rrd"),
    ],
)
def test_a_bad_option_is_one_message(
    log: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path, options: list[str], said: str
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(view, "FRAMES_MOST", 3)
    assert said in refused(capsys, str(log), *options)


def test_an_arm_that_is_not_known_or_another_one_is_one_message(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = write_recording(tmp_path / "a.armlog", 9, 2, arm="nobody's")
    assert "give it with --arm" in refused(capsys, str(log))
    assert "2 joints, but arm right has 3" in refused(capsys, str(log), "--arm", "right")
    empty = write_recording(tmp_path / "b.armlog", 0)
    assert "empty recording" in refused(capsys, str(empty))


def test_live_without_a_runtime_says_how_to_start_one(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "armwright serve" in refused(capsys, "--socket", str(tmp_path / "none.sock"))
    assert "need a LOG" in refused(capsys, "--from", "1")


@pytest.mark.usefixtures("no_gl")
def test_a_live_arm_is_one_picture(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    client = SimpleNamespace(status=statuses().__next__, close=lambda: None)
    monkeypatch.setattr(view, "connected", lambda given: client)
    assert main(["view", "--render", str(tmp_path / "now.png")]) == 0
    assert (tmp_path / "now.png").stat().st_size > 1000
    capsys.readouterr()
    assert "FILE.png" in refused(capsys, "--render", str(tmp_path / "now.gif"))


class Rerun:
    """rerun-sdk's calls, written down; its archetypes are their names and arguments."""

    def __init__(self) -> None:
        self.calls: list[tuple[str, tuple[Any, ...], dict[str, Any]]] = []
        self.ViewCoordinates = SimpleNamespace(RIGHT_HAND_Z_UP="z up")

    def __getattr__(self, name: str) -> Any:
        def call(*values: Any, **more: Any) -> Any:
            self.calls.append((name, values, more))
            return name, values

        return call


def test_rerun_gets_every_moment_with_its_time(
    log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    rerun = Rerun()
    monkeypatch.setitem(sys.modules, "rerun", rerun)  # type: ignore[arg-type]
    file = tmp_path / "a.rrd"
    assert main(["view", str(log), "--rerun", str(file)]) == 0
    assert "50 samples" in capsys.readouterr().out
    assert [call[:2] for call in rerun.calls if call[0] == "save"] == [("save", (file,))]
    times = [more["duration"] for name, _, more in rerun.calls if name == "set_time"]
    np.testing.assert_allclose(times, np.arange(50) * 0.02, atol=0.0021)
    logged = {values[0] for name, values, _ in rerun.calls if name == "log"}
    assert {"joint1/q_rad", "joint3/following_error_rad", "joint2/current_A", "arm/measured", "arm/commanded"} <= logged
    assert "arm/camera" in logged
    assert next(more for name, _, more in rerun.calls if name == "init") == {"spawn": False}


def test_without_rerun_its_installation_is_named(
    log: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    assert "pip install -e '.[rerun]'" in refused(capsys, str(log), "--rerun")


def test_opengl_is_asked_for_without_a_display_and_the_users_choice_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "platform", "linux")
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "MUJOCO_GL"):
        monkeypatch.delenv(name, raising=False)
    render.prefer_headless_gl()
    assert render.os.environ["MUJOCO_GL"] == "egl"
    monkeypatch.setenv("MUJOCO_GL", "osmesa")
    render.prefer_headless_gl()
    assert render.os.environ["MUJOCO_GL"] == "osmesa"


def test_images_need_a_free_place(tmp_path: Path) -> None:
    (tmp_path / "x").write_text("")
    with pytest.raises(ArmError, match="never overwritten"):
        render.write_images(tmp_path, iter(()), 0.1)
