"""What boards of each kind cost and carry: microseconds of a cycle, and the highest rate at which every cycle has new values.

`python -m benchmarks.loop.boards` prints a table for the reference arm on the mock. The mock's serial lines take their time, byte
by byte; its CAN bus takes none, so CAN rates come from the bus arithmetic of the pages in docs.
"""

import sys
from statistics import quantiles
from time import perf_counter

import msgspec

from control.errors import ArmError
from control.hardware.connect import connect
from control.model.arm import Arm
from control.model.board_kinds import KINDS
from control.model.description import load_arm
from control.server.assemble import assemble
from control.server.client import ArmClient
from control.server.in_process import InProcessChannel
from firmware_iface.errors import LinkError
from hil_mocks.rig import SteppedRig
from hil_mocks.scenario import EveryJoint, load_scenario
from procedures.mock import wired_to
from procedures.on_boards import on_boards

CYCLES = 400
FRESH_SHARE = 0.99  # of the cycles with new counts of every joint
# Drives that open their windings hold no arm: without friction it would fall while they are set up, for 0.3 s on CANopen.
STIFF = msgspec.structs.replace(load_scenario("ideal"), every_joint=EveryJoint(coulomb_share=0.3))
RATES_Hz = (500, 400, 350, 300, 250, 200, 150, 100, 50)


def held(arm: Arm, rate_Hz: float) -> tuple[float, float]:
    """Hold the arm for CYCLES: microseconds of a cycle, and the share of cycles in which every joint had a new count.

    The time is of control alone, in a cycle that nothing interrupts.
    """
    period_s = 1.0 / rate_Hz
    with SteppedRig(arm, STIFF) as rig:
        model = wired_to(arm, rig)
        connection = connect(model, rig.clock, period_s)
        assembly = assemble(model, connection.hardware, period_s)
        client = ArmClient(InProcessChannel(assembly, rig.clock))
        try:
            client.wait(0.2)
            client.enable()
            spent_s, last, fresh = list[float](), list(connection.hardware.feedback.reported_at_s), 0
            cycle = assembly.runtime.cycle
            for _ in range(CYCLES):
                connection.hardware.attend(rig.clock.now_s() + period_s)
                begun_s = perf_counter()
                cycle(rig.clock.now_s(), 0.0, 0, 0)
                spent_s.append(perf_counter() - begun_s)
                seen = connection.hardware.feedback.reported_at_s
                fresh += all(new > old for new, old in zip(seen, last, strict=True))
                last = list(seen)
        finally:
            connection.close()
    return 1e6 * quantiles(spent_s, n=20)[0], fresh / CYCLES


def highest_Hz(arm: Arm) -> int:
    """The highest of RATES_Hz at which every cycle has new counts; 0 if none."""
    for rate_Hz in RATES_Hz:
        try:
            if held(arm, rate_Hz)[1] >= FRESH_SHARE:
                return rate_Hz
        except (ArmError, LinkError):
            continue  # the line refuses the rate
    return 0


def main() -> None:
    """Print a row for each kind."""
    reference = load_arm("right")
    cost_us, _ = held(reference, 500.0)
    sys.stdout.write(f"reference: {cost_us:.0f} us a cycle\n")
    for kind in KINDS:
        arm = on_boards(reference, kind)
        cost_us, _ = held(arm, arm.usual_rate_Hz)
        rate = f", {highest_Hz(arm)} Hz on the mock" if KINDS[kind].line == "serial" else ""
        sys.stdout.write(f"{kind}: {cost_us:.0f} us a cycle at {arm.usual_rate_Hz:.0f} Hz{rate}\n")


if __name__ == "__main__":
    main()
