"""Wires within one process, for the stepped mock: no kernel between the host's drivers and the boards.

The host opens them as any other: `mock://NAME` is a URL that pyserial resolves, `armwright-mock` an interface of python-can. The
drivers, and the bytes, are the same as over a pty and python-can's virtual bus (tests/hil_mocks/test_in_process.py).
"""

import serial
from can.interfaces import BACKENDS

CAN_INTERFACE = "armwright-mock"


def register() -> None:
    """Let pyserial and python-can find the handlers of this package."""
    if __name__ not in serial.protocol_handler_packages:
        serial.protocol_handler_packages.append(__name__)
    BACKENDS[CAN_INTERFACE] = (f"{__name__}.mock_can", "MockCanBus")
