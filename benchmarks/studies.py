"""Options that all studies have: what runs them."""

from __future__ import annotations

import argparse


def add_options(parser: argparse.ArgumentParser) -> None:
    """--workers and --cluster, as `calib.studies.cluster.executor` takes them."""
    parser.add_argument("--workers", type=int, metavar="K", help="processes (default: all processors)")
    parser.add_argument("--cluster", metavar="ADDRESS", help="a Dask scheduler, e.g. tcp://host:8786")
