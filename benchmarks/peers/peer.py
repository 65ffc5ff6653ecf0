"""Peers run in environments of their own under `.venv-peers`, so that their dependencies are not ours, nor each other's."""

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
    """The peers' environment cannot be made here; says why."""


def peer_python(lock_name: str = MAIN) -> Path:
    """Return the Python of an environment of peers, made from <lock_name>.lock where it is not there yet."""
    path, reason = _environment(lock_name)
    if reason:
        raise PeerMissing(reason)
    return path


@cache
def _environment(lock_name: str) -> tuple[Path, str]:
    """Its Python, and why it cannot be made here: tried once a run, and said once."""
    environment = ENVIRONMENT if lock_name == MAIN else ENVIRONMENT / lock_name
    lock = HERE / f"{lock_name}.lock"
    python, stamp = environment / "bin" / "python", environment / "installed"
    if stamp.exists() and stamp.stat().st_mtime >= lock.stat().st_mtime:
        return python, ""
    print(f"(installing peers from {lock.name}; once)", flush=True)
    pip = [str(python), "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
    for command in (
        [sys.executable, "-m", "venv", str(environment)],
        [*pip, "--require-hashes", "-r", str(lock)],
    ):
        if reason := _failure(command):
            print(f"peers of {lock.name} are not installed, their columns stay empty: {reason}", flush=True)
            return python, "not installed"
    stamp.touch()
    return python, ""


def _failure(command: Sequence[str]) -> str:
    """Run a command; its last error line where it fails."""
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=INSTALL_TIMEOUT_S, check=False)
    except (OSError, subprocess.TimeoutExpired) as error:
        return f"{type(error).__name__}: {error}"
    said = (done.stderr.strip() or done.stdout.strip() or f"status {done.returncode}").splitlines()
    return next((line for line in said if line.startswith("ERROR")), said[-1]) if done.returncode else ""


class Peer:
    """A peer script at work: one JSON line in, one out."""

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
        """Return the answer to one line; PeerMissing where the script has ended."""
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

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """End the script."""
        if self._process.stdin is not None:
            self._process.stdin.close()
        if self._process.stdout is not None:
            self._process.stdout.close()
        self._process.wait()
