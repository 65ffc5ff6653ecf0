"""`armwright import-points`: points.csv of a table that another program wrote; asks what the table does not tell.
`armwright import-capture`: a recording of a motion capture system as points, on the time of the encoders.
`armwright register`: locates the calibration board from markers measured by a camera.
"""

import argparse
import sys
from pathlib import Path

import numpy as np

from calib.arrays import Array, norms
from calib.boards import Registration, markers_text, read_markers, register_boards, write_boards
from calib.capture.alignment import Alignment, JointMotion, align
from calib.capture.poses import Rested, believed, board_markers, poses_at_rest
from calib.capture.tracks import BodyTrack, Capture, CaptureError, placed_m, read_c3d, read_vicon_csv, relative
from calib.gap.log import Log, read_log
from calib.points.points import CAMERA_FRAME, STREAM_FRAME
from calib.points.spreadsheet import ANGLES, LENGTHS, Unclear, Understood, read_sheet, understood
from calib.points.writer import write_points
from calib.results import entries, input_file, made_today
from console.commands.progress import answer, say, to_type, warn
from control.errors import ArmError
from control.files import write_whole
from control.model.arm import Arm
from control.model.description import load_arm
from control.model.table import board_cavities, table_of
from procedures.folders import require_new
from procedures.gap_recording import log_text
from procedures.gap_timing import on_one_clock, with_tips

SHOWN = 3


def run_import_points(args: argparse.Namespace) -> int:
    """Read, show what was understood, write; with a line that repeats it without questions."""
    file = Path(args.out) / "points.csv"
    if Path(args.out).suffix == ".csv":
        raise ArmError(f"--out {args.out}: expected a folder, in which points.csv is written")
    require_new(Path(args.out), ["points.csv"])
    columns = dict(pair.partition("=")[::2] for pair in args.columns or [])
    imported = _asked(args, columns)
    write_points(file, imported.points)
    named = [f"{ours}={name}" for ours, name in columns.items()]
    line = ["import-points", args.file, "--arm", args.arm, "--out", args.out]
    line += [*(["--columns", *named] if named else []), *(["--angles", args.angles] if args.angles else [])]
    line += ["--lengths", args.lengths] if args.lengths else []
    rows = file.read_text(encoding="utf-8").splitlines()[: SHOWN + 1]
    say("\n".join([*imported.in_words, "", *rows, "...", f"written: {file}", f"Again:\n  {to_type(*line)}"]))
    return 0


def _asked(args: argparse.Namespace, columns: dict[str, str]) -> Understood:
    """What the table says, with the answers to what it does not."""
    arm, sheet = load_arm(args.arm), read_sheet(Path(args.file))
    for option, units in (("angles", ANGLES), ("lengths", LENGTHS)):
        if getattr(args, option) not in (None, *units):
            raise ArmError(f"--{option}: expected one of {', '.join(units)}, got {getattr(args, option)}")
    while True:
        try:
            return understood(sheet, arm, columns, args.angles, args.lengths)
        except Unclear as unclear:
            if not sys.stdin.isatty():
                raise
            try:
                answer = input(f"{unclear.question}? ({', '.join(unclear.choices)}) ").strip()
            except EOFError:
                raise unclear from None
            if answer not in unclear.choices:
                continue
            if unclear.option == "--columns":
                columns[unclear.key.rstrip("=")] = answer
            else:
                setattr(args, unclear.option.removeprefix("--"), answer)


def run_import_capture(args: argparse.Namespace) -> int:
    """Write points of the arm's rests, or markers of the board."""
    arm, out = load_arm(args.arm), Path(args.out)
    files = [out / name for name in (("markers.csv",) if args.board_markers else ("points.csv", "log.csv"))]
    require_new(out, [file.name for file in files])
    return (_markers if args.board_markers else _points)(args, arm, files[0])


def _markers(args: argparse.Namespace, arm: Arm, file: Path) -> int:
    """Markers in the board's cavities, in the base frame."""
    if args.log or args.body or args.run or args.json:
        raise CaptureError("--board-markers: the arm need not move: leave --log, --body, --run and --json out")
    markers = board_markers(arm, _read(Path(args.file)), args.board_markers, args.base_body or "")
    write_whole(file, markers_text(markers))
    say(f"{len(markers)} markers of setup {args.board_markers}, in the base frame\nwritten: {file}")
    return 0


def _points(args: argparse.Namespace, arm: Arm, file: Path) -> int:
    """Read both recordings, align them, write a point for each rest."""
    if not args.log or not args.body:
        raise CaptureError("expected --log, the arm's log.csv, and --body, what is followed; or --board-markers")
    log, _ = read_log(Path(args.log), arm.joint_count)
    JointMotion.of(log, args.run)  # refuses what has no common clock
    log, of_clock = on_one_clock(arm, log, args.run)
    motion, of_log = JointMotion.of(log, args.run)
    capture = _read(Path(args.file))
    body, notes = _followed(capture, args.body, args.base_body)
    aligned = align(arm, motion, capture.t_s, body)
    rested = poses_at_rest(motion, capture.t_s, body, aligned, _frame(arm, args))
    notes = (*capture.notes, *of_log, *notes, *rested.left_out)
    warn(notes)
    write_points(file, rested.points)
    written, about_log = _log_written(arm, args, log, motion, aligned.log_time(capture.t_s), body)
    about = "".join(f"{sentence.rstrip('.')}.\n" for sentence in of_clock)
    content = {
        "format": "import-capture/1",
        **entries(aligned, "offset_s", "offset_sd_s", "rate", "rate_sd", "correlation"),
        "poses": len(rested.points),
        "noise_m": rested.noise_m,
        "said": (*of_clock, *notes),
        "file": str(file),
        "log": str(written) if written is not None else None,
    }
    answer(args, content, f"{about}{_text(aligned, rested, body)}written: {file}\n{about_log}")
    return 0


def _log_written(
    arm: Arm, args: argparse.Namespace, log: Log, motion: JointMotion, seen_s: Array, body: BodyTrack
) -> tuple[Path | None, str]:
    """Write log.csv with the measured tips, if the stream's frame is placed; the file and a sentence."""
    stream = arm.camera.stream if arm.camera is not None else None
    if stream is None or not stream.is_placed or _frame(arm, args) != STREAM_FRAME:
        return None, (
            "log.csv with tips: not yet, they are in the base frame; calibrate with these points, and import again with the"
            " calibrated arm.toml, whose [camera.stream] has these bodies and their origin_m"
        )
    with_seen = with_tips(arm, log, motion, seen_s, placed_m(stream, body.position_m))
    file = Path(args.out) / "log.csv"
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
    bodies, said = believed(capture, {**{k: v for k, v in capture.bodies.items() if k not in wanted}, **wanted})
    return (bodies[name] if base is None else relative(bodies[name], bodies[base])), said


def _frame(arm: Arm, args: argparse.Namespace) -> str:
    """That of the arm's [camera.stream] if the same bodies were followed: a calibration then places it."""
    stream = arm.camera.stream if arm.camera is not None else None
    is_stream = stream is not None and (stream.body, stream.base_body) == (args.body, args.base_body or "")
    return STREAM_FRAME if is_stream else CAMERA_FRAME


def _text(aligned: Alignment, rested: Rested, body: BodyTrack) -> str:
    turn = f", {1e3 * rested.noise_rad:.2f} mrad" if body.rotation is not None else ""
    words = aligned.in_words()
    return (
        f"{words[0].upper()}{words[1:]}.\n"
        f"{len(rested.points)} poses at rest; noise of a frame {1e3 * rested.noise_m:.3f} mm per axis{turn}.\n"
    )


def run_register(args: argparse.Namespace) -> int:
    """Register every setup of the file, print residuals, write boards.json."""
    arm = load_arm(args.arm)
    cavities = board_cavities(table_of(arm))
    file = Path(args.markers)
    markers = read_markers(file)
    warn(markers.warnings)
    boards = register_boards(markers, cavities)
    if not args.json:
        sys.stdout.write("".join(described(setup, board) for setup, board in boards.items()))
    out = Path(args.out) / "boards.json"
    write_boards(out, arm.name, boards, made_today(input_file(file, "markers")))
    sys.stdout.write(out.read_text(encoding="utf-8") if args.json else f"written: {out}\n")
    return 0


def described(setup: str, board: Registration) -> str:
    """Pose, residual of every marker, and what cannot be determined, in mm and mrad."""
    x, y, z = (f"{1e3 * value:.2f}" for value in board.origin_m)
    nx, ny, nz = (f"{value:.4f}" for value in board.normal)
    sd = board.sd
    lines = [
        f"setup {setup}: {len(board.names)} markers, noise {1e3 * board.noise_m:.3f} mm per axis",
        f"  origin ({x}, {y}, {z}) mm, sd {' '.join(f'{1e3 * value:.3f}' for value in sd[:3])} mm",
        f"  normal ({nx}, {ny}, {nz}), sd of the tilt {' '.join(f'{1e3 * value:.3f}' for value in sd[3:])} mrad",
        "  marker    dx      dy      dz    total  (measured minus board, mm)",
    ]
    for name, residual, total in zip(board.names, board.residual_m, norms(board.residual_m), strict=True):
        mark = "  outlier, not used" if name in board.outliers else ""
        parts = " ".join(f"{1e3 * value:7.3f}" for value in (*residual, total))
        lines.append(f"  {name:<6} {parts}{mark}")
    lines += [f"  note: {note}" for note in board.notes]
    return "\n".join(lines) + "\n"
