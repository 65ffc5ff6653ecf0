"""Peers run in separate environments under `.venv-peers`, so that their dependencies do not mix."""

import json
import os
import subprocess
import sys
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from types import TracebackType
from typing import Any

HERE = Path(__file__).parent
ENVIRONMENT = HERE.parents[1] / ".venv-peers"
MAIN = "requirements"  # the lock file of pinocchio; every other one has a folder in .venv-peers
INSTALL_TIMEOUT_S = 600.0


class PeerMissing(Exception):
    """The peers' environment cannot be created here."""


def peer_python(lock_name: str = MAIN) -> Path:
    """Return the Python of an environment of peers, created from <lock_name>.lock if missing."""
    path, reason = _environment(lock_name)
    if reason:
        raise PeerMissing(reason)
    return path


@cache
def _environment(lock_name: str) -> tuple[Path, str]:
    """Its Python, or the reason why it cannot be created; tried and reported once per run."""
    environment = ENVIRONMENT if lock_name == MAIN else ENVIRONMENT / lock_name
    lock = HERE / f"{lock_name}.lock"
    python, stamp = environment / "bin" / "python", environment / "installed"
    if stamp.exists() and stamp.stat().st_mtime >= lock.stat().st_mtime:
        return python, ""
    print(f"(installing peers from {lock.name}; once)", flush=True)
    pip = [str(python), "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
    for command in ([sys.executable, "-m", "venv", str(environment)], [*pip, "--no-deps", "--require-hashes", "-r", str(lock)]):
        if reason := _failure(command):
            print(f"peers of {lock.name} are not installed, their columns stay empty: {reason}", flush=True)
            return python, "not installed"
    stamp.touch()
    return python, ""


def _failure(command: Sequence[str]) -> str:
    """Run a command; return its last error line if it fails."""
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=INSTALL_TIMEOUT_S, check=False)
    except (OSError, subprocess.TimeoutExpired) as error:
        return f"{type(error).__name__}: {error}"
    lines = (done.stderr.strip() or done.stdout.strip() or f"status {done.returncode}").splitlines()
    return next((line for line in lines if line.startswith("ERROR")), lines[-1]) if done.returncode else ""


class Peer:
    """A running peer script: one JSON line in, one out."""

    def __init__(self, script: str, task: Mapping[str, Any], lock_name: str = MAIN) -> None:
        quiet = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
        self._process = subprocess.Popen(
            [str(peer_python(lock_name)), str(HERE / script)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
            env=quiet,
        )
        self.answers = self.ask(task)

    def ask(self, question: Any) -> dict[str, Any]:
        """Return the answer to one line; PeerMissing if the script has ended."""
        if self._process.stdin is None or self._process.stdout is None:
            raise PeerMissing("has no pipes")
        try:
            self._process.stdin.write(json.dumps(question) + "\n")
            self._process.stdin.flush()
        except BrokenPipeError:
            raise PeerMissing("does not run here") from None
        line = self._process.stdout.readline()
        if not line:
            raise PeerMissing("does not run here")
        answer: dict[str, Any] = json.loads(line)
        return answer

    def __enter__(self) -> "Peer":
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        """End the script."""
        if self._process.stdin is not None:
            self._process.stdin.close()
        if self._process.stdout is not None:
            self._process.stdout.close()
        self._process.wait()
