"""`armwright serve`: runs the loop in this process until it is stopped."""

import argparse
from pathlib import Path

from console.commands.connection import socket_path
from control.errors import ArmError
from control.hardware.connect import with_links
from control.model.arm import Arm
from control.model.description import load_arm
from control.server.process import ServeOptions, serve
from procedures.link_options import link_options

LOWEST_RATE_Hz, HIGHEST_RATE_Hz = 50.0, 1200.0  # three boards at 1 Mbit/s end at 1234 Hz


def run(given: argparse.Namespace) -> int:
    """Connect and serve."""
    if given.rate is not None and not LOWEST_RATE_Hz <= given.rate <= HIGHEST_RATE_Hz:
        raise ArmError(f"--rate: expected {LOWEST_RATE_Hz:g} to {HIGHEST_RATE_Hz:g} Hz, got {given.rate:g}")
    arm = with_links(load_arm(given.arm), link_options(given))
    rate_Hz = given.rate or arm.usual_rate_Hz
    options = ServeOptions(socket_path(given, arm), Path(given.log), 1.0 / rate_Hz, camera_port(given, arm))
    serve(arm, options)
    return 0


def camera_port(given: argparse.Namespace, arm: Arm) -> int | None:
    """The UDP port of the command line, or of the arm's [camera]; None for an arm without a camera."""
    if given.camera_port is not None:
        return int(given.camera_port)
    return arm.camera.udp_port if arm.camera else None
