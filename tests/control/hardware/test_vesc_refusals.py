"""What is refused of an arm on VESCs before anything moves, and how a VESC turns to an angle."""

from dataclasses import replace

import pytest

from control.errors import ArmError
from firmware_iface.errors import ConnectionFailed
from firmware_iface.vesc import wire
from hil_mocks.devices.vesc import VescMock, VescSetup
from procedures.mock.on_boards import on_boards
from tests.cell import RIGHT, open_cell, scenario, with_drives

ON_VESCS = on_boards(RIGHT, "vesc")


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"pid": replace(ON_VESCS.drives[0].pid, mode="position")}, "a range below half a turn"),
        ({"encoder_counts_per_rev": 2048}, "encoder_counts_per_rev = 18000, got 2048"),
    ],
)
def test_what_a_vesc_cannot_do_is_refused_when_it_is_connected(changes: dict[str, object], said: str) -> None:
    arm = with_drives(ON_VESCS, **changes)
    with pytest.raises((ConnectionFailed, ArmError), match=said), open_cell(scenario(), arm, period_s=0.005):
        pass


def test_a_vesc_turns_to_an_angle_the_shorter_way() -> None:
    mock = VescMock(VescSetup(5, 0.2, 8.0), lambda: 0.9)
    for moment, (count, sign) in enumerate(
        ((wire.COUNTS_PER_TURN // 10, 1.0), (wire.COUNTS_PER_TURN // 2, -1.0))
    ):
        mock.receive(*wire.position(5, count), now_s=0.001 * moment)
        mock.tick(0.001 * (1 + moment), 0.0, 24.0)
        kind, volts = mock.output
        assert kind == "voltage"
        assert volts * sign > 0.0
