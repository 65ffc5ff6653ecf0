"""`armwright check`: are the boards there, and are they the right ones? Nothing moves."""

import argparse
import sys

from console.commands.serve import camera_port, link_options
from control.loop.connect import connect, with_links
from control.loop.scheduling import punctuality_remedy
from control.model.description import load_arm
from firmware_iface.clock import MonotonicClock

PERIOD_S = 0.002


def run(given: argparse.Namespace) -> int:
    """Connect, say who answered, hang up."""
    arm = with_links(load_arm(given.arm), link_options(given))
    connection = connect(arm, MonotonicClock(), PERIOD_S, camera_port(given, arm))
    try:
        for encoder in connection.encoders:
            if (found := encoder.identity) is not None:
                _say(
                    f"{encoder.where}: serial number {found.serial_number}, firmware {found.firmware >> 8}."
                    f"{found.firmware & 255}, {found.channels} channels, {found.encoder_bits}-bit counters"
                )
        for motor in connection.motors:
            if (who := motor.identity) is not None:
                _say(
                    f"{motor.where}: serial number {who.serial_number}, firmware {who.firmware >> 8}."
                    f"{who.firmware & 255}, {who.encoder_counts_per_turn} counts a turn"
                )
    finally:
        connection.close()
    remedy = punctuality_remedy()
    _say(f"real-time rights: {remedy or 'granted'}")
    _say(f"arm {arm.name}: all boards are there and are the right ones")
    return 0


def _say(text: str) -> None:
    sys.stdout.write(f"{text}\n")
