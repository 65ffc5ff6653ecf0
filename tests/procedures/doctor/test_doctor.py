"""The doctor: what is wrong is named, each of several faults at once, in words and with a remedy; and nothing is energised."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from console.main import main
from control.model.arm import Arm, CanBus
from firmware_iface.clock import MonotonicClock
from firmware_iface.motor.cia402 import DriveState
from firmware_iface.motor.wire import ResetCause
from firmware_iface.serial_link import PortHere
from hil_mocks.rig import SteppedRig
from hil_mocks.scenario import FaultTable, Scenario
from procedures.doctor import host
from procedures.doctor.boards import AnsweringBoards, BoardSamples, open_boards, sample
from procedures.doctor.finding import Finding, Level, as_text, graded, percentile, verdict, worst
from procedures.doctor.host import (
    judge_can,
    judge_lateness,
    judge_serial,
    judge_strain,
    lateness,
    look_at_disk,
    look_at_kernel,
    look_at_last_recording,
)
from procedures.doctor.judging import clock_drift, judge
from procedures.on_boards import on_boards
from tests.cell import RIGHT, scenario, wired_to, with_drive, with_drives
from tests.recordings import write_recording

QUICK_S = 0.2


@contextmanager
def open_rig(*faults: FaultTable, believed: Arm = RIGHT, **changes: Any) -> Iterator[tuple[SteppedRig, Arm]]:
    with SteppedRig(RIGHT, scenario(None, homed=False, base="demo", fault=faults, **changes)) as rig:
        yield rig, wired_to(believed, rig)


def examined(rig: SteppedRig, arm: Arm, duration_s: float = QUICK_S) -> list[Finding]:
    boards = open_boards(arm, rig.clock, 0.002)
    try:
        return boards.findings + list(judge(sample(boards, rig.clock, 0.002, duration_s), arm))
    finally:
        boards.close()


def found_on(*faults: FaultTable, believed: Arm = RIGHT) -> list[str]:
    """`level what: measured -> remedy` of everything that is not well."""
    with open_rig(*faults, believed=believed) as (rig, arm):
        findings = examined(rig, arm)
    return [f"{f.level.name} {f.what}: {f.measured} -> {f.remedy}" for f in findings if f.level is not Level.OK]


def test_a_good_arm_is_well_and_every_quantity_was_looked_at() -> None:
    with open_rig() as (rig, arm):
        findings = examined(rig, arm)
    assert worst(findings) is Level.OK, as_text(findings)
    looked_at = " ".join(finding.what for finding in findings)
    for quantity in (
        "report rate",
        "frames lost",
        "clock",
        "jitter",
        "load of its serial line",
        "replies",
        "latency",
        "CAN bus load",
        "encoder",
        "current",
        "supply",
        "power stage",
    ):
        assert quantity in looked_at


def test_a_long_name_widens_its_own_group_alone_and_remedies_have_the_whole_line() -> None:
    findings = [
        Finding(Level.WARN, "host", "kernel", "without PREEMPT_RT", "PREEMPT_RT", "install one"),
        Finding(Level.OK, "boards", "board on /dev/serial/by-id/usb-a-long-name", "there"),
    ]
    assert as_text(findings).splitlines() == [
        "host",
        "  warn  kernel  without PREEMPT_RT  (expected PREEMPT_RT)",
        "        -> install one",
        "boards",
        "  ok    board on /dev/serial/by-id/usb-a-long-name  there",
    ]


def test_nothing_is_energised_and_no_board_leaves_switch_on_disabled() -> None:
    with open_rig() as (rig, arm):
        before = rig.joint_rad()
        seen: set[DriveState] = set()
        boards = open_boards(arm, rig.clock, 0.002)
        sample(boards, rig.clock, 0.002, 0.1)
        seen = {motor.state for motor in boards.motors.values() if motor.state}
        boards.close()
        assert seen == {DriveState.SWITCH_ON_DISABLED}
        assert rig.joint_rad() == pytest.approx(before, abs=1e-3)  # it settles in its play


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        (FaultTable("silent", "encoder"), "no answer to Identify"),
        (FaultTable("silent", "motor2"), "joint 2 (node 2): does not answer -> check its supply"),
        (FaultTable("drop_frames", "encoder", probability=0.1), "frames lost or broken"),
        (FaultTable("corrupt_frames", "encoder", probability=0.1), "with a bad CRC"),
        (FaultTable("drop_frames", "motor1", probability=0.2, at_s=0.5), "joint 1: replies"),
        (FaultTable("delay_frames", "motor1", value=0.006, at_s=0.5), "latency of replies"),
        (FaultTable("lost_wire", "encoder", channel=1), "joint 2: encoder: its signal is lost"),
        (FaultTable("supply", "motor3", value=15.0), "joint 3: supply: 15.0"),
        (FaultTable("over_temperature", "motor1"), "joint 1: drive: reports a fault: over-temperature"),
        (FaultTable("wrong_counts", "encoder", channel=2, value=4096.0), "joint 3, counts per turn: 4096"),
        (FaultTable("wrong_protocol", "encoder", value=7.0), "speaks protocol version 7, expected 1"),
        (FaultTable("wrong_protocol", "motor1", value=7.0), "speaks protocol version 7, expected 1"),
        (FaultTable("quadrature_error", "encoder", channel=0, at_s=0.5), "illegal transition"),
    ],
)
def test_each_fault_is_named(fault: FaultTable, words: str) -> None:
    # Listening begins at about 0.25 s of the mock's time; faults "at 0.5 s" come once the boards have been met.
    with open_rig(fault) as (rig, arm):
        findings = examined(rig, arm, 1.0 if fault.at_s else QUICK_S)
    said = [f"{f.what}: {f.measured} -> {f.remedy}" for f in findings if f.level is not Level.OK]
    assert any(words in line for line in said), said
    assert all(f.remedy for f in findings if f.level is not Level.OK)


def test_two_faults_at_once_are_both_named() -> None:
    findings = found_on(FaultTable("silent", "motor2"), FaultTable("lost_wire", "encoder", channel=0))
    assert any("joint 2 (node 2): does not answer" in line for line in findings)
    assert any("joint 1: encoder: its signal is lost" in line for line in findings)
    assert len(findings) == 2


def test_a_board_under_another_node_is_offered_for_the_one_that_is_missing() -> None:
    findings = found_on(believed=with_drive(RIGHT, 2, motor_node=9))
    assert any("joint 2 (node 9)" in line and "node 2 answers but has no joint" in line for line in findings)
    assert any(line.startswith("WARN node 2:") for line in findings)


def test_a_board_that_its_watchdog_or_a_low_supply_restarted_says_so() -> None:
    with open_rig() as (rig, arm):
        for cause, board in zip(ResetCause, rig.robot.motor_boards, strict=False):
            board.setup = replace(board.setup, reset_cause=int(cause) + 2)  # reset line, watchdog, low supply
        starts = {f.what.split(" (")[0]: f.measured for f in examined(rig, arm) if "last start" in f.what}
    assert starts == {
        "motor board of joint 2": "its watchdog ended a program that hung",
        "motor board of joint 3": "its own supply broke down",
    }


def test_a_joint_that_moves_is_not_judged_for_noise_and_its_current_not_at_all() -> None:
    with SteppedRig(RIGHT, Scenario()) as rig:  # no friction: the arm sinks on its shorted windings
        findings = examined(rig, wired_to(RIGHT, rig), 0.5)
    moved = [f for f in findings if "moved" in f.measured]
    assert [f.level for f in moved] == [Level.WARN, Level.WARN]
    assert not any(f.what == "joint 3: current with the drive off" for f in findings)


def test_a_bus_that_somebody_else_commands_is_only_listened_to() -> None:
    with open_rig() as (rig, arm):
        first, second = open_boards(arm, rig.clock, 0.002), AnsweringBoards()
        try:
            sending = first.motors[1]
            original = rig.clock.wait_until_s

            def wait_until_s(t: float) -> None:
                if not second.motors:
                    sending.command_off()
                original(t)

            rig.clock.wait_until_s = wait_until_s  # type: ignore[method-assign]
            second = open_boards(replace(arm, encoder_boards=()), rig.clock, 0.002)
            rig.clock.wait_until_s = original  # type: ignore[method-assign]
            assert not second.may_command
            commands = sample(second, rig.clock, 0.002, 0.05).motors
            assert all(motor.commands == 0 for motor in commands.values())
            assert any("another host commands node 1" in f.measured for f in second.findings)
        finally:
            first.close()
            second.close()


def test_an_arm_without_boards_says_what_to_add() -> None:
    bare = replace(RIGHT, encoder_boards=(), can=None)
    said = [f.remedy for f in open_boards(bare, MonotonicClock(), 0.002).findings]
    assert said == [
        "add [[encoder_board]] to arm.toml, or give --encoder",
        "add [can] to arm.toml, or give --can-interface and --can-channel",
    ]


def test_placeholders_are_a_warning_until_their_words_are_taken_out() -> None:
    silent = BoardSamples(1.0, 0.002)
    drafted = replace(RIGHT, placeholders=("masses", "motors"))
    assert [(f.level, f.measured) for f in judge(silent, drafted)] == [(Level.WARN, "masses and motors")]
    assert list(judge(silent, RIGHT)) == []


@pytest.mark.parametrize(("mode", "warned"), [("position", 0), ("current", 3)])
def test_boards_that_would_free_their_motors_without_the_host_are_named(mode: str, warned: int) -> None:
    arm = on_boards(RIGHT, "odrive")
    in_mode = with_drives(arm, pid=replace(arm.drives[0].pid, mode=mode))
    with SteppedRig(in_mode, scenario(None)) as rig:
        boards = open_boards(wired_to(in_mode, rig), rig.clock, 0.004)
        boards.close()
    unwell = [found for found in boards.findings if found.level is not Level.OK]
    assert len(unwell) == warned
    assert all("a loaded arm drops" in found.measured for found in unwell)


UP = {
    "flags": ["NOARP", "UP", "LOWER_UP"],
    "txqlen": 100,
    "linkinfo": {
        "info_kind": "can",
        "info_data": {"state": "ERROR-ACTIVE", "restart_ms": 100, "bittiming": {"bitrate": 1_000_000}},
    },
}
CAN0 = CanBus("socketcan", "can0")


def about_can(can: CanBus, details: Mapping[str, Any] | None, needs_fd: bool = False, **data: object) -> list[str]:
    """What is not well, with `data` in place of what the kernel says of a good interface."""
    if details is not None and data:
        info = {**details["linkinfo"]["info_data"], **data}
        details = {**details, "linkinfo": {"info_kind": "can", "info_data": info}}
    found = list(judge_can(can, lambda channel: details, needs_fd))
    assert all(finding.remedy for finding in found if finding.level is not Level.OK)
    return [f"{f.level.name} {f.what}: {f.measured}" for f in found if f.level is not Level.OK]


def test_the_state_of_a_can_interface_is_read_from_the_kernel() -> None:
    name = "CAN interface socketcan:can0"
    assert about_can(CAN0, UP) == []
    assert about_can(CAN0, {}) == []  # no `ip` on this machine
    assert about_can(CAN0, None) == [f"BAD {name}: there is no such interface"]
    assert about_can(CAN0, {**UP, "flags": ["NOARP"]}, state="STOPPED") == [f"BAD {name}: down, stopped"]
    assert about_can(CAN0, UP, state="BUS-OFF") == [f"BAD {name}: up, bus-off"]
    assert about_can(CAN0, UP, state="ERROR-PASSIVE") == [f"WARN {name}: up, error-passive"]
    assert about_can(CAN0, UP, bittiming={"bitrate": 500_000}) == [f"BAD {name}: bit rate: 500000"]
    assert about_can(CAN0, UP, restart_ms=0) == [f"WARN {name}: restart after bus-off: never"]
    assert about_can(CAN0, {**UP, "txqlen": 10}) == [f"WARN {name}: transmit queue: 10 frames"]
    assert about_can(CAN0, UP, needs_fd=True) == [f"BAD {name}: CAN FD: off"]
    assert about_can(CAN0, UP, needs_fd=True, ctrlmode=["FD"]) == []
    assert about_can(CanBus("socketcan", "can1", 500_000), UP)[0].endswith("bit rate: 1000000")


def test_a_missing_package_or_a_slow_driver_of_an_adapter_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("firmware_iface.can_link.find_spec", lambda name: None)
    (found,) = judge_can(CanBus("gs_usb", "0"), lambda channel: None)
    assert (found.level, found.remedy) == (Level.BAD, "pip install gs_usb pyusb")
    monkeypatch.setattr("firmware_iface.can_link.find_spec", lambda name: name)
    (found,) = judge_can(CanBus("gs_usb", "0"), lambda channel: None)
    assert found.level is Level.WARN
    assert "socketcan" in found.remedy
    assert list(judge_can(CanBus("udp_multicast", "239.74.163.2"), lambda channel: None)) == []


def test_ports_get_names_that_stay_and_short_latencies(tmp_path: Path) -> None:
    timer = tmp_path / "sys/bus/usb-serial/devices/ttyUSB7/latency_timer"
    timer.parent.mkdir(parents=True)
    timer.write_text("16\n")
    here = [PortHere("/dev/ttyUSB7", "", "/dev/serial/by-id/usb-FTDI-if00")]
    found = list(judge_serial("board", "/dev/ttyUSB7", here, tmp_path))
    assert [finding.level for finding in found] == [Level.WARN, Level.OK]
    assert "/dev/serial/by-id/usb-FTDI-if00" in found[0].remedy
    assert timer.read_text() == "1"  # set, because this user may
    assert list(judge_serial("board", "/dev/serial/by-id/usb-other", here, tmp_path)) == []


def test_drift_and_jitter_come_out_of_arrivals() -> None:
    latched = [0.001 * k for k in range(1000)]
    arrived = [t / (1.0 + 300e-6) + 5.0 + (0.004 if k % 50 == 7 else 0.0) for k, t in enumerate(latched)]
    drift_ppm, sd_ppm, late_s = clock_drift(latched, arrived)
    assert drift_ppm == pytest.approx(300.0, abs=3.0 * sd_ppm)
    assert percentile(late_s, 0.99) == pytest.approx(0.004, abs=2e-4)
    assert percentile(late_s, 0.9) < 2e-4


@pytest.mark.parametrize(
    ("value", "level"), [(1.0, Level.OK), (1.0001, Level.WARN), (2.0, Level.WARN), (2.0001, Level.BAD), (float("nan"), Level.BAD)]
)
def test_limits_are_inclusive_and_a_nan_is_bad(value: float, level: Level) -> None:
    finding = graded("host", "x", value, (1.0, 2.0), ("m", "e", "r"))
    assert finding.level is level
    assert finding.remedy == ("" if level is Level.OK else "r")


def test_a_host_that_pauses_is_told_apart_from_one_that_is_always_late() -> None:
    pausing = judge_lateness([0.0001] * 999 + [0.15], 0.002, 0.2)
    assert [f.level for f in pausing] == [Level.OK, Level.WARN]
    late = judge_lateness([0.003] * 1000, 0.002, 0.2)
    assert [f.level for f in late] == [Level.WARN, Level.OK]


def test_lateness_is_counted_from_deadlines_of_a_clock() -> None:
    class Late:
        t = 0.0

        def now_s(self) -> float:
            return self.t

        def wait_until_s(self, t: float) -> None:
            self.t = max(self.t, t) + 2e-4

    late_s = lateness(Late(), 0.1)
    assert len(late_s) == pytest.approx(100, abs=2)
    assert max(late_s) == pytest.approx(2e-4, abs=1e-9)


def test_a_folder_that_cannot_be_written_to_is_bad(tmp_path: Path) -> None:
    assert {f.level for f in look_at_disk(tmp_path / "not" / "there", 1e5)} == {Level.OK}
    (finding,) = look_at_disk(Path("/proc"), 1e5)  # where not even root may write
    assert finding.level is Level.BAD
    assert finding.measured.startswith("not written: ")


def test_verdicts() -> None:
    ok, warned, bad = (Finding(level, "host", "x", "y") for level in Level)
    assert verdict([ok]) == "no problems found"
    assert verdict([ok, warned]).startswith("no errors; 1")
    assert verdict([ok, warned, bad]).startswith("1 to fix")


def test_the_command_says_json_and_fails_on_what_is_bad(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(host, "PAUSE_TEST_S", 0.02)
    monkeypatch.setattr("console.commands.bringup.look_at_host", lambda *_: [])  # of the machine that tests run on
    file = tmp_path / "hurt.toml"
    file.write_text('[[fault]]\nkind = "silent"\nboard = "motor3"\n')
    options = ["doctor", "--mock", "--seconds", "0.1", "--json"]
    assert main(options) == 0
    assert json.loads(capsys.readouterr().out)["worst"] == "ok"
    assert main([*options, "--scenario", str(file)]) == 1
    said = json.loads(capsys.readouterr().out)
    assert (said["format"], said["worst"]) == ("doctor/1", "bad")


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--mock", "--encoder", "/dev/x"], "--mock brings its own links"),
        (["--scenario", "demo"], "--scenario needs --mock"),
        (["--mock", "--rate", "5"], "--rate: expected 20 to 1200 Hz"),
        (["--mock", "--seconds", "0"], "--seconds: expected 0.1"),
        (["--mock", "--scenario", "nowhere"], "there is no such file"),
    ],
)
def test_wrong_input_is_one_message(options: list[str], words: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["doctor", *options]) == 2
    assert words in capsys.readouterr().err


def test_the_kernel_is_looked_at_and_what_is_missing_has_a_remedy(tmp_path: Path) -> None:
    governor = tmp_path / "sys/devices/system/cpu/cpu0/cpufreq/scaling_governor"
    realtime, throttle = tmp_path / "sys/kernel/realtime", tmp_path / "proc/sys/kernel/sched_rt_runtime_us"
    for file, text in ((governor, "powersave"), (realtime, "0"), (throttle, "500000")):
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(f"{text}\n")
    assert [(found.level, found.measured) for found in look_at_kernel(tmp_path)] == [
        (Level.WARN, "powersave"),
        (Level.WARN, "without PREEMPT_RT"),
        (Level.WARN, "50 % of each second"),
    ]
    assert all(found.remedy for found in look_at_kernel(tmp_path))
    for file, text in ((governor, "performance"), (realtime, "1"), (throttle, "-1")):
        file.write_text(f"{text}\n")
    assert {found.level for found in look_at_kernel(tmp_path)} == {Level.OK}
    assert look_at_kernel(tmp_path / "nothing")[2].level is Level.OK


def test_switches_while_lateness_was_measured_are_a_warning() -> None:
    assert judge_strain(3, 10).level is Level.OK
    assert "400 involuntary switches, 3 page faults" in judge_strain(3, 400).measured
    assert judge_strain(3, 400).level is Level.WARN


def test_the_last_recording_says_how_old_the_counts_were_and_what_made_the_loop_late(tmp_path: Path) -> None:
    assert look_at_last_recording(tmp_path) == []
    calm = {k: {"age_s": 2.5e-4, "late_s": 5e-5} for k in range(200)}
    write_recording(tmp_path / "a.armlog", 200, changes=calm)
    findings = look_at_last_recording(tmp_path)
    assert [finding.level for finding in findings] == [Level.OK] * 3
    assert findings[0].measured == "0.25 ms, 99 % below 0.25 ms, in a.armlog"
    assert findings[0].expected == "99 % below 0.3 ms"
    stormy = {k: {"age_s": 4e-4, "late_s": 2e-3, "switches": 1, "page_faults": k == 7} for k in range(200)}
    os.utime(tmp_path / "a.armlog", (0, 0))
    write_recording(tmp_path / "b.armlog", 200, changes={**stormy, 199: {"missed": 3, "age_s": math.nan}})
    age, late, causes = look_at_last_recording(tmp_path)
    assert [age.level, late.level, causes.level] == [Level.WARN] * 3
    assert "in b.armlog" in age.measured
    assert late.measured == "99 % within 2.00 ms, 3 cycles missed in 0 s"
    assert causes.measured == "199 involuntary switches, 1 page faults"


def test_recordings_of_the_real_arm_say_nothing_about_a_mock_one(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(host, "PAUSE_TEST_S", 0.02)
    Path("log").mkdir()
    write_recording(Path("log/real.armlog"), 200, changes={k: {"age_s": 1168.0} for k in range(200)})

    def groups(*options: str) -> set[str]:
        main(["doctor", "--mock", "--seconds", "0.1", "--json", *options])
        return {found["group"] for found in json.loads(capsys.readouterr().out)["findings"]}

    assert groups("--log", "log") - groups() == {"last recording"}
    assert [file.name for file in Path("log").iterdir()] == ["real.armlog"]


def test_a_last_recording_that_cannot_be_read_is_a_warning_and_no_error(tmp_path: Path) -> None:
    (tmp_path / "torn.armlog").write_bytes(b"\0" * 20)
    (found,) = look_at_last_recording(tmp_path)
    assert found.level is Level.WARN
    assert "not an armwright recording" in found.remedy
