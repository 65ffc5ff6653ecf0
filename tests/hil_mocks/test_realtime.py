"""The mock arm in a process of its own: it speaks, obeys, and goes away."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys

import pytest

from firmware_iface.encoder.board import EncoderBoard
from firmware_iface.serial_link import open_serial
from hil_mocks.errors import RigError
from hil_mocks.rig import RealTimeRig
from hil_mocks.scenario import FaultTable
from hil_mocks.serve import Pacer

LIMIT_s = 300.0  # a busy machine is slow, a broken program never ends


def test_a_punctual_pacer_runs_one_tick_a_period() -> None:
    pacer = Pacer(1e-3, 100.0)
    assert [pacer.due(100.0 + 1e-3 * k + 1e-6) for k in range(5)] == [0, 1, 1, 1, 1]
    assert pacer.overruns == 0


def test_a_late_pacer_catches_up_within_its_bound_and_drops_the_rest() -> None:
    pacer = Pacer(1e-3, 0.0)
    assert pacer.due(0.0401) == 40
    assert pacer.overruns == 0
    assert pacer.due(0.2401) == 50
    assert (pacer.overruns, pacer.lost_s) == (1, pytest.approx(0.15))
    assert pacer.due(0.2411) == 1


@pytest.mark.realtime
def test_a_mock_arm_in_real_time_speaks_obeys_and_ends() -> None:
    with RealTimeRig("right", "demo") as rig:
        link = open_serial(rig.encoder_urls[0], 1_000_000)
        assert EncoderBoard(link, rig.clock, "enc0").identify(2.0).channels == 3
        link.close()
        assert rig.hand.state == "away"
        x, y, z = rig.tip_m()
        assert rig.hand.seat((x, y, z)) == pytest.approx(0.1, abs=0.05)
        rig.hand.let_go()
        rig.inject(FaultTable("silent", "motor1"))
        rig.clear_faults()
        rig.set_payload(0.5)
        assert len(rig.joint_rad()) == 3
        assert rig.status()["time_s"] > 0.0
        hasty = socket.socket(socket.AF_UNIX)
        hasty.connect(rig._socket.getpeername())
        hasty.sendall(b'{"do": "truth"}\n' * 50)
        hasty.close()  # before it has read an answer: nobody else is concerned
        assert rig.status()["time_s"] > 0.0
        with pytest.raises(RigError, match='unknown request "dance"'):
            rig.ask("dance")
        with pytest.raises(RigError, match='no board "motor7"'):
            rig.inject(FaultTable("silent", "motor7"))


@pytest.mark.realtime
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_ends_it_cleanly(number: signal.Signals) -> None:
    rig = RealTimeRig("right")
    os.kill(rig.pid, number)
    assert rig.wait_for_end(LIMIT_s) == 0
    rig.close()


@pytest.mark.realtime
def test_it_ends_when_its_parent_dies() -> None:
    rig = RealTimeRig("right")
    rig.close_pipe()
    assert rig.wait_for_end(LIMIT_s) == 0
    rig.close()


@pytest.mark.realtime
def test_a_bad_scenario_is_one_line_and_exit_status_2() -> None:
    command = [sys.executable, "-m", "hil_mocks.serve", "--scenario", "none.toml"]
    ended = subprocess.run(command, capture_output=True, text=True, check=False, stdin=subprocess.DEVNULL)
    assert ended.returncode == 2
    assert ended.stderr.startswith("scenario none.toml: there is no such file")
    with pytest.raises(RigError, match=r"its process ended at once: scenario none\.toml"):
        RealTimeRig("right", "none.toml")
