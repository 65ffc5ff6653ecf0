"""`armwright trend`: what drifts, how fast, and when the next calibration is due."""

import argparse
from pathlib import Path

from calib.ageing import as_text, read_history, trend_json, trend_of
from console.commands.calibration.options import length_m
from console.commands.progress import answer
from control.model.description import load_arm


def run(given: argparse.Namespace) -> int:
    """Read the record and print."""
    arm, wanted_m = load_arm(given.arm), length_m(given.tolerance, "--tolerance")
    trend = trend_of(arm, read_history(Path(given.history), arm.name), wanted_m)
    answer(given, trend_json(trend), as_text(trend))
    return 0
