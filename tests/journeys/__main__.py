"""`make journeys`: walk all of them, or those that are named, and print the table."""

from __future__ import annotations

import argparse
import signal
import sys
import tempfile
from collections import Counter
from pathlib import Path

from tests.journeys.runner import ARMS, JOURNEYS, Stumble, walk


def main() -> int:
    """Exit status 1 if one stumbled."""
    parser = argparse.ArgumentParser(prog="python -m tests.journeys", description=__doc__)
    parser.add_argument("journeys", nargs="*", metavar="JOURNEY", help=f"of {', '.join(JOURNEYS)} (default: all)")
    parser.add_argument("--arms", nargs="*", choices=[*ARMS], default=[*ARMS], metavar="ARM")
    args = parser.parse_args()
    stumbled = 0
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # killed, it ends what it has started
    for name, journey in JOURNEYS.items():
        for arm in journey.arms():
            if arm not in args.arms or (args.journeys and name not in args.journeys):
                continue
            with tempfile.TemporaryDirectory(prefix=f"journey-{arm}-") as folder:
                try:
                    done = walk(journey, arm, Path(folder))
                except Stumble as stumble:
                    stumbled += 1
                    print(f"{name:24}{arm:8}stumbled\n{stumble}", flush=True)
                    continue
                decided = ", ".join(f"{option} x{n}" if n > 1 else option for option, n in Counter(done.options).items())
                print(
                    f"{name:24}{arm:8}{done.minutes:6.1f} min   {len(done.options) + done.answers} decided: {decided}", flush=True
                )
    return 1 if stumbled else 0


if __name__ == "__main__":
    sys.exit(main())
