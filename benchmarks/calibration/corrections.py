"""Correction of named effects by the controller: tip errors of the mock arm with and without the effect in its model.

The mock hides friction and one effect. The tip runs a circle and comes to rest at points over the workspace; its true position
is compared with the commanded one. Three runs: the arm without the effect, with it unknown, with it in arm.toml.
Run with `python -m benchmarks.calibration.corrections`; docs/corrections.md has the table.
"""

import dataclasses
import sys
from collections.abc import Sequence
from dataclasses import dataclass

import msgspec
import numpy as np
from numpy.typing import NDArray

from control.hardware.connect import connect
from control.kinematics.inverse import InverseKinematics
from control.kinematics.kinematics import ForwardKinematics
from control.model.arm import Arm, Effect
from control.model.description import load_arm
from control.motion.plan import PlannedPath, plan_path
from control.safety.modes import Mode
from control.server.assemble import Assembly, assemble
from control.server.client import ArmClient
from control.server.in_process import InProcessChannel
from hil_mocks.rig import SteppedRig
from hil_mocks.scenario import EffectTable, Scenario, Start, load_scenario
from procedures.mock import wired_to

Points = NDArray[np.float64]
PERIOD_S = 0.002
RIGHT = load_arm("right")
# In front of the arm, from low to high, and where gravity changes sign for joints 2 and 3.
STOPS_m = (
    (0.45, 0.1, 0.25),
    (0.3, -0.3, 0.3),
    (0.1, 0.4, 0.55),
    (0.35, 0.15, 0.62),
    (0.05, 0.12, 0.78),
    (-0.1, 0.15, 0.76),
    (0.2, -0.1, 0.7),
    (0.5, -0.2, 0.12),
)
CIRCLE_m, RADIUS_m, SPEED_m_s = (0.38, 0.0, 0.3), 0.12, 0.15
FRICTION = tuple(Effect("coulomb_friction", j, {"torque_Nm": t}) for j, t in ((1, 1.0), (2, 1.2), (3, 0.7)))
GENTLE = 0.4  # of the joints' limits, between stops


@dataclass(frozen=True, slots=True)
class Case:
    """A hidden effect of the mock, with its settings."""

    name: str
    effects: tuple[Effect, ...]


def case(effect: str, joint: int | None, **parameters: float) -> Case:
    """One effect."""
    return Case(effect + (f" {joint}" if joint else ""), (Effect(effect, joint, parameters),))


GEOMETRIC = (
    *(case("backlash", joint, width_rad=0.005) for joint in (1, 2, 3)),
    *(case("joint_compliance", joint, stiffness_Nm_rad=k) for joint, k in ((1, 2000.0), (2, 2500.0), (3, 1500.0))),
    case("belt_coupling", None, ratio=0.01),
    *(case("encoder_eccentricity", joint, amplitude_rad=0.005, phase_rad=0.7) for joint in (1, 2, 3)),
    *(case("encoder_scale", joint, scale=0.004) for joint in (1, 2, 3)),
)


@dataclass(frozen=True, slots=True)
class Errors:
    """Tip errors [m]: root mean square and largest at rest, and along the paths; the cycle's median busy time."""

    rest_m: float
    rest_most_m: float
    path_m: float
    path_most_m: float


def run(hidden: Sequence[Effect], modelled: Sequence[Effect], seed: int = 7) -> Errors:
    """One run of the whole programme on an arm of nominal geometry."""
    return run_as(dataclasses.replace(RIGHT, effects=tuple(modelled)), hidden, seed)


def run_as(arm: Arm, hidden: Sequence[Effect], seed: int = 7) -> Errors:
    """One run with this model of the mock arm."""
    with SteppedRig(RIGHT, _scenario(hidden, seed)) as rig:
        connection = connect(wired_to(arm, rig), rig.clock, PERIOD_S)
        assembly = assemble(arm, connection.hardware, PERIOD_S, stopwatch_s=rig.clock.now_s)
        client = ArmClient(InProcessChannel(assembly, rig.clock))
        client.wait(0.05)
        client.enable()
        client.home()
        try:
            rest = _stops(arm, rig, client)
            path = _path(arm, rig, assembly, client)
        finally:
            connection.close()
    return Errors(_rms(rest), _most(rest), _rms(path), _most(path))


def _scenario(hidden: Sequence[Effect], seed: int) -> Scenario:
    shipped = load_scenario("ideal")
    tables = tuple(EffectTable(e.effect, e.joint or 0, dict(e.parameters)) for e in hidden)
    start = Start(q_rad=(0.1, -0.6, 0.2), homed=True)
    return msgspec.structs.replace(shipped, seed=seed, start=start, effect=tables)


def _stops(arm: Arm, rig: SteppedRig, client: ArmClient) -> Points:
    """Errors (m, 3) at rest; each stop is approached in both directions, so that joints come from both sides."""
    inverse = InverseKinematics(arm)
    q: tuple[float, ...] = (0.1, -0.6, 0.2)
    errors = []
    for stop in (*STOPS_m, *reversed(STOPS_m[:-1])):
        q = inverse.nearest(stop, q)
        client.move_joints(q, GENTLE)
        client.wait(0.3)
        errors.append(np.subtract(rig.tip_m(), stop))
    return np.array(errors)


def circle(arm: Arm = RIGHT) -> PlannedPath:
    """A circle in a tilted plane on which all joints reverse."""
    turns = np.linspace(0.0, 2.0 * np.pi, 25)
    x, y, z = CIRCLE_m
    points = [(x + RADIUS_m * np.cos(a), y + RADIUS_m * np.sin(a), z + 0.5 * RADIUS_m * np.sin(a + 1.0)) for a in turns]
    return plan_path(arm, [tuple(map(float, p)) for p in points], SPEED_m_s)


def _path(arm: Arm, rig: SteppedRig, assembly: Assembly, client: ArmClient) -> Points:
    """Errors (m, 3) of every cycle on the circle."""
    path, runtime, kinematics = circle(arm), assembly.runtime, ForwardKinematics(arm)
    client.move_joints(path.q_start_rad, GENTLE)
    client.wait(0.2)
    errors: list[Points] = []
    original = runtime.cycle

    def cycle(now_s: float, late_s: float, missed: int, missed_in_row: int) -> bool:
        goes_on = original(now_s, late_s, missed, missed_in_row)
        if runtime.monitor.mode is Mode.MOVING:
            errors.append(np.subtract(rig.tip_m(), kinematics.tip(*runtime.set_point.q_rad)))
        return goes_on

    runtime.cycle = cycle  # type: ignore[method-assign]
    client.run_path(path.to_message())
    return np.array(errors)


def _rms(errors: Points) -> float:
    return float(np.sqrt(np.mean(np.sum(errors**2, axis=1))))


def _most(errors: Points) -> float:
    return float(np.linalg.norm(errors, axis=1).max())


def table(cases: Sequence[Case]) -> list[str]:
    """Markdown rows: without the effect, with it unknown, with it named."""
    lines = ["| effect | at rest, unknown | named | on the circle, unknown | named |", "| --- | --- | --- | --- | --- |"]
    bare = run(FRICTION, FRICTION)
    lines.append(f"| none of these | {_mm(bare.rest_m, bare.rest_most_m)} | | {_mm(bare.path_m, bare.path_most_m)} | |")
    for one in cases:
        unknown, named = (run((*FRICTION, *one.effects), (*FRICTION, *of)) for of in ((), one.effects))
        cells = [
            _mm(unknown.rest_m, unknown.rest_most_m),
            _mm(named.rest_m, named.rest_most_m),
            _mm(unknown.path_m, unknown.path_most_m),
            _mm(named.path_m, named.path_most_m),
        ]
        lines.append(f"| {one.name} | {' | '.join(cells)} |")
        sys.stderr.write(lines[-1] + "\n")
    return lines


FED_FORWARD = (
    case("coulomb_friction", 2, torque_Nm=2.0),
    case("viscous_friction", 1, coefficient_Nm_s_rad=6.0),
    case("stribeck_friction", 1, torque_Nm=1.0, speed_rad_s=0.3),
    case("asymmetric_friction", 1, torque_Nm=0.8),
    case("load_friction", 2, fraction=0.25),
    case("cogging", 3, amplitude_Nm=0.6, order=2.0, phase_rad=0.4),
    case("torque_constant", 3, scale=0.7),
    case("payload", None, mass_kg=0.5),
    case("link_inertia", 2, mass_kg=1.0),
)


def tracking_rad(hidden: Sequence[Effect], modelled: Sequence[Effect], joint: int) -> float:
    """RMS following error of a joint (1-based) on slow moves there and back."""
    arm = dataclasses.replace(RIGHT, effects=tuple(modelled))
    errors: list[float] = []
    with SteppedRig(RIGHT, _scenario(hidden, 7)) as rig:
        connection = connect(wired_to(arm, rig), rig.clock, PERIOD_S)
        assembly = assemble(arm, connection.hardware, PERIOD_S, stopwatch_s=rig.clock.now_s)
        client, runtime = ArmClient(InProcessChannel(assembly, rig.clock)), assembly.runtime
        original = runtime.cycle

        def cycle(now_s: float, late_s: float, missed: int, missed_in_row: int) -> bool:
            goes_on = original(now_s, late_s, missed, missed_in_row)
            if runtime.monitor.mode is Mode.MOVING:
                errors.append(runtime.parts.measurement.q_rad[joint - 1] - runtime.aim.q_rad[joint - 1])
            return goes_on

        runtime.cycle = cycle  # type: ignore[method-assign]
        client.wait(0.05)
        client.enable()
        client.home()
        for target in ((0.3, -0.8, 0.5), (0.1, -0.6, 0.2)):
            client.move_joints(target, 0.3)
        connection.close()
    return float(np.sqrt(np.mean(np.square(errors))))


def forward_table(cases: Sequence[Case]) -> list[str]:
    """Markdown rows: following error [mrad] without the effect, with it unknown, with it named; dry friction is known in all."""
    lines = ["| effect | without it | unknown | named |", "| --- | --- | --- | --- |"]
    for one in cases:
        joint = one.effects[0].joint or 2
        keys = [(e.effect, e.joint) for e in one.effects]
        rest = tuple(e for e in FRICTION if (e.effect, e.joint) not in keys)
        hidden = (*rest, *one.effects)
        runs = ((rest, rest), (hidden, rest), (hidden, hidden))
        cells = [f"{1e3 * tracking_rad(hides, knows, joint):.2f}" for hides, knows in runs]
        lines.append(f"| {one.name} (joint {joint}) | {' | '.join(cells)} |")
    return lines


def _mm(rms_m: float, most_m: float) -> str:
    return f"{1e3 * rms_m:.3f} ({1e3 * most_m:.3f})"


if __name__ == "__main__":
    print("\n".join([*table(GEOMETRIC), "", *forward_table(FED_FORWARD)]))
