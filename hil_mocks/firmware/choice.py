"""Which firmware the mock's reference boards run."""

from __future__ import annotations

import os

from hil_mocks.devices.encoder_board import EncoderBoardMock
from hil_mocks.devices.motor_board import MotorBoardMock
from hil_mocks.errors import ScenarioError
from hil_mocks.firmware.encoder_board import EncoderBoardFirmware
from hil_mocks.firmware.library import library
from hil_mocks.firmware.motor_board import MotorBoardFirmware
from hil_mocks.scenario import Scenario

VARIABLE = "ARMWRIGHT_MOCK_FIRMWARE"  # for every mock of a process and its children: drills, demos, tests
CHOICES = ("python", "c")


def choose(firmware: str | None) -> None:
    """Choose for every mock of this process and of its children; None leaves it as it is. FirmwareError if it cannot run."""
    if firmware == "c":
        library()
    if firmware is not None:
        os.environ[VARIABLE] = firmware


def encoder_board_class(scenario: Scenario) -> type[EncoderBoardMock | EncoderBoardFirmware]:
    """The encoder boards of a mock arm."""
    return EncoderBoardFirmware if _is_in_c(scenario) else EncoderBoardMock


def motor_board_class(scenario: Scenario) -> type[MotorBoardMock | MotorBoardFirmware]:
    """The motor boards of a mock arm."""
    return MotorBoardFirmware if _is_in_c(scenario) else MotorBoardMock


def _is_in_c(scenario: Scenario) -> bool:
    """Whether the boards run firmware_iface/firmware. ScenarioError for an unknown value of the variable."""
    chosen = scenario.firmware or os.environ.get(VARIABLE) or "python"
    if chosen not in CHOICES:
        raise ScenarioError(f"${VARIABLE}: expected {' or '.join(CHOICES)}, got {chosen!r}.")
    return chosen == "c"
