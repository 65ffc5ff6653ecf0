"""A whole mock arm without its wires: plant, boards, camera and faults, advanced together in ticks.

At time t the host's bytes take effect; a tick then runs the plant to t + tick with the outputs of t, lets every
board measure and control there, and collects what the boards send. Nothing here uses a clock of the machine or a
file descriptor.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Sequence
from dataclasses import replace

from control.model.arm import Arm
from firmware_iface.link import CanFormat
from hil_mocks.assembly import (
    PinWires,
    build_camera,
    build_encoder_boards,
    build_gripper,
    build_gripper_board,
    build_motor_board,
    build_plant,
)
from hil_mocks.bought import Bought, PlantState
from hil_mocks.devices.encoder_board import EncoderBoardHardware
from hil_mocks.devices.motor_inputs import BRAKE, Frame, MotorBoardHardware, Output
from hil_mocks.errors import RigError, ScenarioError
from hil_mocks.faults import CanOut, FaultPlan, FaultyFrames, Frames, check_fault
from hil_mocks.plant.parts import tool_parts
from hil_mocks.plant.plant import Hand, Plant, Point
from hil_mocks.scenario import FaultTable, Scenario
from hil_mocks.wires import Picture
from hil_mocks.wiring import LOOSE_PART, Channels, LooseCoupling, MotorWires, as_built, wiring_of

_FORCED = {"over_current": 1, "over_temperature": 2, "encoder_fault": 32}  # bits of the motor board's faults


# Controlwords that another program would send to take a board out of operation, and into it to hold (docs/motor_board.md).
_SENT = {"switched_off": (0x00,), "switched_on": (0x06, 0x07, 0x0F)}


def switch_motor_board(board: MotorBoardHardware, fault: FaultTable, is_on: bool, now_s: float) -> None:
    """Begin or end a fault of a motor board; kinds that it does not have change nothing."""
    if fault.kind.startswith("says_"):
        board.says[fault.kind] = fault.value if is_on else None
    elif fault.kind in _FORCED:
        bit = _FORCED[fault.kind]
        board.forced_faults = board.forced_faults | bit if is_on else board.forced_faults & ~bit
    elif fault.kind in _SENT and is_on:  # unheard by the host: not on its bus
        for controlword in _SENT[fault.kind]:
            board.receive(0x100 + board.setup.node, struct.pack("<BBih", controlword, 4, 0, 0), now_s)
    elif fault.kind == "board_reset" and is_on:
        board.power_up()
    elif fault.kind == "wrong_identity" and is_on:
        board.setup = replace(board.setup, serial_number=int(fault.value or 0))
    elif fault.kind == "wrong_protocol" and is_on:
        board.setup = replace(board.setup, protocol=int(fault.value or 0))
    elif fault.kind == "wrong_counts" and is_on:
        board.setup = replace(board.setup, counts_per_turn=int(fault.value or 0))


def switch_encoder_board(
    board: EncoderBoardHardware, fault: FaultTable, is_on: bool, now_s: float, counts: Callable[[], Sequence[int]]
) -> None:
    """Begin or end a fault of an encoder board; `counts`: of its shafts now, from which it starts after a reset."""
    sets = {"stuck_encoder": board.stuck, "lost_wire": board.lost, "backwards_encoder": board.backwards}
    if fault.kind in sets:
        change: Callable[[int], None] = sets[fault.kind].add if is_on else sets[fault.kind].discard
        change(fault.channel)
    elif fault.kind == "quadrature_error" and is_on:
        board.quadrature_error(fault.channel, round(fault.value or 1))
    elif fault.kind == "slipped_encoder" and is_on:
        board.slip(fault.channel, round(fault.value or 0))
    elif fault.kind == "jumping_encoder" and is_on:
        board.jump(fault.channel, round(fault.value or 0))
    elif fault.kind == "drifting_encoder":
        board.drift.pop(fault.channel, None)
        if is_on:
            board.drift[fault.channel] = fault.value or 0.0
    elif fault.kind == "frozen_clock":
        board.freeze_clock(is_on)
    elif fault.kind == "board_reset" and is_on:
        board.power_up(now_s, counts())
    elif fault.kind == "wrong_identity" and is_on:
        board.setup = replace(board.setup, serial_number=int(fault.value or 0))
    elif fault.kind == "wrong_protocol" and is_on:
        board.setup = replace(board.setup, protocol=int(fault.value or 0))


_SLACK_S = 1e-9  # rounding of sums of ticks


class MockRobot:
    """An arm as built (`arm` and the scenario's hidden errors) with its boards. Joints 0-based; time from power-up."""

    def __init__(self, arm: Arm, scenario: Scenario, plant: Plant | None = None) -> None:
        """`plant`: of an arm in a world with others (hil_mocks.cell); else its own is built."""
        self.scenario, self.tick_s = scenario, scenario.tick_s
        self._ticks, self._steps = 0, _steps_per_tick(scenario)
        self.now_s = 0.0  # time since power-up
        arm = as_built(arm, scenario)
        self._tools = {tool.name: tool_parts(tool) for tool in arm.tools}
        self._loose: dict[int, LooseCoupling] = {}
        self._stuck_counts: dict[int, int] = {}  # of motor boards, by joint
        self._turn_rad = [2.0 * math.pi / drive.gear_ratio for drive in arm.drives]
        self.plant = plant or build_plant(arm, scenario)
        self._reading_rad = self.plant.encoder_angles_rad()  # of this tick
        self.gripper = None if arm.gripper is None else build_gripper(arm.gripper, scenario)
        driven = replace(arm, drives=arm.motors)  # a gripper on a bought board is to it one joint more
        self._wiring = wiring_of(driven, scenario)
        self.encoder_boards = build_encoder_boards(arm, scenario, self._wiring)
        self.bought = Bought(driven, self._wiring, self._shaft_rad)
        self._has_bought = bool(self.bought.names)
        self._motor_joints = [j for j in range(len(self._wiring)) if j not in self.bought.joints]
        self.motor_boards = [build_motor_board(self._wiring[j], scenario, self._motor_counter(j)) for j in self._motor_joints]
        if arm.gripper is not None and self.gripper is not None and not arm.gripper.board:
            self.motor_boards.append(build_gripper_board(arm.gripper, scenario, self.gripper))
            self._motor_joints.append(self.plant.joints)  # its motor comes after those of the joints
        self.pins = PinWires(arm, scenario, self.motor_boards)
        self._channels = [
            Channels(i, self._wiring, len(board.setup.counts_per_turn)) for i, board in enumerate(self.encoder_boards)
        ]
        self.camera = build_camera(arm, scenario)
        self._name_boards(scenario)
        self._wire_up(arm)
        self._power_up()

    def _name_boards(self, scenario: Scenario) -> None:
        """Names of the boards in faults, and the lines that these act on."""
        self._board_of_node = {board.setup.node: at for at, board in enumerate(self.motor_boards)}
        self._encoder_names = ["encoder" + (str(i + 1) if i else "") for i in range(len(self.encoder_boards))]
        self._motor_names = [f"motor{board.setup.node}" for board in self.motor_boards]
        self.drive_names = [*self._motor_names, *self.bought.names]
        self.board_names = [*self._encoder_names, *self._motor_names, *self.bought.names, "camera"]
        for fault in scenario.fault:
            check_fault(fault, self.board_names, f"scenario {scenario.path or scenario.name}")
        self._lines = {name: FaultyFrames(name, scenario.seed) for name in self.board_names}
        self._motor_lines = [self._lines[name] for name in self._motor_names]
        self._plan = FaultPlan(scenario.fault)

    def _wire_up(self, arm: Arm) -> None:
        """What the motors are driven with, and what is on its way to the host."""
        directions = [w.motor_direction for w in self._wiring]
        if arm.gripper is not None and not arm.gripper.board:
            directions.append(arm.gripper.motor_direction)
        self._motors = MotorWires(self.plant, self.gripper, directions)
        self._serial: list[Frames] = [[] for _ in (*self.encoder_boards, *self.bought.lines)]
        self._can_out = {carried: CanOut() for carried in (CanFormat.STANDARD, *self.can_formats)}
        self._classic_out = self._can_out[CanFormat.STANDARD]
        self.outgoing = {carried: out.outgoing for carried, out in self._can_out.items()}
        self.can_outgoing = self.outgoing[CanFormat.STANDARD]
        self.camera_outgoing: list[Picture] = []

    @property
    def outputs(self) -> tuple[Output, ...]:
        """What each joint's bridge puts out."""
        return tuple(self._motors.applied)

    @property
    def can_formats(self) -> set[CanFormat]:
        """Which frames its boards use beside classic ones with 11-bit ids."""
        return {boards.carried for boards in self.bought.on_can} - {CanFormat.STANDARD}

    @property
    def serial_lines(self) -> int:
        """The number of serial lines."""
        return len(self._serial)

    @property
    def hand(self) -> Hand:
        """The hand that seats the tip."""
        return self.plant.hand

    def tip_m(self) -> Point:
        """True tip in the base frame."""
        return self.plant.tip_m()

    def joint_rad(self) -> tuple[float, ...]:
        """True joint angles."""
        return self.plant.joint_rad()

    def set_tool(self, name: str) -> None:
        """Mount another of the arm's tools. RigError lists them."""
        if name not in self._tools:
            raise RigError(f'mock arm: no tool "{name}"; there are {", ".join(self._tools)}.')
        self.plant.set_tool(self._tools[name])

    def set_object(self, width_m: float | None, stiffness_N_m: float = 2e4) -> None:
        """Put an object between the fingers, or remove it (None). RigError without a gripper."""
        if self.gripper is None:
            raise RigError("mock arm: it has no gripper; arm.toml describes it as [gripper].")
        self.gripper.object_m = None if width_m is None else (width_m, stiffness_N_m)

    def gripper_truth(self) -> tuple[float, float]:
        """True opening [m], and force on the object [N]. RigError without a gripper."""
        if self.gripper is None:
            raise RigError("mock arm: it has no gripper; arm.toml describes it as [gripper].")
        return self.gripper.opening_m, self.gripper.force_N()

    def from_host_serial(self, board: int, received: bytes) -> None:
        """Process bytes from the host to a serial line now: the encoder boards', then the bought boards'."""
        line = board - len(self.encoder_boards)
        if line >= 0:
            if not self._lines[self.bought.line_names[line]].is_silent:
                self.bought.lines[line].receive(received, self.now_s)
                self._gather_line(line)
        elif not self._lines[self._encoder_names[board]].is_silent:
            self.encoder_boards[board].receive(received, self.now_s)
            self._gather_serial(board)

    def from_host_can(self, can_id: int, payload: bytes, carried: CanFormat = CanFormat.STANDARD) -> None:
        """Process a frame from the host now; replies go to `outgoing`."""
        if carried is not CanFormat.STANDARD:
            self._to_bought(can_id, payload, carried)
            return
        if can_id == 0:
            for at in range(len(self.motor_boards)):
                self._to_motor_board(at, can_id, payload)
        if self._has_bought:
            self._to_bought(can_id, payload, carried)
        if can_id == 0:
            return
        addressed = self._board_of_node.get(can_id & 0xF)
        if addressed is not None:
            self._to_motor_board(addressed, can_id, payload)

    def tick(self) -> None:
        """Advance everything by one tick."""
        self.plant.step(self._steps)
        self.after_physics()

    @property
    def steps_per_tick(self) -> int:
        """Steps of the physics in a tick."""
        return self._steps

    def after_physics(self) -> None:
        """The rest of a tick, once the physics has run: boards, camera and faults."""
        self._ticks += 1
        now_s = self.now_s = self._ticks * self.tick_s
        self._reading_rad = self.plant.encoder_angles_rad()
        if now_s >= self._plan.next_change_s:
            self._change_faults(now_s)
        bridges, motors, polarity = self.plant.bridges, self._motors, self._motors.polarity
        currents_A, supply_V, is_clamped = bridges.currents_A(), bridges.supply_V, bridges.is_clamped
        if (gripper := self.gripper) is not None:
            gripper.step(self._steps)
            currents_A = [*currents_A, gripper.current_A]
            supply_V, is_clamped = [*supply_V, gripper.supply_V], [*is_clamped, gripper.is_clamped]
        for at, (j, board) in enumerate(zip(self._motor_joints, self.motor_boards, strict=True)):
            frames = board.tick(now_s, polarity[j] * currents_A[j], supply_V[j], is_clamped[j])
            if frames:
                self._send_can(self._motor_names[at], frames)
            if board.output is not motors.applied[j]:
                motors.apply(j, board.output, board.current_limit_A)
        joint_rad = self.plant.joint_rad()
        self.pins.tick(joint_rad)
        for out in self._can_out.values():
            out.release(now_s)
        encoder_rad = self._encoder_rad()
        if self._has_bought:
            signed_A = [sign * current for sign, current in zip(polarity, currents_A, strict=True)]
            turned_rad = joint_rad if gripper is None else (*joint_rad, gripper.motor_rad())
            for driven in self.bought.tick(now_s, PlantState(signed_A, supply_V, is_clamped, turned_rad)):
                motors.apply(*driven)
            self._gather_bought()
        for i, encoder in enumerate(self.encoder_boards):
            encoder.tick(now_s, *self._channels[i].seen(encoder_rad, joint_rad))
            if encoder.outgoing:
                self._gather_serial(i)
        if now_s >= self.camera.next_s:
            self._look(now_s)

    def from_host_camera(self, camera: int, request: bytes) -> None:
        """Process a packet from the host to the camera now."""
        self.camera_outgoing += [(0, packet) for packet in self.camera.answer(request)]

    def serial_outgoing(self, board: int, ahead_s: float = 0.0) -> bytes:
        """Bytes of a serial line that arrive at the host by now, or within `ahead_s`."""
        queue = self._serial[board]
        if not queue:
            return b""
        moment_s = self.now_s + ahead_s + _SLACK_S
        there = [frame for when_s, frame in queue if when_s <= moment_s]
        if there:
            self._serial[board] = [sent for sent in queue if sent[0] > moment_s]
        return b"".join(there)

    @property
    def serial_next_s(self) -> float:
        """When the next bytes of any serial line arrive at the host; infinity if none are under way."""
        return min((when_s for queue in self._serial for when_s, _ in queue), default=math.inf)

    def inject(self, fault: FaultTable) -> None:
        """Inject a fault; its times are those of the simulation. Raises ScenarioError."""
        check_fault(fault, self.board_names, "inject")
        self._plan.add(fault)
        self._change_faults(self.now_s)

    def clear_faults(self) -> None:
        """End all faults that can end."""
        self._plan.clear()
        self._change_faults(self.now_s)

    def _power_up(self) -> None:
        """Power up the boards at the present pose; the encoder board may have been powered before."""
        start = self.scenario.start
        self._change_faults(0.0)
        for i, encoder in enumerate(self.encoder_boards):
            raw, is_home = self._shafts(i)
            encoder.power_up(0.0, raw)
            encoder.tick(0.0, raw, is_home)
            on_it = sorted((w.encoder_channel, j) for j, w in enumerate(self._wiring) if w.encoder_board == i)
            if start.homed:
                counts = [0] * len(raw)
                for channel, j in on_it:
                    counts[channel] = self._wiring[j].zero_count + raw[channel]
                encoder.preset(counts, True)
            elif start.raw_counts is not None:
                encoder.preset([start.raw_counts[j] for _, j in on_it], False)
            self._gather_serial(i)
        supply_V = [*self.plant.bridges.supply_V, self.gripper.supply_V if self.gripper else 0.0]
        for at, (j, board) in enumerate(zip(self._motor_joints, self.motor_boards, strict=True)):
            self._send_can(self._motor_names[at], board.tick(0.0, 0.0, supply_V[j], False))
            self._motors.apply(j, board.output, board.current_limit_A)
        for j in self.bought.joints:
            self._motors.apply(j, BRAKE, math.inf)

    def _motor_counter(self, j: int) -> Callable[[], int]:
        """The encoder input of a motor board: each of its periods reads it."""
        wired, loose = self._wiring[j], self._loose
        motor_count = wired.motor_count
        if wired.has_second_encoder:
            stuck = self._stuck_counts
            return lambda: stuck[j] if j in stuck else motor_count(self.plant.motor_rad(j))

        def count() -> int:
            if j in self._stuck_counts:
                return self._stuck_counts[j]
            reading_rad = self._reading_rad[j]
            if j in loose:
                reading_rad += loose[j].slip_rad
            return motor_count(reading_rad)

        return count

    def _shaft_rad(self, j: int) -> float:
        """The encoder angle of a joint, or of the gripper's motor."""
        if j == self.plant.joints and self.gripper is not None:
            return self.gripper.motor_rad()
        return self._encoder_rad()[j]

    def _encoder_rad(self) -> list[float]:
        """Encoder angles in joint angles."""
        if not self._loose:
            return self._reading_rad
        readings_rad = list(self._reading_rad)
        for j, coupling in self._loose.items():
            readings_rad[j] = coupling.reading_rad(readings_rad[j])
        return readings_rad

    def _shafts(self, board: int) -> tuple[list[int], list[bool]]:
        """Raw counts and home switches by channel of an encoder board."""
        return self._channels[board].seen(self._encoder_rad(), self.plant.joint_rad())

    def _to_motor_board(self, at: int, can_id: int, payload: bytes) -> None:
        if self._motor_lines[at].is_silent:
            return
        j, board = self._motor_joints[at], self.motor_boards[at]
        frames = board.receive(can_id, payload, self.now_s)
        if frames:
            self._send_can(self._motor_names[at], frames)
        motors = self._motors
        if board.output is not motors.applied[j] or board.current_limit_A != motors.limits_A[j]:
            motors.apply(j, board.output, board.current_limit_A)

    def _to_bought(self, can_id: int, payload: bytes, carried: CanFormat) -> None:
        for boards in self.bought.on_can:
            if boards.carried is carried:
                for name, mock in zip(boards.names, boards.mocks, strict=True):
                    if not self._lines[name].is_silent:
                        mock.receive(can_id, payload, self.now_s)
        self._gather_bought()

    def _gather_bought(self) -> None:
        for boards in self.bought.on_can:
            out = self._can_out[boards.carried]
            for name, mock in zip(boards.names, boards.mocks, strict=True):
                if mock.outgoing:
                    out.send(self._lines[name], list(mock.outgoing), self.now_s)
                    mock.outgoing.clear()

    def _send_can(self, name: str, frames: list[Frame]) -> None:
        self._classic_out.send(self._lines[name], frames, self.now_s)

    def _gather_serial(self, board: int) -> None:
        outgoing = self.encoder_boards[board].outgoing
        if outgoing:
            line = self._lines[self._encoder_names[board]]
            self._serial[board] += line.passed(outgoing) if line.faults else outgoing
            outgoing.clear()

    def _gather_line(self, line: int) -> None:
        """Answers of a bought board's line; the faults of its first board act on its frames."""
        outgoing = self.bought.lines[line].outgoing
        through = self._lines[self.bought.line_names[line]]
        sent = through.passed(outgoing) if through.faults else outgoing
        self._serial[len(self.encoder_boards) + line] += sent
        outgoing.clear()

    def _look(self, now_s: float) -> None:
        datagrams = self.camera.tick(now_s, self.plant)
        line = self._lines["camera"]
        if line.faults:
            datagrams = [arrived for _, arrived in line.passed([(now_s, datagram) for datagram in datagrams])]
        self.camera_outgoing += [(0, datagram) for datagram in datagrams]

    def _change_faults(self, now_s: float) -> None:
        begun, ended = self._plan.update(now_s)
        for name, line in self._lines.items():
            line.faults = self._plan.on_frames(name)
        for fault in ended:
            self._switch(fault, False)
        for fault in begun:
            self._switch(fault, True)

    def _switch(self, fault: FaultTable, is_on: bool) -> None:
        if fault.board in self._motor_names:
            self._switch_motor(fault, self._motor_names.index(fault.board), is_on)
        elif fault.board in self.bought.names:
            joint = self.bought.joint(fault)
            if joint is None or not self._motors.switch(fault, joint, is_on):
                self.bought.switch(fault, is_on, self.now_s)
        elif fault.board == "camera" and fault.kind == "exchanged_bodies":
            self.camera.is_exchanged = is_on
        elif fault.board in self._encoder_names:
            self._switch_encoder(fault, self._encoder_names.index(fault.board), is_on)

    def _switch_motor(self, fault: FaultTable, at: int, is_on: bool) -> None:
        joint = self._motor_joints[at]
        if fault.kind == "stuck_encoder":
            self._stuck_counts.pop(joint, None)
            if is_on:
                self._stuck_counts[joint] = self._motor_counter(joint)()
        elif not self._motors.switch(fault, joint, is_on):
            switch_motor_board(self.motor_boards[at], fault, is_on, self.now_s)

    def _switch_encoder(self, fault: FaultTable, i: int, is_on: bool) -> None:
        if fault.kind == "loose_encoder":
            self._loosen(i, fault, is_on)
        else:
            switch_encoder_board(self.encoder_boards[i], fault, is_on, self.now_s, lambda: self._shafts(i)[0])

    def _loosen(self, i: int, fault: FaultTable, is_on: bool) -> None:
        """Start or end the loose coupling; a tightened coupling keeps its slip."""
        at = (i, fault.channel)
        for j, wired in enumerate(self._wiring):
            if (wired.encoder_board, wired.encoder_channel) == at:
                part = (LOOSE_PART if fault.value is None else fault.value) if is_on else 0.0
                before = self._loose.get(j)
                self._loose[j] = LooseCoupling(part, self._turn_rad[j], f"{j} {self.scenario.seed}")
                self._loose[j].slip_rad = before.slip_rad if before else 0.0


def _steps_per_tick(scenario: Scenario) -> int:
    steps = round(scenario.tick_s / scenario.plant.timestep_s)
    if steps < 1 or not math.isclose(steps * scenario.plant.timestep_s, scenario.tick_s, rel_tol=1e-9):
        raise ScenarioError(
            f"scenario {scenario.path or scenario.name}: tick_s = {scenario.tick_s:g} must be a multiple of "
            f"plant.timestep_s = {scenario.plant.timestep_s:g}."
        )
    return steps
