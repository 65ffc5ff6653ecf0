"""Children of the console and the demos: they end with their parent, whatever signals it was told to ignore."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

LIMIT_s = 120.0  # a busy machine is slow, a broken program never ends
PARENT = """
import signal, subprocess, sys
for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
    signal.signal(number, signal.SIG_IGN)
signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT, signal.SIGTERM])
from firmware_iface.interrupts import ends_with_parent
begins = "import signal; from firmware_iface import interrupts; interrupts.end_at_once()"  # as every `command` does
child = [sys.executable, "-c", begins + "; print('begun', flush=True); signal.pause()"]
subprocess.Popen(child, preexec_fn=ends_with_parent(signal.{name}), start_new_session=True)
signal.pause()
"""


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM"])
def test_a_child_ends_with_a_killed_parent_that_was_started_with_signals_ignored(name: str) -> None:
    parent = subprocess.Popen(
        [sys.executable, "-c", PARENT.replace("{name}", name)], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
    )
    assert parent.stdout is not None
    assert parent.stdout.readline() == b"begun\n"
    parent.kill()
    parent.communicate(timeout=LIMIT_s)  # the child holds the pipe, too: it ends with the child


def test_a_command_that_was_started_with_sigint_ignored_is_interrupted_by_it() -> None:
    process = subprocess.Popen(
        # a shell would catch it until its trap is set
        ["env", "--ignore-signal=INT", sys.executable, "-m", "console.main", "script", "--check", "-"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )
    end_s = time.monotonic() + LIMIT_s
    while not has_handler(process.pid, signal.SIGINT):
        assert time.monotonic() < end_s
        assert process.poll() is None
        time.sleep(0.02)
    process.send_signal(signal.SIGINT)
    said, error = process.communicate(timeout=LIMIT_s)
    assert (process.returncode, said, error) == (130, b"", b"armwright: interrupted\n")


def has_handler(pid: int, number: signal.Signals) -> bool:
    """Whether a process has a handler of its own for a signal (proc_pid_status(5), SigCgt)."""
    text = Path(f"/proc/{pid}/status").read_text()
    caught = next(line for line in text.splitlines() if line.startswith("SigCgt"))
    return bool(int(caught.split()[1], 16) >> (number - 1) & 1)
