"""`armwright import-capture`: a recording of a motion capture system as points, on the time of the encoders."""

import argparse
import sys
from pathlib import Path

import numpy as np

from calib.arrays import Array
from calib.boards import markers_text
from calib.capture.alignment import Alignment, JointMotion, align
from calib.capture.poses import Rested, believed, board_markers, poses_at_rest
from calib.capture.tracks import (
    BodyTrack,
    Capture,
    CaptureError,
    placed_m,
    read_c3d,
    read_vicon_csv,
    relative,
)
from calib.gap.log import Log, read_log
from calib.points.points import CAMERA_FRAME, STREAM_FRAME
from calib.points.writer import write_points
from calib.results import entries
from console.commands.progress import answer, warn
from control.files import write_whole
from control.model.arm import Arm
from control.model.description import load_arm
from procedures.folders import require_new
from procedures.gap.recording import log_text
from procedures.gap.timing import on_one_clock, with_tips


def run(given: argparse.Namespace) -> int:
    """Write points of the arm's rests, or markers of the board."""
    arm, out = load_arm(given.arm), Path(given.out)
    files = [out / name for name in (("markers.csv",) if given.board_markers else ("points.csv", "log.csv"))]
    require_new(out, [file.name for file in files])
    return (_markers if given.board_markers else _points)(given, arm, files[0])


def _markers(given: argparse.Namespace, arm: Arm, file: Path) -> int:
    """Markers in the board's cavities, in the base frame."""
    if given.log or given.body or given.run or given.json:
        raise CaptureError(
            "--board-markers: the arm need not move: leave --log, --body, --run and --json out"
        )
    found = board_markers(arm, _read(Path(given.file)), given.board_markers, given.base_body or "")
    write_whole(file, markers_text(found))
    sys.stdout.write(
        f"{len(found)} markers of setup {given.board_markers}, in the base frame\nwritten: {file}\n"
    )
    return 0


def _points(given: argparse.Namespace, arm: Arm, file: Path) -> int:
    """Read both recordings, align them, write a point for each rest."""
    if not given.log or not given.body:
        raise CaptureError(
            "expected --log, the arm's log.csv, and --body, what is followed; or --board-markers"
        )
    log, _ = read_log(Path(given.log), arm.joint_count)
    JointMotion.of(log, given.run)  # refuses what has no common clock
    log, of_clock = on_one_clock(arm, log, given.run)
    motion, of_log = JointMotion.of(log, given.run)
    capture = _read(Path(given.file))
    body, said = _followed(capture, given.body, given.base_body)
    aligned = align(arm, motion, capture.t_s, body)
    rested = poses_at_rest(motion, capture.t_s, body, aligned, _frame(arm, given))
    said = (*capture.notes, *of_log, *said, *rested.left_out)
    warn(said)
    write_points(file, rested.points)
    written, about_log = _log_written(arm, given, log, motion, aligned.log_time(capture.t_s), body)
    about = "".join(f"{sentence.rstrip('.')}.\n" for sentence in of_clock)
    content = {
        "format": "import-capture/1",
        **entries(aligned, "offset_s", "offset_sd_s", "rate", "rate_sd", "correlation"),
        "poses": len(rested.points),
        "noise_m": rested.noise_m,
        "said": (*of_clock, *said),
        "file": str(file),
        "log": str(written) if written is not None else None,
    }
    answer(given, content, f"{about}{_text(aligned, rested, body)}written: {file}\n{about_log}")
    return 0


def _log_written(
    arm: Arm, given: argparse.Namespace, log: Log, motion: JointMotion, seen_s: Array, body: BodyTrack
) -> tuple[Path | None, str]:
    """Write log.csv with the measured tips, if the stream's frame is placed; the file and a sentence."""
    stream = arm.camera.stream if arm.camera is not None else None
    if stream is None or not stream.is_placed or _frame(arm, given) != STREAM_FRAME:
        return None, (
            "log.csv with tips: not yet, they are in the base frame; calibrate with these points, and import again with the"
            " calibrated arm.toml, whose [camera.stream] has these bodies and their origin_m"
        )
    with_seen = with_tips(arm, log, motion, seen_s, placed_m(stream, body.position_m))
    file = Path(given.out) / "log.csv"
    write_whole(file, log_text(arm.joint_count, [(one.name, one, one.payload) for one in with_seen.runs]))
    tips = sum(int(np.isfinite(one.tip_m[:, 0]).sum()) for one in with_seen.runs)
    return file, f"written: {file}, with {tips} tips"


def _read(path: Path) -> Capture:
    ending = path.name.lower().removesuffix(".gz").rpartition(".")[2]
    readers = {"csv": read_vicon_csv, "c3d": read_c3d}
    if ending not in readers:
        raise CaptureError(f"{path}: expected a .csv that Vicon has exported, or a .c3d")
    return readers[ending](path)


def _followed(capture: Capture, name: str, base: str | None) -> tuple[BodyTrack, tuple[str, ...]]:
    """The body, relative to the one on the base if there is one; frames in which one of them had leapt are not used."""
    wanted = {one: capture.body(one) for one in (name, base) if one is not None}
    bodies, said = believed(
        capture, {**{k: v for k, v in capture.bodies.items() if k not in wanted}, **wanted}
    )
    return (bodies[name] if base is None else relative(bodies[name], bodies[base])), said


def _frame(arm: Arm, given: argparse.Namespace) -> str:
    """That of the arm's [camera.stream] if the same bodies were followed: a calibration then places it."""
    stream = arm.camera.stream if arm.camera is not None else None
    is_stream = stream is not None and (stream.body, stream.base_body) == (given.body, given.base_body or "")
    return STREAM_FRAME if is_stream else CAMERA_FRAME


def _text(aligned: Alignment, rested: Rested, body: BodyTrack) -> str:
    turn = f", {1e3 * rested.noise_rad:.2f} mrad" if body.rotation is not None else ""
    words = aligned.in_words()
    return (
        f"{words[0].upper()}{words[1:]}.\n"
        f"{len(rested.points)} poses at rest; noise of a frame {1e3 * rested.noise_m:.3f} mm per axis{turn}.\n"
    )
