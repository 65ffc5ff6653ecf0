"""Drills: the table's promises on some of them, and what a drill measures."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from console.main import main
from control.model.description import load_arm
from hil_mocks.firmware import VARIABLE
from procedures.drills.catalogue import drills
from procedures.drills.drill import HEADER, Drill, gripping_stage, header, off_way_m, row, stage, verdict
from procedures.drills.files import Disk, PowerLost
from tests.firmware import needs_compiler
from tests.leftovers import nothing_left_for_the_collector

PAGE = Path(__file__).parents[3] / "docs" / "drills.md"
SITUATIONS = {"rest", "motion", "homing", "session", "measuring", "realtime", "pair"}
USUAL = "rest, motion, session"


# A pause, a link, a sensor, a load, the power and two arms: one of each sort at each change.
AT_EACH_CHANGE = (
    "pause-100-motion",
    "serial-gone-motion",
    "encoder-swapped-rest",
    "jammed-motion",
    "power-arm",
    "revoke-pair",
    "guided-into-pair",
    "off-at-once-odrive",
    "restarted-feetech",
    "restarted-at-once-cia402",
    "restarted-at-once-moteus",
    "torque-lost-cia402",
    "torque-in-off-dynamixel",
    "turn-off-odrive",
    "limit-switch-crossed-motion",
    "joint-encoder-slips-rest",
    "below-floor-dynamixel",
    "brown-out-feetech",
    "own-error-odrive",
    "asked-dynamixel",
    "old-firmware-dynamixel",
)
AT_NIGHT = (
    "drift-20000-rest",
    "serial-gone-measuring",
    "same-id-rest",
    "bus-full-rest",
    "two-clients-motion",
    "wrap-motion",
    "pause-190-motion",
    "limit-switch-motion",
    "motor-encoder-stuck-motion",
    "power-session",
    "cut-recording",
    "over-temperature-pair",
    "overload-feetech",
    "asked-roboclaw",
    "restarted-roboclaw",
    "torque-in-hold-vesc",
    "old-firmware-odrive",
    "old-firmware-roboclaw",
    "host-gone-dynamixel",
    "host-gone-vesc",
)


@pytest.mark.parametrize("name", [*AT_EACH_CHANGE, *(pytest.param(name, marks=pytest.mark.nightly) for name in AT_NIGHT)])
def test_a_drill_goes_as_promised(name: str) -> None:
    outcome = drills()[name].run()
    assert outcome.broken == ()
    assert outcome.drill.name in row(outcome)


IN_THE_CLIENT = ("singularity",)  # its plans are made there, and the collector is on
OF_ANOTHER_ARM = ("wrap", "unseen")  # homed first; what they do, others do too


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[] if name in ("bit-rate-motion", "another-host-rest") else pytest.mark.nightly)
        for name, drill in drills().items()
        if isinstance(drill, Drill) and not name.startswith((*IN_THE_CLIENT, *OF_ANOTHER_ARM))
    ],
)
def test_neither_a_fault_nor_the_recovery_from_it_leaves_anything_for_the_collector(name: str) -> None:
    drill = drills()[name]
    assert isinstance(drill, Drill)
    with gripping_stage() if drill.has_gripper else stage(drill.arm(load_arm("right"))) as played:
        played.begin(drill.during)
        with nothing_left_for_the_collector():
            drill.inject(played)
            played.run(0.6)
            played.recover()


@needs_compiler
def test_a_drill_goes_as_promised_on_the_firmware_in_c(monkeypatch: pytest.MonkeyPatch) -> None:
    """The boards' own stop, and their watchdog: `armwright drill --mock --firmware c` runs all."""
    monkeypatch.setenv(VARIABLE, "c")
    assert drills()["pause-100-motion"].run().broken == ()


def test_a_promise_that_is_not_kept_is_said() -> None:
    strict = replace(drills()["stop-0-motion"], codes=frozenset({"overspeed"}), most_mm=-1.0)
    outcome = strict.run()
    assert outcome.broken == ("expected overspeed", "more than -1 mm off its path")
    assert "BROKEN: expected overspeed" in row(outcome)
    assert verdict([outcome]) == "1 drills, 0 as promised, 1 not"
    assert header().split()[: len(HEADER)][0] == "drill"


def test_the_distance_from_a_way_is_that_from_its_sections() -> None:
    way = ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (1.0, 1.0, 0.0))
    assert off_way_m((0.5, 0.1, 0.0), way) == pytest.approx(0.1)
    assert off_way_m((1.3, 1.4, 0.0), way) == pytest.approx(0.5)
    assert off_way_m((0.0, 0.0, 2.0), way[:1]) == pytest.approx(2.0)


def names_of(row: str) -> Iterator[str]:
    """The drills of a row: each fault in each of its situations, or names in full; `a-{b,c}` is a-b and a-c."""
    first, second, *_ = re.split(r"  +", row)
    second = second.replace("usual", USUAL)
    situations = second.split(", ") if set(second.split(", ")) <= SITUATIONS else None
    for code in re.split(r", (?![^{]*})", first):
        stem, _, ends = code.rstrip("}").partition("{")
        for fault in [stem + end for end in ends.split(",")]:
            yield from [f"{fault}-{place}" for place in situations] if situations else [fault]


def tables() -> list[list[str]]:
    """The tables of the page, as lines."""
    found = re.findall(r"^```\n(.*?)^```", PAGE.read_text("utf-8"), re.MULTILINE | re.DOTALL)
    return [table.splitlines() for table in found]


def test_the_page_lists_every_drill_and_no_other() -> None:
    named = [name for _, *rows in tables() for row in rows for name in names_of(row)]
    assert sorted(named) == sorted(drills())


@pytest.mark.parametrize("row", [row for head, *rows in tables() if " fault" in head for row in rows], ids=lambda row: row[:25])
def test_the_page_has_for_each_drill_faults_that_it_expects(row: str) -> None:
    codes = {code for name in names_of(row) for code in drills()[name].codes}
    known = {code for drill in drills().values() for code in drill.codes}
    said = known.intersection(re.findall(r"[a-z_]+", row))
    assert said <= codes
    assert said or not codes


def test_drills_run_on_a_mock_only(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["drill", "stop-0-motion"]) == 2
    assert "--mock" in capsys.readouterr().err


def test_a_wrong_name_is_answered_by_near_ones_and_by_what_lists_all(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["drill", "serial-los-rest", "--mock"]) == 2
    error = capsys.readouterr().err
    assert "did you mean serial-lost-rest" in error
    assert "`armwright drill --list`" in error
    assert main(["drill", "--list"]) == 0
    assert [line.split()[0] for line in capsys.readouterr().out.splitlines()] == list(drills())


def test_a_disk_without_power_keeps_what_was_forced_to_it_and_nothing_else(tmp_path: Path) -> None:
    kept, lost, named = tmp_path / "kept", tmp_path / "lost", tmp_path / "named"
    named.write_bytes(b"before")
    disk = Disk(fails_at=100)
    with disk.under():
        for path, is_forced in ((kept, True), (lost, False)):
            with path.open("wb", buffering=0) as file:
                os.write(file.fileno(), b"all of it")
                if is_forced:
                    os.fsync(file.fileno())
        (tmp_path / "new").write_bytes(b"after")
        (tmp_path / "new").replace(named)
    disk.forget()
    assert (kept.read_bytes(), lost.read_bytes(), named.read_bytes()) == (b"all of it", b"", b"before")


def test_no_write_goes_on_after_the_power_has_failed(tmp_path: Path) -> None:
    disk = Disk(fails_at=0)
    with disk.under(), (tmp_path / "a").open("wb", buffering=0) as file:
        with pytest.raises(PowerLost):
            os.write(file.fileno(), b"half")
        with pytest.raises(PowerLost):
            os.fsync(file.fileno())
    disk.forget()
    assert (tmp_path / "a").read_bytes() == b""
