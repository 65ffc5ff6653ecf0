"""What can be done to an arm on the stage: the mock's faults, a man in the middle on its wires, a host that is away."""

import random
import struct
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any
from unittest.mock import patch

import msgspec

from control.errors import ArmError
from control.kinematics.kinematics import ForwardKinematics
from control.motion.plan import plan_path
from control.server.messages import asked
from firmware_iface.link import FrameLink
from firmware_iface.motor.wire import COMMAND_ID, SetpointMode
from hil_mocks.assembly import build_motor_board
from hil_mocks.wiring import wiring_of
from procedures.drills.stage import PERIOD_S, Stage

Inject = Callable[[Stage], None]
MOTORS = ("motor1", "motor2", "motor3")
HOST_MOST_ID = 0x27F  # COMMAND 0x100, PARAMETER_REQUEST 0x200, emergency stop 0: docs/motor_board.md
ENABLE_OPERATION = 0x0F
PASSIVE_AFTER_S = 0.01  # of errors: a controller leaves the bus soon
SEED = 1
GUEST = 1  # another connection than the drill's own
NAN = float("nan")
_VALUES: tuple[Any, ...] = (None, NAN, 1e308, -1e308, "0.1", True, [], {}, [[0.0]], 10**30)
NONSENSE: tuple[dict[str, Any], ...] = (
    *({"do": "move_joints", "q_rad": [value, 0.0, 0.0]} for value in _VALUES if value is not True),
    *({"do": "jog", "joint": value, "speed": 0.1} for value in _VALUES if value is not True),
    *({"do": "override", "fraction": value} for value in _VALUES),
    *({"do": "payload", "mass_kg": value} for value in _VALUES),
    {"do": "move_joints", "q_rad": [0.0, 0.0]},
    {"do": "move_joints", "q_rad": [9.0, 0.0, 0.0]},
    {"do": "run_path", "path": {"spline": 1}},
    {"do": "run_joints", "path": {}},
    {"do": "explode"},
)
COMMANDS: tuple[dict[str, Any], ...] = (
    {"do": "move_joints", "q_rad": [0.5, -0.3, 0.4]},
    {"do": "jog", "joint": 1, "speed": 0.1},
    {"do": "home", "again": True},
    {"do": "guide"},
    {"do": "override", "fraction": 0.5},
    {"do": "payload", "mass_kg": 1.0},
    {"do": "enable"},
    {"do": "resume"},
    {"do": "control", "take": True},
)
CONTRADICTING: tuple[dict[str, Any], ...] = (*COMMANDS[:4], {"do": "hold"})
MEETING: tuple[dict[str, Any], ...] = (
    {"do": "move_joints", "q_rad": [0.0, -1.9, -0.6]},  # the tip through the table
    {"do": "move_joints", "q_rad": [-0.8, -1.8, 0.2]},  # beside it, through the floor
    {"do": "move_joints", "q_rad": [2.5, -1.9, -1.1]},  # on the far side of the base
)
UNREACHABLE = ((2.0, 0.0, 0.5), (0.0, 0.0, 0.5), (0.0, 0.0, -0.5), (0.05, 0.0, 0.1))


def fault(kind: str, *boards: str, **keys: float) -> Inject:
    """A fault of docs/mock_robot.md on some boards."""

    def inject(played: Stage) -> None:
        for board in boards:
            played.inject(kind, board, **keys)

    return inject


def both(*injects: Inject) -> Inject:
    """Several at once."""

    def inject(played: Stage) -> None:
        for one in injects:
            one(played)

    return inject


def away(duration_s: float) -> Inject:
    """The loop is paused, or dead and another one looks later."""
    return lambda played: played.away(duration_s)


def stop_at(delay_s: float) -> Inject:
    """Somebody presses stop."""

    def inject(played: Stage) -> None:
        played.run(delay_s)
        played.client.ask("stop")

    return inject


def brake(played: Stage) -> None:
    """Somebody has the arm braked."""
    played.client.ask("brake")


def payload(mass_kg: float) -> Inject:
    """A mass at the tip that the runtime is not told of."""

    def inject(played: Stage) -> None:
        played.rig.set_payload(mass_kg)
        played.undo.callback(played.rig.set_payload, 0.0)

    return inject


def let_go(mass_kg: float) -> Inject:
    """The drives carry the arm for a hand that guides it, but not this mass at its tip."""

    def inject(played: Stage) -> None:
        payload(mass_kg)(played)
        played.client.guide(weightless=True)

    return inject


def serial_gone(played: Stage) -> None:
    """The serial port vanishes."""
    played.rig.wires.serial[0].vanish()


def bus_off(played: Stage) -> None:
    """The host's CAN controller leaves the bus."""
    for board in MOTORS:
        played.inject("silent", board)
    played.rig.wires.bus_off()


def serial_noise(most_bytes: int) -> Inject:
    """Bursts of noise between the frames of the encoder board."""

    def inject(played: Stage) -> None:
        source = random.Random(SEED)
        wire = played.rig.wires.serial[0]
        played.each_cycle.append(lambda: wire.write(source.randbytes(source.randrange(most_bytes))))

    return inject


def can_flood(frames_a_cycle: int) -> Inject:
    """Frames of other devices on the bus: any id that no board of ours listens to or sends."""

    def inject(played: Stage) -> None:
        source, guest = random.Random(SEED), _guest(played)

        def send() -> None:
            for _ in range(frames_a_cycle):
                guest.send(source.randrange(0x400, 0x800), source.randbytes(8))  # above those of digital pins

        played.each_cycle.append(send)

    return inject


def can_full(played: Stage) -> None:
    """No frame of the host gets onto the bus."""
    played.undo.enter_context(played.rig.wires.full_bus())


def wrong_bit_rate(played: Stage) -> None:
    """A device at another bit rate is plugged in: nothing but errors, until the controllers leave the bus."""
    for board in MOTORS:
        played.inject("silent", board)
    wires, begun_s = played.rig.wires, played.now_s

    def errors() -> None:
        if played.now_s - begun_s < PASSIVE_AFTER_S:
            wires.bit_error()
        else:
            wires.bus_off()

    played.each_cycle.append(errors)


def second_board(joint: int) -> Inject:
    """A board fresh from its box, with the node id of another one, is plugged in."""

    def inject(played: Stage) -> None:
        guest, wired = _guest(played), wiring_of(played.arm, played.rig.scenario)[joint]
        board = build_motor_board(wired, played.rig.scenario, lambda: 0)

        def answer() -> None:
            board.tick(played.now_s, 0.0, 24.0, False)
            for can_id, payload in guest.receive():
                if can_id & 0xF == wired.motor_node and can_id <= HOST_MOST_ID:
                    for reply_id, reply in board.receive(can_id, payload, played.now_s):
                        guest.send(reply_id, reply)

        played.each_cycle.append(answer)

    return inject


def another_host(node: int, volts: float) -> Inject:
    """Another program commands a board, cycle after cycle."""
    command = struct.pack("<BBih", ENABLE_OPERATION, SetpointMode.VOLTAGE, round(volts * 1e3), 0)

    def inject(played: Stage) -> None:
        guest = _guest(played)
        played.each_cycle.append(lambda: guest.send(COMMAND_ID + node, command))

    return inject


def clock_stepped(step_s: float) -> Inject:
    """The time of day is set, by hand or by the network."""

    def inject(played: Stage) -> None:
        was_s = time.time
        played.undo.enter_context(patch.object(time, "time", lambda: was_s() + step_s))

    return inject


def refused(requests: Sequence[dict[str, Any]], client: int | None = None) -> Inject:
    """Requests that must all be refused; one that is served is a fault of its own."""

    def inject(played: Stage) -> None:
        for request in requests:
            if client is None:
                answer = played.request(request)
            else:
                answer = played.assembly.requests.handle(asked(msgspec.json.encode(request)), client)
            if answer["ok"]:
                played.found = (*played.found, f"served: {request}")
            played.run(PERIOD_S)

    return inject


def unplanned(goals: Sequence[Sequence[float]]) -> Inject:
    """Tip goals, by a straight line, that no plan may reach."""

    def inject(played: Stage) -> None:
        q_rad = played.client.status()["joint_rad"]
        start = ForwardKinematics(played.arm).tip(*q_rad)
        for goal in goals:
            with suppress(ArmError):
                plan_path(played.arm, [start, goal], 0.2, q_near_rad=q_rad)
                played.found = (*played.found, f"planned: {goal}")

    return inject


def _guest(played: Stage) -> FrameLink:
    """Another device on the bus."""
    guest = played.rig.wires.guest()
    played.undo.callback(guest.close)
    return guest
