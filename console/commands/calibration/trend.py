"""`armwright trend`: what drifts, how fast, and when the next calibration is due."""

import argparse
import sys
from pathlib import Path

from calib.ageing import as_text, read_history, trend_json, trend_of
from calib.results import json_text
from console.quantities import length_m
from control.model.description import load_arm


def run(given: argparse.Namespace) -> int:
    """Read the record and print."""
    arm, wanted_m = load_arm(given.arm), length_m(given.tolerance, "--tolerance")
    trend = trend_of(arm, read_history(Path(given.history), arm.name), wanted_m)
    if given.json:
        sys.stdout.write(json_text(trend_json(trend)))
    else:
        sys.stdout.write(as_text(trend))
    return 0
