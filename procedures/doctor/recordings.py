"""How the loop kept time in the last recording: age of the counts, lateness, and what caused it."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from control.errors import ArmError
from control.recording.frame_decoder import row_type
from control.recording.parts import SUFFIX
from control.recording.reading import Recording, RowReader
from procedures.doctor.finding import Finding, Level, advised, graded

GROUP = "last recording"
AGE_MOST = 0.15  # of a period: 0.3 ms at 500 Hz
COLUMNS = ("t_s", "missed", "late_s", "age_s", "switches", "page_faults")
CALM_PER_s = 50.0  # involuntary switches


def look_at_last_recording(folder: Path) -> list[Finding]:
    """Judge the newest file of recordings in `folder`; nothing if there is none, or it has no such columns."""
    files = [path for path in folder.glob(f"*{SUFFIX}") if path.is_file()]
    if not files:
        return []
    newest = max(files, key=lambda path: path.stat().st_mtime)
    try:
        recording = Recording.open(newest)
        with np.errstate(invalid="ignore"):  # damaged rows
            columns = _columns(recording)
    except (ArmError, OSError, ValueError) as error:
        return [Finding(Level.WARN, GROUP, newest.name, "cannot be read", "", str(error))]
    if columns is None or len(columns) < 2:
        return []
    with np.errstate(all="ignore"):
        return _judged(newest.name, columns, float(recording.header.get("period_s", 0.002)))


def _columns(recording: Recording) -> NDArray[np.float64] | None:
    """COLUMNS of all rows (m, 6); None for recordings of earlier versions."""
    layout = recording.layout
    if not set(COLUMNS) <= set(layout.names):
        return None
    kind = row_type(layout.names, layout.packing)
    parts = [np.frombuffer(packed, dtype=kind) for packed in RowReader(recording).portions()]
    taken = [np.stack([part[name].astype(float) for name in COLUMNS], axis=1) for part in parts]
    return np.concatenate(taken) if taken else None


def _judged(name: str, columns: NDArray[np.float64], period_s: float) -> list[Finding]:
    t_s, missed, late_s, age_s, switches, page_faults = columns.T
    duration_s = max(float(t_s[-1] - t_s[0]), 1e-6)
    age_s = age_s[np.isfinite(age_s)]
    p50, p99 = (float(np.quantile(age_s, share)) if len(age_s) else float("nan") for share in (0.5, 0.99))
    late_p99 = float(np.quantile(late_s, 0.99))
    per_s = float(switches.sum()) / duration_s
    return [
        graded(
            GROUP, "age of the counts", p99, (AGE_MOST * period_s, 5.0 * period_s),
            (
                f"{1e3 * p50:.2f} ms, 99 % below {1e3 * p99:.2f} ms, in {name}", f"99 % below {1e3 * AGE_MOST * period_s:.2g} ms",
                "look at the lateness below, and at the latency timer of the serial port",
            ),
        ),
        graded(
            GROUP, "lateness of the loop", late_p99, (0.5 * period_s, 5.0 * period_s),
            (
                f"99 % within {1e3 * late_p99:.2f} ms, {missed[-1] - missed[0]:.0f} cycles missed in {duration_s:.0f} s",
                f"below {500 * period_s:.2g} ms", "give the operator the real-time rights (see host)",
            ),
        ),
        advised(
            per_s <= CALM_PER_s, GROUP, "what took its time",
            f"{switches.sum():.0f} involuntary switches, {page_faults.sum():.0f} page faults",
            f"at most {CALM_PER_s:.0f} switches a second",
            "end other programs; give the operator the real-time rights (see host)",
        ),
    ]  # fmt: skip
