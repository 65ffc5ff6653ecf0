"""`armwright camera`: a target to print, the lens of a camera, and the target's pose in pictures of the arm."""

import argparse
import re
import sys
from pathlib import Path

from calib.errors import VisionError
from calib.points.points import read_points
from calib.points.writer import write_points
from calib.results import input_file, made_today
from calib.vision import targets
from calib.vision.advice import advice, lens_text
from calib.vision.advice import poses_text as described
from calib.vision.intrinsics import CORNERS_LEAST as CORNERS_OF_A_LENS
from calib.vision.intrinsics import fit_lens, read_camera, write_camera
from calib.vision.poses import CORNERS_LEAST, CameraPictures, measure_poses, poses_text, with_pictures
from console.commands.calibration.options import quantity
from console.commands.progress import Bar, answer, warn
from control.files import write_whole
from procedures.folders import require_new


def run(args: argparse.Namespace) -> int:
    """Read the options, then do what is asked for."""
    out = Path(args.out)
    return {"board": _board, "calibrate": _calibrate, "poses": _poses}[args.what](args, out)


def _board(args: argparse.Namespace, out: Path) -> int:
    """Write the target to print."""
    target = _target(args)
    if not isinstance(target, targets.Charuco) and len(target.corners_m) > 1:
        raise VisionError("--tags: print each tag by itself, with --tag and --size")
    require_new(out, ["board.pdf"])
    sheet = targets.write_print(out / "board.pdf", target)
    width, height = (1e3 * size for size in target.print_m)
    sys.stdout.write(
        f"written: {sheet}\nPrint it at 100 % (no fitting to the page), glue it on something flat and stiff, and measure it: the"
        f" pattern should be {width:.1f} x {height:.1f} mm. Give the measured --square or --size to the other commands: the arm's"
        " lengths come from it.\n"
    )
    return 0


def _calibrate(args: argparse.Namespace, out: Path) -> int:
    """Identify the lens, write camera.json, say what the pictures lack."""
    board = _target(args)
    if not isinstance(board, targets.Charuco):
        raise VisionError("camera calibrate: expected a ChArUco board: --board 5x7 --square 30mm")
    if args.camera or args.points:
        raise VisionError("camera calibrate: --camera and --points are for `armwright camera poses`")
    (folder,) = _folders(args, 1)
    require_new(out, ["camera.json"])
    files = targets.picture_files(folder)
    with Bar("camera") as bar:
        pictures = targets.look_for(board, files, CORNERS_OF_A_LENS, bar.advance)
        bar.advance("fitting the lens", 0.9)
        fit = fit_lens(board, pictures, _positive(args.readout_s, "--readout-s"))
    path = out / "camera.json"
    made = made_today(*(input_file(file, "a picture of the board") for file in files))
    write_camera(path, fit, board.name, advice(fit), made)
    answer(args, path, f"{lens_text(fit)}\nwritten: {path}")
    return 0


def _poses(args: argparse.Namespace, out: Path) -> int:
    """Measure the target in every picture; write markers.csv, and points.csv if the joint angles are given."""
    target, lenses = _target(args), [(Path(name), read_camera(Path(name))) for name in args.camera or []]
    if not lenses:
        raise VisionError("camera poses: expected --camera camera.json, as `armwright camera calibrate` writes it")
    folders = _folders(args, len(lenses))
    points = None if args.points is None else read_points(Path(args.points))[0]
    require_new(out, ["markers.csv", "points.csv"])
    with Bar("camera") as bar:
        cameras = [
            CameraPictures(
                _name(path, folder), lens, targets.look_for(target, targets.picture_files(folder), CORNERS_LEAST, bar.advance)
            )
            for (path, lens), folder in zip(lenses, folders, strict=True)
        ]
        bar.advance("fitting poses", 0.9)
        poses = measure_poses(target, cameras, _positive(args.tip_speed, "--tip-speed"))
    if points is not None:
        measured, notes = with_pictures(points, poses.measured)
        warn(notes)
        write_points(out / "points.csv", measured)
    write_whole(out / "markers.csv", poses_text(poses.measured))
    written = [out / name for name in ("markers.csv", *(["points.csv"] if points is not None else []))]
    content = {
        "format": "camera-poses/1",
        "measured": [one.name for one in poses.measured],
        "rejected": {one.name: one.reason for one in poses.rejected},
        "noise_px": poses.noise_px,
        "files": [str(path) for path in written],
    }
    answer(args, content, described(poses) + "".join(f"written: {path}\n" for path in written))
    return 0


def _target(args: argparse.Namespace) -> targets.Charuco | targets.Tags:
    """The target of the options. VisionError unless exactly one is given."""
    kinds = [name for name in ("board", "tag", "tags") if getattr(args, name) is not None]
    if len(kinds) != 1:
        raise VisionError(
            "expected one target: --board 5x7 --square 30mm (ChArUco), --tag 7 --size 50mm, or --tags tags.csv; got"
            f" {' and '.join(f'--{kind}' for kind in kinds) or 'none'}"
        )
    if args.board is not None:
        return _charuco(args)
    if args.square is not None or args.marker is not None or args.legacy:
        raise VisionError("--square, --marker and --legacy belong to --board")
    dictionary = args.dictionary or targets.TAG_DICTIONARY
    if args.tags is not None:
        return targets.read_tags(Path(args.tags), dictionary)
    if args.size is None:
        raise VisionError("--tag: give the edge of its black square with --size, e.g. --size 50mm")
    return targets.Tags.single(args.tag, quantity(args.size, "m", "--size"), dictionary)


def _charuco(args: argparse.Namespace) -> targets.Charuco:
    match = re.fullmatch(r"(\d{1,3})x(\d{1,3})", args.board)
    if match is None:
        raise VisionError(f'--board: expected columns x rows of squares, such as 5x7, got "{args.board}"')
    if args.square is None:
        raise VisionError("--board: give the edge of a square as measured on the print with --square, e.g. --square 30mm")
    square_m = quantity(args.square, "m", "--square")
    marker_m = quantity(args.marker, "m", "--marker") if args.marker is not None else targets.MARKER_SHARE * square_m
    columns, rows = int(match[1]), int(match[2])
    return targets.Charuco(columns, rows, square_m, marker_m, args.dictionary or targets.BOARD_DICTIONARY, args.legacy)


def _folders(args: argparse.Namespace, count: int) -> list[Path]:
    """The folders of --images, one for each camera."""
    folders = [Path(name) for name in args.images or []]
    if len(folders) != count:
        raise VisionError(f"--images: expected {count} folder(s), one for each camera, got {len(folders)}")
    return folders


def _name(camera: Path, folder: Path) -> str:
    """Of a camera in messages: its pictures' folder, since files are often all called camera.json."""
    return str(folder) if camera.stem == "camera" else camera.stem


def _positive(value: float | None, name: str) -> float:
    if value is not None and value < 0.0:
        raise VisionError(f"{name}: expected a number from 0 on, got {value:g}")
    return value or 0.0
