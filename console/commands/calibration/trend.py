"""`armwright trend`: what drifts, how fast, and when the next calibration is due."""

import argparse
import json
import sys
from pathlib import Path

from calib.ageing import as_text, read_history, trend_json, trend_of
from console.quantities import length_m
from control.model.description import load_arm


def run(given: argparse.Namespace) -> int:
    """Read the record and print."""
    arm, wanted_m = load_arm(given.arm), length_m(given.tolerance, "--tolerance")
    trend = trend_of(arm, read_history(Path(given.history), arm.name), wanted_m)
    if given.json:
        sys.stdout.write(json.dumps(trend_json(trend), indent=2, allow_nan=False) + "\n")
    else:
        sys.stdout.write(as_text(trend))
    return 0
