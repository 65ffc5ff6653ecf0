"""`armwright export`: a recording as log.csv.gz and MCAP, that of a cell as one of each, or several as a LeRobot dataset."""

import argparse
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from console.commands.progress import Bar, answer, warn
from console.lerobot_dataset import Episode, episodes_of, write_dataset
from console.visualisation.reading import read_series
from control.errors import ArmError
from control.files import make_whole
from control.model.arm import Arm
from control.model.description import load_arm
from control.recording.cell_folder import FILE_NAME, join, recorded_cell, recordings_in
from control.recording.export import export
from control.recording.mcap_file import cell_to_mcap
from control.recording.reading import Recording, recorded_arm

MCAP_NAME = "cell.mcap"
DATASET_RATE_Hz = 50  # usual for imitation learning; a recording has 500


def run(given: argparse.Namespace) -> int:
    """Export and print what was written."""
    if given.lerobot:
        return _dataset(given)
    if given.fps is not None or given.task is not None:
        raise ArmError("--fps and --task are of a dataset: give --lerobot too")
    if len(given.recording) > 1:
        raise ArmError(
            f"expected one recording, got {len(given.recording)}: several make a dataset with --lerobot"
        )
    recording, out = _existing(given.recording[0]), Path(given.out)
    written = _joined(recording, out, given) if recording.is_dir() else _exported(given, recording, out)
    for name in (name for name, rows in written.items() if not rows):
        sys.stderr.write(
            f"armwright: warning: {name} is empty: it begins with the first motion, and nothing moved in this recording\n"
        )
    files = {name: {"file": str(out / name), "cycles": rows} for name, rows in written.items()}
    text = "".join(f"{out / name}: {rows} cycles\n" for name, rows in written.items())
    if not recording.is_dir() and len(set(written.values())) > 1:
        text += "log.csv.gz holds the motions alone, log.mcap what came before the first one, too"
    answer(given, files, text)
    return 0


def _dataset(given: argparse.Namespace) -> int:
    """A LeRobot dataset of all recordings, an episode a run."""
    rate_Hz, out = DATASET_RATE_Hz if given.fps is None else given.fps, Path(given.out)
    if given.every != 1:
        raise ArmError("--lerobot: not together with --every; --fps sets the rate")
    if rate_Hz < 1:
        raise ArmError(f"--fps: expected 1 or more samples per second, got {rate_Hz}")
    if not (given.task or "").strip():
        raise ArmError(
            "--lerobot: say in words what the arm does, which policies may read: --task 'draw a square'"
        )
    recordings = [_existing(one) for one in given.recording]
    arm = load_arm(given.arm) if given.arm else None
    episodes, frames = write_dataset(_episodes(recordings, arm, rate_Hz), rate_Hz, given.task, out)
    made = {"folder": str(out), "episodes": episodes, "frames": frames, "fps": rate_Hz}
    answer(given, made, f"{out}: {episodes} episodes, {frames} frames at {rate_Hz} Hz")
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


def _joined(folder: Path, out: Path, given: argparse.Namespace) -> dict[str, int]:
    """All arms of a cell in one table and one MCAP file."""
    recordings, files = recordings_in(folder), (out / FILE_NAME, out / MCAP_NAME)
    if given.arm:
        raise ArmError("--arm: not for a cell's folder, which has every arm's description")
    if given.every < 1:
        raise ArmError(f"--every: expected a cycle count of 1 or more, got {given.every}")
    for file in files:
        if file.exists():
            raise ArmError(f"{file} already exists: choose another folder or remove it first")
    cell = recorded_cell(recordings)
    out.mkdir(parents=True, exist_ok=True)
    total = max(1, min(one.row_count for one in recordings))
    with Bar("export") as bar:

        def half(begun: float) -> Callable[[int], None]:
            return lambda row: bar.advance("export", begun + 0.5 * min(row / total, 1.0))

        rows = make_whole(files[0], lambda part: join(recordings, part, given.every, half(0.0)))
        cycles = make_whole(
            files[1], lambda part: cell_to_mcap(recordings, part, cell, given.every, half(0.5))
        )
    return {FILE_NAME: rows, MCAP_NAME: cycles}


def _exported(given: argparse.Namespace, recording: Path, out: Path) -> dict[str, int]:
    arm = load_arm(given.arm) if given.arm else recorded_arm(Recording.open(recording))
    if arm is None:
        sys.stderr.write(
            "armwright: warning: the arm of this recording is unknown, so log.mcap has no 3-D view: give it with --arm\n"
        )
    with Bar("export") as bar:
        return export(recording, out, given.every, arm, lambda done: bar.advance("export", done))
