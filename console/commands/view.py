"""`armwright view [LOG]`: shows a recording or the live arm in MuJoCo's viewer, as pictures, in Rerun or Foxglove."""

import argparse
import contextlib
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

from console.commands.connection import connected, connected_arms
from console.commands.progress import Bar, warn
from console.visualisation.reading import read_log
from console.visualisation.render import FRAMES_MOST, Image, frames, painter_of, write_images
from console.visualisation.series import Series, chosen
from console.visualisation.snapshots import (
    CellSource,
    Snapshot,
    TipPath,
    Traces,
    live,
    live_statuses,
    recorded,
    snapshot_at,
    snapshot_of,
    tips_in,
    traces_of,
)
from control.errors import ArmError
from control.model.arm import Arm
from control.model.cell import Cell, load_cell
from control.model.description import load_arm
from control.server.channel import RuntimeGone
from control.server.client import ArmClient
from firmware_iface.clock import MonotonicClock

LIVE_PERIOD_s = 1.0 / 30.0  # the loop serves at most one request per cycle; this is negligible
RERUN_PERIOD_s = 0.02


def run(given: argparse.Namespace) -> int:
    """Show the recording LOG, or else the live arm."""
    if not 0.0 < given.speed < 1e3:
        raise ArmError(f"--speed: expected a factor above 0 and below 1000, got {given.speed:g}")
    if not 0.0 < given.fps <= 100.0:
        raise ArmError(f"--fps: expected above 0 and at most 100 frames per second, got {given.fps:g}")
    if given.rerun:
        _file(given.rerun)
    if sum(one is not None for one in (given.render, given.rerun, given.foxglove)) > 1:
        raise ArmError("--render, --rerun and --foxglove contradict each other: give one")
    if given.foxglove is not None and (given.log is not None or given.cell is not None):
        raise ArmError(
            "--foxglove: shows one live arm; not together with a LOG or --cell. For a recording, open the log.mcap of"
            " `armwright export`"
        )
    if given.foxglove:
        from console.visualisation.streams import address_of

        address_of(given.foxglove)
    if given.cell is not None:
        return _cell(given)
    return _live(given) if given.log is None else _recorded(given)


def _cell(given: argparse.Namespace) -> int:
    """All arms of a cell, live; or their present poses as a picture."""
    if given.log is not None or given.arm is not None or given.socket is not None or given.rerun is not None:
        raise ArmError("--cell: shows the live arms; not together with a LOG, --arm, --socket or --rerun")
    cell = load_cell(given.cell)
    with connected_arms(given, cell.names) as clients:
        source = CellSource(list(clients.values()))
        if given.render:
            snapshot = snapshot_of(source.status())
            return _picture(given, cell, snapshot, TipPath(tips_in(cell)).add(snapshot))
        from console.visualisation.scene import CellScene
        from console.visualisation.window import follow, open_window

        with _until_the_runtime_ends():
            follow(CellScene(cell), live(source, MonotonicClock(), LIVE_PERIOD_s), open_window)
    return 0


@contextlib.contextmanager
def _until_the_runtime_ends() -> Iterator[None]:
    try:
        yield
    except RuntimeGone as gone:
        sys.stdout.write(f"the runtime has ended ({gone})\n")


def _recorded(given: argparse.Namespace) -> int:
    wanted = load_arm(given.arm) if given.arm else None
    with Bar("read") as bar:
        whole = read_log(Path(given.log), wanted, lambda done: bar.advance("read", done))
    warn(whole.notes)
    if not len(whole):
        raise ArmError(f"{given.log}: empty recording: a header without cycles")
    shown = whole.arm or whole.cell
    if shown is None:
        raise ArmError(f"{given.log}: its arm is unknown: give it with --arm")
    series = chosen(whole, given.run, given.from_s, given.to_s)
    if given.render:
        return _render(given, shown, series)
    if given.rerun is not None:
        if isinstance(shown, Cell):
            raise ArmError("--rerun: shows one arm: give the recording of one, in the cell's folder")
        from console.visualisation.streams import stream

        rows, _ = recorded(series, RERUN_PERIOD_s)
        count = stream(shown, (snapshot_at(series, int(row)) for row in rows), _file(given.rerun))
        sys.stdout.write(f"{count} samples sent to Rerun\n")
        return 0
    _play(given, shown, series)
    return 0


def _play(given: argparse.Namespace, shown: Arm | Cell, series: Series) -> None:
    from console.visualisation.scene import scene_of
    from console.visualisation.window import open_window, play

    rows = _rows(series, 1.0 / 60.0)
    scene = scene_of(shown)
    sys.stdout.write("solid: commanded; ghost: measured. Space: pause. Left, right: one second. Up, down: speed. Home: restart\n")
    play(scene, series, rows, traces_of(series, scene.tips), given.speed, MonotonicClock(), open_window)


def _rows(series: Series, period_s: float) -> Sequence[int]:
    rows, _ = recorded(series, period_s)
    if not len(rows):
        raise ArmError(f"{series.name}: no sample has all joint angles")
    return [int(row) for row in rows]


def _render(given: argparse.Namespace, shown: Arm | Cell, series: Series) -> int:
    """Render the last sample, or a picture every `--speed`/`--fps` seconds of the recording."""
    out = _picture_path(given.render)
    rows = _rows(series, given.speed / given.fps)
    if out.suffix == ".png":
        rows = rows[-1:]
    if len(rows) > FRAMES_MOST:
        raise ArmError(
            f"--render: expected at most {FRAMES_MOST} pictures, got {len(rows)}: choose a part with --run, --from"
            " and --to, or raise --speed"
        )
    paint = painter_of(shown, _warn, is_still=out.suffix == ".png")
    images = frames(series, rows, traces_of(series, tips_in(shown)), paint)
    with Bar("render") as bar:
        files = write_images(out, _with_progress(images, len(rows), bar), 1.0 / given.fps)
    sys.stdout.write(f"written: {out} ({len(files)} file{'s' * (len(files) != 1)}, {len(rows)} samples)\n")
    return 0


def _with_progress(images: Iterator[tuple[float, Image]], count: int, bar: Bar) -> Iterator[tuple[float, Image]]:
    for number, image in enumerate(images):
        bar.advance("render", number / count)
        yield image


def _picture_path(text: str) -> Path:
    path = Path(text)
    if path.suffix not in ("", ".png", ".gif"):
        raise ArmError(
            f"--render: expected FILE.png (the last sample), FILE.gif, or a folder for PNG files; got {text}. To make"
            " a video: ffmpeg -framerate 25 -i FOLDER/frame-%05d.png film.mp4"
        )
    return path


def _live(given: argparse.Namespace) -> int:
    for name in ("run", "from_s", "to_s"):
        if getattr(given, name) is not None:
            raise ArmError("--run, --from and --to need a LOG")
    given.arm = given.arm or "right"
    arm, client = load_arm(given.arm), connected(given)
    if given.render:
        return _snapshot(given, arm, snapshot_of(client.status()))
    if given.foxglove is not None:
        return _serve(given, arm, client)
    snapshots = live(client, MonotonicClock(), LIVE_PERIOD_s)
    with contextlib.closing(client), _until_the_runtime_ends():
        if given.rerun is not None:
            from console.visualisation.streams import stream

            stream(arm, snapshots, _file(given.rerun))
        else:
            from console.visualisation.scene import ArmScene
            from console.visualisation.window import follow, open_window

            follow(ArmScene(arm), snapshots, open_window)
    return 0


def _serve(given: argparse.Namespace, arm: Arm, client: ArmClient) -> int:
    """Serve the live arm to Foxglove until Ctrl-C, or until the runtime ends."""
    from console.visualisation.streams import address_of, serve

    statuses = live_statuses(client, MonotonicClock(), LIVE_PERIOD_s)
    with contextlib.closing(client), _until_the_runtime_ends(), contextlib.suppress(KeyboardInterrupt):
        serve(arm, statuses, address_of(given.foxglove), _announce)
    return 0


def _announce(url: str) -> None:
    sys.stdout.write(f"In Foxglove: Open connection, Foxglove WebSocket, {url}; Ctrl-C ends it\n")
    sys.stdout.flush()


def _snapshot(given: argparse.Namespace, arm: Arm, snapshot: Snapshot) -> int:
    """Render the present pose as one picture."""
    return _picture(given, arm, snapshot, TipPath(tips_in(arm)).add(snapshot))


def _picture(given: argparse.Namespace, shown: Arm | Cell, snapshot: Snapshot, traces: Traces) -> int:
    out = _picture_path(given.render)
    if out.suffix != ".png":
        raise ArmError("--render without a LOG draws the present pose: give a FILE.png")
    image = painter_of(shown, _warn, is_still=True)(snapshot, traces)
    write_images(out, iter([(snapshot.t_s, image)]), 1.0)
    sys.stdout.write(f"written: {out}\n")
    return 0


def _file(text: str) -> Path | None:
    """The file of `--rerun FILE.rrd`, None for a viewer; a LOG after --rerun is not an output file."""
    if text and Path(text).suffix != ".rrd":
        raise ArmError(f"--rerun: expected FILE.rrd, got {text}; put a LOG before it: armwright view LOG --rerun")
    return Path(text) if text else None


def _warn(text: str) -> None:
    sys.stderr.write(f"armwright: warning: {text}\n")
