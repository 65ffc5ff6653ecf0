"""`armwright mock`: a mock arm in real time, until Ctrl-C."""

import argparse
import sys

from hil_mocks.realtime import RealTimeRig


def run(given: argparse.Namespace) -> int:
    """Start the mock, print how to connect to it, and wait."""
    with RealTimeRig(given.arm, given.scenario) as rig:
        encoders = " ".join(f"--encoder {url}" for url in rig.encoder_urls)
        options = " ".join(f"--can-option {key}={value}" for key, value in rig.can_options.items())
        sys.stdout.write(
            f"A mock of arm {given.arm!r} runs with scenario {given.scenario!r}; Ctrl-C ends it. Connect to it with\n\n"
            f"  armwright serve --arm {given.arm} {encoders} --can-interface {rig.can_interface}"
            f" --can-channel {rig.can_channel} {options} --camera-port {rig.camera_port}\n"
        )
        sys.stdout.flush()
        try:
            status = rig.wait_for_end(None)
        except KeyboardInterrupt:
            return 0
    sys.stderr.write(f"armwright: the mock arm's process ended by itself with status {status}\n")
    return 1
