"""The canopen library as master of the mock drive: its SDO client, its PDO configuration and its CiA 402 profile."""

from typing import Any

import pytest

from hil_mocks.devices.cia402_drive import OPERATIONAL, Cia402Mock, Cia402Setup
from hil_mocks.devices.motor_states import MotorState

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
        "u8": kinds.UNSIGNED8, "i8": kinds.INTEGER8, "u16": kinds.UNSIGNED16, "i16": kinds.INTEGER16,
        "u32": kinds.UNSIGNED32, "i32": kinds.INTEGER32,
    }  # fmt: skip
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
