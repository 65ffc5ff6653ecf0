"""Drills of arms on bought boards: torque that nobody asked for, that was found, and that somebody else switched off.

A supply that sags, an error of one board, questions of another program, old firmware.
And of an arm.toml that is not true of the arm: an angle a turn off, a floor above the tip.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from math import dist

from control.model.description import load_arm
from control.safety.modes import Mode
from firmware_iface import canopen_wire as canopen
from firmware_iface import dynamixel_wire as dynamixel
from firmware_iface import feetech_wire as feetech
from firmware_iface import moteus as moteus
from firmware_iface import odrive as odrive
from firmware_iface import roboclaw as roboclaw
from firmware_iface import vesc as vesc
from firmware_iface.canopen import POSITION
from firmware_iface.errors import ConnectionFailed
from firmware_iface.link import CanFormat
from hil_mocks.devices.cia402_drive import Cia402Mock
from hil_mocks.devices.dynamixel import DynamixelLineMock
from hil_mocks.devices.feetech import FeetechLineMock
from hil_mocks.devices.moteus import MoteusMock
from hil_mocks.devices.odrive import OdriveMock
from hil_mocks.devices.roboclaw import RoboClawLineMock
from hil_mocks.devices.vesc import VescMock
from hil_mocks.scenario import FaultTable
from procedures.drills import drill
from procedures.on_boards import on_boards

HOLDING = ("dynamixel", "feetech", "odrive", "cia402", "moteus")
BRAKING = ("vesc", "roboclaw")
HOLDING_ON = HOLDING[:-1]  # at a low supply that they bear: a moteus frees its motor
DURING_A_CYCLE_S = 0.004  # at its end, a goal may switch a Feetech servo on again before its state is read
FALLS_mm = 900.0  # an arm without torque, or one of whose joints has none, falls as far as it can
HELD_mm = 3.0
SINKS_mm = 80.0  # on shorted windings, in two seconds
STOPS_mm = 100.0  # along its path
JOGGED_rad_s, JOGGED_S = 0.1, 0.2
SAGGED_V = 14.4  # of 24
# What is found of each kind when `serve` starts again, and how that is refused; "" where the connection serves it, too. Registers
# of servos: firmware of a Dynamixel without a bus watchdog; low byte of the model of a Feetech HLS, another series.
REFUSED = {
    "dynamixel": "expected firmware 38",
    "feetech": "expected an STS",
    "odrive": "expected firmware 0.6, it is 0.5",
    "cia402": "",
    "moteus": "",
    "vesc": "",
    "roboclaw": "",
}
SERVO_REGISTERS = {"dynamixel": (6, 36), "feetech": (3, 10)}
CYCLE_TIME = 0x60C2
MODE, EXTENDED_POSITION = 11, 4
FULL_DUPLEX = "roboclaw"
# What other programs ask the first board, and take no answer of: the position, or whether it is there.
QUESTIONS: dict[str, bytes | tuple[int, bytes, CanFormat]] = {
    "dynamixel": dynamixel.read(1, 132, 4),
    "feetech": feetech.read(1, 56, 2),
    "roboclaw": roboclaw.read_packet(0x80, roboclaw.RoboclawCommand.READ_ENCODERS),
    "odrive": (odrive.frame_id(1, odrive.OdriveCommand.CLEAR_ERRORS), b"\0", CanFormat.STANDARD),
    "cia402": (canopen.SDO_REQUEST + 1, canopen.read_request(POSITION), CanFormat.STANDARD),
    "moteus": (1 << 8 | moteus.ask(1)[0], moteus.ask(1)[1], CanFormat.FD),
    "vesc": (vesc.frame_id(vesc.Packet.PING, 0), bytes((7,)), CanFormat.EXTENDED),
}
OBEYS_S = 0.3  # until a board that was told to go off is off
LANDS_S = 20.0
ASKED_AFTER_S = 0.004  # of `enable`: its drives are on their way
AWAY_S = 1.0  # longer than any board's time-out
LOOKED_AROUND_S = 1.0  # by a person who finds the arm held
UP_rad, DOWN_rad = ((-0.6, 0.2, 0.2), (-0.6, -1.0, 0.0))  # the tip goes up, and down, from where every drill begins
RAISED_m = 0.1  # of the floor over the tip


@dataclass(frozen=True, slots=True)
class BoardsDrill(drill.Promise):
    """Something that befalls an arm on boards of one kind."""

    kind: str = HOLDING[0]
    act: Callable[[drill.Stage], str] = field(default=lambda played: "")  # what was wrong afterwards, as text

    def run(self) -> drill.DrillOutcome:
        """Run it on a fresh arm."""
        with drill.stage(on_boards(load_arm("right"), self.kind)) as played:
            played.run(0.1)
            played.way = played.way[-1:]
            wrong = self.act(played)
            way = played.way  # from what befell it on
            begun_s, before = way[0]
            return drill.DrillOutcome(
                self,
                max(dist(before, tip) for _, tip in way) * 1e3,
                drill.length_m(way) * 1e3,
                None if played.noticed_s is None else played.noticed_s - begun_s,
                drill.stood_s(way, begun_s, drill.LOOKED),
                "nothing",
                played.found,
                played.message,
                0.0,
                wrong,
            )

    @classmethod
    def all(cls) -> Iterator["BoardsDrill"]:
        """The drills, each on every kind of boards that it befalls."""
        lost, faulted, sagged, silent, moved = (
            frozenset(codes.split())
            for codes in ("drive_left link", "drive_fault", "drive_fault supply", "drive_silent", "encoder_contradicted")
        )
        for name, says, codes, most_mm, act, kinds in (
            ("off-at-once", "off pressed 4 ms after enable", drill.GOES_ON, FALLS_mm, off_at_once, HOLDING),
            ("restarted", "loop killed while it holds the arm, another started", drill.GOES_ON, HELD_mm, restarted, HOLDING),
            (
                "restarted-at-once",
                "another loop started before the time-out of any board",
                drill.GOES_ON,
                HELD_mm,
                restarted_at_once,
                HOLDING,
            ),
            ("torque-lost", "another program switches a drive off that holds", lost, FALLS_mm, torque_lost, HOLDING),
            (
                "torque-in-off",
                "another program switches a drive on while the arm is off",
                drill.GOES_ON,
                FALLS_mm,
                torque_in_off,
                HOLDING,
            ),
            ("turn-off", "encoder 1 reads a turn too much", drill.GOES_ON, FALLS_mm, a_turn_off, ("dynamixel", "odrive")),
            ("below-floor", "moves of an arm that stands below the floor", drill.GOES_ON, FALLS_mm, below_floor, HOLDING[:1]),
            ("brown-out", "the supply of one board sags to 60 %", sagged, HELD_mm, brown_out, HOLDING_ON),
            ("brown-out", "the supply of one board sags to 60 %", sagged, SINKS_mm, brown_out, (*HOLDING[-1:], *BRAKING)),
            ("own-error", "one board is too hot", faulted, FALLS_mm, own_error, (*HOLDING, *BRAKING)),
            ("overload", "a servo is overloaded, and keeps a share of its torque", faulted, HELD_mm, overloaded, ("feetech",)),
            ("asked", "another program asks a board in each cycle", drill.GOES_ON, HELD_mm, asked, (*HOLDING, *BRAKING[:1])),
            ("asked", "another program asks a board in each cycle", silent, SINKS_mm, asked, BRAKING[1:]),
            ("host-gone", "loop killed while joint 1 moves (jogged if not homed)", drill.GOES_ON, STOPS_mm, host_gone, HOLDING),
            ("host-gone", "loop killed while joint 1 moves (jogged if not homed)", drill.GOES_ON, SINKS_mm, host_gone, BRAKING),
            ("restarted", "loop killed while it holds the arm, another started", drill.GOES_ON, SINKS_mm, restarted, BRAKING),
            (
                "torque-in-hold",
                "another program commands a drive of a held arm now and then",
                moved,
                SINKS_mm,
                torque_in_hold,
                BRAKING,
            ),
            ("old-firmware", "other firmware is found when serve starts again", drill.GOES_ON, HELD_mm, old_firmware, HOLDING),
            ("old-firmware", "other firmware is found when serve starts again", drill.GOES_ON, SINKS_mm, old_firmware, BRAKING),
        ):
            for kind in kinds:
                yield cls(f"{name}-{kind}", f"{says}, on {kind}", drill.REST, codes, 0.1, most_mm, kind, act)


def _torques(played: drill.Stage) -> list[bool]:
    return [kind in ("voltage", "current") and value != 0.0 for kind, value in played.rig.robot.outputs]


def off_at_once(played: drill.Stage) -> str:
    """`off` crosses an enabling: in OFF no joint has torque, and none gets it."""
    played.client.ask("enable")
    played.run(ASKED_AFTER_S)
    played.client.ask("off")
    end_s = played.now_s + LANDS_S
    while played.mode is not Mode.OFF and played.now_s < end_s:
        played.run(0.01)
    played.run(OBEYS_S)
    if played.mode is not Mode.OFF:
        return f"off was not reached: {played.mode.name}"
    return "a joint had torque in OFF" if any(_torques(played)) else ""


def restarted(played: drill.Stage) -> str:
    """Boards that hold are left so, let go by no mere `off`, and taken over without a step; others wait for `enable`."""
    return _restarted(played, AWAY_S, LOOKED_AROUND_S)


def restarted_at_once(played: drill.Stage) -> str:
    """The same, of boards that are still in operation."""
    return _restarted(played, 0.0, 0.0)


def _restarted(played: drill.Stage, away_s: float, looked_s: float) -> str:
    holds = played.arm.boards[0].kind in HOLDING
    expected = Mode.HELD if holds else Mode.OFF
    played.begin(drill.REST)
    played.way = played.way[-1:]
    played.away(away_s)
    torques = [any(_torques(played))]
    played.restart()
    played.run(looked_s)
    torques.append(any(_torques(played)))
    if torques != [holds] * 2:
        return "a joint had torque that nobody had asked for" if any(torques) else "the boards did not hold"
    if played.mode is not expected:
        return f"the arm was {played.mode.name}, not {expected.name}"
    if holds and played.request({"do": "off"})["ok"]:
        return "off let the arm go without a question"
    played.client.enable()
    played.run(0.5)
    return "" if played.mode is Mode.HOLDING else f"it was not taken over: {played.mode.name}"


def torque_in_hold(played: drill.Stage) -> str:
    """A board that obeys whoever spoke last is taken back by the next cycle's command; what the joint did then is noticed."""
    played.begin(drill.REST)
    played.way = played.way[-1:]
    for _ in range(5):
        played.inject("switched_on", played.rig.robot.drive_names[1], at_s=played.now_s + DURING_A_CYCLE_S)
        played.run(0.1)
    return "" if played.mode is Mode.FAULT else f"the arm was {played.mode.name}"


def torque_lost(played: drill.Stage) -> str:
    """A drive that somebody else has switched off stays off, until a person enables it."""
    played.begin(drill.REST)
    played.way = played.way[-1:]
    played.inject("switched_off", played.rig.robot.drive_names[1], at_s=played.now_s + DURING_A_CYCLE_S)
    for _ in range(50):
        played.run(0.01)
        if _torques(played)[1]:
            return "the torque came back by itself"
    return ""


def torque_in_off(played: drill.Stage) -> str:
    """A drive that somebody else has switched on is switched off again."""
    played.inject("switched_on", played.rig.robot.drive_names[1], at_s=played.now_s + DURING_A_CYCLE_S)
    played.run(OBEYS_S)
    return "the torque stayed" if any(_torques(played)) else ""


def a_turn_off(played: drill.Stage) -> str:
    """A joint that reads a turn too much is neither enabled nor homed: a servo has counted on, or arm.toml is a turn off."""
    servos = [line.servos[1] for line in played.rig.robot.bought.lines if isinstance(line, DynamixelLineMock)]
    for servo in servos:
        servo.table[MODE], servo.turned_on = EXTENDED_POSITION, 1
    if not servos:
        first, *others = played.arm.drives
        turn = round(first.counts_per_joint_turn)
        played.arm = replace(played.arm, drives=(replace(first, zero_count=first.zero_count - turn), *others))
    played.restart()
    for do in ("enable", "home", "hold"):
        if played.request({"do": do})["ok"]:
            return f"{do} was accepted"
    played.run(0.5)
    return "it counts as homed" if played.assembly.runtime.monitor.is_homed else ""


def below_floor(played: drill.Stage) -> str:
    """The arm is moved up, and in no other way; what is accepted is not stopped midway."""
    limits = replace(played.arm.limits, floor_z_m=played.rig.tip_m()[2] + RAISED_m)
    played.arm = replace(played.arm, limits=limits, table=None)
    played.restart()
    played.begin(drill.REST)
    if played.request({"do": "move_joints", "q_rad": DOWN_rad})["ok"]:
        return "a move further down was accepted"
    played.client.move_joints(UP_rad)
    return "" if played.mode is Mode.HOLDING else f"the way up ended in {played.mode.name}"


def brown_out(played: drill.Stage) -> str:
    """A board whose supply sags is noticed; what holds goes on holding, and the arm is held again when the supply is back."""
    played.begin(drill.REST)
    played.way = played.way[-1:]
    played.inject("supply", _second(played)[0], value=SAGGED_V)
    played.run(drill.WATCHED_S)
    refusal = played.recover()
    played.client.enable()
    return refusal or ("" if played.mode is Mode.HOLDING else f"it was not held again: {played.mode.name}")


def own_error(played: drill.Stage) -> str:
    """A board that an error has freed stays so when its cause ends, until a person acknowledges; the others hold meanwhile."""
    played.begin(drill.REST)
    played.way = played.way[-1:]
    name, joint = _second(played)
    holding = [k for k, driven in enumerate(_torques(played)) if driven and k != joint]
    played.inject("over_temperature", name)
    played.run(0.5)
    torques = _torques(played)
    if played.arm.boards[0].kind in HOLDING and not all(torques[k] for k in holding):
        return "another joint was let go"
    played.mend()
    for _ in range(50):
        played.run(0.01)
        if _torques(played)[joint]:
            return "the torque came back by itself"
    return ""


def overloaded(played: drill.Stage) -> str:
    """What its settings leave of the torque is not switched off by us: the arm sinks by less than one that is let go."""
    played.begin(drill.REST)
    played.way = played.way[-1:]
    name, joint = _second(played)
    played.inject("over_current", name)  # its overload
    for _ in range(50):
        played.run(0.01)
        if not _torques(played)[joint]:
            return "the torque was switched off"
    return ""


def asked(played: drill.Stage) -> str:
    """Questions of another program, and their answers on the line; those of a RoboClaw cannot be told from its own."""
    played.begin(drill.REST)
    played.way = played.way[-1:]
    robot, kind = played.rig.robot, played.arm.boards[0].kind
    question = QUESTIONS[kind]

    def ask() -> None:
        if isinstance(question, bytes):
            if kind != FULL_DUPLEX:
                played.rig.wires.serial[0].write(question)  # all on the line hear it
            robot.from_host_serial(0, question)
        else:
            robot.from_host_can(*question)

    played.each_cycle.append(ask)
    played.run(drill.WATCHED_S)
    return ""


def host_gone(played: drill.Stage) -> str:
    """Without the host a board stops its joint by its own time-out, or goes on to its last goal; those that hold then hold."""
    played.begin(drill.REST)
    if played.assembly.runtime.monitor.is_homed:
        played.client.move_joints(drill.TO_rad, waits=False)
        played.run(drill.UNDER_WAY_S)
    else:
        played.client.ask("jog", joint=1, by_rad=1.0, speed_rad_s=JOGGED_rad_s)
        played.run(JOGGED_S)
    played.way = played.way[-1:]
    played.away(drill.WATCHED_S)
    if played.arm.boards[0].kind not in HOLDING or all(_torques(played)):
        return ""
    return "a joint was let go"


def old_firmware(played: drill.Stage) -> str:
    """Firmware that lacks what an arm relies on is refused before anything is commanded; what is only older is served."""
    played.begin(drill.REST)
    played.way = played.way[-1:]
    kind = played.arm.boards[0].kind
    refused = REFUSED[kind]
    _make_older(played, kind)
    try:
        played.restart()
    except ConnectionFailed as error:
        return "" if refused and refused in str(error) else f"refused for another reason: {error}"
    if refused:
        return "the board was taken"
    played.run(0.1)
    played.client.enable()
    played.run(0.5)
    return "" if played.mode is Mode.HOLDING else f"the arm was not held again: {played.mode.name}"


def _make_older(played: drill.Stage, kind: str) -> None:
    """What its boards of this kind have of other firmware."""
    bought = played.rig.robot.bought
    if kind in SERVO_REGISTERS:
        address, value = SERVO_REGISTERS[kind]
        for line in bought.lines:
            assert isinstance(line, DynamixelLineMock | FeetechLineMock)
            line.servos[2].table[address] = value
    for line in bought.lines:
        if isinstance(line, RoboClawLineMock):
            for claw in line.boards.values():
                claw.be_of_older_firmware()
    for mock in (mock for boards in bought.on_can for mock in boards.mocks):
        match mock:
            case Cia402Mock():
                for sub in range(3):
                    mock.objects.pop((CYCLE_TIME, sub), None)
            case MoteusMock():
                mock.setup = replace(mock.setup, unknown=(moteus.Register.AUX1_INPUTS, moteus.Register.FIRMWARE))
            case OdriveMock():
                mock.setup = replace(mock.setup, is_firmware_5=True)
            case VescMock():
                mock.setup = replace(mock.setup, answers=False)


def _second(played: drill.Stage) -> tuple[str, int]:
    """The board of joint 2, or the second one; and a joint that it drives."""
    name = played.rig.robot.drive_names[1]
    joint = played.rig.robot.bought.joint(FaultTable("supply", name))
    return name, 1 if joint is None else joint
