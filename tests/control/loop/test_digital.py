"""Named pins on the mock's motor boards: set, read, wired, safe."""

from collections.abc import Iterator
from dataclasses import replace

import msgspec
import pytest

from control.model.end_effector import Digital
from control.safety.modes import Mode
from firmware_iface.errors import ConnectionFailed
from tests.cell import RIGHT, Cell, holding_cell, open_cell, scenario

PINS = (
    Digital("valve", 1, 0, "output"),
    Digital("lamp", 2, 7, "output", "high"),
    Digital("vacuum", 2, 1, "output", "keep"),
    Digital("part", 3, 2, "input"),
    Digital("door", 3, 3, "input"),
)
ARM = replace(RIGHT, digital=PINS)


@pytest.fixture
def cell() -> Iterator[Cell]:
    with holding_cell(scenario(wire={"valve": "part"}), ARM) as cell:
        cell.run(0.05)
        yield cell


def levels(cell: Cell) -> str:
    """Levels of all pins in their order, as the host sees them."""
    found = cell.client.status()["digital"]
    return "".join({None: "?", True: "1", False: "0"}[found[pin.name]["level"]] for pin in PINS)


def test_an_output_is_set_and_an_input_follows_its_wire_or_the_world(cell: Cell) -> None:
    assert levels(cell) == "01000"
    cell.client.set_output("valve", True)
    cell.rig.set_pin("door", True)
    assert cell.client.await_level("part", True, 0.2)
    assert levels(cell) == "11011"
    assert cell.rig.pins() == dict(zip((pin.name for pin in PINS), map(bool, (1, 1, 0, 1, 1)), strict=True))
    assert not cell.client.await_level("door", False, 0.1)


def test_an_output_is_set_while_the_arm_moves(cell: Cell) -> None:
    cell.start_move((0.3, -0.6, 0.2))
    cell.client.set_output("vacuum", True)
    cell.run(0.05)
    assert (levels(cell), cell.mode) == ("01100", Mode.MOVING)


def test_what_cannot_be_set_is_refused_in_words(cell: Cell) -> None:
    assert "is an input" in cell.refusal(do="digital", name="part", level=True)
    assert "valve, lamp, vacuum" in cell.refusal(do="digital", name="pump", level=True)
    assert "true or false" in cell.refusal(do="digital", name="valve", level=1)
    with open_cell() as bare:
        assert "add a [[digital]]" in bare.refusal(do="digital", name="valve", level=True)


@pytest.mark.parametrize("end", ["fault", "held fault", "the host is gone"])
def test_outputs_go_to_their_safe_levels_and_stay_there(cell: Cell, end: str) -> None:
    for name, level in (("valve", True), ("lamp", False), ("vacuum", True)):
        cell.client.set_output(name, level)
    cell.run(0.05)
    assert levels(cell) == "10110"
    if end == "the host is gone":
        cell.rig.clock.wait_until_s(cell.rig.clock.now_s() + 0.4)
        assert list(cell.rig.pins().values())[:3] == [False, True, True]
        return
    cell.inject("over_temperature" if end == "fault" else "stuck_joint", "motor1")
    if end == "held fault":
        cell.start_move((1.0, -0.6, 0.2))
    cell.until_fault(1.0)
    cell.run(0.1)
    assert list(cell.rig.pins().values())[:3] == [False, True, True]
    assert "enable first" in cell.refusal(do="digital", name="valve", level=True)
    cell.rig.clear_faults()
    cell.client.acknowledge()
    cell.client.enable()
    cell.run(0.1)
    assert levels(cell) == "01100"
    cell.client.set_output("valve", True)
    cell.run(0.05)
    assert levels(cell) == "11110"


def test_outputs_are_not_set_while_the_drives_are_off() -> None:
    with open_cell(arm=ARM) as off:
        assert "enable first" in off.refusal(do="digital", name="valve", level=True)
        off.run(0.05)
        assert levels(off) == "00000"  # no board was told yet what its pins are
        off.client.enable()
        off.run(0.05)
        assert levels(off) == "01000"


def test_levels_of_a_silent_board_are_unknown(cell: Cell) -> None:
    cell.inject("silent", "motor3")
    cell.run(0.3)
    assert levels(cell).endswith("??")


def test_boards_that_lack_pins_are_refused_before_anything_moves() -> None:
    for pins, what in ((0, "has no digital pins"), (4, "has 4 digital pins, 0 to 3, but arm.toml names pin 7")):
        real = scenario()
        older = msgspec.structs.replace(real.motor_board, digital_pins=pins)
        with pytest.raises(ConnectionFailed, match=what), open_cell(msgspec.structs.replace(real, motor_board=older), ARM):
            pass
