"""CiA 402 drives (IEC 61800-7-201) on a CANopen bus, seen from the host: SDO configuration, PDOs at SYNC, states.

The bus is drained once a cycle, and dispatches frames to its nodes by id.

"""

import contextlib
import math
import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from firmware_iface import canopen_wire
from firmware_iface.canopen_wire import DictionaryObject, NmtCommand
from firmware_iface.clock import Clock
from firmware_iface.errors import BoardFaulted, BoardRefused, BoardReset, BoardSilent, MisuseError, Problems
from firmware_iface.link import FrameLink
from firmware_iface.motor.cia402 import STATE_OF_STATUSWORD, DriveCommand, DriveState, next_command
from firmware_iface.node_bus import AnswersInTurn

FrameHandler = Callable[[bytes, float], None]
HOST_NODE = 127  # the node id of our heartbeat


class CanOpenBus:
    """One bus with its nodes, which add themselves. `synced_at_s` is when the last SYNC was sent."""

    def __init__(self, link: FrameLink, clock: Clock, heartbeat_every_s: float = math.inf) -> None:
        """`heartbeat_every_s`: well within the time-out of the drives for it."""
        self.link = link
        self.clock = clock
        self.name = link.name
        self.problems = Problems()
        self.synced_at_s = clock.now_s()
        self._handlers: dict[int, FrameHandler] = {}
        self._answers: list[AnswersInTurn] = []
        self._heartbeat_every_s = heartbeat_every_s
        self._next_heartbeat_s = -math.inf

    def add(self, node: int, handlers: dict[int, FrameHandler], counted: AnswersInTurn) -> None:
        """Dispatch frames with these base ids of a node; `counted` are its answers to SYNC. Raises MisuseError."""
        if node not in canopen_wire.NODES or node == HOST_NODE:
            raise MisuseError(f"CAN bus {self.name}: node ids are 1 to 126, got {node}")
        self._handlers.update({base + node: handler for base, handler in handlers.items()})
        self._answers.append(counted)

    def update(self) -> None:
        """Process everything received. Raises LinkLost, and once per event what the nodes found."""
        frames = self.link.receive()
        if frames:
            now_s = self.clock.now_s()
            for can_id, payload in frames:
                if (handler := self._handlers.get(can_id)) is not None:
                    handler(payload, now_s)
        if self.problems:
            raise self.problems.pop(0)

    def flush(self) -> None:
        """End a cycle: all drives have their set-points and take them over at once. Raises LinkLost."""
        if self.clock.now_s() >= self._next_heartbeat_s:
            self.heartbeat()
            self._next_heartbeat_s = self.clock.now_s() + self._heartbeat_every_s
        self.sync()

    def sync(self) -> None:
        """Send SYNC: the nodes take over their set-points, and answer with what they measured then. Raises LinkLost."""
        self.link.send(canopen_wire.SYNC, b"")
        self.synced_at_s = now_s = self.clock.now_s()
        for answers in self._answers:
            answers.asked(now_s)

    def heartbeat(self) -> None:
        """Tell the nodes that the host lives."""
        self.link.send(canopen_wire.HEARTBEAT + HOST_NODE, b"\x05")

    def nmt(self, command: canopen_wire.NmtCommand, node: int) -> None:
        """Send an NMT command to a node, 0: to all."""
        self.link.send(canopen_wire.NMT, bytes((command, node)))


ANSWER_TIMEOUT_s = 0.1  # drives answer SDO within some ms; some take 50 ms to store a value
ATTEMPTS = 2
FRESH_WAIT_s = 0.1  # for an answer to SYNC
_STEP_s = 0.001
CYCLIC_POSITION: Final = 8
CYCLIC_TORQUE: Final = 10

DEVICE_TYPE = DictionaryObject(0x1000, 0, "u32")
VENDOR, PRODUCT, REVISION, SERIAL = (DictionaryObject(0x1018, sub, "u32") for sub in (1, 2, 3, 4))
HEARTBEAT_CONSUMER, HEARTBEAT_PRODUCER = (DictionaryObject(0x1016, 1, "u32"), DictionaryObject(0x1017, 0, "u16"))
ABORT_CONNECTION, QUICK_STOP_OPTION = DictionaryObject(0x6007, 0, "i16"), DictionaryObject(0x605A, 0, "i16")
FAULT_REACTION, FOLLOWING_ERROR_WINDOW = (DictionaryObject(0x605E, 0, "i16"), DictionaryObject(0x6065, 0, "u32"))
NO_WINDOW = 0xFFFF_FFFF  # of 0x6065: the drive watches no following error
CONTROLWORD, STATUSWORD = DictionaryObject(0x6040, 0, "u16"), DictionaryObject(0x6041, 0, "u16")
MODE, MODE_NOW = DictionaryObject(0x6060, 0, "i8"), DictionaryObject(0x6061, 0, "i8")
POSITION, TARGET_POSITION = DictionaryObject(0x6064, 0, "i32"), DictionaryObject(0x607A, 0, "i32")
TORQUE, TARGET_TORQUE = DictionaryObject(0x6077, 0, "i16"), DictionaryObject(0x6071, 0, "i16")
RATED_CURRENT, RATED_TORQUE = DictionaryObject(0x6075, 0, "u32"), DictionaryObject(0x6076, 0, "u32")
MAX_TORQUE = DictionaryObject(0x6072, 0, "u16")
SUPPLY, INPUTS = DictionaryObject(0x6079, 0, "u32"), DictionaryObject(0x60FD, 0, "u32")
CYCLE_TIME, CYCLE_UNIT = DictionaryObject(0x60C2, 1, "u8"), DictionaryObject(0x60C2, 2, "i8")
MODES, POSITION_UNIT = DictionaryObject(0x6502, 0, "u32"), DictionaryObject(0x60A8, 0, "u32")
INCREMENTS: Final = 0x00B5_0000  # of 0x60A8
QUICK_STOP_WITHOUT_HOST, STAY_IN_QUICK_STOP = 3, 6  # of options 0x6007 and 0x605A
EVERY_SYNC = 1  # transmission type
NO_REMOTE_REQUESTS: Final = 1 << 30  # of a COB-ID
_RPDO_1 = struct.Struct("<Hbi")
_RPDO_2 = struct.Struct("<h")
_TPDO_1 = struct.Struct("<Hih")
_TPDO_2 = {(SUPPLY, INPUTS): struct.Struct("<II"), (INPUTS,): struct.Struct("<I")}
SUPPLY_EVERY_s = 0.05  # where it is asked for by SDO: a drop is seen within 0.1 s
SUPPLY_LATE_s = 0.5  # an older one says nothing of the supply now
NEGATIVE_LIMIT, POSITIVE_LIMIT, HOME_INPUT = 1 << 0, 1 << 1, 1 << 2  # of 0x60FD


@dataclass(frozen=True, slots=True)
class Maker:
    """How a maker's drives depart from CiA 402: unit of 0x6076; rated current, supply and limit of the current by own objects.

    `most` limits the current in mA, where 0x6072 does it in 1/1000 of the rated torque.
    """

    rated_torque_unit_Nm: float = 1e-3
    rated_current: DictionaryObject = RATED_CURRENT  # mA
    supply: DictionaryObject | None = None  # where 0x6079 does not exist, by SDO
    supply_unit_mV: int = 1
    most: DictionaryObject | None = None


# By vendor id, 0x1018:01. maxon: EDS of the EPOS4, firmware 0x0170, which has neither 0x6072 nor 0x6075 nor 0x6079.
MAKERS: Final = {
    0x0000_00FB: Maker(
        1e-6, DictionaryObject(0x3001, 1, "u32"), DictionaryObject(0x2200, 1, "u16"), 100, DictionaryObject(0x3001, 2, "u32")
    )
}


@dataclass(frozen=True, slots=True)
class DriveIdentity:
    """Object 0x1018, and the profile in 0x1000."""

    profile: int
    vendor: int
    product: int
    revision: int
    serial_number: int


class Cia402Drive:
    """Sends set-points and keeps the latest values; `CanOpenBus.update()` delivers them, `CanOpenBus.sync()` asks for them.

    `command…()` send frames and return. The other requests wait for answers through the clock, outside of the cycle.
    """

    def __init__(self, bus: CanOpenBus, node: int, name: str) -> None:
        self.node = node
        self.name = name
        self.statusword = 0
        self.state: DriveState | None = None
        self.count = 0
        self.torque_permille = 0
        self.at_s = -math.inf
        """The SYNC before they came."""
        self.counted = AnswersInTurn()
        self.supply_mV: int | None = None
        self._supply_at_s = self._inputs_at_s = -math.inf
        self._inputs = 0  # object 0x60FD
        self.errors: list[int] = []
        """Codes of emergency messages since the last acknowledged fault; 0x0000 is "no error" and not kept."""
        self.resets = 0
        self._heartbeat_ms = 0  # between its heartbeats, once it is set up
        self.identity: DriveIdentity | None = None
        self.rated_torque_Nm = self.rated_current_A = math.nan
        """The current is NaN where the drive does not say it."""
        self._maker = Maker()
        self._slow: tuple[DictionaryObject, ...] = (SUPPLY, INPUTS)  # as TPDO 2 is mapped
        self._supply_asked_at_s = -math.inf
        self.bus = bus
        self._controlword = int(DriveCommand.DISABLE_VOLTAGE)
        self._answers: dict[tuple[int, int], canopen_wire.SdoAnswer] = {}
        self._max_torque: int | None = None  # that the drive has confirmed
        self._asked_max: tuple[int, float] | None = None  # and that it was last told, and when
        self._is_known = False
        bus.add(
            node,
            {
                canopen_wire.TPDO_1: self._take_values,
                canopen_wire.TPDO_2: self._take_slow_values,
                canopen_wire.EMERGENCY: self._take_emergency,
                canopen_wire.SDO_ANSWER: self._take_answer,
                canopen_wire.HEARTBEAT: self._take_heartbeat,
            },
            self.counted,
        )

    @property
    def where(self) -> str:
        """Name in messages: `CiA 402 drive "elbow" (node 3) on socketcan:can0`."""
        return f'CiA 402 drive "{self.name}" (node {self.node}) on {self.bus.name}'

    @property
    def heard_at_s(self) -> float:
        """When it measured the oldest of its values; a supply that is asked for by SDO counts as of now until it is late."""
        mapped_at_s = min(self.at_s, self._inputs_at_s)
        return min(mapped_at_s, self._supply_at_s + SUPPLY_LATE_s) if self._supply_by_sdo else mapped_at_s

    @property
    def _supply_by_sdo(self) -> DictionaryObject | None:
        return None if SUPPLY in self._slow else self._maker.supply

    @property
    def is_switch_on(self) -> bool:
        """Whether its home input is on."""
        return bool(self._inputs & HOME_INPUT)

    @property
    def are_limits_on(self) -> tuple[bool, bool]:
        """Whether its negative and its positive limit switch are on."""
        return bool(self._inputs & NEGATIVE_LIMIT), bool(self._inputs & POSITIVE_LIMIT)

    # ---- in the cycle

    def step_towards(self, wanted: DriveState) -> None:
        """Take the next step to a state, without a motion: the set-point is where the motor is. FAULT is not left."""
        now = self.state
        if now is None or now in (DriveState.FAULT, DriveState.FAULT_REACTION_ACTIVE, DriveState.NOT_READY_TO_SWITCH_ON):
            self._controlword = int(DriveCommand.DISABLE_VOLTAGE)
        elif now is not wanted and (command := next_command(now, wanted)) is not None:
            self._controlword = int(command)
        self._send(CYCLIC_POSITION, self.count, 0)

    def command_position(self, position: int) -> None:
        """Cyclic synchronous position of a drive in operation, also of one that was found so."""
        self._controlword = int(DriveCommand.ENABLE_OPERATION)
        self._send(CYCLIC_POSITION, position, 0)

    def command_torque(self, permille: int) -> None:
        """Cyclic synchronous torque, in 1/1000 of the rated torque, of a drive in operation."""
        self._controlword = int(DriveCommand.ENABLE_OPERATION)
        self._send(CYCLIC_TORQUE, self.count, min(max(permille, -32768), 32767))

    def ask_supply(self) -> None:
        """Ask for the supply from time to time, where it cannot be mapped; does not wait."""
        if (entry := self._supply_by_sdo) is None:
            return
        if (answer := self._answers.pop((entry.at, entry.sub), None)) is not None and not answer.abort:
            self._take_supply(canopen_wire.unpacked(entry.kind, answer.data), self._supply_asked_at_s)
        now_s = self.bus.clock.now_s()
        if now_s - self._supply_asked_at_s >= SUPPLY_EVERY_s and self._asked_max is None:
            self._supply_asked_at_s = now_s
            self.bus.link.send(canopen_wire.SDO_REQUEST + self.node, canopen_wire.read_request(entry))

    def _take_supply(self, value: int, asked_at_s: float) -> None:
        self.supply_mV, self._supply_at_s = value * self._maker.supply_unit_mV, asked_at_s

    @property
    def force_limit(self) -> DictionaryObject:
        """The object that limits torque or current in every mode."""
        return self._maker.most or MAX_TORQUE

    def limit_current(self, current_A: float, permille_per_A: float) -> None:
        """At most so much current, in every mode: told until the drive confirms it; does not wait."""
        entry = self.force_limit
        permille = max(round(current_A * (permille_per_A if self._maker.most is None else 1e3)), 1)
        now_s = self.bus.clock.now_s()
        answer = self._answers.pop((entry.at, entry.sub), None)
        if answer is not None and self._asked_max is not None:
            self._max_torque = None if answer.abort else self._asked_max[0]
            self._asked_max = None
        is_told = self._asked_max is not None and now_s - self._asked_max[1] < ANSWER_TIMEOUT_s
        if self._max_torque != permille and not is_told:
            self._asked_max = permille, now_s
            self.bus.link.send(canopen_wire.SDO_REQUEST + self.node, canopen_wire.write_request(entry, permille))

    def quick_stop(self) -> None:
        """Quick stop: the drive slows down by its own ramp and holds."""
        self._controlword = int(DriveCommand.QUICK_STOP)
        self._send(CYCLIC_POSITION, self.count, 0)

    def resume(self) -> None:
        """From QUICK STOP ACTIVE back to OPERATION ENABLED, where the motor is: transition 16 of a drive that stays there."""
        self._controlword = int(DriveCommand.ENABLE_OPERATION)
        self._send(CYCLIC_POSITION, self.count, 0)

    def _send(self, mode: int, position: int, permille: int) -> None:
        wrapped = (position + 0x8000_0000 & 0xFFFF_FFFF) - 0x8000_0000
        send = self.bus.link.send
        send(canopen_wire.RPDO_2 + self.node, _RPDO_2.pack(permille))
        send(canopen_wire.RPDO_1 + self.node, _RPDO_1.pack(self._controlword, mode, wrapped))

    # ---- outside of the cycle

    def identify(self) -> DriveIdentity:
        """Ask who it is. Raises BoardSilent, RequestRefused."""
        profile = self.read(DEVICE_TYPE) & 0xFFFF
        parts = (self.read(entry) for entry in (VENDOR, PRODUCT, REVISION, SERIAL))
        self.identity = DriveIdentity(profile, *parts)
        self._maker = MAKERS.get(self.identity.vendor, Maker())
        self.rated_torque_Nm = (self.read_if_there(RATED_TORQUE) or 0) * self._maker.rated_torque_unit_Nm
        with contextlib.suppress(BoardRefused):
            self.rated_current_A = self.read(self._maker.rated_current) * 1e-3
        self._is_known = True
        return self.identity

    def await_count(self) -> None:
        """Wait for a position that the drive measures from now on. Raises BoardSilent."""
        clock, asked_s = self.bus.clock, self.bus.clock.now_s()
        self.bus.heartbeat()
        self.bus.sync()
        while (now_s := clock.now_s()) - asked_s < FRESH_WAIT_s:
            clock.wait_until_s(now_s + 0.5 * _STEP_s)
            self.bus.update()
            if self.at_s >= asked_s:
                return
        if self._heartbeat_ms and self.read(HEARTBEAT_PRODUCER) != self._heartbeat_ms:
            self._restarted()  # unseen: what was written to it is gone
            self.bus.update()
        raise BoardSilent(f"{self.where}: no position within {FRESH_WAIT_s} s of a SYNC")

    def set_up(self, period_s: float, watchdog_s: float) -> None:
        """Map the PDOs, set the drive's time-out for our heartbeat and what it does then, and start the node.

        Nothing is stored in the drive. Raises RequestRefused with the object that it does not have.
        """
        self.bus.nmt(NmtCommand.PRE_OPERATIONAL, self.node)
        self._map(0x1400, 0x1600, canopen_wire.RPDO_1, (CONTROLWORD, MODE, TARGET_POSITION))
        self._map(0x1401, 0x1601, canopen_wire.RPDO_2, (TARGET_TORQUE,))
        self._map(0x1800, 0x1A00, canopen_wire.TPDO_1, (STATUSWORD, POSITION, TORQUE))
        self._map_slow_values()
        if self.read_if_there(CYCLE_TIME) is not None:
            self.write(CYCLE_TIME, max(1, round(period_s * 1e3)))
            self.write(CYCLE_UNIT, -3)
        self.write(QUICK_STOP_OPTION, STAY_IN_QUICK_STOP)
        self._end_motion()
        self.write(ABORT_CONNECTION, QUICK_STOP_WITHOUT_HOST)
        self.write(HEARTBEAT_CONSUMER, HOST_NODE << 16 | round(watchdog_s * 1e3))
        self.write(HEARTBEAT_PRODUCER, round(watchdog_s * 1e3))
        self._heartbeat_ms = round(watchdog_s * 1e3)
        self.bus.heartbeat()
        self.bus.nmt(NmtCommand.START, self.node)
        self.state = self._max_torque = self._asked_max = None

    def _end_motion(self) -> None:
        """Bring a drive in operation to rest, as the time-out of another host would, which our heartbeats keep from coming.

        One that holds or follows positions is left so.
        """
        in_operation = STATE_OF_STATUSWORD[self.read(STATUSWORD) & 0xFF] is DriveState.OPERATION_ENABLED
        if in_operation and self.read_if_there(MODE_NOW) != CYCLIC_POSITION:
            self.write(CONTROLWORD, int(DriveCommand.QUICK_STOP))

    def _map_slow_values(self) -> None:
        """The supply where the drive has it as CiA 402 does, and the inputs."""
        try:
            self._slow = (SUPPLY, INPUTS)
            self._map(0x1801, 0x1A01, canopen_wire.TPDO_2, self._slow)
        except BoardRefused:
            self._slow = (INPUTS,)
            self._map(0x1801, 0x1A01, canopen_wire.TPDO_2, self._slow)
        if (entry := self._supply_by_sdo) is not None:
            self._take_supply(self.read(entry), self.bus.clock.now_s())

    def _map(self, communication: int, mapping: int, base: int, entries: tuple[DictionaryObject, ...]) -> None:
        """Configure a PDO as CiA 301 has it: invalid, empty, filled, valid. Its bit for remote requests stays as it is."""
        cob, count = DictionaryObject(communication, 1, "u32"), DictionaryObject(mapping, 0, "u8")
        cob_id = base + self.node | self.read(cob) & NO_REMOTE_REQUESTS
        self.write(cob, cob_id | 1 << 31)
        self.write(DictionaryObject(communication, 2, "u8"), EVERY_SYNC)
        self.write(count, 0)
        for sub, entry in enumerate(entries, start=1):
            self.write(DictionaryObject(mapping, sub, "u32"), entry.mapping)
        self.write(count, len(entries))
        self.write(cob, cob_id)

    def acknowledge_fault(self, timeout_s: float = 0.5) -> None:
        """Reset a fault by a rising edge of bit 7; ends in SWITCH ON DISABLED and never beyond. Raises BoardFaulted.

        Without a fault nothing is commanded.
        """
        clock = self.bus.clock
        deadline_s = clock.now_s() + timeout_s
        self.errors.clear()
        if not self._is_in_fault():
            return
        while True:
            for command in (DriveCommand.DISABLE_VOLTAGE, DriveCommand.FAULT_RESET, DriveCommand.DISABLE_VOLTAGE):
                self._controlword = int(command)
                self._send(CYCLIC_POSITION, self.count, 0)
                self.bus.heartbeat()
                self.bus.sync()
                clock.wait_until_s(clock.now_s() + 4 * _STEP_s)
                self.bus.update()
            if not self._is_in_fault():
                return
            if clock.now_s() >= deadline_s:
                raise BoardFaulted(f"{self.where}: its fault ({self.error_text()}) cannot be acknowledged: the cause persists")

    def _is_in_fault(self) -> bool:
        return self.state in (DriveState.FAULT, DriveState.FAULT_REACTION_ACTIVE)

    def error_text(self) -> str:
        """The codes of its emergency messages."""
        return ", ".join(f"0x{code:04X}" for code in self.errors[-3:]) or "no emergency message"

    def read(self, entry: DictionaryObject) -> int:
        """Read an object. Raises BoardSilent, RequestRefused."""
        return canopen_wire.unpacked(entry.kind, self._ask(entry, canopen_wire.read_request(entry)).data)

    def read_if_there(self, entry: DictionaryObject) -> int | None:
        """Read an object; None where the drive does not have it. Raises BoardSilent."""
        with contextlib.suppress(BoardRefused):
            return self.read(entry)
        return None

    def write(self, entry: DictionaryObject, value: int) -> None:
        """Write an object. Raises BoardSilent, RequestRefused."""
        self._ask(entry, canopen_wire.write_request(entry, value))

    def _ask(self, entry: DictionaryObject, request: bytes) -> canopen_wire.SdoAnswer:
        clock = self.bus.clock
        for _ in range(ATTEMPTS):
            self._answers.clear()
            self.bus.link.send(canopen_wire.SDO_REQUEST + self.node, request)
            deadline_s = clock.now_s() + ANSWER_TIMEOUT_s
            while (now_s := clock.now_s()) < deadline_s:
                clock.wait_until_s(now_s + _STEP_s)
                self.bus.update()
                answer = self._answers.get((entry.at, entry.sub))
                if answer is not None:
                    if answer.abort:
                        raise BoardRefused(
                            f"{self.where}: refused object {entry}: {canopen_wire.abort_text(answer.abort)}; docs/cia402.md lists"
                            " what a drive must have"
                        )
                    return answer
        raise BoardSilent(
            f"{self.where}: no answer to SDO {entry} within {ANSWER_TIMEOUT_s:.1f} s, asked {ATTEMPTS} times; check its supply,"
            " node id and bit rate"
        )

    # ---- frames delivered by the bus

    def _take_values(self, payload: bytes, now_s: float) -> None:
        if len(payload) == _TPDO_1.size:
            self.statusword, self.count, self.torque_permille = _TPDO_1.unpack(payload)
            self.at_s = self.bus.synced_at_s
            self.counted.arrived(now_s)
            self.state = STATE_OF_STATUSWORD[self.statusword & 0xFF]

    def _take_slow_values(self, payload: bytes, now_s: float) -> None:
        layout = _TPDO_2[self._slow]
        if len(payload) == layout.size:
            *supply_mV, self._inputs = layout.unpack(payload)
            self._inputs_at_s = self.bus.synced_at_s
            if supply_mV:
                self.supply_mV = supply_mV[0]

    def _take_emergency(self, payload: bytes, now_s: float) -> None:
        if len(payload) >= 2 and (code := int.from_bytes(payload[:2], "little")):
            self.errors.append(code)

    def _take_answer(self, payload: bytes, now_s: float) -> None:
        if (answer := canopen_wire.sdo_answer(payload)) is not None:
            self._answers[answer.at, answer.sub] = answer

    def _take_heartbeat(self, payload: bytes, now_s: float) -> None:
        if payload[:1] == bytes((canopen_wire.BOOT_UP,)) and self._is_known:
            self._restarted()

    def _restarted(self) -> None:
        self.resets += 1
        self.state, self.at_s = None, -math.inf
        self.counted.forget()
        self._supply_at_s = self._inputs_at_s = -math.inf
        self._controlword = int(DriveCommand.DISABLE_VOLTAGE)
        self.bus.problems.append(
            BoardReset(
                f"{self.where}: restarted by itself; its position and configuration are lost: check its supply, then home again"
            )
        )
