"""Rows of a recording on one clock: the ages of angles and camera frames are found, and what is left is the arm's own."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calib.gap.log import read_log
from control.kinematics.kinematics import ForwardKinematics
from control.model.description import load_arm
from procedures.gap_recording import RunFile, log_text, write_log
from procedures.gap_timing import MEAN_s, Raw, aligned, clocks_of, lead_rad_of
from procedures.on_boards import on_boards

ARM = load_arm("right")
PERIOD_s, LENGTH_s = 0.002, 6.0
OFFSET_s, RATE = 37.2, 20e-6  # of the board's clock
CAMERA_s = 0.0093


def angle(t: np.ndarray, order: int = 0) -> np.ndarray:
    """Joint angles (m, 3) and their derivatives: three sines a joint, the fastest of 7 Hz."""
    total = np.zeros((len(t), 3))
    for j in range(3):
        for k, (size, hertz) in enumerate(((0.2, 0.4), (0.03, 1.9), (0.0015, 7.0))):
            w = 2.0 * np.pi * hertz * (1.0 + 0.07 * j)
            total[:, j] += size * w**order * np.sin(w * t + 0.6 * j + k + 0.5 * np.pi * order)
    return total


def run(start_s: float, noise: float = 1.0, seed: int = 0, has_camera: bool = True, is_newest: bool = False) -> Raw:
    """What the runtime would record of an arm that moves like that: staircase voltages, a current mean, a board's own clock.

    `is_newest`: the current is that at the end of the row before, under its voltage.
    """
    draw = np.random.default_rng((seed, round(start_s)))
    t = start_s + PERIOD_s * np.arange(round(LENGTH_s / PERIOD_s))
    counted = np.floor(((t - OFFSET_s) * (1.0 + RATE) + 4e-4) * 1000.0) / 1000.0 - 1e-3  # newest report of each millisecond
    latched = counted / (1.0 + RATE) + OFFSET_s
    q = angle(latched) + noise * draw.normal(0.0, 8e-6, (len(t), 3))
    current = np.zeros((len(t), 3))
    voltage = np.zeros((len(t), 3))
    for j, drive in enumerate(ARM.drives):
        constant, r = drive.torque_constant_Nm_A * drive.gear_ratio, drive.resistance_ohm
        lag = drive.inductance_H / r
        asked = 1.3 * np.sign(angle(t, 1)[:, j]) + angle(t, 2)[:, j] / 6.0  # friction and inertia
        voltage[:, j] = r * asked + constant * angle(t, 1)[:, j]
        # Held over a cycle; the current is the mean of the last millisecond before the next command, one row later.
        ends = t if is_newest else t - PERIOD_s - 0.5 * MEAN_s
        held = np.roll(voltage[:, j], 1 if is_newest else 2)
        current[:, j] = (held - constant * angle(ends - lag, 1)[:, j]) / r
    current += noise * draw.normal(0.0, 5e-3, current.shape)
    tip = np.full((len(t), 3), np.nan)
    if has_camera:
        frames = np.arange(4, len(t), 5)
        seen = ForwardKinematics(ARM).tips(angle(t[frames] - CAMERA_s))
        tip[frames] = seen + noise * draw.normal(0.0, 1.4e-4, seen.shape) + 0.004  # a frame that is displaced
    lead = np.full((len(t), 3), np.nan)
    lead[::20, 1] = 1e-3 * np.sin(t[::20])  # joint 2 has an encoder on the motor, too, which is asked now and then
    return Raw(t, q, angle(t), current, voltage, np.repeat(counted[:, None], 3, axis=1), tip, 0.0, lead)


RUNS = [run(start) for start in (40.0, 60.0, 95.0)]


def test_ages_of_angles_and_frames_are_found_within_microseconds() -> None:
    clocks = clocks_of(ARM, RUNS)
    for raw in RUNS:
        true = raw.counted_s[:, 0] / (1.0 + RATE) + OFFSET_s
        # noise of currents leaves about 10 us
        assert np.abs(clocks.encoder[0].loop_s(raw.counted_s[:, 0]) - true).max() < 4e-5
    assert clocks.camera_s == pytest.approx(CAMERA_s, abs=1e-4)
    assert "9.3 ms" in clocks.in_words()[0]


def test_aligned_rows_are_the_arms_own_motion_and_tips() -> None:
    clocks = clocks_of(ARM, RUNS)
    for raw in RUNS:
        got = aligned(ARM, raw, clocks)
        at = raw.t_s[1:-1]
        assert got.t_s[0] == 0.0
        assert np.abs(got.q_rad - angle(at)).max() < 1e-4  # 40 us at 1 rad/s, noise of 8e-6
        assert np.sqrt(np.mean((got.q_rad - angle(at)) ** 2)) < 3e-5
        seen = np.isfinite(got.tip_m[:, 0])
        assert seen.sum() > 0.19 * len(at)
        apart = got.tip_m[seen] - 0.004 - ForwardKinematics(ARM).tips(angle(at[seen]))
        assert np.sqrt(np.mean(apart**2)) < 2.0e-4  # the camera's noise is 1.4e-4


@pytest.mark.parametrize("is_newest", [False, True], ids=["reference boards", "VESCs"])
def test_the_current_is_brought_to_the_moment_of_the_command(is_newest: bool) -> None:
    arm = on_boards(ARM, "vesc") if is_newest else ARM
    runs = [run(start, 0.0, is_newest=is_newest) for start in (40.0, 60.0, 95.0)]
    raw = runs[0]
    got = aligned(arm, raw, clocks_of(arm, runs))
    drive = ARM.drives[0]
    constant, lag = drive.torque_constant_Nm_A * drive.gear_ratio, drive.inductance_H / drive.resistance_ohm
    at = raw.t_s[1:-1]
    held = np.roll(raw.voltage_V[:, 0], 1)[1:-1]
    true = (held - constant * angle(at - lag, 1)[:, 0]) / drive.resistance_ohm
    inner = slice(50, -50)
    assert np.abs(got.current_A[inner, 0] - true[inner]).max() < 3e-3  # the mean alone is 20 mA off


def test_a_log_has_the_voltages_of_all_joints_or_of_none(tmp_path: Path) -> None:
    """An empty voltage would say that the driver is off."""
    for lost in (None, "u3_V"):
        write_run(tmp_path, "1", RUNS[0], lost)
        write_log(tmp_path, ARM, ["1"])
        header = (tmp_path / "log.csv").read_text().partition("\n")[0]
        assert ("u1_V" in header, "i1_A" in header) == (lost is None, True)


def test_a_run_of_another_runtime_is_put_on_a_clock_of_its_own(tmp_path: Path) -> None:
    """The runtime's clock began anew, the encoder board's went on."""
    later = replace(RUNS[1], t_s=RUNS[1].t_s - 55.0)
    logs = {}
    for names in (("2",), ("1", "2")):
        for name, raw in (("1", RUNS[0]), ("2", later)):
            write_run(tmp_path, name, raw)
        write_log(tmp_path, ARM, names)
        lines = (tmp_path / "log.csv").read_text().splitlines()
        logs[names] = [line for line in lines if line.startswith("2,")]
    assert logs["2",] == logs["1", "2"] != []


def write_run(folder: Path, name: str, one: Raw, lost: str | None = None, has_leads: bool = True) -> None:
    n = 3
    table = {
        f"{form}{j + 1}{unit}": values[:, j]
        for j in range(n)
        for form, unit, values in (
            ("q", "_rad", one.q_rad),
            ("q", "_set_rad", one.q_set_rad),
            ("i", "_A", one.current_A),
            ("u", "_V", one.voltage_V),
            ("counted", "_s", one.counted_s),
        )
    }
    table |= {
        "lead2_rad": one.lead_rad[:, 1],
        "t_s": one.t_s,
        **{name: one.tip_m[:, k] for k, name in enumerate(("x_m", "y_m", "z_m"))},
    }
    table = {column: values for column, values in table.items() if has_leads or column != "lead2_rad"}
    rows = np.zeros(400, dtype=[(column, np.float64) for column in table])
    for column, values in table.items():
        rows[column] = math.nan if column == lost else values[:400]
    RunFile.write(RunFile.of(folder, name), rows, ARM, 0.0)


def test_leads_between_two_encoders_are_in_the_log_and_stay_in_one_that_gets_tips(tmp_path: Path) -> None:
    write_run(tmp_path, "1", RUNS[0])
    write_log(tmp_path, ARM, ["1"])
    log, warnings = read_log(tmp_path / "log.csv", 3)
    assert warnings == ()
    (recorded,) = log.runs
    assert set(recorded.extra) == {"lead2_rad"}
    lead_rad = lead_rad_of(recorded, 3)
    there = np.isfinite(lead_rad[:, 1])
    assert lead_rad[there, 1] == pytest.approx(1e-3 * np.sin(40.0 + PERIOD_s + recorded.t_s[there]), rel=1e-6)
    assert there.sum() == 19  # of 400 rows
    copied = tmp_path / "copied.csv"
    copied.write_text(log_text(3, [("1", recorded, 0.0)]))
    (again,) = read_log(copied, 3)[0].runs
    assert again.extra == recorded.extra


def test_a_run_of_before_leads_were_recorded_is_read(tmp_path: Path) -> None:
    write_run(tmp_path, "1", RUNS[0], has_leads=False)
    assert np.isnan(RunFile.read(RunFile.of(tmp_path, "1"), 3).lead_rad).all()


@pytest.mark.parametrize("kind", ["dynamixel", "mixed"])
def test_what_a_board_is_told_beside_a_position_is_no_voltage(tmp_path: Path, kind: str) -> None:
    arm = on_boards(ARM, kind)
    forms = ("q{}_rad", "q{}_set_rad", "i{}_A", "u{}_V", "counted{}_s")
    names = ["t_s", *(form.format(j) for j in (1, 2, 3) for form in forms)]
    rows = np.ones(5, dtype=[(name, np.float64) for name in (*names, "x_m", "y_m", "z_m")])
    RunFile.write(tmp_path / "1.csv", rows, arm, 0.0)
    read = RunFile.read(tmp_path / "1.csv", 3)
    assert np.isnan(read.voltage_V).all(axis=0).tolist() == [d.pid.mode == "position" for d in arm.drives]
    assert (read.current_A == 1.0).all()


def test_without_voltages_a_bought_boards_counts_are_as_old_as_the_host_noted() -> None:
    bare = [replace(raw, voltage_V=np.full_like(raw.voltage_V, np.nan), counted_s=raw.counted_s + OFFSET_s) for raw in RUNS[:1]]
    clocks = clocks_of(on_boards(ARM, "dynamixel"), bare)
    assert clocks.angle_age_s == pytest.approx(np.mean(bare[0].t_s - bare[0].counted_s[:, 0]), abs=1e-9)


def test_an_exported_log_begins_at_0_while_a_bought_boards_counts_have_the_hosts_time() -> None:
    (raw,) = RUNS[:1]
    ages_s = raw.t_s - raw.counted_s[:, 0]
    exported = replace(raw, voltage_V=np.full_like(raw.voltage_V, np.nan), counted_s=raw.counted_s + 13_949.0)
    clocks = clocks_of(on_boards(ARM, "dynamixel"), [exported])
    assert clocks.angle_age_s == pytest.approx(np.mean(ages_s) - np.min(ages_s), abs=1e-6)


def test_without_voltages_angles_count_as_half_a_cycle_old_and_without_frames_there_is_no_camera() -> None:
    bare = [
        replace(raw, voltage_V=np.full_like(raw.voltage_V, np.nan), tip_m=np.full_like(raw.tip_m, np.nan)) for raw in RUNS[:1]
    ]
    clocks = clocks_of(ARM, bare)
    assert clocks.angle_age_s == pytest.approx(0.5 * PERIOD_s, abs=1e-6)
    assert np.isnan(clocks.camera_s)
    assert "camera" not in clocks.in_words()[0]
    assert np.isnan(aligned(ARM, bare[0], clocks).tip_m).all()
