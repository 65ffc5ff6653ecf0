"""The firmware in C: it compiles without a warning, for a Cortex-M too, and no bytes break it. What it does: tests/hil_mocks."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

from hil_mocks.firmware import SOURCES, VARIABLE, EncoderBoardFirmware, FirmwareError, build, choose, encoder_board_class, library
from hil_mocks.scenario import Scenario
from tests.firmware import needs_compiler

FUZZ_FRAMES = 100_000
FORBIDDEN = ("malloc(", "calloc(", "free(", "printf(", "float", "double", "goto ")


@needs_compiler
def test_no_bytes_break_it(tmp_path: Path) -> None:
    """Whole, mutated and random frames, under the address and undefined-behaviour sanitizers (`make -C ... fuzz` for long)."""
    program = tmp_path / "fuzz"
    try:
        build(program, "-fsanitize=address,undefined", "-fno-sanitize-recover=all", "-O0", sources=(SOURCES / "test/fuzz.c",))
    except FirmwareError as problem:
        pytest.skip(f"the compiler has no sanitizers: {problem}")
    ended = subprocess.run([str(program), "7", str(FUZZ_FRAMES)], capture_output=True, text=True, check=False)
    assert (ended.returncode, ended.stdout) == (0, f"{FUZZ_FRAMES} frames\n"), ended.stderr


def test_the_code_has_no_allocation_no_output_and_no_floating_point() -> None:
    for file in sorted((SOURCES / "src").glob("*.c")):
        text = file.read_text(encoding="utf-8")
        assert [word for word in FORBIDDEN if word in text] == [], file.name


def test_every_file_of_it_is_shipped() -> None:
    """The patterns of pyproject.toml reach three folders deep."""
    assert max(len(file.relative_to(SOURCES).parts) for file in SOURCES.rglob("*")) <= 3


@needs_compiler
def test_the_bridge_of_a_board_that_cannot_go_on_is_off_before_its_watchdog_resets_it(tmp_path: Path) -> None:
    """The files for the Nucleo on this machine, their registers in memory: enable pin, MOE, duty of the bridge's inputs."""
    program, board = tmp_path / "nucleo", SOURCES / "bsp/nucleo_f446re"
    build(
        program, f"-I{board}", "-Wno-conversion", sources=(board / "stm32f446.c", board / "startup.c", SOURCES / "test/nucleo.c")
    )
    said = subprocess.run([str(program)], capture_output=True, text=True, check=True, timeout=30).stdout
    assert said.splitlines() == [
        "writes to a timer before its clock: 0",
        "reset flags 00: cause 0",
        "reset flags 07: cause 1",
        "reset flags 02: cause 2",
        "reset flags 12: cause 3",
        "reset flags 03: cause 4",
        "reset flags 0a: cause 5",
        "brown-out reset: level 0, written 1",
        "at power-up: state 00, enable 1, MOE 1, duty 0 0",
        "at 6 V: state 27, enable 1, MOE 1, duty 4201 3151",
        "0.5 ms without the fast loop: state 27, enable 0, MOE 0, duty 4201 3151",
        "stuck, and the watchdog unfed",
        "a fault of the processor: state 27, enable 0, MOE 0, duty 4201 3151",
        "stuck, and the watchdog unfed",
        "3.3 V below 2.9 V: state 27, enable 0, MOE 0, duty 4201 3151",
        "stuck, and the watchdog unfed",
        "emergency stop, the fast loop stalled: state 0f, enable 1, MOE 0, duty 4201 3151",
    ]


@pytest.mark.skipif(
    shutil.which("arm-none-eabi-gcc") is None,
    reason="no arm-none-eabi-gcc: apt-get install gcc-arm-none-eabi libnewlib-arm-none-eabi",
)
def test_it_compiles_for_the_board(tmp_path: Path) -> None:
    made = subprocess.run(["make", "-C", str(SOURCES), "target", f"OUT={tmp_path}"], capture_output=True, text=True, check=False)
    assert made.returncode == 0, made.stderr
    images = {file.name: file.stat().st_size for file in tmp_path.glob("*.bin")}
    assert set(images) == {"encoder_board.bin", "motor_board.bin"}
    assert max(images.values()) < 16 * 1024


@needs_compiler
@pytest.mark.skipif(
    shutil.which("arm-none-eabi-gcc") is None or shutil.which("qemu-system-arm") is None,
    reason="no emulated Cortex-M: apt-get install gcc-arm-none-eabi libnewlib-arm-none-eabi qemu-system-arm",
)
def test_an_emulated_cortex_m_says_the_same_as_this_machine(tmp_path: Path) -> None:
    made = subprocess.run(
        ["make", "-s", "-C", str(SOURCES), "replay", f"OUT={tmp_path}"],
        capture_output=True,
        text=True,
        check=False,
        stdin=subprocess.DEVNULL,
        timeout=120,
    )
    assert made.returncode == 0, made.stderr
    here, there = [line for line in (made.stdout + made.stderr).splitlines() if line.startswith("sum ")]
    assert here == there


def test_without_a_compiler_one_sentence_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    library.cache_clear()
    monkeypatch.setenv("CC", "no-such-compiler")
    with pytest.raises(FirmwareError, match="apt-get install gcc"):
        choose("c")
    monkeypatch.undo()


def test_a_scenario_or_the_environment_chooses_the_firmware(monkeypatch: pytest.MonkeyPatch) -> None:
    assert encoder_board_class(Scenario(firmware="c")) is EncoderBoardFirmware
    monkeypatch.setenv(VARIABLE, "c")
    assert encoder_board_class(Scenario()) is EncoderBoardFirmware
    assert encoder_board_class(Scenario(firmware="python")) is not EncoderBoardFirmware
    monkeypatch.setenv(VARIABLE, "rust")
    with pytest.raises(Exception, match="expected python or c, got 'rust'"):
        encoder_board_class(Scenario())
