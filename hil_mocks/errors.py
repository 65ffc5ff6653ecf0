"""What can go wrong with a mock robot; every message is one sentence that can be shown to an operator."""

from __future__ import annotations

from firmware_iface.errors import ArmwrightError


class MockError(ArmwrightError):
    """Base of all errors of hil_mocks."""


class ScenarioError(MockError):
    """A scenario file says something that the mock does not understand; names file and key."""


class UnreachableError(MockError):
    """The hand was asked to seat the tip where the arm cannot be."""


class RigError(MockError):
    """The mock robot did not start, or its process is gone."""
