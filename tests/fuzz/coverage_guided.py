"""Coverage-guided fuzzing of one target with atheris: `python -m tests.fuzz.coverage_guided TARGET SECONDS` (`make fuzz`).

Runs in an environment that has atheris. Ends with status 0 if nothing was found in that time.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import atheris

with atheris.instrument_imports(
    include=["firmware_iface", "control", "calib", "console", "hil_mocks"], enable_loader_override=False
):
    from tests.fuzz.seeds import seeds_of
    from tests.fuzz.targets import is_survived


def main() -> None:
    """Fuzz from the seeds; libFuzzer ends the process."""
    name, seconds = sys.argv[1:]
    with tempfile.TemporaryDirectory() as corpus:
        for k, seed in enumerate(seeds_of(name)):
            (Path(corpus) / str(k)).write_bytes(seed)
        atheris.Setup(
            [sys.argv[0], f"-max_total_time={seconds}", "-max_len=8192", "-timeout=10", corpus],
            lambda content: is_survived(name, content),
        )
        atheris.Fuzz()


if __name__ == "__main__":
    main()
