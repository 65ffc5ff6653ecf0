"""One runtime after another on the mock arm: its operator holds the tip while the drives are off.

Without brakes an arm sinks then, from any pose that its friction does not hold; so somebody holds it, as in a session.
"""

from pathlib import Path

from control.model.arm import Arm
from control.server.client import ArmClient
from procedures.mock import MockBench
from procedures.ports import HandPort


def shut_down(arm: Arm, bench: MockBench, client: ArmClient) -> Path:
    """Move to the rest pose, if there is one, and end the runtime there, with the tip held; returns its recording."""
    if arm.rest is not None:
        client.move_joints(arm.rest.q_rad, bench.speed)
    HandPort(bench.rig.hand, bench.wait).seat(bench.rig.tip_m())
    return bench.stop()


def start_again(arm: Arm, bench: MockBench) -> ArmClient:
    """Start a runtime with the model `arm`; its drives hold, homed, before the operator lets go."""
    client = bench.start(arm)
    client.enable()
    bench.rig.hand.let_go()
    client.home()  # at once where the boards still have their zeros
    return client
