"""Importing calib costs neither scipy nor matplotlib: each takes about a second."""

import subprocess
import sys


def test_calib_is_imported_without_scipy_and_matplotlib() -> None:
    code = (
        "import sys, calib.identify, calib.points.writer, calib.report.report, calib.calibration\n"
        "import calib.session, calib.validation.verify\n"
        "print([name for name in ('scipy', 'matplotlib', 'mujoco', 'serial', 'can') if name in sys.modules])"
    )
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert said.strip() == "[]"
