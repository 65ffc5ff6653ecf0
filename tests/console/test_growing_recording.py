"""Commands that read the recording while it grows follow it into its next files; results have a place before anything moves."""

from __future__ import annotations

import resource
from pathlib import Path

import pytest

from console.main import main
from control.errors import ArmError
from control.recording.record import Layout
from control.recording.writer import Policy, RecordingParts, begin
from procedures.survey import recorded, wait_until_recorded
from procedures.tour import RunRows

LAYOUT = Layout.of(3)


def rows(first: int, count: int, run: int) -> bytes:
    fixed = {"run": run}
    return b"".join(
        LAYOUT.packing.pack(*({**fixed, "t_s": float(k), "cycle": k}.get(name, 0) for name in LAYOUT.names))
        for k in range(first, first + count)
    )


@pytest.fixture
def parts(tmp_path: Path) -> RecordingParts:
    begin(tmp_path / "a.armlog", LAYOUT.about(period_s=0.002))
    size = (tmp_path / "a.armlog").stat().st_size + 10 * LAYOUT.packing.size
    return RecordingParts(tmp_path / "a.armlog", Policy(size), lambda text: None)


def test_a_run_that_goes_on_in_the_next_file_is_read_whole(tmp_path: Path, parts: RecordingParts) -> None:
    grown = RunRows(tmp_path / "a.armlog")
    parts.append(rows(0, 4, run=1))
    grown.skip()
    for first in (4, 8, 12, 16, 20, 24):
        parts.append(rows(first, 4, run=2))
    assert (tmp_path / "a.part3.armlog").exists()
    assert grown.of_run(2)["cycle"].tolist() == list(range(4, 28))
    parts.append(rows(28, 1, run=3))
    assert grown.of_run(3)["cycle"].tolist() == [28]


def test_a_verification_reads_every_part_and_waits_for_the_newest(tmp_path: Path, parts: RecordingParts) -> None:
    for first in (0, 4, 8):
        parts.append(rows(first, 4, run=1))
    assert recorded(tmp_path / "a.armlog")["cycle"].tolist() == list(range(12))
    wait_until_recorded(tmp_path / "a.armlog", 11.0, lambda duration_s: None)
    with pytest.raises(ArmError, match="has stopped growing"):
        wait_until_recorded(tmp_path / "a.armlog", 12.0, lambda duration_s: None)


@pytest.mark.parametrize(
    "arguments",
    [
        ["tune", "--mock", "--out", "{}/new.toml"],
        ["bringup", "--mock", "--out", "{}/new.toml"],
        ["session", "--mock", "--out", "{}/session"],
        ["gap", "--record", "--mock", "--out", "{}/gap"],
        ["iso9283", "--mock", "--out", "{}/iso"],
        ["verify", "--mock", "--against", "left", "--arm", "right", "--out", "{}/verify"],
        ["demo", "--out", "{}/demo"],
        ["plan-poses", "--out", "{}/plan"],
        ["new", "--out", "{}/new.toml"],
    ],
    ids=lambda arguments: arguments[0],
)
def test_results_that_have_no_room_are_refused_before_anything_moves(
    tmp_path: Path, arguments: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, before[1]))
    try:
        status = main([argument.format(tmp_path) for argument in arguments])
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    said = capsys.readouterr().err
    assert status == 2
    assert f"--out {tmp_path}" in said
    assert "not written: File too large: free some space, or choose another place" in said
    assert not list(tmp_path.iterdir())
