"""ODrive's own description of its messages (the DBC of firmware 0.6.10, in the package odrive-can) reads ours and the mock's."""

import importlib.util
import math
from itertools import pairwise
from pathlib import Path
from typing import Any

import cantools
import pytest

from firmware_iface import odrive
from firmware_iface.odrive import AxisState, Error, OdriveCommand, OdriveControlMode
from hil_mocks.devices.odrive import OdriveMock, OdriveSetup

NODE = 5
PACKAGE = importlib.util.find_spec("odrive_can")
if PACKAGE is None or PACKAGE.origin is None:
    pytest.skip("pip install odrive-can: it brings ODrive's DBC", allow_module_level=True)
DBC = Path(PACKAGE.origin).parent / "dbc" / "odrive-cansimple-0.6.10.dbc"


@pytest.fixture(scope="module")
def database() -> Any:
    return cantools.database.load_file(DBC)


def read(database: Any, frame: odrive.Frame) -> tuple[str, dict[str, Any]]:
    message = database.get_message_by_frame_id(frame[0])
    return message.name.removeprefix(f"Axis{NODE}_"), message.decode(frame[1], decode_choices=False, allow_truncated=True)


@pytest.mark.parametrize(
    ("frame", "name", "values"),
    [
        (odrive.axis_state(NODE, AxisState.CLOSED_LOOP_CONTROL), "Set_Axis_State", {"Axis_Requested_State": 8}),
        (odrive.controller_mode(NODE, OdriveControlMode.POSITION), "Set_Controller_Mode", {"Control_Mode": 3, "Input_Mode": 1}),
        (odrive.position(NODE, -1.5, -2.5), "Set_Input_Pos", {"Input_Pos": -1.5, "Vel_FF": -2.5, "Torque_FF": 0.0}),
        (odrive.torque(NODE, 0.25), "Set_Input_Torque", {"Input_Torque": 0.25}),
        (odrive.limits(NODE, 20.0, 8.0), "Set_Limits", {"Velocity_Limit": 20.0, "Current_Limit": 8.0}),
        (odrive.clear_errors(NODE), "Clear_Errors", {"Identify": 0}),
    ],
)
def test_what_is_sent_is_read_by_the_vendors_description(
    database: Any, frame: odrive.Frame, name: str, values: dict[str, float]
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


HOST = 63  # all axes
# What the host may send, and what then is to be seen of the mock a control period later: a message that it is asked for.
OBEYED: dict[str, tuple[dict[str, float], str, dict[str, float]]] = {
    "Estop": ({}, "Heartbeat", {"Axis_Error": Error.ESTOP_REQUESTED}),
    "Address": ({"Node_ID": 7, "Serial_Number": int.from_bytes(b"ODRV01", "little")}, "", {}),
    "Set_Axis_State": ({"Axis_Requested_State": 8}, "Heartbeat", {"Axis_State": 8}),
    "Set_Controller_Mode": ({"Control_Mode": 1, "Input_Mode": 1}, "", {}),
    "Set_Input_Pos": ({"Input_Pos": 2.5, "Vel_FF": 0, "Torque_FF": 0.125}, "Get_Torques", {"Torque_Target": 0.125}),
    "Set_Input_Vel": ({"Input_Vel": 1, "Input_Torque_FF": 0.25}, "Get_Torques", {"Torque_Target": 0.25}),
    "Set_Input_Torque": ({"Input_Torque": 0.5}, "Get_Iq", {"Iq_Setpoint": 10.0}),
    "Set_Limits": ({"Velocity_Limit": 3, "Current_Limit": 4}, "", {}),
    "Set_Traj_Vel_Limit": ({"Traj_Vel_Limit": 8}, "", {}),
    "Set_Traj_Accel_Limits": ({"Traj_Accel_Limit": 10, "Traj_Decel_Limit": 20}, "", {}),
    "Set_Traj_Inertia": ({"Traj_Inertia": 0.5}, "", {}),
    "Set_Absolute_Position": ({"Position": -4.0}, "Get_Encoder_Estimates", {"Pos_Estimate": -4.0}),
    "Set_Pos_Gain": ({"Pos_Gain": 7}, "", {}),
    "Set_Vel_Gains": ({"Vel_Gain": 0.5, "Vel_Integrator_Gain": 2}, "", {}),
    "Clear_Errors": ({"Identify": 0}, "Heartbeat", {"Axis_Error": 0}),
    "Reboot": ({"Action": 0}, "", {}),
    "Enter_DFU_Mode": ({}, "", {}),
}
ASKED: dict[str, dict[str, float]] = {
    "Get_Version": {"Fw_Version_Major": 0, "Fw_Version_Minor": 6, "Fw_Version_Revision": 10},
    "Heartbeat": {"Axis_State": 1},
    "Get_Error": {"Active_Errors": 0},
    "Get_Encoder_Estimates": {"Pos_Estimate": 2.5},
    "Get_Iq": {"Iq_Measured": 1.25},
    "Get_Temperature": {"FET_Temperature": 35.0},
    "Get_Bus_Voltage_Current": {"Bus_Voltage": 24.0},
    "Get_Torques": {"Torque_Estimate": 0.0625},
    "Get_Powers": {"Electrical_Power": 0.0},
}


class Axis:
    """A mock that sends nothing of its own, and is asked and told by the vendor's description."""

    def __init__(self, database: Any) -> None:
        self.database, self.now_s = database, 0.05
        self.mock = OdriveMock(OdriveSetup(NODE, 0.05, 8.0, periods_s=()), lambda: 2.5)
        self.tick()

    def tick(self, seconds: float = 0.001) -> None:
        for _ in range(round(seconds / 0.001)):
            self.now_s += 0.001
            self.mock.tick(self.now_s, 1.25, 24.0)

    def tell(self, name: str, **values: float) -> None:
        message = self.database.get_message_by_name(f"Axis{NODE}_{name}")
        given = {signal.name: values.get(signal.name, 0) for signal in message.signals}
        self.mock.receive(message.frame_id, message.encode(given), self.now_s)
        self.tick()

    def ask(self, name: str) -> dict[str, Any]:
        self.mock.receive(self.database.get_message_by_name(f"Axis{NODE}_{name}").frame_id, b"", self.now_s, is_remote=True)
        (frame,) = self.mock.outgoing
        self.mock.outgoing.clear()
        said, values = read(self.database, frame)
        assert said == name
        return values


def test_no_message_of_the_vendors_description_is_left_out(database: Any) -> None:
    offered = {message.name.removeprefix(f"Axis{NODE}_") for message in database.messages if message.frame_id >> 5 == NODE}
    assert offered == {*OBEYED, *ASKED, "RxSdo", "TxSdo"}


@pytest.mark.parametrize("name", ASKED)
def test_what_the_vendor_describes_is_told_when_it_is_asked_for(database: Any, name: str) -> None:
    axis = Axis(database)
    assert axis.ask(name).items() >= ASKED[name].items()


@pytest.mark.parametrize("name", OBEYED)
def test_what_the_vendor_describes_is_obeyed(database: Any, name: str) -> None:
    axis = Axis(database)
    given, seen, expected = OBEYED[name]
    if name == "Clear_Errors":
        axis.tell("Estop")
    before = dict(vars(axis.mock))
    trajectory, rate = dict(axis.mock._trajectory), axis.mock._motor.position_rate
    axis.tell(name, **given)
    axis.tick(0.003)
    if seen:
        assert axis.ask(seen).items() >= expected.items()
    else:
        now = vars(axis.mock)
        changed = {key for key in before if before[key] != now[key]} - {"_heard_s"}
        assert changed or trajectory != axis.mock._trajectory or rate != axis.mock._motor.position_rate


@pytest.mark.parametrize(("action", "kept"), [(0, 0), (1, 5), (2, 0)], ids=["restarted", "saved", "erased"])
def test_settings_are_written_and_read_by_their_numbers_and_last_when_they_are_saved(
    database: Any, action: int, kept: int
) -> None:
    axis = Axis(database)
    for opcode, value in ((1, 5), (0, 0)):
        axis.tell("RxSdo", Opcode=opcode, Endpoint_ID=300, Value=value)
        said = {"Reserved0": 0, "Endpoint_ID": 300, "Reserved1": 0, "Value": 5}
        assert read(database, axis.mock.outgoing.pop()) == ("TxSdo", said)
    axis.tell("Reboot", Action=action)
    axis.tick(0.2)
    axis.tell("RxSdo", Opcode=0, Endpoint_ID=300)
    assert read(database, axis.mock.outgoing.pop())[1]["Value"] == kept


def test_an_axis_is_found_by_its_serial_number_and_given_another_node(database: Any) -> None:
    axis = Axis(database)
    axis.mock.receive(odrive.frame_id(HOST, 0x06), b"", axis.now_s)
    serial = int.from_bytes(b"ODRV01", "little")
    assert read(database, axis.mock.outgoing.pop()) == ("Address", {"Node_ID": NODE, "Serial_Number": serial})
    axis.tell("Address", Node_ID=9, Serial_Number=serial + 1)
    assert axis.mock.node == NODE
    axis.tell("Address", Node_ID=9, Serial_Number=serial)
    assert axis.mock.node == 9


def test_a_trajectory_keeps_its_limits(database: Any) -> None:
    axis = Axis(database)
    axis.mock.setup = OdriveSetup(NODE, 0.05, 8.0, watchdog_s=math.inf, periods_s=())
    axis.tell("Set_Traj_Vel_Limit", Traj_Vel_Limit=2)
    axis.tell("Set_Traj_Accel_Limits", Traj_Accel_Limit=20, Traj_Decel_Limit=10)
    axis.tell("Set_Controller_Mode", Control_Mode=3, Input_Mode=5)
    axis.tell("Set_Axis_State", Axis_Requested_State=8)
    axis.tick(0.003)
    axis.tell("Set_Input_Pos", Input_Pos=3.5)
    goals = []
    for _ in range(800):
        goals.append(axis.mock._motor.goal_turns)
        axis.tick()
    speeds = [(after - before) * 1e3 for before, after in pairwise(goals)]
    assert goals[-1] == pytest.approx(3.5)
    assert max(speeds) == pytest.approx(2.0)
    assert max(after - before for before, after in pairwise(speeds)) <= 20e-3 + 1e-9
    assert axis.ask("Heartbeat")["Trajectory_Done_Flag"]


def test_a_velocity_is_followed_until_the_axis_waits_for_a_firmware(database: Any) -> None:
    axis = Axis(database)
    axis.tell("Set_Controller_Mode", Control_Mode=2, Input_Mode=1)
    axis.tell("Set_Axis_State", Axis_Requested_State=8)
    axis.tick(0.003)
    axis.tell("Set_Input_Vel", Input_Vel=-1.0)
    assert axis.mock.output.value < 0.0
    axis.tell("Enter_DFU_Mode")
    axis.tick(1.0)
    axis.tell("Set_Axis_State", Axis_Requested_State=8)
    assert axis.mock.output.kind == "open"


def test_names_of_commands_and_errors_are_the_vendors(database: Any) -> None:
    heartbeat = database.get_message_by_name(f"Axis{NODE}_Heartbeat")
    choices = heartbeat.get_signal_by_name("Axis_Error").choices
    assert {int(error): error.name for error in Error} == {value: str(name) for value, name in choices.items() if value}
    known = {message.frame_id & 0x1F for message in database.messages if message.frame_id >> 5 == NODE}
    assert set(OdriveCommand) <= known
