"""ODrive's own description of its messages (the DBC of firmware 0.6.10, in the package odrive-can) reads ours and the mock's."""

import importlib.util
import math
from pathlib import Path
from typing import Any

import cantools
import pytest

from firmware_iface.odrive import wire
from firmware_iface.odrive.wire import AxisState, Error, OdriveCommand, OdriveControlMode
from hil_mocks.devices.odrive import OdriveMock, OdriveSetup

NODE = 5
PACKAGE = importlib.util.find_spec("odrive_can")
if PACKAGE is None or PACKAGE.origin is None:
    pytest.skip("pip install odrive-can: it brings ODrive's DBC", allow_module_level=True)
DBC = Path(PACKAGE.origin).parent / "dbc" / "odrive-cansimple-0.6.10.dbc"


@pytest.fixture(scope="module")
def database() -> Any:
    return cantools.database.load_file(DBC)


def read(database: Any, frame: wire.Frame) -> tuple[str, dict[str, Any]]:
    message = database.get_message_by_frame_id(frame[0])
    return message.name.removeprefix(f"Axis{NODE}_"), message.decode(
        frame[1], decode_choices=False, allow_truncated=True
    )


@pytest.mark.parametrize(
    ("frame", "name", "values"),
    [
        (wire.axis_state(NODE, AxisState.CLOSED_LOOP_CONTROL), "Set_Axis_State", {"Axis_Requested_State": 8}),
        (
            wire.controller_mode(NODE, OdriveControlMode.POSITION),
            "Set_Controller_Mode",
            {"Control_Mode": 3, "Input_Mode": 1},
        ),
        (
            wire.position(NODE, -1.5, -2.5),
            "Set_Input_Pos",
            {"Input_Pos": -1.5, "Vel_FF": -2.5, "Torque_FF": 0.0},
        ),
        (wire.torque(NODE, 0.25), "Set_Input_Torque", {"Input_Torque": 0.25}),
        (wire.limits(NODE, 20.0, 8.0), "Set_Limits", {"Velocity_Limit": 20.0, "Current_Limit": 8.0}),
        (wire.clear_errors(NODE), "Clear_Errors", {"Identify": 0}),
    ],
)
def test_what_is_sent_is_read_by_the_vendors_description(
    database: Any, frame: wire.Frame, name: str, values: dict[str, float]
) -> None:
    assert read(database, frame) == (name, values)


def test_what_the_mock_sends_is_read_by_the_vendors_description(database: Any) -> None:
    mock = OdriveMock(OdriveSetup(NODE, 0.05, 8.0), lambda: 2.5)
    mock.tick(0.2, 1.25, 24.0)
    found = dict(read(database, frame) for frame in mock.outgoing)
    assert found["Heartbeat"]["Axis_Error"] == Error.WATCHDOG_TIMER_EXPIRED
    assert found["Heartbeat"]["Axis_State"] == AxisState.IDLE
    assert found["Get_Encoder_Estimates"]["Pos_Estimate"] == 2.5
    assert found["Get_Iq"]["Iq_Measured"] == 1.25
    assert found["Get_Bus_Voltage_Current"]["Bus_Voltage"] == 24.0
    assert math.isnan(found["Get_Temperature"]["Motor_Temperature"])
    assert found["Get_Error"] == {"Active_Errors": 0, "Disarm_Reason": Error.WATCHDOG_TIMER_EXPIRED}


def test_names_of_commands_and_errors_are_the_vendors(database: Any) -> None:
    heartbeat = database.get_message_by_name(f"Axis{NODE}_Heartbeat")
    choices = heartbeat.get_signal_by_name("Axis_Error").choices
    assert {int(error): error.name for error in Error} == {
        value: str(name) for value, name in choices.items() if value
    }
    known = {message.frame_id & 0x1F for message in database.messages if message.frame_id >> 5 == NODE}
    assert set(OdriveCommand) <= known
