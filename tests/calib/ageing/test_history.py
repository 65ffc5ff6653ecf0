"""history.jsonl: lines are appended whole, and a mistake is named with file and line."""

import datetime
import json
from pathlib import Path

import numpy as np
import pytest

from benchmarks.calibration.ageing import entry_of, measured
from benchmarks.calibration.chains import REFERENCE_DH
from calib.errors import CalibrationError
from calib.gap.finding import EffectName, GapFinding, NamedEffect
from calib.history import (
    Entry,
    GeometryRecord,
    HistoryFileError,
    Quantity,
    append_entry,
    measured_at,
    quantities_of,
    read_history,
)
from calib.points.writer import write_points
from console.main import main

DAY = datetime.datetime(2026, 3, 1, tzinfo=datetime.UTC)
GEOMETRY = GeometryRecord(("theta2",), (1.57,), (0.035,), ((1e4,),))


def entry(day: int = 0, arm: str = "right") -> Entry:
    date = DAY + datetime.timedelta(days=day)
    return Entry("history/1", date, "calibrate", arm, "test", {"p.csv": "0"}, GEOMETRY, {"backlash2.width_rad": Quantity(1e-3)})


def test_what_is_appended_is_read_in_the_order_of_its_dates(tmp_path: Path) -> None:
    file = tmp_path / "history.jsonl"
    for day in (5, 0, 9):
        append_entry(file, entry(day))
    assert read_history(file, "right") == (entry(0), entry(5), entry(9))
    assert len(file.read_text().splitlines()) == 3


def line_with(**changes: object) -> str:
    known = {"format": "history/1", "measured": "2026-01-01T00:00:00Z", "by": "x", "arm": "right", "program_version": ""}
    return json.dumps(known | changes)


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("{", "truncated"),
        ("[]", "Expected `object`"),
        ("", "truncated"),
        ('{"format": "history/2"}', "missing required field"),
        (line_with(format="history/2"), "expected format"),
        (line_with(measured="2026-01-01T00:00:00"), "time zone"),
        (line_with(measured="soon"), "RFC3339"),
        (line_with(arm="left"), 'expected arm "right"'),
        (line_with(geometry={"names": ["d1"], "values": [], "scales": [1], "information": [[1]]}), "expected 1 values"),
        (line_with(temperature=3), "unknown field `temperature`"),
    ],
)
def test_a_mistake_is_named_with_file_and_line(line: str, said: str, tmp_path: Path) -> None:
    file = tmp_path / "history.jsonl"
    append_entry(file, entry())
    file.write_text(file.read_text() + line + "\n")
    with pytest.raises(HistoryFileError) as error:
        read_history(file, "right")
    assert f"{file}, line 2: " in str(error.value)
    assert said in str(error.value)


@pytest.mark.parametrize(("text", "date"), [("2026-03-01", DAY), ("2026-03-01T00:00Z", DAY), ("2026-03-01T01:00+01:00", DAY)])
def test_dates_without_a_zone_are_utc(text: str, date: datetime.datetime) -> None:
    assert measured_at(text) == date
    with pytest.raises(CalibrationError, match="--measured: expected a date"):
        measured_at("yesterday")


def test_a_gap_gives_its_effects_parameters() -> None:
    effects = (
        NamedEffect(EffectName("backlash", 2), {"width_rad": (2e-3, 1e-4)}, 1.0),
        NamedEffect(EffectName("belt_coupling"), {"ratio": (0.01, float("nan"))}, 1.0),
    )
    found = GapFinding("right", (), {}, 9.0, 1.0, {}, {}, effects)
    assert quantities_of(found) == {"backlash2.width_rad": Quantity(2e-3, 1e-4), "belt_coupling.ratio": Quantity(0.01, None)}


@pytest.mark.usefixtures("unrendered")
def test_calibrations_are_recorded_and_their_trend_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rng, record, points = np.random.default_rng(1), tmp_path / "history.jsonl", tmp_path / "points.csv"
    tables = [REFERENCE_DH.copy() for _ in range(3)]
    for month, table in enumerate(tables):
        table[1, 1] += 1e-3 * month
    for month, table in enumerate(tables[:2]):
        append_entry(record, entry_of(30.0 * month, table, rng))
    write_points(points, measured(tables[2], rng))
    line = ["calibrate", "--arm", "right", "--points", str(points), "--out", str(tmp_path / "out"), "--starts", "1"]
    assert main([*line, "--history", str(record), "--measured", "2026-03-02"]) == 0
    capsys.readouterr()
    assert main(["trend", "--arm", "right", "--history", str(record), "--tolerance", "5mm"]) == 0
    assert "joint 2: zero drifts by 12" in capsys.readouterr().out  # mrad in a year
    assert main(["trend", "--arm", "right", "--history", str(record), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["entries"] == 3


@pytest.mark.parametrize(
    ("line", "said"),
    [
        (["trend", "--history", "none.jsonl"], "none.jsonl: cannot be read"),
        (["calibrate", "--points", "p.csv", "--out", "o", "--measured", "2026-01-01"], "--measured: needs --history"),
        (
            ["calibrate", "--points", "p.csv", "--out", "o", "--history", "/dev/null/h.jsonl"],
            "--history /dev/null/h.jsonl: not written: Not a directory: choose another place",
        ),
        (["calibrate", "--points", "p.csv", "--out", "o", "--history", "h", "--measured", "x"], "--measured: expected a date"),
        (["gap", "--points", "p.csv", "--out", "o", "--history", "h", "--measured", "x"], "--measured: expected a date"),
    ],
)
def test_wrong_input_is_told_before_anything_is_computed(
    line: list[str], said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(line) == 2
    assert said in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
