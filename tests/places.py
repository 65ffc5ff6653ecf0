"""Files that tests of several folders read."""

from pathlib import Path

ROOT = Path(__file__).parents[1]
RIGHT_TOML = ROOT / "control" / "arms" / "right.toml"
ARMS = ROOT / "tests" / "control" / "model" / "arms"
REAL = ROOT / "tests" / "real"  # recordings of other people's arms
