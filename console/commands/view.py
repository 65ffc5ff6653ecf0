"""`armwright view [LOG]`: shows a recording or the live arm in MuJoCo's viewer, as pictures, in Rerun or Foxglove."""

import argparse
import contextlib
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

from console.commands.connection import connected, connected_arms
from console.commands.progress import Bar, say
from console.commands.recordings import whole_series
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


def run(args: argparse.Namespace) -> int:
    """Show the recording LOG, or else the live arm."""
    if not 0.0 < args.speed < 1e3:
        raise ArmError(f"--speed: expected a factor above 0 and below 1000, got {args.speed:g}")
    if not 0.0 < args.fps <= 100.0:
        raise ArmError(f"--fps: expected above 0 and at most 100 frames per second, got {args.fps:g}")
    if args.rerun:
        _file(args.rerun)
    if sum(one is not None for one in (args.render, args.rerun, args.foxglove)) > 1:
        raise ArmError("--render, --rerun and --foxglove contradict each other: give one")
    if args.foxglove is not None and (args.log is not None or args.cell is not None):
        raise ArmError(
            "--foxglove: shows one live arm; not together with a LOG or --cell. For a recording, open the log.mcap of"
            " `armwright export`"
        )
    if args.foxglove:
        from console.visualisation.streams import address_of

        address_of(args.foxglove)
    if args.cell is not None:
        return _cell(args)
    return _live(args) if args.log is None else _recorded(args)


def _cell(args: argparse.Namespace) -> int:
    """All arms of a cell, live; or their present poses as a picture."""
    if args.log is not None or args.arm is not None or args.socket is not None or args.rerun is not None:
        raise ArmError("--cell: shows the live arms; not together with a LOG, --arm, --socket or --rerun")
    cell = load_cell(args.cell)
    with connected_arms(args, cell.names) as clients:
        source = CellSource(list(clients.values()))
        if args.render:
            snapshot = snapshot_of(source.status())
            return _picture(args, cell, snapshot, TipPath(tips_in(cell)).add(snapshot))
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
        say(f"the runtime has ended ({gone})")


def _recorded(args: argparse.Namespace) -> int:
    whole = whole_series(args)
    shown = whole.arm or whole.cell
    if shown is None:
        raise ArmError(f"{args.log}: its arm is unknown: give it with --arm")
    series = chosen(whole, args.run, args.from_s, args.to_s)
    if args.render:
        return _render(args, shown, series)
    if args.rerun is not None:
        if isinstance(shown, Cell):
            raise ArmError("--rerun: shows one arm: give the recording of one, in the cell's folder")
        from console.visualisation.streams import stream

        rows, _ = recorded(series, RERUN_PERIOD_s)
        count = stream(shown, (snapshot_at(series, int(row)) for row in rows), _file(args.rerun))
        say(f"{count} samples sent to Rerun")
        return 0
    _play(args, shown, series)
    return 0


def _play(args: argparse.Namespace, shown: Arm | Cell, series: Series) -> None:
    from console.visualisation.scene import scene_of
    from console.visualisation.window import Player, open_window, play

    rows = _rows(series, 1.0 / 60.0)
    scene = scene_of(shown)
    say("solid: commanded; ghost: measured. Space: pause. Left, right: one second. Up, down: speed. Home: restart")
    player = Player(rows, series.t_s[rows].tolist(), args.speed)
    play(scene, series, player, MonotonicClock(), open_window)


def _rows(series: Series, period_s: float) -> Sequence[int]:
    rows, _ = recorded(series, period_s)
    if not len(rows):
        raise ArmError(f"{series.name}: no sample has all joint angles")
    return [int(row) for row in rows]


def _render(args: argparse.Namespace, shown: Arm | Cell, series: Series) -> int:
    """Render the last sample, or a picture every `--speed`/`--fps` seconds of the recording."""
    out = _picture_path(args.render)
    rows = _rows(series, args.speed / args.fps)
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
        files = write_images(out, _with_progress(images, len(rows), bar), 1.0 / args.fps)
    say(f"written: {out} ({len(files)} file{'s' * (len(files) != 1)}, {len(rows)} samples)")
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


def _live(args: argparse.Namespace) -> int:
    for name in ("run", "from_s", "to_s"):
        if getattr(args, name) is not None:
            raise ArmError("--run, --from and --to need a LOG")
    args.arm = args.arm or "right"
    arm, client = load_arm(args.arm), connected(args)
    if args.render:
        return _snapshot(args, arm, snapshot_of(client.status()))
    if args.foxglove is not None:
        return _serve(args, arm, client)
    snapshots = live(client, MonotonicClock(), LIVE_PERIOD_s)
    with contextlib.closing(client), _until_the_runtime_ends():
        if args.rerun is not None:
            from console.visualisation.streams import stream

            stream(arm, snapshots, _file(args.rerun))
        else:
            from console.visualisation.scene import ArmScene
            from console.visualisation.window import follow, open_window

            follow(ArmScene(arm), snapshots, open_window)
    return 0


def _serve(args: argparse.Namespace, arm: Arm, client: ArmClient) -> int:
    """Serve the live arm to Foxglove until Ctrl-C, or until the runtime ends."""
    from console.visualisation.streams import address_of, serve

    statuses = live_statuses(client, MonotonicClock(), LIVE_PERIOD_s)
    with contextlib.closing(client), _until_the_runtime_ends(), contextlib.suppress(KeyboardInterrupt):
        serve(arm, statuses, address_of(args.foxglove), _announce)
    return 0


def _announce(url: str) -> None:
    say(f"In Foxglove: Open connection, Foxglove WebSocket, {url}; Ctrl-C ends it")
    sys.stdout.flush()


def _snapshot(args: argparse.Namespace, arm: Arm, snapshot: Snapshot) -> int:
    """Render the present pose as one picture."""
    return _picture(args, arm, snapshot, TipPath(tips_in(arm)).add(snapshot))


def _picture(args: argparse.Namespace, shown: Arm | Cell, snapshot: Snapshot, traces: Traces) -> int:
    out = _picture_path(args.render)
    if out.suffix != ".png":
        raise ArmError("--render without a LOG draws the present pose: give a FILE.png")
    image = painter_of(shown, _warn, is_still=True)(snapshot, traces)
    write_images(out, iter([(snapshot.t_s, image)]), 1.0)
    say(f"written: {out}")
    return 0


def _file(text: str) -> Path | None:
    """The file of `--rerun FILE.rrd`, None for a viewer; a LOG after --rerun is not an output file."""
    if text and Path(text).suffix != ".rrd":
        raise ArmError(f"--rerun: expected FILE.rrd, got {text}; put a LOG before it: armwright view LOG --rerun")
    return Path(text) if text else None


def _warn(text: str) -> None:
    sys.stderr.write(f"armwright: warning: {text}\n")
