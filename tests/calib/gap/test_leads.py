"""Play, spring and belt between two encoders: from simulated leads, and from those of an arm of four joints on the rig."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calib.arrays import Array
from calib.gap.leads import gears_by_leads
from calib.gap.log import Log, LoggedRun
from control.dynamics.dynamics import Dynamics
from control.dynamics.gains import placed_gains
from control.model.arm import Arm, Effect
from tests.control.loop.test_encoder_places import (
    BELT,
    PLAY_rad,
    STIFFNESS_Nm_rad,
    arm_of_four,
    holding_four,
    known_friction,
    with_both,
)

ARM = with_both(arm_of_four("joint"))
PERIOD_S, EVERY, STEP_rad = 0.002, 20, 1e-4
TOURS = (
    ((0.4, 0.9, 0.6, -0.3), (-0.3, -0.9, 0.4, 0.5)),
    ((0.2, 0.5, -1.0, 0.2), (0.0, -0.5, 1.0, -0.2)),
    ((-0.4, 0.9, -0.9, 0.4), (0.0, -0.9, 0.9, 0.1)),
    ((0.3, 0.2, 0.9, 0.2), (0.0, -1.0, -0.5, 0.0)),
)


def run_of(name: str, t_s: Array, q_rad: Array, lead_rad: Array) -> LoggedRun:
    m, n = q_rad.shape
    nothing = np.full((m, n), np.nan)
    columns = {f"lead{j + 1}_rad": tuple("" if x != x else f"{x:.9g}" for x in own) for j, own in enumerate(lead_rad.T)}
    seen = np.full((m, 3), np.nan)
    return LoggedRun(name, t_s - t_s[0], q_rad, nothing, nothing, nothing, np.zeros(m), seen, columns)


def simulated(play_rad: float, stiffness_Nm_rad: float, seed: int) -> Log:
    """Joint 2 of three runs: its motor leads by a hard-flanked play and a spring, seen each 40 ms to a count."""
    draw, t_s, runs = np.random.default_rng(seed), np.arange(0.0, 12.0, PERIOD_S), []
    for k in range(3):
        w, phase = draw.uniform(0.6, 1.4, 4), draw.uniform(0.0, 6.0, 4)
        q = 0.8 * np.sin(t_s[:, None] * w + phase)
        speed, acceleration = 0.8 * w * np.cos(t_s[:, None] * w + phase), -(w**2) * q
        drive = ARM.drives[1]
        torque = Dynamics(ARM).torques(q, speed, acceleration)[:, 1]
        torque -= drive.gear_ratio**2 * drive.rotor_inertia_kg_m2 * acceleration[:, 1]
        lead = np.full_like(q, np.nan)
        exact = torque / stiffness_Nm_rad + 0.5 * play_rad * np.sign(torque) + 0.003 * speed[:, 1]
        lead[::EVERY, 1] = np.round(exact / STEP_rad)[::EVERY] * STEP_rad
        runs.append(run_of(str(k), t_s, q, lead))
    return Log(tuple(runs))


@pytest.mark.parametrize(("play_rad", "stiffness_Nm_rad"), [(0.006, 600.0), (0.006, 1e9), (0.0, 600.0)])
def test_play_and_spring_are_told_apart_and_measured(play_rad: float, stiffness_Nm_rad: float) -> None:
    found = {str(one.name): one.parameters for one in gears_by_leads(ARM, simulated(play_rad, stiffness_Nm_rad, 1))}
    wanted = {"backlash on joint 2": ("width_rad", play_rad)} if play_rad else {}
    if stiffness_Nm_rad < 1e6:
        wanted["joint_compliance on joint 2"] = ("stiffness_Nm_rad", stiffness_Nm_rad)
    assert set(found) == set(wanted)
    for name, (key, true) in wanted.items():
        assert found[name][key][0] == pytest.approx(true, rel=0.04)


@pytest.mark.parametrize("seed", range(5))
def test_a_stiff_gear_is_given_no_name(seed: int) -> None:
    assert gears_by_leads(ARM, simulated(0.0, 1e9, seed)) == ()


def test_a_log_without_leads_or_an_arm_with_one_encoder_says_nothing() -> None:
    log = simulated(0.006, 600.0, 1)
    bare = Log(tuple(replace(run, extra={}) for run in log.runs))
    assert gears_by_leads(ARM, bare) == ()
    assert gears_by_leads(arm_of_four("joint"), log) == ()


def tuned(arm: Arm, pole_rad_s: float = 12.0) -> Arm:
    """With gains of its own in its file, by which it crosses its play more quickly than by those of the model."""
    drives = []
    for j, drive in enumerate(arm.drives):
        inertia_kg_m2 = float(Dynamics(arm).mass_matrix((0.0,) * 4)[j][j])
        gains = placed_gains(replace(drive, encoder_on="motor"), inertia_kg_m2, 0.001, pole_rad_s)
        drives.append(replace(drive, pid=replace(drive.pid, kp=gains.kp, ki=gains.ki, kd=gains.kd)))
    return replace(arm, drives=tuple(drives))


@pytest.mark.nightly
def test_the_leads_of_an_arm_show_play_spring_and_belt_of_its_gears() -> None:
    """Friction on both sides of the gears, flanks that are passed, counts of two moments: what the law leaves out."""
    arm, runs = with_both(tuned(known_friction(arm_of_four("joint")))), []
    with holding_four(arm) as cell:
        rows: list[tuple[float, ...]] = []
        parts = cell.runtime.parts
        cell.watchers.append(lambda: rows.append((cell.rig.clock.now_s(), *parts.measurement.q_rad, *parts.motor_leads.lead_rad)))
        for k, tour in enumerate(TOURS):
            rows.clear()
            for place in tour:
                cell.client.move_joints(place, 0.3)
                cell.run(0.2)
            table = np.array(rows)
            runs.append(run_of(str(k), table[:, 0], table[:, 1:5], table[:, 5:]))
    found = {str(one.name): one.parameters for one in gears_by_leads(arm, Log(tuple(runs)))}
    wanted = {
        "backlash on joint 2": ("width_rad", PLAY_rad),
        "backlash on joint 3": ("width_rad", PLAY_rad),
        "joint_compliance on joint 2": ("stiffness_Nm_rad", STIFFNESS_Nm_rad),
        "belt_coupling on joint 3": ("ratio", BELT),
    }
    assert set(found) == set(wanted)
    for name, (key, true) in wanted.items():
        assert found[name][key][0] == pytest.approx(true, rel=0.06)
    known = replace(arm, effects=(*arm.effects, Effect("belt_coupling", None, {"ratio": 0.001})))
    (belt,) = [one for one in gears_by_leads(known, Log(tuple(runs))) if one.name.effect == "belt_coupling"]
    assert belt.parameters["ratio"][0] == pytest.approx(found["belt_coupling on joint 3"]["ratio"][0] + 0.001)
