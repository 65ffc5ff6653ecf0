"""`armwright plot LOG`: figures of a recording in a window or as files, and their key figures."""

import argparse
from collections.abc import Sequence
from pathlib import Path

from console.commands.progress import Bar, answer, warn
from console.visualisation.metrics import Metrics, metrics_json, metrics_of, metrics_text
from console.visualisation.pictures import FORMS, PICTURES, Picture, show, write_each, write_sheet
from console.visualisation.reading import read_log
from console.visualisation.series import Series, chosen
from control.errors import ArmError
from control.model.description import load_arm
from procedures.folders import free_folder, require_writable

USUAL_OUT = Path("out/plot")


def run(given: argparse.Namespace) -> int:
    """Read, select, draw, print."""
    out = None if given.window or (given.json and not given.out) else _place(given.out)
    series, joints = _series(given)
    pictures = _pictures(given.what, series)
    files: list[Path] = []
    if given.window:
        show(pictures, series, joints)
    elif out is not None:
        files = _written(out, pictures, series, joints)
    _say(given, series, metrics_of(series), joints, files)
    return 0


def _place(out: str | None) -> Path:
    """The folder or the file to write, which is tried before anything is read and drawn."""
    path = Path(out) if out else free_folder(USUAL_OUT)
    if path.suffix and path.suffix not in FORMS and not path.is_dir():
        raise ArmError(f"--out: expected a folder, or a file that ends in {', '.join(FORMS)}; got {out}")
    require_writable(path.parent if path.suffix in FORMS else path)
    return path


def _series(given: argparse.Namespace) -> tuple[Series, Sequence[int]]:
    """The requested part of the file, and its joints (1-based)."""
    arm = load_arm(given.arm) if given.arm else None
    with Bar("read") as bar:
        series = read_log(Path(given.log), arm, lambda done: bar.advance("read", done))
    warn(series.notes)
    if not len(series):
        raise ArmError(f"{given.log}: empty recording: a header without cycles")
    joints = _joints(given.joints, series.joint_count)
    return chosen(series, given.run, given.from_s, given.to_s), joints


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
    if not names or any(name not in by_name for name in names):
        raise ArmError(f'--what: expected one or more of {", ".join(by_name)}, got "{text}"')
    for name in names:
        if not by_name[name].has(series):
            needs = (
                " (the arm is unknown: give it with --arm)"
                if series.arm is None and series.cell is None
                else ""
            )
            raise ArmError(f"--what {name}: {series.name} has no data for it{needs}")
    return [by_name[name] for name in dict.fromkeys(names)]


def _written(out: Path, pictures: Sequence[Picture], series: Series, joints: Sequence[int]) -> list[Path]:
    """Write files into a folder, or one file if `out` names one."""
    if out.suffix in FORMS:
        return write_sheet(out, pictures, series, joints)
    with Bar("draw") as bar:
        return write_each(out, pictures, series, joints, bar.advance)


def _say(
    given: argparse.Namespace, series: Series, merit: Metrics, joints: Sequence[int], files: Sequence[Path]
) -> None:
    content = metrics_json(series, merit)
    content["joints"] = [joint for joint in content["joints"] if joint["joint"] in joints]
    written = [str(file) for file in files]
    text = metrics_text(series, merit) + "".join(f"written: {file}\n" for file in written)
    answer(given, {**content, "files": written}, text)
