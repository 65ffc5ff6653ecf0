"""Plant, boards, camera and gripper of a mock arm, built from arm.toml and a scenario, and the wires between pins of its
boards.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

from control.model.arm import Arm, Drive
from control.model.end_effector import Gripper
from hil_mocks.devices.cameras import CameraMock, CameraSetup, MocapMock, NatNetMock, PictureMock, QtmMock, SceneSetup, ViconMock
from hil_mocks.devices.encoder_board import EncoderBoardHardware, EncoderBoardSetup
from hil_mocks.devices.motor_inputs import MotorBoardHardware, MotorBoardSetup
from hil_mocks.errors import RigError, ScenarioError
from hil_mocks.firmware import encoder_board_class, motor_board_class
from hil_mocks.plant.build import PlantOptions
from hil_mocks.plant.effects import EffectEntry, PlantEffects, deviations, gather
from hil_mocks.plant.gripper import GripperParts, GripperPlant
from hil_mocks.plant.parts import parts_of, rotor_inertia_kg_m2
from hil_mocks.plant.plant import Plant
from hil_mocks.scenario import EveryJoint, Scenario
from hil_mocks.wiring import ENCODER_BOARD_SERIAL, MOTOR_BOARD_SERIAL, OWN_INPUT, JointWiring, limit_switches

_MOTOR_BOARD_RATING_mA = 20_000
_CAMERA_NOISE_M = 0.00014  # default of scenario and arm.toml: 0.28 mm at 95 %
_TURN_NOISE_rad = 0.001  # of a body's orientation: that noise over markers some 150 mm apart
MOCAP: Mapping[str, type[MocapMock]] = {"vicon": ViconMock, "natnet": NatNetMock, "qualisys": QtmMock}


def effects_of(arm: Arm, scenario: Scenario) -> PlantEffects:
    """Effects of the real arm: those of arm.toml, overridden by the scenario's, and its hidden DH deviations."""
    where = f"scenario {scenario.path or scenario.name}"
    known = [EffectEntry(e.effect, e.joint or 0, e.parameters) for e in arm.effects] if scenario.plant.arm_effects else []
    for_this_arm = [e for e in scenario.effect if not e.arms or arm.name in e.arms]
    hidden = [EffectEntry(e.effect, e.joint, e.parameters) for e in for_this_arm]
    hidden += _of_every_joint(arm, scenario.every_joint, [*known, *hidden])
    drawn = scenario.drawn_deviations(len(arm.links))
    deviations(drawn, len(arm.links), f"{where}: [true_dh.deviations]")
    if drawn:
        hidden.append(EffectEntry("link_geometry", 0, drawn))
    return gather([*known, *hidden], len(arm.drives), len(arm.links), where)


def _of_every_joint(arm: Arm, table: EveryJoint, listed: Sequence[EffectEntry]) -> list[EffectEntry]:
    """What `[every_joint]` gives to joints that have no such effect yet."""
    present = {(entry.effect, entry.joint) for entry in listed}
    entries = []
    for drive in arm.drives:
        torque_Nm = _torque_Nm(drive)
        for effect, key, value in (
            ("coulomb_friction", "torque_Nm", table.coulomb_share * torque_Nm),
            ("viscous_friction", "coefficient_Nm_s_rad", table.viscous_share_s_rad * torque_Nm),
            ("backlash", "width_rad", table.backlash_rad),
        ):
            if value > 0.0 and (effect, drive.joint) not in present:
                entries.append(EffectEntry(effect, drive.joint, {key: value}))
    return entries


def _torque_Nm(drive: Drive) -> float:
    """At the joint, at the current limit, or stalled at the full supply if that is less."""
    current_A = min(drive.current_limit_A, drive.supply_V / drive.resistance_ohm)
    return current_A * drive.torque_constant_Nm_A * drive.gear_ratio


def start_pose(arm: Arm, scenario: Scenario) -> tuple[float, ...]:
    """The scenario's pose at power-up, else the rest pose of arm.toml, else all zero."""
    if scenario.start.q_rad is not None:
        return scenario.start.q_rad
    return tuple(arm.rest.q_rad) if arm.rest is not None else (0.0,) * len(arm.drives)


def build_plant(arm: Arm, scenario: Scenario) -> Plant:
    """Build the physics."""
    return Plant(parts_of(arm), effects_of(arm, scenario), start_pose(arm, scenario), plant_options(scenario))


def plant_options(scenario: Scenario) -> PlantOptions:
    """What a scenario says of the physics beside the arm."""
    return PlantOptions(
        timestep_s=scenario.plant.timestep_s,
        link_share=scenario.plant.link_share,
        end_stop_margin_rad=scenario.plant.end_stop_margin_rad,
        hand_speed_m_s=scenario.hand.speed_m_s,
        seating_noise_m=scenario.hand.seating_noise_m,
        seed=scenario.seed,
    )


def build_encoder_boards(arm: Arm, scenario: Scenario, wiring: Sequence[JointWiring]) -> list[EncoderBoardHardware]:
    """Build one board for each named by a drive, in order."""
    kind = encoder_board_class(scenario)
    boards: list[EncoderBoardHardware] = []
    for i in range(1 + max((w.encoder_board for w in wiring), default=-1)):
        on_it = {w.encoder_channel: w for w in wiring if w.encoder_board == i}
        channels = [on_it.get(at) for at in range(1 + max(on_it, default=0))]
        port = arm.encoder_boards[i] if i < len(arm.encoder_boards) else None
        setup = EncoderBoardSetup(
            serial_number=(port.serial_number if port else None) or ENCODER_BOARD_SERIAL + i,
            counts_per_turn=tuple(w.said_counts_per_turn if w else 4096 for w in channels),
            index_spacing_counts=tuple(w.counts_per_turn if w else 4096 for w in channels),
            encoder_bits=arm.drives[0].encoder_bits,
            baud=port.baud if port else 1_000_000,
            clock_ppm=scenario.encoder_board.clock_ppm,
        )
        boards.append(kind(setup, [w.index_count() if w else 0 for w in channels]))
    return boards


def build_motor_board(wiring: JointWiring, scenario: Scenario, read_shaft: Callable[[], int]) -> MotorBoardHardware:
    """Build the board of one joint; `read_shaft` is its encoder input."""
    table = scenario.motor_board
    setup = MotorBoardSetup(
        node=wiring.motor_node,
        serial_number=wiring.motor_serial_number,
        counts_per_turn=wiring.motor_counts_per_turn,
        rating_mA=_MOTOR_BOARD_RATING_mA,
        current_noise_A=table.current_noise_A,
        current_step_A=table.current_step_A,
        supply_noise_V=table.supply_noise_V,
        ambient_degC=table.ambient_degC,
        thermal_K_W=table.thermal_K_W,
        thermal_time_s=table.thermal_time_s,
        bridge_ohm=table.bridge_ohm,
        rated_degC=table.rated_degC,
        period_us=min(1000, round(scenario.tick_s * 1e6)),
        digital_pins=table.digital_pins,
        seed=scenario.seed,
    )
    return motor_board_class(scenario)(setup, read_shaft)


def build_camera(arm: Arm, scenario: Scenario) -> PictureMock:
    """Build the camera; its noise is the scenario's, else that of arm.toml."""
    table = scenario.camera
    noise_m = table.noise_m
    if noise_m is None:
        noise_m = arm.camera.position_noise_m if arm.camera is not None else _CAMERA_NOISE_M
    setup = CameraSetup(table.rate_Hz, noise_m, table.latency_s, table.dropout, table.clock_ppm, scenario.seed)
    if arm.camera is None or arm.camera.stream is None:
        return CameraMock(setup)
    stream, turn_noise_rad = arm.camera.stream, arm.camera.orientation_noise_rad or _TURN_NOISE_rad
    scene = SceneSetup(stream.body, stream.base_body, table.place_m, table.turn_rad, turn_noise_rad)
    return MOCAP[stream.system](setup, scene)


_RATING_mA = 8000
_NO_ENCODER_COUNTS = 4  # a board says some number, whether an encoder is connected or not


def build_gripper(gripper: Gripper, scenario: Scenario) -> GripperPlant:
    """The physics."""
    table = scenario.gripper
    turns_per_m = 1.0 / gripper.travel_per_turn_m
    parts = GripperParts(
        travel_m=gripper.travel_m,
        constant_N_A=2.0 * math.pi * gripper.torque_constant_Nm_A * turns_per_m,
        resistance_ohm=gripper.resistance_ohm,
        supply_V=gripper.supply_V,
        rotor_kg=rotor_inertia_kg_m2(gripper) * (2.0 * math.pi * turns_per_m) ** 2,
        friction_N=table.friction_N,
        start_m=table.start * gripper.travel_m,
        counts_per_m=gripper.encoder_counts_per_rev * turns_per_m,
        travel_per_turn_m=gripper.travel_per_turn_m,
    )
    plant = GripperPlant(parts, scenario.plant.timestep_s)
    if table.object_m is not None:
        plant.object_m = (table.object_m, table.object_N_m)
    return plant


def build_gripper_board(gripper: Gripper, scenario: Scenario, plant: GripperPlant) -> MotorBoardHardware:
    """Its motor board, which reads the encoder of its motor."""
    setup = MotorBoardSetup(
        node=gripper.motor_node,
        serial_number=gripper.motor_serial_number or MOTOR_BOARD_SERIAL + gripper.motor_node,
        counts_per_turn=gripper.encoder_counts_per_rev or _NO_ENCODER_COUNTS,
        rating_mA=_RATING_mA,
        current_noise_A=scenario.motor_board.current_noise_A,
        current_step_A=scenario.motor_board.current_step_A,
        supply_noise_V=scenario.motor_board.supply_noise_V,
        period_us=min(1000, round(scenario.tick_s * 1e6)),
        digital_pins=scenario.motor_board.digital_pins,
        seed=scenario.seed,
    )
    return motor_board_class(scenario)(setup, lambda: gripper.motor_direction * plant.count())


class PinWires:
    """What is connected to the pins of all boards, by name: wires from outputs to inputs, and levels from outside."""

    def __init__(self, arm: Arm, scenario: Scenario, boards: Sequence[MotorBoardHardware]) -> None:
        by_node = {board.setup.node: board for board in boards}
        self._places: Mapping[str, tuple[MotorBoardHardware, int]] = {
            pin.name: (by_node[pin.board], pin.pin) for pin in arm.digital if pin.board in by_node
        }
        self._wires = [(self._place(a), self._place(b)) for a, b in scenario.wire.items()]
        # of each limit switch its pin, joint, place, the side on which it is active, and the level of an active one
        self._limits = [
            (self._place(name), j, at_rad, side, drive.limit_switches.active == "high")
            for j, drive in enumerate(arm.drives)
            for name, at_rad, side in limit_switches(drive)
            if drive.limit_switches is not None and name != OWN_INPUT
        ]

    def set_level(self, name: str, level: bool) -> None:
        """Put a level on an input from outside; its limit switch changes by hand from then on. RigError for an unknown name."""
        if name not in self._places:
            raise RigError(f'mock arm: no pin "{name}"; there are {", ".join(self._places) or "none"}.')
        place = self._places[name]
        self._limits = [limit for limit in self._limits if limit[0] != place]
        self._put(place, level)

    def levels(self) -> dict[str, bool]:
        """Levels at all named pins."""
        return {name: bool(board.pins.levels >> pin & 1) for name, (board, pin) in self._places.items()}

    def tick(self, joint_rad: Sequence[float]) -> None:
        """Let levels pass through the wires, and joints press their limit switches."""
        for place, j, at_rad, side, is_active_high in self._limits:
            self._put(place, ((joint_rad[j] - at_rad) * side >= 0.0) is is_active_high)
        for (source, pin), target in self._wires:
            self._put(target, bool(source.pins.levels >> pin & 1))

    def _place(self, name: str) -> tuple[MotorBoardHardware, int]:
        if name not in self._places:
            raise ScenarioError(f'scenario: [wire]: no pin "{name}"; arm.toml has {", ".join(self._places) or "none"}.')
        return self._places[name]

    @staticmethod
    def _put(place: tuple[MotorBoardHardware, int], level: bool) -> None:
        board, pin = place
        board.pins.outside = board.pins.outside & ~(1 << pin) | level << pin
