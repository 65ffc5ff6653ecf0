"""The canopen library as master of the mock drive: its SDO client, its PDO configuration and its CiA 402 profile."""

from typing import Any

import pytest

from hil_mocks.devices.cia402_drive import OPERATIONAL, Cia402Mock, Cia402Setup
from hil_mocks.devices.motor_inputs import MotorState

canopen = pytest.importorskip("canopen")
NODE = 5


class Bus:
    """What the library takes for python-can's bus: the mock answers at once, and its control period passes."""

    def __init__(self, mock: Cia402Mock) -> None:
        self.network = canopen.Network()
        self.network.bus = self
        self.mock = mock
        self._now_s = 0.001

    def send(self, message: Any) -> None:
        self.mock.receive(message.arbitration_id, bytes(message.data), self._now_s)
        self.tick()

    def tick(self) -> None:
        """Let a control period of the drive pass."""
        self._now_s += 0.001
        self.mock.tick(self._now_s, 0.0, 24.0)
        frames = list(self.mock.outgoing)
        self.mock.outgoing.clear()
        for can_id, payload in frames:
            self.network.notify(can_id, bytearray(payload), self._now_s)


def dictionary(mock: Cia402Mock) -> Any:
    """The mock's objects as the library's object dictionary."""
    kinds = canopen.objectdictionary
    types = {
        "u8": kinds.UNSIGNED8,
        "i8": kinds.INTEGER8,
        "u16": kinds.UNSIGNED16,
        "i16": kinds.INTEGER16,
        "u32": kinds.UNSIGNED32,
        "i32": kinds.INTEGER32,
    }
    made = kinds.ObjectDictionary()
    records = {index for index, sub in mock.objects if sub}
    for (index, sub), (kind, _) in sorted(mock.objects.items()):
        variable = kinds.ODVariable(f"{index:04X}:{sub}", index, sub)
        variable.data_type, variable.access_type = types[kind], "rw"
        if index not in records:
            made.add_object(variable)
            continue
        if index not in made:
            made.add_object(kinds.ODRecord(f"{index:04X}", index))
        made[index].add_member(variable)
    return made


@pytest.fixture
def mock() -> Cia402Mock:
    made = Cia402Mock(Cia402Setup(NODE, 77, 2000, 0.05, 1.0, 10.0), lambda: 1000)
    made.tick(0.001, 0.0, 24.0)
    return made


def test_the_sdo_client_reads_and_writes_the_mock(mock: Cia402Mock) -> None:
    bus = Bus(mock)
    node = bus.network.add_node(canopen.RemoteNode(NODE, dictionary(mock)))
    assert node.sdo[0x1018][4].raw == 77
    node.sdo[0x607A].raw = -123456
    assert mock.objects[0x607A, 0] == ("i32", -123456)
    with pytest.raises(canopen.SdoAbortedError) as refused:
        node.sdo.upload(0x5555, 0)
    assert refused.value.code == 0x06020000
    with pytest.raises(canopen.SdoAbortedError) as refused:
        node.sdo[0x6064].raw = 1
    assert refused.value.code == 0x06010002


def test_the_library_takes_the_mock_to_operation_and_out_of_a_fault(mock: Cia402Mock) -> None:
    bus = Bus(mock)
    node = bus.network.add_node(canopen.BaseNode402(NODE, dictionary(mock)))
    node.nmt.send_command(1)
    assert mock.nmt_state == OPERATIONAL
    node.tpdo_values, node.rpdo_pointers = {}, {}  # control by SDO
    node.state = "OPERATION ENABLED"
    assert mock.state is MotorState.ENABLED
    mock.forced_error = 0x2310
    bus.tick()
    bus.tick()
    assert node.state == "FAULT"
    mock.forced_error = 0
    node.state = "SWITCH ON DISABLED"
    assert mock.state is MotorState.SWITCH_ON_DISABLED


def test_pdos_that_the_library_maps_carry_what_it_unpacks(mock: Cia402Mock) -> None:
    bus = Bus(mock)
    node = bus.network.add_node(canopen.RemoteNode(NODE, dictionary(mock)))
    node.tpdo.read()
    node.tpdo[1].clear()
    node.tpdo[1].add_variable(0x6041)
    node.tpdo[1].add_variable(0x6064)
    node.tpdo[1].trans_type = 1
    node.tpdo[1].enabled = True
    node.tpdo[1].save()
    node.nmt.send_command(1)
    bus.network.sync.transmit()
    assert node.tpdo[1][0x6041].raw & 0x6F == MotorState.SWITCH_ON_DISABLED.value
    assert node.tpdo[1][0x6064].raw == mock.position == 0


# Calls of the library: those that a test here makes, and those that send nothing or are made of others.
CALLED = {
    "BaseNode402": {
        "op_mode",
        "state",
        "is_faulted",
        "is_homed",
        "homing",
        "is_op_mode_supported",
        "reset_from_fault",
        "check_statusword",
        "controlword",
        "statusword",
        "store",
        "restore",
        "setup_402_state_machine",
        "setup_pdos",
    },
    "SdoClient": {"upload", "download", "open", "abort"},
    "NmtMaster": {"send_command", "state"},
}
OWN = {
    "BaseNode402": {
        "add_sdo",
        "associate_network",
        "remove_network",
        "has_network",
        "load_configuration",
        "on_TPDOs_update_callback",
    },
    "SdoClient": {
        "get",
        "get_variable",
        "items",
        "keys",
        "values",
        "on_response",
        "read_response",
        "request_response",
        "send_request",
        "crc_cls",
    },
    "NmtMaster": {
        "add_hearbeat_callback",
        "add_heartbeat_callback",
        "on_command",
        "on_heartbeat",
        "wait_for_bootup",
        "wait_for_heartbeat",
        "stop_node_guarding",
    },
}
UNANSWERED = {"start_node_guarding"}  # by remote frames, which CiA advises against; heartbeats are there


def test_no_call_of_the_library_is_left_out() -> None:
    for offering in (canopen.BaseNode402, canopen.sdo.SdoClient, canopen.nmt.NmtMaster):
        offered = {name for name in dir(offering) if not name.startswith("_") and not name.isupper()}
        assert offered - UNANSWERED == CALLED[offering.__name__] | OWN[offering.__name__]


def drive(mock: Cia402Mock) -> tuple[Bus, Any]:
    """The library's drive, in operation by SDO."""
    bus = Bus(mock)
    node = bus.network.add_node(canopen.BaseNode402(NODE, dictionary(mock)))
    node.nmt.send_command(1)
    node.tpdo_values, node.rpdo_pointers, node.tpdo_pointers = {}, {}, {}
    return bus, node


def test_a_long_object_comes_in_segments_and_block_transfers_are_refused(mock: Cia402Mock) -> None:
    node = Bus(mock).network.add_node(canopen.RemoteNode(NODE, dictionary(mock)))
    assert node.sdo.upload(0x1008, 0) == b"mock drive"
    with pytest.raises(canopen.SdoAbortedError) as refused:
        node.sdo.open(0x1008, 0, "rb", block_transfer=True)
    assert refused.value.code == 0x05040001
    node.sdo.abort(0x08000000)
    node.sdo.download(0x6065, 0, (500).to_bytes(4, "little"))
    assert node.sdo.upload(0x6065, 0) == (500).to_bytes(4, "little")


def test_what_the_library_stores_lasts_over_a_restart_until_it_is_restored(mock: Cia402Mock) -> None:
    _, node = drive(mock)
    for ends, expected in ((node.store, 500), (node.restore, 0xFFFF_FFFF)):
        node.sdo[0x6065].raw = 500
        ends()
        node.nmt.send_command(0x81)
        assert node.sdo[0x6065].raw == expected
    with pytest.raises(canopen.SdoAbortedError) as refused:
        node.sdo.download(0x1010, 1, b"safe")
    assert refused.value.code == 0x08000020


def test_the_library_homes_the_drive_where_it_stands(mock: Cia402Mock) -> None:
    bus, node = drive(mock)
    shaft = [1000]
    mock._read_shaft = lambda: shaft[0]
    shaft[0] = 3456
    bus.tick()
    assert (mock.position, node.is_homed()) == (2456, False)
    assert node.is_op_mode_supported("HOMING")
    assert not node.is_op_mode_supported("PROFILED POSITION")
    assert node.homing(timeout=1)
    assert (mock.position, node.is_homed(), node.op_mode) == (0, True, "HOMING")
    assert (mock.output.kind, node.check_statusword() & 0x1400) == ("voltage", 0x1400)


def test_the_library_sees_the_nmt_states_and_resets_a_fault(mock: Cia402Mock) -> None:
    bus, node = drive(mock)
    node.sdo[0x1017].raw = 1
    for command, state in ((2, "STOPPED"), (0x80, "PRE-OPERATIONAL"), (1, "OPERATIONAL")):
        node.nmt.send_command(command)
        for _ in range(2):
            bus.tick()
        assert node.nmt.state == state
    mock.forced_error = 0x2310
    for _ in range(2):
        bus.tick()
    assert node.is_faulted()
    mock.forced_error = 0
    node.TIMEOUT_RESET_FAULT = 0.0
    node.reset_from_fault()
    assert (node.is_faulted(), mock.state) == (False, MotorState.ENABLED)


def test_the_library_finds_the_state_machine_in_the_pdos_that_are_mapped(mock: Cia402Mock) -> None:
    bus = Bus(mock)
    node = bus.network.add_node(canopen.BaseNode402(NODE, dictionary(mock)))
    node.nmt.send_command(0x80)
    node.nmt._state = 0x7F
    node.rpdo.read()
    node.tpdo.read()
    for pdo, variables in ((node.rpdo[1], (0x6040, 0x6060)), (node.tpdo[1], (0x6041, 0x6061))):
        pdo.clear()
        for variable in variables:
            pdo.add_variable(variable)
        pdo.trans_type, pdo.enabled = 1, True
        pdo.save()
    node.setup_402_state_machine()
    assert set(node.tpdo_values) == {0x6041, 0x6061}
    node.nmt.send_command(1)
    node.controlword = 0x06
    node.rpdo[1].transmit()
    bus.network.sync.transmit()
    assert mock.state is MotorState.READY
    assert node.statusword & 0x6F == MotorState.READY.value
