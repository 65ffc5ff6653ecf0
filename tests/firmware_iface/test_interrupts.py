"""SIGINT and SIGTERM at any moment of a program: exit status 130, one line, and never a traceback."""

from __future__ import annotations

import importlib
import itertools
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from firmware_iface import interrupts
from firmware_iface.installation import command

SAID = "armwright: interrupted\n"
PROGRAM = """
import os, signal, sys
from firmware_iface.interrupts import run_command

signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored in the background job that the tests may be

number, left = int(sys.argv.pop(1)), int(sys.argv.pop(1))

def at_an_import(event, what):
    global left
    if event == "import":
        left -= 1
        if left == 0:
            os.kill(os.getpid(), number)

sys.addaudithook(at_an_import)
sys.exit(run_command())
"""


@pytest.fixture(scope="module")
def imports() -> int:
    """How many imports `armwright arm` makes when nobody interrupts it."""
    counted = PROGRAM.replace("sys.exit(run_command())", "run_command()\nprint(-left)")
    ended = subprocess.run(
        [sys.executable, "-c", counted, "0", "0", "arm", "right"], capture_output=True, text=True, check=True, timeout=60
    )
    return int(ended.stdout.split()[-1])


# A third of the imports stand before the command line is read. At the first ones only Python itself listens,
# and to SIGINT alone.
@pytest.mark.parametrize(
    ("part", "number"),
    [(0.0, signal.SIGINT), (0.01, signal.SIGINT), *itertools.product([0.1, 0.25, 0.4, 0.6, 0.8, 0.95], interrupts.NUMBERS)],
)
def test_an_interrupt_at_any_import_of_a_command_leaves_one_line(part: float, number: signal.Signals, imports: int) -> None:
    count = 1 + int(part * imports)
    ended = subprocess.run(
        [sys.executable, "-c", PROGRAM, str(int(number)), str(count), "arm", "right"],
        capture_output=True,
        text=True,
        check=False,
        timeout=60,
    )
    assert (ended.returncode, ended.stderr) == (interrupts.STATUS, SAID)


@pytest.mark.parametrize("number", interrupts.NUMBERS)
@pytest.mark.parametrize("module", ["console.main", "control.recording.writer", "hil_mocks.serve"])
def test_a_child_that_is_interrupted_before_its_first_line_says_nothing(module: str, number: signal.Signals) -> None:
    with interrupts.held():
        child = subprocess.Popen(command(module), stdin=subprocess.PIPE, stderr=subprocess.PIPE)
    child.send_signal(number)
    assert child.communicate(timeout=60) == (None, b"")
    assert child.returncode == interrupts.STATUS


def test_a_module_is_imported_whole_before_the_interrupt_is_raised(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "compiled_one.py").write_text(
        "import signal\n"
        "try:\n"
        "    signal.raise_signal(signal.SIGTERM)\n"
        "except KeyboardInterrupt:\n"
        "    raise ImportError('cannot be loaded') from None\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    with interrupts.heard():
        importlib.import_module("compiled_one")
        with pytest.raises(KeyboardInterrupt):
            signal.pause()


def test_an_interrupt_that_falls_into_a_destructor_is_raised_behind_it() -> None:
    program = (
        "import signal\n"
        "from firmware_iface import interrupts\n"
        "class Closing:\n"
        "    def __del__(self):\n"
        "        signal.raise_signal(signal.SIGINT)\n"
        "interrupts.end_at_once()\n"
        "with interrupts.heard():\n"
        "    try:\n"
        "        Closing()\n"
        "        signal.pause()\n"
        "    except KeyboardInterrupt:\n"
        "        print('raised')\n"
    )
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, timeout=60)
    assert (ended.stdout, ended.stderr) == ("raised\n", "")


def test_an_interrupt_at_the_last_import_of_a_block_is_raised_at_its_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its second coming would be lost, or fall into Python's own end, where the alarm kills."""
    (tmp_path / "last_one.py").write_text("import signal\nsignal.raise_signal(signal.SIGINT)\n")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(KeyboardInterrupt), interrupts.heard():
        importlib.import_module("last_one")
    assert "last_one" in sys.modules  # whole
    assert signal.getitimer(signal.ITIMER_REAL) == (0.0, 0.0)
