"""Tracking of a circle with orientation by six joints: the plant's true pose of the tip against that of the path.

Every cycle, on the stepped mock with the arm's own geometry, so that only tracking errors remain.
"""

from collections.abc import Iterator
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from benchmarks.arms import SIX, circle_in_place
from benchmarks.table import BenchRow
from control.hardware.connect import connect
from control.kinematics import rotation
from control.kinematics.kinematics import ForwardKinematics, PoseKinematics
from control.motion.plan import plan_path
from control.safety.modes import Mode
from control.server.assemble import assemble
from control.server.client import ArmClient
from control.server.in_process import InProcessChannel
from hil_mocks.rig import SteppedRig
from hil_mocks.scenario import EffectTable, EveryJoint, Scenario, Start, TrueDh, load_scenario
from procedures.mock import wired_to

PERIOD_S = 0.002
SPEED_m_s, TILT_rad = 0.15, 0.2
FRICTION_Nm = (0.5, 0.6, 0.4, 0.2, 0.2, 0.1)
Array = NDArray[np.float64]


def rows() -> Iterator[BenchRow]:
    """Yield the rows as they are measured."""
    for has_friction in (False, True):
        off_m, off_rad = tracking_errors(has_friction)
        what = f"6 joints with orientation, {'friction' if has_friction else 'no friction'}"
        for off, unit in ((1e3 * off_m, "mm"), (1e3 * off_rad, "mrad")):
            yield BenchRow(f"circle of 0.05 m at {SPEED_m_s} m/s, {what}, RMS", float(np.sqrt(np.mean(off**2))), unit)
            yield BenchRow(f"circle of 0.05 m at {SPEED_m_s} m/s, {what}, max", float(off.max()), unit)


def tracking_errors(has_friction: bool) -> tuple[Array, Array]:
    """Distances [m] and angles [rad] of the true tip from the path in each cycle of the run."""
    path = plan_path(SIX, circle_in_place(SIX, tilt_rad=TILT_rad), SPEED_m_s)
    wanted: list[tuple[float, ...]] = []
    true: list[tuple[float, ...]] = []
    with SteppedRig(SIX, _scenario(path.q_start_rad, has_friction)) as rig:
        connection = connect(wired_to(SIX, rig), rig.clock, PERIOD_S)
        assembly = assemble(wired_to(SIX, rig), connection.hardware, PERIOD_S, stopwatch_s=rig.clock.now_s)
        runtime, advance = assembly.runtime, assembly.runtime.cycle

        def cycle(*timing: Any) -> bool:
            goes_on = advance(*timing)
            if runtime.monitor.mode is Mode.MOVING:
                wanted.append(runtime.set_point.q_rad)
                true.append(tuple(rig.joint_rad()))
            return goes_on

        runtime.cycle = cycle  # type: ignore[method-assign, assignment]
        client = ArmClient(InProcessChannel(assembly, rig.clock))
        client.wait(0.05)
        client.enable()
        client.move_joints(path.q_start_rad)
        wanted.clear()
        true.clear()
        client.run_path(path.to_message())
        connection.close()
    poses = PoseKinematics(ForwardKinematics(SIX))
    asked, seen = poses.batch(wanted), poses.batch(true)
    turned = rotation.logarithms(seen.rotation @ np.swapaxes(asked.rotation, 1, 2))
    return np.linalg.norm(seen.position_m - asked.position_m, axis=1), np.linalg.norm(turned, axis=1)


def _scenario(q_rad: tuple[float, ...], has_friction: bool) -> Scenario:
    """The demo's noise on a known arm, at the path's start."""
    demo = load_scenario("demo")
    effects = tuple(EffectTable("coulomb_friction", joint, {"torque_Nm": torque}) for joint, torque in enumerate(FRICTION_Nm, 1))
    return msgspec.structs.replace(
        demo,
        true_dh=TrueDh(),
        every_joint=EveryJoint(),
        effect=effects if has_friction else (),
        start=Start(q_rad=q_rad, homed=True),
    )
