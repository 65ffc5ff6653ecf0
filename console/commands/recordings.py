"""`armwright export`: a recording as log.csv.gz and MCAP, that of a cell as one of each, or several as a LeRobot dataset.
`armwright plot LOG`: figures of a recording in a window or as files, and their key figures.
"""

import argparse
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from console.commands.progress import Bar, answer, warn
from console.lerobot_dataset import Episode, episodes_of, write_dataset
from console.visualisation.metrics import Metrics, metrics_json, metrics_of, metrics_text
from console.visualisation.pictures import FORMS, PICTURES, Picture, show, write_each, write_sheet
from console.visualisation.reading import read_log, read_series
from console.visualisation.series import Series, chosen
from control.errors import ArmError
from control.files import make_whole
from control.model.arm import Arm
from control.model.description import load_arm
from control.recording.cell_folder import FILE_NAME, join, recorded_cell, recordings_in
from control.recording.export import cell_to_mcap, export
from control.recording.reading import Recording, recorded_arm
from procedures.folders import free_folder, require_writable

MCAP_NAME = "cell.mcap"
DATASET_RATE_Hz = 50  # usual for imitation learning; a recording has 500


def run_export(args: argparse.Namespace) -> int:
    """Export and print what was written."""
    if args.lerobot:
        return _dataset(args)
    if args.fps is not None or args.task is not None:
        raise ArmError("--fps and --task are of a dataset: give --lerobot too")
    if len(args.recording) > 1:
        raise ArmError(f"expected one recording, got {len(args.recording)}: several make a dataset with --lerobot")
    recording, out = _existing(args.recording[0]), Path(args.out)
    written = _joined(recording, out, args) if recording.is_dir() else _exported(args, recording, out)
    for name in (name for name, rows in written.items() if not rows):
        sys.stderr.write(
            f"armwright: warning: {name} is empty: it begins with the first motion, and nothing moved in this recording\n"
        )
    files = {name: {"file": str(out / name), "cycles": rows} for name, rows in written.items()}
    text = "".join(f"{out / name}: {rows} cycles\n" for name, rows in written.items())
    if not recording.is_dir() and len(set(written.values())) > 1:
        text += "log.csv.gz holds the motions alone, log.mcap what came before the first one, too"
    answer(args, files, text)
    return 0


def _dataset(args: argparse.Namespace) -> int:
    """A LeRobot dataset of all recordings, an episode a run."""
    rate_Hz, out = DATASET_RATE_Hz if args.fps is None else args.fps, Path(args.out)
    if args.every != 1:
        raise ArmError("--lerobot: not together with --every; --fps sets the rate")
    if rate_Hz < 1:
        raise ArmError(f"--fps: expected 1 or more samples per second, got {rate_Hz}")
    if not (args.task or "").strip():
        raise ArmError("--lerobot: say in words what the arm does, which policies may read: --task 'draw a square'")
    recordings = [_existing(one) for one in args.recording]
    arm = load_arm(args.arm) if args.arm else None
    episodes, frames = write_dataset(_episodes(recordings, arm, rate_Hz), rate_Hz, args.task, out)
    made = {"folder": str(out), "episodes": episodes, "frames": frames, "fps": rate_Hz}
    answer(args, made, f"{out}: {episodes} episodes, {frames} frames at {rate_Hz} Hz")
    return 0


def _episodes(recordings: Sequence[Path], arm: Arm | None, rate_Hz: int) -> Iterator[Episode]:
    with Bar("read") as bar:
        for number, recording in enumerate(recordings):
            series = read_series(recording, arm)
            warn(series.notes)
            yield from episodes_of(series, rate_Hz)
            bar.advance("read", (number + 1) / len(recordings))


def _existing(text: str) -> Path:
    recording = Path(text)
    if not recording.exists():
        raise ArmError(f"{recording}: no such recording; `armwright serve` writes them to its --log folder")
    return recording


def _joined(folder: Path, out: Path, args: argparse.Namespace) -> dict[str, int]:
    """All arms of a cell in one table and one MCAP file."""
    recordings, files = recordings_in(folder), (out / FILE_NAME, out / MCAP_NAME)
    if args.arm:
        raise ArmError("--arm: not for a cell's folder, which has every arm's description")
    if args.every < 1:
        raise ArmError(f"--every: expected a cycle count of 1 or more, got {args.every}")
    for file in files:
        if file.exists():
            raise ArmError(f"{file} already exists: choose another folder or remove it first")
    cell = recorded_cell(recordings)
    out.mkdir(parents=True, exist_ok=True)
    total = max(1, min(one.row_count for one in recordings))
    with Bar("export") as bar:

        def half(begun: float) -> Callable[[int], None]:
            return lambda row: bar.advance("export", begun + 0.5 * min(row / total, 1.0))

        rows = make_whole(files[0], lambda part: join(recordings, part, args.every, half(0.0)))
        cycles = make_whole(files[1], lambda part: cell_to_mcap(recordings, part, cell, args.every, half(0.5)))
    return {FILE_NAME: rows, MCAP_NAME: cycles}


def _exported(args: argparse.Namespace, recording: Path, out: Path) -> dict[str, int]:
    arm = load_arm(args.arm) if args.arm else recorded_arm(Recording.open(recording))
    if arm is None:
        sys.stderr.write(
            "armwright: warning: the arm of this recording is unknown, so log.mcap has no 3-D view: give it with --arm\n"
        )
    with Bar("export") as bar:
        return export(recording, out, args.every, arm, lambda done: bar.advance("export", done))


USUAL_OUT = Path("out/plot")


def run_plot(args: argparse.Namespace) -> int:
    """Read, select, draw, print."""
    out = None if args.window or (args.json and not args.out) else _place(args.out)
    series, joints = _series(args)
    pictures = _pictures(args.what, series)
    files: list[Path] = []
    if args.window:
        show(pictures, series, joints)
    elif out is not None:
        files = _written(out, pictures, series, joints)
    _say(args, series, metrics_of(series), joints, files)
    return 0


def _place(out: str | None) -> Path:
    """The folder or the file to write, which is tried before anything is read and drawn."""
    path = Path(out) if out else free_folder(USUAL_OUT)
    if path.suffix and path.suffix not in FORMS and not path.is_dir():
        raise ArmError(f"--out: expected a folder, or a file that ends in {', '.join(FORMS)}; got {out}")
    require_writable(path.parent if path.suffix in FORMS else path)
    return path


def whole_series(args: argparse.Namespace) -> Series:
    """All of the file."""
    arm = load_arm(args.arm) if args.arm else None
    with Bar("read") as bar:
        series = read_log(Path(args.log), arm, lambda done: bar.advance("read", done))
    warn(series.notes)
    if not len(series):
        raise ArmError(f"{args.log}: empty recording: a header without cycles")
    return series


def _series(args: argparse.Namespace) -> tuple[Series, Sequence[int]]:
    """The requested part of the file, and its joints (1-based)."""
    series = whole_series(args)
    joints = _joints(args.joints, series.joint_count)
    return chosen(series, args.run, args.from_s, args.to_s), joints


def _joints(text: str | None, count: int) -> Sequence[int]:
    """Joint numbers separated by commas, each once and in order."""
    if text is None:
        return range(1, count + 1)
    parts = [part.strip() for part in text.split(",") if part.strip()]
    wanted = sorted({int(part) for part in parts if part.isdigit()})
    if not wanted or not all(part.isdigit() for part in parts) or not 1 <= wanted[0] <= wanted[-1] <= count:
        raise ArmError(f'--joints: expected numbers from 1 to {count} separated by commas, got "{text}"')
    return wanted


def _pictures(text: str | None, series: Series) -> Sequence[Picture]:
    """The requested pictures; by default all that the recording has data for."""
    if text is None:
        return [picture for picture in PICTURES if picture.has(series)]
    by_name = {picture.name: picture for picture in PICTURES}
    names = [name.strip() for name in text.split(",") if name.strip()]
    wrong = next((name for name in names if name not in by_name), None if names else text)
    if wrong is not None:
        raise ArmError(f'--what: expected one or more of {", ".join(by_name)}, got "{wrong}"')
    for name in names:
        if not by_name[name].has(series):
            needs = " (the arm is unknown: give it with --arm)" if series.arm is None and series.cell is None else ""
            raise ArmError(f"--what {name}: {series.name} has no data for it{needs}")
    return [by_name[name] for name in dict.fromkeys(names)]


def _written(out: Path, pictures: Sequence[Picture], series: Series, joints: Sequence[int]) -> list[Path]:
    """Write files into a folder, or one file if `out` names one."""
    if out.suffix in FORMS:
        return write_sheet(out, pictures, series, joints)
    with Bar("draw") as bar:
        return write_each(out, pictures, series, joints, bar.advance)


def _say(args: argparse.Namespace, series: Series, merit: Metrics, joints: Sequence[int], files: Sequence[Path]) -> None:
    content = metrics_json(series, merit)
    content["joints"] = [joint for joint in content["joints"] if joint["joint"] in joints]
    written = [str(file) for file in files]
    text = metrics_text(series, merit) + "".join(f"written: {file}\n" for file in written)
    answer(args, {**content, "files": written}, text)
