"""Several mock arms in one world of MuJoCo, on one CAN bus, each with its own encoder boards and camera.

Advanced together in ticks, as one arm is (hil_mocks.robot). The base of each stands where the cell.toml says.
"""

from __future__ import annotations

import itertools
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import msgspec
import mujoco

from control.model.cell import Cell
from firmware_iface.clock import Clock
from firmware_iface.link import CanFormat, Closing
from hil_mocks.assembly import effects_of, plant_options, start_pose
from hil_mocks.devices.motor_inputs import Frame
from hil_mocks.errors import RigError, ScenarioError
from hil_mocks.plant.build import PlantOptions, Standing, build, to_build
from hil_mocks.plant.effects import PlantEffects
from hil_mocks.plant.parts import ArmParts, parts_of
from hil_mocks.plant.plant import Plant, step_together
from hil_mocks.protocol_mock import CAN_INTERFACE, SerialLine, register
from hil_mocks.rig import ArmPorts, SteppedClock
from hil_mocks.robot import MockRobot
from hil_mocks.scenario import Scenario, load_scenario
from hil_mocks.wires import Picture, Wires
from hil_mocks.wiring import as_built

_rigs = itertools.count(1)  # a virtual bus is shared by all users of its channel in the process


class MockCell:
    """All arms of a cell; meets `hil_mocks.wires.OnWires` as one arm does. Serial lines come arm by arm."""

    def __init__(self, cell: Cell, scenario: Scenario) -> None:
        is_alone = len(cell.arms) == 1
        if scenario.fault and not is_alone:
            raise ScenarioError(
                f"scenario {scenario.path or scenario.name}: expected no [[fault]] for a cell of {len(cell.arms)} arms, since"
                " it does not say of which arm: inject it instead"
            )
        # Each arm has its own hidden errors and noise.
        scenarios = [msgspec.structs.replace(scenario, seed=scenario.seed + index) for index in range(len(cell.arms))]
        arms = [as_built(placed.arm, seeded) for placed, seeded in zip(cell.arms, scenarios, strict=True)]
        plants = plants_of(
            [
                PlacedPlant(
                    parts_of(arm),
                    effects_of(arm, seeded),
                    start_pose(arm, seeded),
                    plant_options(seeded),
                    Standing() if is_alone else Standing(placed.name, placed.origin_m, placed.orientation),
                )
                for placed, arm, seeded in zip(cell.arms, arms, scenarios, strict=True)
            ]
        )
        self.robots: Mapping[str, MockRobot] = {
            placed.name: MockRobot(placed.arm, seeded, plant)
            for placed, seeded, plant in zip(cell.arms, scenarios, plants, strict=True)
        }
        self._plants, self._all = plants, tuple(self.robots.values())
        self.tick_s, self._steps = self._all[0].tick_s, self._all[0].steps_per_tick
        self._line_of = [(robot, k) for robot in self._all for k in range(robot.serial_lines)]
        self.transports = [robot.camera.transport for robot in self._all]
        self.can_formats = set[CanFormat]().union(*(robot.can_formats for robot in self._all))
        self.outgoing: dict[CanFormat, list[Frame]] = {carried: [] for carried in CanFormat}
        self.camera_outgoing: list[Picture] = []

    @property
    def now_s(self) -> float:
        """Time since power-up."""
        return self._all[0].now_s

    @property
    def serial_lines(self) -> int:
        """The number of serial lines of all arms."""
        return len(self._line_of)

    def robot(self, name: str | None) -> MockRobot:
        """An arm by its name; without one, the only arm. RigError lists the names."""
        if name is None and len(self._all) == 1:
            return self._all[0]
        if name is None or name not in self.robots:
            names = ", ".join(self.robots)
            got = "none" if name is None else f'"{name}"'
            raise RigError(f"mock cell: expected `arm` to be one of {names}, got {got}.")
        return self.robots[name]

    def ports(self, paths: list[str]) -> Iterator[tuple[str, list[str], dict[str, str]]]:
        """For each arm: its name, its encoder boards' paths, and the path of each port of its bought boards."""
        at = 0
        for name, robot in self.robots.items():
            arm_paths = paths[at : at + robot.serial_lines]
            at += robot.serial_lines
            encoders = len(robot.encoder_boards)
            yield name, arm_paths[:encoders], dict(zip(robot.bought.ports, arm_paths[encoders:], strict=True))

    def tick(self) -> None:
        """Advance everything by one tick."""
        step_together(self._plants, self._steps)
        for robot in self._all:
            robot.after_physics()
        self._gather()

    def from_host_serial(self, board: int, received: bytes) -> None:
        """Process bytes from the host to a serial line now."""
        robot, line = self._line_of[board]
        robot.from_host_serial(line, received)

    def from_host_can(self, can_id: int, payload: bytes, carried: CanFormat = CanFormat.STANDARD) -> None:
        """Process a frame from the host now: every board on the bus sees it."""
        for robot in self._all:
            robot.from_host_can(can_id, payload, carried)
        self._gather()

    def from_host_camera(self, camera: int, request: bytes) -> None:
        """Process a packet from the host to the camera of an arm now."""
        self._all[camera].from_host_camera(0, request)
        self._gather()

    def serial_outgoing(self, board: int, ahead_s: float = 0.0) -> bytes:
        """Bytes of a serial line that arrive at the host by now, or within `ahead_s`."""
        robot, line = self._line_of[board]
        return robot.serial_outgoing(line, ahead_s)

    @property
    def serial_next_s(self) -> float:
        """When the next bytes of any serial line arrive at the host; infinity if none are under way."""
        return min(robot.serial_next_s for robot in self._all)

    def _gather(self) -> None:
        for camera, robot in enumerate(self._all):
            for carried, sent in robot.outgoing.items():
                if sent:
                    self.outgoing[carried] += sent
                    sent.clear()
            if robot.camera_outgoing:
                self.camera_outgoing += [(camera, datagram) for _, datagram in robot.camera_outgoing]
                robot.camera_outgoing.clear()


class SteppedCell(Closing):
    """A mock cell in this process, deterministic: `hil_mocks.rig.SteppedRig` for several arms."""

    def __init__(self, cell: Cell, scenario: Scenario | str = "ideal") -> None:
        self.scenario = scenario if isinstance(scenario, Scenario) else load_scenario(scenario)
        self.mock = MockCell(cell, self.scenario)
        register()
        name = f"armwright-cell-{os.getpid()}-{next(_rigs)}"
        lines = [SerialLine(f"{name}-{k}") for k in range(self.mock.serial_lines)]
        self.can_interface, self.can_channel = CAN_INTERFACE, name
        self.wires = Wires(lines, CAN_INTERFACE, name, self.mock.transports, self.mock.can_formats)
        self.can_options = self.wires.can_options
        paths = [wire.path for wire in self.wires.serial]
        self.ports = {
            arm: ArmPorts(urls, boards, self.can_interface, name, self.can_options, camera_port)
            for (arm, urls, boards), camera_port in zip(self.mock.ports(paths), self.wires.camera_ports, strict=True)
        }
        self.clock: Clock = SteppedClock(self.mock, self.wires)

    def close(self) -> None:
        """Close all links."""
        self.wires.close()


@dataclass(frozen=True, slots=True)
class PlacedPlant:
    """What `plants_of` builds the plant of one arm from."""

    arm: ArmParts
    effects: PlantEffects
    start_rad: Sequence[float]
    options: PlantOptions
    standing: Standing


def plants_of(placed: Sequence[PlacedPlant]) -> list[Plant]:
    """Plants of several arms in one world; `step_together` advances them."""
    models = build([to_build(p.arm, p.effects, p.options, p.standing) for p in placed])
    state = mujoco.MjData(models[0].model)
    return [Plant(p.arm, p.effects, p.start_rad, p.options, (at, state)) for p, at in zip(placed, models, strict=True)]
