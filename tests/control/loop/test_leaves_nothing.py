"""No mode, fault, board, client or request leaves anything for the garbage collector, which the loop's process has switched off.

What leaks a little in every cycle shows in some hundred of them; at night there are 20,000, and memory is looked at, too.
"""

from __future__ import annotations

import os
import socket
from collections.abc import Callable
from pathlib import Path

import pytest

from control.hardware.boards import LOOK_AGAIN_S
from control.safety.modes import Mode
from control.server.server import CLIENT_LIMIT, STOP_PLACES, Server
from firmware_iface.errors import LinkLost
from hil_mocks.firmware import compiler
from procedures.drills.catalogue import COMMANDS, NONSENSE
from tests.cell import PERIOD_S, Cell, holding_cell, open_cell, scenario
from tests.kinds import ON_BOARDS
from tests.leftovers import nothing_left_for_the_collector
from tests.pair import PAIR, holding_pair

FEW, MANY = 60, 20_000  # cycles
WARM = 260  # until the recorder keeps as many rows as it ever does
NIGHT = pytest.mark.nightly
UPRIGHT = (0.0, -0.8, 0.2)

Act = Callable[[Cell, int], object]


def nothing(cell: Cell, number: int) -> None:
    """Nobody does anything."""


def flat(cell: Cell, cycles: int, act: Act = nothing) -> set[Mode]:
    """Run cycles, with `act` between them; nothing is left, and of many nothing has grown. The modes that were seen."""
    period_s, begun_kB, seen = cell.runtime.period_s, 0, {cell.mode}
    with nothing_left_for_the_collector():
        for number in range(cycles):
            act(cell, number)
            cell.run(period_s)
            seen.add(cell.mode)
            if number == cycles // 4:
                begun_kB = resident_kB()
    if cycles >= MANY:
        assert resident_kB() - begun_kB < 256  # a leak of 20 bytes a cycle is 300 kB
    return seen


def resident_kB() -> int:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") // 1024


# ---- modes


def paused(cell: Cell) -> None:
    cell.start_move((0.8, -0.8, 0.2))
    cell.run(0.1)
    cell.client.pause()


def moving(cell: Cell, number: int) -> None:
    """To and fro, jogged, stopped, homed a little: whatever the mode lets begin."""
    to_rad = [0.2 if number % 400 < 200 else -0.2, -0.8, 0.2]
    cell.channel.request({"do": "move_joints", "q_rad": to_rad, "speed": 1.0})


def stopping(cell: Cell, number: int) -> None:
    moving(cell, number)
    if number % 50 == 49:
        cell.client.ask("stop")


def jogging(cell: Cell, number: int) -> None:
    speed_rad_s = 0.2 if number % 400 < 200 else -0.2
    cell.channel.request({"do": "jog", "joint_speed_rad_s": [speed_rad_s, 0.0, 0.0]})


def homing(cell: Cell, number: int) -> None:
    cell.channel.request({"do": "home", "again": True})
    if number % 300 == 299:
        cell.client.ask("stop")


def off_and_on(cell: Cell, number: int) -> None:
    if number % 40 == 0:
        cell.channel.request({"do": "enable" if number % 800 < 400 else "off"})


@pytest.mark.parametrize("cycles", [FEW, pytest.param(MANY, marks=NIGHT)])
@pytest.mark.parametrize(
    ("mode", "begin", "act"),
    [
        (Mode.BRAKED, lambda cell: cell.client.ask("brake"), nothing),
        (Mode.HOLDING, lambda cell: None, nothing),
        (Mode.PAUSED, paused, nothing),
        (Mode.GUIDING, lambda cell: cell.client.guide(weightless=True), nothing),
        (Mode.MOVING, lambda cell: None, moving),
        (Mode.STOPPING, lambda cell: None, stopping),
        (Mode.JOGGING, lambda cell: None, jogging),
        (Mode.HOMING, lambda cell: None, homing),
        (Mode.OFF, lambda cell: cell.client.off(), off_and_on),
    ],
)
@pytest.mark.usefixtures("nobody_below")
def test_no_mode_leaves_anything(mode: Mode, begin: Callable[[Cell], object], act: Act, cycles: int) -> None:
    with holding_cell(scenario(UPRIGHT)) as cell:
        begin(cell)
        if cycles >= MANY:
            cell.run(WARM * PERIOD_S)
        assert mode in flat(cell, cycles, act)


# ---- boards


def acknowledging(cell: Cell, number: int) -> None:
    if number % 10 == 9:
        cell.channel.request({"do": "acknowledge"})
    elif number % 20 == 10:
        cell.channel.request({"do": "enable"})


def going_off_the_bus(cell: Cell, number: int) -> None:
    """The host's controller says so again and again: as a bus that is gone, for reading."""
    cell.rig.wires.bus_off()
    acknowledging(cell, number)


AT_EACH_CHANGE = ("reference", "odrive", "roboclaw")  # one each of a stream, of frames, of questions


@pytest.mark.parametrize(
    ("kind", "cycles"), [(kind, 30) for kind in AT_EACH_CHANGE] + [pytest.param(kind, MANY, marks=NIGHT) for kind in ON_BOARDS]
)
def test_no_board_that_is_silent_gone_or_back_leaves_anything(kind: str, cycles: int) -> None:
    on_boards = ON_BOARDS[kind]
    if on_boards.firmware == "c" and compiler() is None:
        pytest.skip("no C compiler: apt-get install gcc")
    mock = scenario(q_rad=None, homed=True, firmware=on_boards.firmware)
    with holding_cell(mock, on_boards.arm, period_s=on_boards.period_s) as cell:
        cell.run((WARM if cycles >= MANY else 10) * on_boards.period_s)
        cell.inject("silent", on_boards.first)
        flat(cell, cycles, acknowledging)
        assert cell.mode is Mode.FAULT
        cell.rig.clear_faults()
        flat(cell, cycles, acknowledging)
        for wire in cell.rig.wires.serial:
            wire.vanish()
        with cell.rig.wires.full_bus():
            flat(cell, cycles, going_off_the_bus)
            assert ("link", "links") in cell.faults
        cell.rig.wires.plug_in()
        flat(cell, cycles, acknowledging)


def test_a_link_that_is_gone_is_asked_ten_times_a_second_and_the_boards_on_others_go_on_hearing_the_loop(
    cell: Cell, monkeypatch: pytest.MonkeyPatch
) -> None:
    board, asked = cell.connection.encoders[0], []

    def gone() -> None:
        asked.append(cell.rig.clock.now_s())
        raise LinkLost("serial port /dev/ttyACM0: gone")

    monkeypatch.setattr(board, "update", gone)
    cell.run(1.0)
    assert 9 <= len(asked) <= 1.0 / LOOK_AGAIN_S + 1
    feedback, now_s = cell.connection.hardware.feedback, cell.rig.clock.now_s()
    assert cell.faults == [("link", "links")]
    assert min(feedback.reply_at_s) > now_s - 0.01
    assert feedback.drive_faults == [0, 0, 0], "their watchdogs have not bitten"
    monkeypatch.undo()
    cell.run(LOOK_AGAIN_S + 0.01)
    assert min(feedback.reported_at_s) > now_s
    cell.client.acknowledge()
    cell.client.hold()
    assert cell.mode is Mode.HOLDING


def test_what_two_boards_say_in_one_cycle_is_heard_of_both(cell: Cell) -> None:
    """A restart that hid behind another board's error would leave a zero that is none."""
    cell.inject("board_reset", "encoder")
    cell.rig.wires.bus_off()
    cell.until_fault(0.1)
    cell.run(0.02)
    assert not cell.runtime.monitor.is_homed


# ---- requests and clients


@pytest.mark.parametrize("rounds", [1, pytest.param(400, marks=NIGHT)])
def test_no_request_leaves_anything(cell: Cell, rounds: int) -> None:
    requests = (
        *NONSENSE,
        *COMMANDS,
        {"do": "acknowledge"},
        {"do": "fault_cycles"},
        {"do": "status", "arm": "another"},
        {"do": "gripper", "action": "open"},
        {"do": "digital", "name": "lamp", "level": True},
        {"do": "tool", "name": "no"},
        {"do": "move_joints", "q_rad": [0.0, -1.9, -0.6]},
        {"do": "jog_on"},
        {"do": "average", "duration_s": 0.01},
        {"do": "average_result"},
        {"do": "stop"},
        {"do": "control", "take": False},
        {"do": "override", "fraction": 1.0},
    )
    flat(cell, rounds * len(requests), lambda cell, number: cell.channel.request(requests[number % len(requests)]))


@pytest.mark.parametrize("clients", [40, pytest.param(4000, marks=NIGHT)])
def test_no_client_that_comes_and_goes_leaves_anything(tmp_path: Path, clients: int) -> None:
    """Too many at once, half lines, no JSON, endless lines, and those that go without reading."""
    path = tmp_path / "arm.sock"
    says = (b'{"do": "mode"}\n', b"no JSON\n", b'{"do": "half', b"[1, 2]\n\xff\n", bytes(9000), b'{"do": "stop"}\n' * 9)
    with open_cell() as cell:
        server = Server(path, cell.assembly.requests.handle, cell.assembly.requests.on_gone)
        waiting: list[socket.socket] = []

        def come_and_go(cell: Cell, number: int) -> None:
            client = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
            client.connect(str(path))
            client.setblocking(False)
            client.send(says[number % len(says)])
            waiting.append(client)
            if len(waiting) > number % (CLIENT_LIMIT + 2 * STOP_PLACES):
                waiting.pop(0).close()
            server.poll()

        try:
            come_and_go(cell, 0)
            flat(cell, clients, come_and_go)
        finally:
            server.close()
            for client in waiting:
                client.close()


def test_two_arms_on_one_runtime_leave_nothing() -> None:
    """Moved and stopped together, one stopped by the other's fault, and refused beside it."""
    with holding_pair() as pair:
        begun = {"do": "move_together", "moves": {arm: {"q_rad": [0.1, 0.1, 0.7]} for arm in pair.clients}}
        requests = (begun, {"do": "stop"}, begun, {"do": "acknowledge"}, {"do": "status"}, {"do": "home", "again": True})
        seen = set()
        with nothing_left_for_the_collector():
            for number in range(80):
                if number == 40:
                    pair.rig.wires.serial[0].vanish()
                for channel in pair.channels.values():
                    channel.request(requests[number // 4 % len(requests)])
                pair.run(pair.assembly.runtime.period_s)
                seen |= {pair.mode(arm) for arm in PAIR.names}
        assert {Mode.MOVING, Mode.STOPPING, Mode.FAULT} <= seen


# ---- errors of the program itself


def test_no_error_in_the_loop_leaves_anything(cell: Cell, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*arguments: object, **keys: object) -> None:
        raise RuntimeError("a bug")

    monkeypatch.setattr(cell.runtime.parts.measurement, "update", broken)
    flat(cell, 30)
    assert ("internal", "control loop") in cell.faults
