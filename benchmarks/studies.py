"""What all studies have: options for what runs them, and lines that are seen at once."""

from __future__ import annotations

import argparse
import sys


def add_options(parser: argparse.ArgumentParser) -> None:
    """--workers and --cluster, as `calib.studies.executor` takes them."""
    parser.add_argument("--workers", type=int, metavar="K", help="processes (default: all processors)")
    parser.add_argument("--cluster", metavar="ADDRESS", help="a Dask scheduler, e.g. tcp://host:8786")


def say(text: str) -> None:
    """A line, at once, also into a pipe."""
    sys.stdout.write(f"{text}\n")
    sys.stdout.flush()
