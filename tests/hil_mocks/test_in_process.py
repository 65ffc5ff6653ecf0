"""The stepped mock's wires within the process: the same bytes through the same drivers as over a pty and a virtual bus."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import pytest

from control.hardware.connect import connect
from control.model.arm import CanBus
from control.model.description import load_arm
from control.server.assemble import assemble
from control.server.client import ArmClient
from control.server.in_process import InProcessChannel
from firmware_iface.can_link import open_can
from firmware_iface.errors import LinkLost, PortMissing
from firmware_iface.serial_link import open_serial
from hil_mocks.protocol_mock import CAN_INTERFACE, SerialLine, register
from hil_mocks.rig import SteppedRig
from hil_mocks.scenario import Start, load_scenario

PERIOD_s = 0.002
Heard = list[tuple[str, object]]


def tapped(rig: SteppedRig) -> Heard:
    """Everything that the boards get and send from now on, in order."""
    heard: Heard = []

    def tap(name: str) -> None:
        work: Callable[..., Any] = getattr(rig.robot, name)

        def noting(*given: Any) -> Any:
            result = work(*given)
            if name != "serial_outgoing" or result:
                heard.append((name, (given, result)))
            return result

        setattr(rig.robot, name, noting)

    for name in ("from_host_serial", "from_host_can", "serial_outgoing"):
        tap(name)
    return heard


def life_of(through_kernel: bool) -> Heard:
    """Enable, home, move: what went over the wires."""
    arm = load_arm("right")
    scenario = msgspec.structs.replace(load_scenario("demo"), start=Start(homed=True))
    with SteppedRig(arm, scenario, through_kernel) as rig:
        heard = tapped(rig)
        boards = tuple(replace(board, port=url) for board, url in zip(arm.encoder_boards, rig.encoder_urls, strict=True))
        bus = CanBus(rig.can_interface, rig.can_channel, options=rig.can_options)
        wired = replace(arm, encoder_boards=boards, can=bus)
        connection = connect(wired, rig.clock, PERIOD_s, None)
        assembly = assemble(arm, connection.hardware, PERIOD_s, stopwatch_s=rig.clock.now_s)
        client = ArmClient(InProcessChannel(assembly, rig.clock))
        client.enable()
        client.home()
        client.move_joints((0.1, -0.9, 0.2))
        client.off(quit_runtime=True)
        connection.close()
    return heard


@pytest.mark.usefixtures("nobody_below")
def test_both_ways_carry_identical_bytes_at_identical_times() -> None:
    through_kernel, in_process = life_of(True), life_of(False)
    assert len(in_process) > 3_000
    assert in_process == through_kernel


def test_a_line_that_vanishes_is_lost_and_cannot_be_opened() -> None:
    register()
    line = SerialLine("vanishing")
    link = open_serial(line.path, 1_000_000)
    line.write(b"abc")
    assert link.read() == b"abc"
    line.vanish()
    with pytest.raises(LinkLost, match=r"mock://vanishing: lost: unplugged"):
        link.read()
    with pytest.raises(LinkLost):
        link.write(b"x")
    link.close()
    with pytest.raises(PortMissing, match=r"no mock serial line mock://vanishing"):
        open_serial(line.path, 1_000_000)
    line.close()


def test_a_line_belongs_to_one_host_which_hears_nothing_from_before_and_not_more_than_a_tty_holds() -> None:
    register()
    line = SerialLine("taken")
    line.write(b"from before")
    first = open_serial(line.path, 1_000_000)
    assert first.read() == b""
    with pytest.raises(PortMissing, match="in use"):
        open_serial(line.path, 1_000_000)
    line.write(bytes(5000))
    assert 0 < len(first.read()) <= 3500
    first.close()
    open_serial(line.path, 1_000_000).close()
    line.close()


def test_a_node_that_left_the_bus_neither_sends_nor_hears(tmp_path: Path) -> None:
    register()
    ours, theirs = (open_can(CAN_INTERFACE, str(tmp_path)) for _ in range(2))
    ours.send(0x101, b"x")
    assert theirs.receive() == [(0x101, b"x")]
    assert ours.receive() == []
    theirs.close()
    ours.send(0x102, b"y")
    for use in (lambda: theirs.send(1, b""), theirs.receive):
        with pytest.raises(LinkLost, match="closed"):
            use()
    ours.close()
