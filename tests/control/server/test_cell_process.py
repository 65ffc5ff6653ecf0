"""`armwright serve --cell` as a process of its own, against mocks of two arms in real time."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import pytest

from control.model.cell import save_cell
from control.recording.cell_folder import join, recordings_in
from control.recording.reading import Recording
from control.server.channel import SocketChannel
from control.server.client import ArmClient
from hil_mocks.rig import RealTimeCell
from procedures.mock import wired_to
from tests.control.server.test_process import SCENARIO, LIMIT_s, enable, patient, started
from tests.pair import PAIR

pytestmark = pytest.mark.realtime


def until(is_so: Callable[[], bool]) -> None:
    end_s = time.monotonic() + LIMIT_s
    while not is_so():
        assert time.monotonic() < end_s, "not so within the limit"
        time.sleep(0.05)


@dataclass
class Served:
    """Mocks of both arms, their runtime, and a client for each arm."""

    rig: RealTimeCell
    process: subprocess.Popen[str]
    sockets: Mapping[str, Path]
    clients: Mapping[str, ArmClient]

    def begin_to_move(self) -> None:
        """Start a slow motion of both that outlives its client, and wait until both move."""
        for client in self.clients.values():
            enable(client)
            client.home()
        before = {name: self.rig.joint_rad(name)[0] for name in self.clients}
        moves = {"left": {"q_rad": [1.0, 0.15, 0.75], "speed": 0.1}, "right": {"q_rad": [-1.0, 0.15, 0.75]}}
        self.clients["left"].ask("move_together", moves=moves, detached=True)
        until(lambda: all(abs(self.rig.joint_rad(name)[0] - q) > 0.02 for name, q in before.items()))


@pytest.fixture
def served(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Served]:
    monkeypatch.setenv("ARMWRIGHT_RUNTIME_DIR", str(tmp_path / "armwright"))
    (tmp_path / "scenario.toml").write_text(SCENARIO)
    with RealTimeCell("pair", tmp_path / "scenario.toml") as rig:
        arms = [patient(wired_to(placed.arm, rig.ports[placed.name])) for placed in PAIR.arms]
        file, log = save_cell(PAIR.with_arms(arms), tmp_path), tmp_path / "log"
        command = [sys.executable, "-m", "console.main", "serve", "--cell", str(file), "--log", str(log)]
        sockets = {name: tmp_path / "armwright" / f"{name}.sock" for name in PAIR.names}
        process = started([*command, "--rate", "100"], sockets["right"])
        try:
            clients = {name: ArmClient(SocketChannel(path, LIMIT_s)) for name, path in sockets.items()}
            yield Served(rig, process, sockets, clients)
            for client in clients.values():
                client.close()
        finally:
            process.kill()
            process.communicate()


def test_both_arms_move_ctrl_c_stops_both_and_their_recordings_belong_together(served: Served, tmp_path: Path) -> None:
    served.begin_to_move()
    recordings = [Path(client.status()["recording"]) for client in served.clients.values()]
    os.killpg(served.process.pid, signal.SIGINT)
    out, error = served.process.communicate(timeout=LIMIT_s)
    assert (served.process.returncode, error) == (0, "")
    for name in PAIR.names:
        assert 0 < out.index(f"{name}: stopping") < out.index(f"{name}: drives off")
    assert not any(path.exists() for path in served.sockets.values())
    assert [Recording.open(path).header["cell"]["arm"] for path in recordings] == ["left", "right"]
    assert recordings[0].parent == recordings[1].parent
    assert join(recordings_in(recordings[0].parent), tmp_path / "cell.csv") > 50
