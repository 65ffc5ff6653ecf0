"""The soak in small: one session and its look, and the verdict on what drifts."""

from __future__ import annotations

from dataclasses import replace

import pytest

from benchmarks.soak.stepped import Look, verdict

LOOKS = [Look(100.0 * k, 90_000_000 + 1_000 * k, 9, 3e-4, 0) for k in range(20)]


def test_flat_memory_handles_and_counts_are_no_drift(capsys: pytest.CaptureFixture[str]) -> None:
    assert verdict(LOOKS) == 0
    assert "nothing drifted" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"memory_bytes": 110_000_000}, "memory grew"),
        ({"handles": 10}, "handles"),
        ({"off_rad": 0.01}, "counts drifted"),
        ({"lost": 1}, "frames were lost"),
    ],
)
def test_whatever_drifts_is_named(change: dict[str, float], said: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert verdict([*LOOKS, replace(LOOKS[-1], **change)]) == 1
    assert said in capsys.readouterr().out
