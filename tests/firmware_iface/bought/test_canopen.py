"""The CANopen side of CiA 402 drives: frames, SDO against canopen's own server, states, and what is not forgiven."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from firmware_iface import canopen_wire
from firmware_iface.canopen import STATUSWORD, CanOpenBus, Cia402Drive
from firmware_iface.canopen_wire import DictionaryObject
from firmware_iface.errors import BoardFaulted, BoardRefused, BoardReset, BoardSilent, MisuseError
from firmware_iface.motor.cia402 import DriveState
from hil_mocks.devices.cia402_drive import EPOS4, MAXON, Cia402Mock, Cia402Setup
from hil_mocks.devices.motor_inputs import MotorState as MockState

NODE = 5
GOLDEN = Path(__file__).parents[2] / "golden" / "canopen.txt"


def golden(name: str) -> tuple[int, bytes]:
    for line in GOLDEN.read_text().splitlines():
        if line.startswith(name + " |"):
            _, can_id, payload = line.split("|")
            return int(can_id, 16), bytes.fromhex(payload)
    raise KeyError(name)


class Wire:
    """A bus on which the far end answers at once: `answer` gets what the host sends and returns frames."""

    name = "memory"

    def __init__(self, answer: Callable[[int, bytes], list[tuple[int, bytes]]]) -> None:
        self.sent: list[tuple[int, bytes]] = []
        self.answer = answer
        self._received: list[tuple[int, bytes]] = []
        self._now_s = 0.0

    def send(self, can_id: int, payload: bytes) -> None:
        self.sent.append((can_id, bytes(payload)))
        self._received += self.answer(can_id, bytes(payload))

    def put(self, can_id: int, payload: bytes) -> None:
        self._received.append((can_id, payload))

    def receive(self) -> list[tuple[int, bytes]]:
        frames, self._received = self._received, []
        return frames

    def close(self) -> None:
        """Nothing to close."""

    def now_s(self) -> float:
        return self._now_s

    def wait_until_s(self, t: float) -> None:
        self._now_s = max(self._now_s, t)


def on(wired: Wire) -> Cia402Drive:
    return Cia402Drive(CanOpenBus(wired, wired), NODE, "elbow")


class Cell:
    """A mock drive on a wire: its control period passes whenever the host waits."""

    def __init__(self, **maker: int) -> None:
        self.mock = Cia402Mock(Cia402Setup(NODE, 77, 2000, 0.05, 1.0, 10.0, **maker), lambda: 0)
        self.states: list[MockState] = []
        self.wired = Wire(self._answer)
        self.bus = CanOpenBus(self.wired, self.wired)
        self.drive = Cia402Drive(self.bus, NODE, "elbow")
        wait = self.wired.wait_until_s

        def wait_until_s(t: float) -> None:
            wait(t)
            self.mock.tick(t, 0.0, 24.0)
            self.states.append(self.mock.state)
            self._flush()

        self.wired.wait_until_s = wait_until_s  # type: ignore[method-assign]

    def _answer(self, can_id: int, payload: bytes) -> list[tuple[int, bytes]]:
        self.mock.receive(can_id, payload, self.wired.now_s())
        self.states.append(self.mock.state)
        frames = list(self.mock.outgoing)
        self.mock.outgoing.clear()
        return frames

    def _flush(self) -> None:
        for frame in self.mock.outgoing:
            self.wired.put(*frame)
        self.mock.outgoing.clear()

    def cycle(self, wanted: DriveState) -> None:
        self.drive.step_towards(wanted)
        self.bus.sync()
        self.wired.wait_until_s(self.wired.now_s() + 0.002)
        self.bus.update()


@pytest.fixture
def cell() -> Cell:
    made = Cell()
    made.drive.identify()
    made.drive.set_up(0.002, 0.2)
    return made


def test_frames_are_those_of_the_standard() -> None:
    wired = Wire(lambda can_id, payload: [])
    bus = CanOpenBus(wired, wired)
    assert canopen_wire.read_request(STATUSWORD) == golden("SDO read 0x6041:00")[1]
    assert canopen_wire.write_request(DictionaryObject(0x6060, 0, "i8"), 8) == golden("SDO write 0x6060:00 = 8")[1]
    assert canopen_wire.write_request(DictionaryObject(0x1017, 0, "u16"), 200) == golden("SDO write 0x1017:00 = 200")[1]
    consumer = canopen_wire.write_request(DictionaryObject(0x1016, 1, "u32"), 127 << 16 | 200)
    assert consumer == golden("SDO write 0x1016:01 = node 127, 200 ms")[1]
    mapped = canopen_wire.write_request(DictionaryObject(0x1A00, 1, "u32"), STATUSWORD.mapping)
    assert mapped == golden("SDO write 0x1A00:01 = 0x60410010")[1]
    bus.nmt(canopen_wire.NmtCommand.START, NODE)
    bus.sync()
    assert wired.sent == [golden("NMT start node 5"), golden("SYNC")]


def test_the_drive_is_brought_to_operation_at_its_present_position(cell: Cell) -> None:
    for _ in range(6):
        cell.cycle(DriveState.OPERATION_ENABLED)
    assert cell.drive.state is DriveState.OPERATION_ENABLED
    assert cell.mock.objects[0x6060, 0] == ("i8", 8)
    assert cell.mock.objects[0x607A, 0] == ("i32", cell.mock.position)
    sent = {frame for frame in cell.wired.sent if frame[0] == 0x205}
    assert (0x205, bytes.fromhex("0f 00 08 00 00 00 00")) in sent
    cell.drive.command_position(-2)
    assert cell.wired.sent[-1] == golden("RPDO 1 enable operation, CSP, -2")


@pytest.mark.parametrize(
    ("maker", "limit"), [({}, ((0x6072, 0), 800)), ({"vendor": MAXON, "product": EPOS4}, ((0x3001, 2), 8000))]
)
def test_each_drive_is_asked_for_what_it_has(maker: dict[str, int], limit: tuple[tuple[int, int], int]) -> None:
    """Rated torque 0.5 N m and 10 A, supply and limit of the current: by CiA 402, and by maxon's EDS of the EPOS4."""
    cell = Cell(**maker)
    cell.drive.identify()
    cell.drive.set_up(0.002, 0.2)
    assert cell.drive.rated_torque_Nm == pytest.approx(0.5)
    assert cell.drive.rated_current_A == pytest.approx(10.0)
    for _ in range(6):
        cell.drive.ask_supply()
        cell.cycle(DriveState.OPERATION_ENABLED)
    assert cell.drive.supply_mV == 24_000
    cell.mock.is_home = True
    cell.drive.limit_current(8.0, 100.0)
    for _ in range(2):
        cell.cycle(DriveState.OPERATION_ENABLED)
    assert cell.drive.is_switch_on
    assert cell.mock.objects[limit[0]][1] == limit[1]
    assert cell.mock.limit_A == pytest.approx(8.0)


def test_a_fault_reset_never_leads_into_operation(cell: Cell) -> None:
    for _ in range(6):
        cell.cycle(DriveState.OPERATION_ENABLED)
    cell.mock.forced_error = 0x2310
    for _ in range(4):
        cell.cycle(DriveState.OPERATION_ENABLED)
    assert cell.drive.state is DriveState.FAULT
    assert cell.drive.error_text() == "0x2310"
    with pytest.raises(BoardFaulted, match="cause persists"):
        cell.drive.acknowledge_fault(0.05)
    cell.mock.forced_error = 0
    cell.states.clear()
    cell.drive.acknowledge_fault()
    assert cell.drive.state is DriveState.SWITCH_ON_DISABLED
    assert MockState.ENABLED not in cell.states


def test_a_boot_up_message_of_a_running_drive_is_a_restart(cell: Cell) -> None:
    cell.wired.put(0x700 + NODE, b"\x00")
    with pytest.raises(BoardReset, match=r'"elbow" \(node 5\).*restarted by itself'):
        cell.bus.update()
    assert cell.drive.state is None


def test_a_restart_that_nobody_saw_is_found_by_what_the_drive_has_forgotten(cell: Cell) -> None:
    cell.drive.await_count()
    cell.mock.power_up(cell.wired.now_s())
    cell.mock.outgoing.clear()  # its boot-up message, too
    with pytest.raises(BoardReset, match="restarted by itself"):
        cell.drive.await_count()
    assert cell.drive.resets == 1


def test_a_drive_that_hears_no_heartbeat_stops_by_itself(cell: Cell) -> None:
    for _ in range(6):
        cell.cycle(DriveState.OPERATION_ENABLED)
    for _ in range(150):
        cell.wired.wait_until_s(cell.wired.now_s() + 0.002)
    assert cell.mock.state is MockState.QUICK_STOP


def test_silence_and_a_bad_node_id_are_errors_that_say_where() -> None:
    with pytest.raises(BoardSilent, match=r"no answer to SDO 0x1000:00.*node id and bit rate"):
        on(Wire(lambda can_id, payload: [])).identify()
    wired = Wire(lambda can_id, payload: [])
    with pytest.raises(MisuseError, match="1 to 126"):
        Cia402Drive(CanOpenBus(wired, wired), 127, "x")


@pytest.mark.parametrize("is_torque", [False, True])
def test_a_drive_that_is_found_in_operation_stays_in_it_when_it_is_commanded(cell: Cell, is_torque: bool) -> None:
    cell.mock.switch_torque(True, 0.0)  # by another host
    for _ in range(3):
        if is_torque:
            cell.drive.command_torque(0)
        else:
            cell.drive.command_position(0)
        cell.bus.sync()
        cell.wired.wait_until_s(cell.wired.now_s() + 0.002)
    assert set(cell.states[-4:]) == {MockState.ENABLED}


@pytest.mark.parametrize(("mode", "state"), [(8, MockState.ENABLED), (9, MockState.QUICK_STOP), (10, MockState.QUICK_STOP)])
def test_a_torque_or_speed_that_another_host_left_is_not_kept_alive_by_our_heartbeats(mode: int, state: MockState) -> None:
    cell = Cell()
    cell.wired.wait_until_s(0.01)
    cell.mock.switch_torque(True, 0.0)
    cell.mock.objects[0x6060, 0] = ("i8", mode)
    cell.mock.objects[0x6071, 0], cell.mock.objects[0x60FF, 0] = ("i16", 300), ("i32", 5000)
    cell.drive.identify()
    cell.drive.set_up(0.002, 0.2)
    assert cell.mock.state is state
    for _ in range(3):
        cell.drive.resume() if state is MockState.QUICK_STOP else cell.drive.command_position(0)
        cell.bus.sync()
        cell.wired.wait_until_s(cell.wired.now_s() + 0.002)
    assert cell.mock.state is MockState.ENABLED  # taken over


@pytest.mark.parametrize("vendor", [0x402, MAXON])
def test_a_tpdo_keeps_its_bit_for_remote_requests(vendor: int) -> None:
    """A drive without them refuses to be told that it has them (CiA 301: 0x06090030)."""
    cell = Cell(vendor=vendor)
    cell.drive.identify()
    cell.drive.set_up(0.002, 0.2)
    assert [cell.mock.objects[0x1800 + pdo, 1][1] for pdo in (0, 1)] == [0x4000_0185, 0x4000_0285]


def test_a_drive_without_an_interpolation_time_is_set_up_all_the_same() -> None:
    cell = Cell(has_cycle_time=False)
    cell.drive.identify()
    cell.drive.set_up(0.002, 0.2)
    for _ in range(6):
        cell.cycle(DriveState.OPERATION_ENABLED)
    assert cell.drive.state is DriveState.OPERATION_ENABLED


class Server:
    """canopen's own SDO server, on our wire."""

    def __init__(self, canopen: Any) -> None:
        self.network = canopen.Network()
        self.network.bus = self
        self._frames: list[tuple[int, bytes]] = []
        dictionary = canopen.ObjectDictionary()
        for index, sub, kind in (
            (0x1000, 0, canopen.objectdictionary.UNSIGNED32),
            (0x1017, 0, canopen.objectdictionary.UNSIGNED16),
            (0x6060, 0, canopen.objectdictionary.INTEGER8),
            (0x607A, 0, canopen.objectdictionary.INTEGER32),
        ):
            entry = canopen.objectdictionary.ODVariable(f"object {index:x}", index, sub)
            entry.data_type, entry.access_type = kind, "rw"
            dictionary.add_object(entry)
        self.node = canopen.LocalNode(NODE, dictionary)
        self.network.add_node(self.node)

    def send(self, message: Any) -> None:
        self._frames.append((message.arbitration_id, bytes(message.data)))

    def answer(self, can_id: int, payload: bytes) -> list[tuple[int, bytes]]:
        self._frames.clear()
        self.network.notify(can_id, bytearray(payload), 0.0)
        return list(self._frames)


def test_sdo_agrees_with_the_server_of_the_canopen_library() -> None:
    server = Server(pytest.importorskip("canopen"))
    drive = on(Wire(server.answer))
    for index, kind, value in ((0x1000, "u32", 0x0002_0192), (0x6060, "i8", -3), (0x607A, "i32", -123456)):
        entry = DictionaryObject(index, 0, kind)
        drive.write(entry, value)
        assert server.node.sdo[index].raw == value
        assert drive.read(entry) == value
    with pytest.raises(BoardRefused, match=r"refused object 0x60FF:00: no such object \(0x06020000\)"):
        drive.write(DictionaryObject(0x60FF, 0, "i32"), 0)
