"""`armwright plot`: the same figures from every form of a recording, whatever is missing, torn, empty or huge in it."""

from __future__ import annotations

import gzip
import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from console.main import main
from console.visualisation import pictures
from console.visualisation.metrics import metrics_json, metrics_of, tip_error_m
from console.visualisation.pictures import PICTURES
from console.visualisation.reading import of_columns, read_series
from console.visualisation.series import TURNS, Series, chosen, envelope, joined_runs, orders, spectrum, with_gaps
from console.visualisation.snapshots import tips_in, traces_of
from control.errors import ArmError
from control.kinematics.kinematics import ForwardKinematics
from control.model.description import arm_text, load_arm
from control.recording.export import to_csv, to_mcap
from control.recording.reading import Recording
from tests.recordings import MODES, AHEAD_rad, ERROR_rad, PERIOD_s, write_recording

RIGHT = load_arm("right")
TOML = arm_text(RIGHT)
CYCLES = 400


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_recording(tmp_path_factory.mktemp("log") / "a.armlog", CYCLES, arm_toml=TOML)


@pytest.fixture(autouse=True)
def coarse(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is drawn is tested, not how finely: most of the time goes into pixels."""
    monkeypatch.setattr(pictures, "DOTS_PER_in", 25)


def printed(capsys: pytest.CaptureFixture[str], *arguments: str) -> dict[str, Any]:
    assert main(["plot", *arguments, "--json"]) == 0
    found: dict[str, Any] = json.loads(capsys.readouterr().out)
    return found


def refused(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    assert main(["plot", *arguments]) == 2
    error = capsys.readouterr().err
    assert "Traceback" not in error
    return error


def test_every_form_of_one_recording_gives_the_same_series(recording: Path, tmp_path: Path) -> None:
    opened = Recording.open(recording)
    to_csv(opened, tmp_path / "log.csv.gz")
    to_mcap(opened, tmp_path / "log.mcap", arm=RIGHT)
    (tmp_path / "log.csv").write_bytes(gzip.decompress((tmp_path / "log.csv.gz").read_bytes()))
    whole = read_series(recording)
    runs_only = whole.at(whole.run == 1)  # log.csv has no cycles before the first run
    for name, expected in (("log.mcap", whole), ("log.csv.gz", runs_only), ("log.csv", runs_only)):
        series = read_series(tmp_path / name)
        assert len(series) == len(expected)
        np.testing.assert_allclose(np.diff(series.t_s), np.diff(expected.t_s), atol=2e-9)  # nine digits
        for key in ("q_rad", "q_set_rad", "current_A", "voltage_V", "temperature_C", "tip_m", "late_s", "missed"):
            np.testing.assert_allclose(getattr(series, key), getattr(expected, key), rtol=1e-7, atol=1e-12)
        np.testing.assert_array_equal(series.following_error_rad.shape, expected.following_error_rad.shape)
        assert [series.modes[k] for k in series.mode] == [expected.modes[k] for k in expected.mode]
    assert read_series(tmp_path / "log.mcap").arm is not None  # attached


def test_tips_are_those_of_the_joints_in_every_form_and_of_the_encoders_where_nothing_else_is_known(tmp_path: Path) -> None:
    kinematics = ForwardKinematics(RIGHT)
    old = read_series(write_recording(tmp_path / "old.armlog", 60, arm_toml=TOML))
    np.testing.assert_array_equal(old.joint_rad, old.q_rad)
    np.testing.assert_array_equal(old.joint_set_rad, old.q_set_rad)
    opened = Recording.open(write_recording(tmp_path / "a.armlog", 60, has_joint_side=True, arm_toml=TOML))
    to_csv(opened, tmp_path / "log.csv")
    to_mcap(opened, tmp_path / "log.mcap", arm=RIGHT)
    ahead = AHEAD_rad * np.arange(1, 4)
    for name in ("a.armlog", "log.mcap", "log.csv"):
        series = read_series(tmp_path / name, RIGHT)
        np.testing.assert_allclose(series.q_rad - series.joint_rad, np.broadcast_to(ahead, series.q_rad.shape), atol=1e-8)
        traces = traces_of(series, tips_in(RIGHT))
        np.testing.assert_allclose(traces.commanded_m, kinematics.tips(series.q_set_rad - ahead), atol=1e-8)
        np.testing.assert_allclose(traces.measured_m, kinematics.tips(series.q_rad - ahead), atol=1e-8)
        seen = np.flatnonzero(np.isfinite(series.tip_m[:, 0]))
        expected = np.linalg.norm(series.tip_m[seen] - kinematics.tips(series.q_rad[seen] - ahead), axis=1)
        np.testing.assert_allclose(tip_error_m(series)[seen], expected, atol=1e-7)


def test_the_figures_are_those_of_the_formula(recording: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = printed(capsys, str(recording))
    assert text["format"] == "plot/1"
    assert (text["samples"], text["arm"], text["files"]) == (CYCLES, "right", [])
    for k, joint in enumerate(text["joints"], start=1):
        assert joint["joint"] == k
        assert joint["following_rms_rad"] == pytest.approx(k * ERROR_rad)
        assert joint["following_max_rad"] == pytest.approx(k * ERROR_rad)
        assert joint["current_peak_A"] == pytest.approx(0.5 * k)
        assert joint["current_limit_A"] == 8.0
        assert joint["current_saturated_share"] == 0.0
    assert text["late_p99_s"] == pytest.approx(1e-4)
    assert text["missed_cycles"] == 0
    assert text["camera_frames"] == CYCLES / 5


def test_saturation_is_counted_against_the_arms_own_limits(tmp_path: Path) -> None:
    changes: dict[int, dict[str, float]] = {k: {"i2_A": -7.95, "u1_V": 23.9} for k in range(40)}
    changes[41] = {"missed": 7, "late_s": 0.5}
    series = read_series(write_recording(tmp_path / "a.armlog", 100, changes=changes, arm_toml=TOML))
    merit = metrics_of(series)
    assert merit.joints[1].current_saturated_share == pytest.approx(0.4)
    assert merit.joints[1].current_peak_A == pytest.approx(7.95)
    assert merit.joints[0].voltage_saturated_share == pytest.approx(0.4)
    assert merit.late_max_s == 0.5


def test_an_error_counts_only_where_a_set_point_is_followed(tmp_path: Path) -> None:
    guiding = {k: {"mode": MODES.index("GUIDING"), "q1_rad": 1.0} for k in range(20, 30)}
    series = read_series(write_recording(tmp_path / "a.armlog", 60, changes=guiding))
    assert metrics_of(series).joints[0].following_max_rad == pytest.approx(ERROR_rad)
    assert np.isnan(series.following_error_rad[20:30]).all()


def test_the_tips_distance_is_to_the_model_and_only_once_the_arm_knows_its_zeros(tmp_path: Path) -> None:
    homing = {k: {"mode": MODES.index("HOMING")} for k in range(10, 20)}
    series = read_series(write_recording(tmp_path / "a.armlog", 60, changes=homing, arm_toml=TOML))
    error = tip_error_m(series)
    assert np.isnan(error[:20]).all()
    expected = np.linalg.norm(np.full(3, 0.3) - ForwardKinematics(RIGHT).tips(series.q_rad[25:26])[0])
    assert error[25] == pytest.approx(expected)
    assert np.isnan(error[26])  # no frame


def test_a_folder_gets_a_picture_each_and_a_file_all(recording: Path, tmp_path: Path) -> None:
    assert main(["plot", str(recording), "--joints", "2", "--out", str(tmp_path / "each")]) == 0
    assert {path.stem for path in (tmp_path / "each").iterdir()} == {picture.name for picture in PICTURES}
    svg = tmp_path / "all.svg"
    assert main(["plot", str(recording), "--out", str(svg), "--what", "errors,currents", "--joints", "3"]) == 0
    text = svg.read_text("utf-8")
    for words in ("Following error", "Motor current", "joint 3", "error [mrad]", "current [A]", "time [s]"):
        assert words in text
    assert "joint 1" not in text
    assert main(["plot", str(recording), "--out", str(svg)]) == 2  # nothing is overwritten


def test_any_number_of_joints_is_drawn(tmp_path: Path) -> None:
    log = write_recording(tmp_path / "a.armlog", 120, 7, arm="nobody's")
    shown = {picture.name for picture in PICTURES if picture.has(read_series(log))}
    assert shown == {picture.name for picture in PICTURES} - {"tip"}  # nobody's geometry is known
    assert main(["plot", str(log), "--out", str(tmp_path / "p"), "--what", "tracking,supply,spectra"]) == 0


def test_a_log_with_angles_alone_is_drawn_and_its_figures_are_null(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = tmp_path / "log.csv"
    log.write_text("run,t_s,q1_rad\na,0,0.1\na,0.1,0.2\nb,0,0.3\nb,0.1,0.4\n")
    assert main(["plot", str(log), "--out", str(tmp_path / "p")]) == 0
    assert [path.name for path in (tmp_path / "p").iterdir()] == ["tracking.png"]
    capsys.readouterr()
    text = printed(capsys, str(log))
    assert text["runs"] == ["a", "b"]
    assert text["joints"][0]["following_rms_rad"] is None
    assert text["late_p99_s"] is None
    assert text["missed_cycles"] is None


def test_rows_of_nothing_but_nan_are_drawn(tmp_path: Path) -> None:
    nan = math.nan
    gone = {f"{kind}{j}_{unit}": nan for kind, unit in (("i", "A"), ("u", "V"), ("temperature", "C")) for j in (1, 2, 3)}
    changes = {k: {**gone, "q1_rad": nan, "q2_set_rad": nan, "x_m": nan} for k in range(100)}
    log = write_recording(tmp_path / "a.armlog", 100, changes=changes, arm_toml=TOML)
    assert main(["plot", str(log), "--out", str(tmp_path / "p.svg")]) == 0


def test_an_empty_recording_is_one_message(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = write_recording(tmp_path / "a.armlog", 0)
    assert "empty recording" in refused(capsys, str(log))


def test_a_recording_of_one_cycle_is_drawn(tmp_path: Path) -> None:
    log = write_recording(tmp_path / "a.armlog", 1, arm_toml=TOML)
    assert main(["plot", str(log), "--joints", "1", "--out", str(tmp_path / "p.svg")]) == 0


def test_a_torn_recording_is_drawn_and_the_loss_said(recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    torn = tmp_path / "torn.armlog"
    torn.write_bytes(recording.read_bytes()[:-5])
    assert main(["plot", str(torn), "--json"]) == 0
    said = capsys.readouterr()
    assert json.loads(said.out)["samples"] == CYCLES - 1
    assert "last row is incomplete" in said.err


def test_a_cut_off_mcap_is_drawn_as_far_as_it_goes(tmp_path: Path) -> None:
    log, whole = tmp_path / "log.mcap", tmp_path / "whole.mcap"
    to_mcap(Recording.open(write_recording(tmp_path / "a.armlog", 8000, 1)), whole)
    content = whole.read_bytes()
    for share in (0.4, 0.7):
        log.write_bytes(content[: int(share * len(content))])
        series = read_series(log)
        assert any("cut off" in note for note in series.notes)
        assert 100 < len(series) < 8000
        np.testing.assert_allclose(np.diff(series.t_s), PERIOD_s, atol=1e-9)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"", "expected a recording"),
        (b"\x00\x01\x02", "expected a recording"),
        (b"ARMLOG1\n\x10\x00", "recording"),
        (b"ARMLOG1\n\xff\xff\x00\x00{", "damaged"),
        (b"run,t_s\n", "q1_rad is missing"),
        (b"run,t_s,q1_rad\n1,0,nan\n", "line 2"),
        (b"\x89MCAP0\r\n", "none of the topics"),
        (b"\x1f\x8bxx", "log"),
    ],
)
def test_what_is_no_recording_is_one_message_that_names_the_file(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], content: bytes, said: str
) -> None:
    file = tmp_path / "log"
    file.write_bytes(content)
    error = refused(capsys, str(file))
    assert str(file) in error
    assert said in error


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--what", "pie"], "tracking, errors"),
        (["--what", "tracking,curents"], 'got "curents"'),
        (["--what", ","], "tracking, errors"),
        (["--joints", "4"], "from 1 to 3"),
        (["--joints", "0"], "from 1 to 3"),
        (["--joints", "one"], "from 1 to 3"),
        (["--run", "9"], "expected one of 0, 1"),
        (["--from", "5"], "it contains 0.000 to"),
        (["--from", "2", "--to", "1"], "time span"),
        (["--out", "a.gif"], ".svg"),
    ],
)
def test_a_bad_option_is_one_message(recording: Path, capsys: pytest.CaptureFixture[str], options: list[str], said: str) -> None:
    assert said in refused(capsys, str(recording), *options)


def test_a_picture_of_what_was_not_recorded_says_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = write_recording(tmp_path / "a.armlog", 50, 2, arm="nobody's")
    assert "give it with --arm" in refused(capsys, str(log), "--what", "tip")
    assert "2 joints, but arm right has 3" in refused(capsys, str(log), "--arm", "right")


def test_without_a_display_a_window_says_what_to_do_instead(
    recording: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MPLBACKEND", "agg")
    assert "--out" in refused(capsys, str(recording), "--window")


def test_one_run_and_a_span_of_time_are_chosen(recording: Path) -> None:
    series = read_series(recording)
    assert len(chosen(series, "0", None, None)) == 10
    part = chosen(series, "1", 0.1, 0.2)
    assert (part.t_s >= 0.1).all()
    assert (part.t_s <= 0.2).all()
    with pytest.raises(ArmError, match="no samples"):
        chosen(series, "0", 0.1, None)


def test_runs_that_begin_at_zero_stand_one_after_the_other() -> None:
    t = joined_runs(np.array([0.0, 0.1, 0.2, 0.0, 0.1, 0.0]), np.array([0, 0, 0, 1, 1, 2]))
    assert (np.diff(t) > 0.0).all()
    assert t[-1] == pytest.approx(0.5)


def test_an_envelope_of_a_million_samples_loses_no_peak_and_no_gap() -> None:
    t = np.arange(1_000_000) * PERIOD_s
    values = np.zeros(len(t))
    values[123_456], values[765_432] = 9.0, -7.0
    values[200_000:300_000] = np.nan
    thin_t, thin = envelope(t, values)
    assert len(thin) == 4000
    assert (np.nanmax(thin), np.nanmin(thin)) == (9.0, -7.0)
    assert thin_t[np.nanargmax(thin)] == pytest.approx(t[123_456], abs=1.1)  # a bucket is 1 s
    assert np.isnan(thin[(thin_t > 402) & (thin_t < 598)]).all()


def test_a_line_does_not_bridge_a_gap() -> None:
    t, values = with_gaps(np.array([0.0, 1.0, 2.0, 50.0, 51.0]), np.arange(5.0), 1.0)
    assert np.isnan(values).tolist() == [False, False, False, True, False, False]
    assert len(t) == 6


def test_a_spectrum_has_the_power_of_what_it_is_of_and_passes_over_gaps() -> None:
    rng = np.random.default_rng(3)
    t = np.arange(30_000) * PERIOD_s
    values = 0.5 * rng.standard_normal(len(t)) + 2.0 * np.sin(2 * math.pi * 40.0 * t)
    values[7000:7003] = np.nan
    frequency, density = spectrum(t, values, PERIOD_s)
    # Parseval: the density's integral is the variance; Welch with some 25 averages is good to a few percent
    assert np.sum(density**2) * (frequency[1] - frequency[0]) == pytest.approx(0.25 + 2.0, rel=0.05)
    assert frequency[np.argmax(density)] == pytest.approx(40.0, abs=0.3)
    assert len(spectrum(t[:50], values[:50], PERIOD_s)[0]) == 0
    assert len(spectrum(t, np.full(len(t), np.nan), PERIOD_s)[0]) == 0


@pytest.mark.parametrize("direction", [1.0, -1.0])
def test_cogging_shows_at_its_order_whatever_the_speed(direction: float) -> None:
    t = np.linspace(0.0, 1.0, 20_000)
    turns = direction * (100.0 * t**2 + 5.0 * t)  # speeding up: nothing periodic in time
    order, amplitude = orders(turns, 0.3 * np.sin(2 * math.pi * 6.0 * turns) + 2.0 * t)
    peak = int(np.argmax(amplitude * (order > 1)))
    assert order[peak] == pytest.approx(6.0)
    assert amplitude[peak] == pytest.approx(0.3, rel=0.02)
    assert len(orders(turns[:100], turns[:100])[0]) == 0  # less than a piece
    assert len(orders(np.zeros(1000), np.ones(1000))[0]) == 0
    assert TURNS > 4


def test_a_recording_whose_clock_starts_again_is_one_that_rises(tmp_path: Path) -> None:
    from control.recording.record import Layout

    layout = Layout.of(3)
    block = write_recording(tmp_path / "few.armlog", 1000, arm_toml=TOML).read_bytes()
    header, rows = block[: -1000 * layout.packing.size], block[-1000 * layout.packing.size :]
    (tmp_path / "huge.armlog").write_bytes(header + 200 * rows)
    series = read_series(tmp_path / "huge.armlog")
    assert len(series) == 200_000
    assert (np.diff(series.t_s) > 0.0).all()
    said = metrics_json(series, metrics_of(series))
    assert said["joints"][2]["following_rms_rad"] == pytest.approx(3 * ERROR_rad)


def test_columns_that_are_absent_are_nan() -> None:
    columns = {"t_s": np.arange(3.0), "q1_rad": np.zeros(3)}
    series: Series = of_columns("x", columns, (), None)
    assert np.isnan(series.current_A).all()
    assert replace(series, notes=("a",)).notes == ("a",)
    assert (series.mode == -1).all()


def test_a_place_that_cannot_be_written_is_refused_before_anything_is_drawn(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    blocked = tmp_path / "a_file"
    blocked.touch()
    for out in (blocked / "sheet.png", blocked / "folder"):
        assert main(["plot", str(recording), "--out", str(out)]) == 2
        assert "not written: " in capsys.readouterr().err
