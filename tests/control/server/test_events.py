"""What serve says: each event once, in order; and a terminal that stopped reading stops nothing."""

from __future__ import annotations

import os
import pty
import subprocess
import sys
import time
from dataclasses import replace

import pytest

from control.safety.modes import Mode
from control.server.printer import Printer
from control.server.process import Events
from hil_mocks.scenario import GripperTable
from tests.cell import GRIPPER, RIGHT, Cell, holding_cell, restarted, scenario
from tests.kinds import ON_BOARDS


def heard_by(cell: Cell) -> list[str]:
    """Grows while cycles run."""
    said: list[str] = []
    events = Events(cell.runtime, said.append)
    cell.assembly.requests.events = events
    cell.watchers.append(events.look)
    return said


@pytest.mark.usefixtures("nobody_below")
def test_a_move_that_is_stopped_and_a_shutdown_are_told_in_order(cell: Cell) -> None:
    heard = heard_by(cell)
    cell.start_move((0.2, -0.4, 0.3))
    cell.run(0.2)
    cell.client.stop()
    cell.client.off()
    run = cell.runtime.run_number
    assert [line.split(",")[0] for line in heard] == [
        "client 0: move_joints",
        f"motion {run} begun",
        "client 0: stop",
        "stopping",
        "stopped: holding",
        "client 0: off",
        "shutdown: holding until the arm is at rest",
        "windings shorted: the arm may sink",
        "shutdown: lowering: windings shorted until the arm is at rest",
        *heard[9:-1],
        "drives off",
    ]
    assert all(line.startswith("shutdown: ") for line in heard[9:-1])


def test_a_fault_is_told_with_its_remedy_and_its_acknowledgement(cell: Cell) -> None:
    heard = heard_by(cell)
    cell.inject("over_temperature", "motor3")
    cell.until_fault(0.5)
    cell.run(0.1)
    assert heard[0] == "FAULT: windings shorted"
    assert heard[1].startswith("FAULT joint 3: its drive reports a fault: over-temperature; let it cool")
    assert len(heard) == 2
    cell.rig.clear_faults()
    cell.run(0.1)
    cell.client.acknowledge()
    assert heard[2:] == ["client 0: acknowledge", "windings shorted", "faults acknowledged"]


def test_a_second_fault_acknowledges_nothing(cell: Cell) -> None:
    heard = heard_by(cell)
    for joint in (3, 1):
        cell.inject("over_temperature", f"motor{joint}")
        cell.run(0.5)
    assert [line.split(":")[0] for line in heard] == ["FAULT", "FAULT joint 3", "FAULT joint 1"]


@pytest.mark.usefixtures("nobody_below")
def test_a_pause_a_jog_and_hand_guiding_are_told_as_what_they_are(cell: Cell) -> None:
    heard = heard_by(cell)
    took_s = cell.start_move((0.2, -0.4, 0.3), speed=0.2)
    run = cell.runtime.run_number
    cell.run(0.1)
    cell.client.pause()
    cell.run(0.5)
    cell.client.resume()
    cell.until(lambda: cell.mode is Mode.HOLDING, 10.0)
    cell.client.jog(joint=1, by_rad=0.02)
    for weightless in (True, False):
        cell.client.guide(weightless=weightless)
        cell.run(0.01)
        cell.client.hold()
        cell.run(0.01)
    assert [line for line in heard if not line.startswith("client 0: ")] == [
        f"motion {run} begun, {took_s:.1f} s",
        "paused",
        "resumed",
        f"motion {run} ended: holding",
        "jog begun",
        "jog ended: holding",
        "hand-guiding: the drives carry the arm's weight",
        "holding",
        "hand-guiding: drives open",
        "holding",
    ]


def test_a_gripper_says_what_it_does_and_that_it_has_lost_what_it_held() -> None:
    with holding_cell(scenario(gripper=GripperTable()), replace(RIGHT, gripper=GRIPPER)) as cell:
        heard = heard_by(cell)
        cell.rig.set_object(0.025)
        cell.client.grip("open")
        cell.client.grip("close")
        cell.rig.set_object(None)
        cell.run(1.0)
        assert [line for line in heard if line.startswith("gripper: ")] == [
            "gripper: on its way",
            "gripper: open",
            "gripper: on its way",
            "gripper: holds something",
            "gripper: on its way; it has lost what it held",
            "gripper: closed, nothing held; it has lost what it held",
        ]


def test_an_arm_that_its_boards_hold_is_told_at_the_start() -> None:
    on = ON_BOARDS["dynamixel"]
    with (
        holding_cell(scenario(q_rad=None), on.arm, period_s=on.period_s) as before,
        restarted(before, on.arm, on.period_s) as held,
    ):
        held.run(0.1)
        assert heard_by(held) == ["held by its boards: `armwright enable` takes it over, `armwright off` lets it go"]


def test_homing_is_told_and_polling_is_not() -> None:
    with holding_cell() as cell:
        heard = heard_by(cell)
        cell.client.status()
        cell.client.home(again=True)
        assert heard == [
            "client 0: home",
            "homing begun",
            "not homed: zeros unknown",
            "homing ended: holding",
            "every joint is homed",
        ]


def test_a_client_that_hangs_up_is_told_where_its_motion_ran(cell: Cell) -> None:
    heard = heard_by(cell)
    cell.start_move((0.2, -0.4, 0.3))
    cell.run(0.1)
    cell.client.close()
    assert heard[-1] == "client 0 disconnected: its motion is stopped"


def test_what_is_said_is_printed_before_the_printer_ends() -> None:
    program = "from control.server.printer import Printer; p = Printer(); p.say('one\\n'); p.say('two\\n'); p.close()"
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, timeout=300)
    assert ended.stdout == "one\ntwo\n"


def test_a_plain_ascii_terminal_gets_what_is_printed_in_ascii() -> None:
    program = "from control.server.printer import Printer; p = Printer(); p.say('größe 5 °C → off\\n'); p.close()"
    ended = subprocess.run(
        [sys.executable, "-c", program],
        env=os.environ | {"PYTHONIOENCODING": "ascii"},
        capture_output=True,
        check=True,
        timeout=300,
    )
    assert ended.stdout == b"gr\\xf6\\xdfe 5 degC -> off\n"


def test_a_terminal_that_nobody_reads_keeps_neither_the_loop_nor_its_end_waiting() -> None:
    screen, terminal = pty.openpty()
    kept = os.dup(1)
    os.dup2(terminal, 1)
    try:
        printer = Printer()
    finally:
        os.dup2(kept, 1)
        os.close(kept)
    try:
        busy_s = time.process_time()
        for _ in range(5000):  # far more than a terminal and a pipe take
            printer.say("x" * 200 + "\n")
        printer.close()
        assert time.process_time() - busy_s < 30.0
    finally:
        os.close(terminal)
        os.close(screen)
