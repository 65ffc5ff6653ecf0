"""Errors of a mock robot; every message is one sentence for the operator."""

from __future__ import annotations

from firmware_iface.errors import ArmwrightError


class MockError(ArmwrightError):
    """Base of all errors of hil_mocks."""


class ScenarioError(MockError):
    """An invalid scenario file; the message names file and key."""


class UnreachableError(MockError):
    """The hand cannot seat the tip because the arm cannot reach the point."""


class RigError(MockError):
    """The mock robot did not start, or its process has ended."""
