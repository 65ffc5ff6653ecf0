"""`armwright register`: locates the calibration board from markers measured by a camera."""

import argparse
import sys
from pathlib import Path

from calib.arrays import norms
from calib.boards import Registration, read_markers, register_boards, write_boards
from calib.results import input_file, made_today
from console.commands.progress import warn
from control.model.description import load_arm
from control.model.table import board_cavities, table_of


def run(given: argparse.Namespace) -> int:
    """Register every setup of the file, print residuals, write boards.json."""
    arm = load_arm(given.arm)
    cavities = board_cavities(table_of(arm))
    file = Path(given.markers)
    markers = read_markers(file)
    warn(markers.warnings)
    found = register_boards(markers, cavities)
    if not given.json:
        sys.stdout.write("".join(described(setup, board) for setup, board in found.items()))
    out = Path(given.out) / "boards.json"
    write_boards(out, arm.name, found, made_today(input_file(file, "markers")))
    sys.stdout.write(out.read_text(encoding="utf-8") if given.json else f"written: {out}\n")
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
