"""An effect that nobody has thought of is two records: it is then named, written to arm.toml, read again and fed forward."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
import pytest

from benchmarks.gap.static.cases import ARM, case
from calib.gap.effects.catalogue import RECORDS
from calib.gap.effects.motor import friction, torque_of
from calib.gap.effects.record import EffectRecord, InPoses, InSeries, PoseScene, by_angle, harmonics
from calib.gap.finding import EffectName, updated_arm
from calib.gap.poses.find import find as find_in_poses
from calib.gap.posterior.term import Term
from calib.gap.series.find import find as find_in_series
from calib.gap.signals.terms import Form
from control.dynamics.feedforward import torque_model
from control.model.description import load_arm, save_arm
from control.model.effects import EFFECTS, EffectKind, Functions, Torque, itself, wave
from tests.calib.gap.series.prescribed import arm_with_friction, log_of

DRAG, ELLIPSE = "quadratic_drag", "encoder_ellipse"
DRAG_Nm_s2_rad2, AMPLITUDE_rad, PHASE_rad = 1.2, 0.004, 0.7


def drag(p: Mapping[str, float], f: Functions = math) -> Torque:
    """A joint that turns in oil."""
    coefficient = p["coefficient_Nm_s2_rad2"]
    return lambda angle, speed, load: coefficient * speed * abs(speed)


def twice_a_turn(record: EffectRecord, scene: PoseScene) -> Iterator[Term]:
    """An encoder disc that is no circle."""
    for j, q in enumerate(scene.points.q_rad.T):
        yield record.on_joint(scene, j + 1, np.array(harmonics(q, 2)))


@pytest.fixture
def _drag(monkeypatch: pytest.MonkeyPatch) -> None:
    parameter = "coefficient_Nm_s2_rad2"
    kind = EffectKind("joint", (parameter,), linear=itself(parameter), torque=drag, corrected="torque")
    monkeypatch.setitem(EFFECTS, DRAG, kind)  # type: ignore[arg-type]
    form = Form(DRAG, "motor", 0.03, is_torque=True, lower=(0.0,), torque=torque_of(DRAG))
    series = InSeries((form,), friction, "motor", departs=(by_angle,), variable="speed", over="speed")
    monkeypatch.setitem(RECORDS, DRAG, EffectRecord(DRAG, series=series, role="torque"))
    monkeypatch.setattr("calib.gap.series.find.motion_gaps", lambda *_: {})


@pytest.fixture
def _ellipse(monkeypatch: pytest.MonkeyPatch) -> None:
    kind = EffectKind("joint", ("amplitude_rad", "phase_rad"), linear=wave("amplitude_rad"))
    monkeypatch.setitem(EFFECTS, ELLIPSE, kind)  # type: ignore[arg-type]
    poses = InPoses(0.003, twice_a_turn, "poses over half a turn of that joint", variable="q{j}")
    monkeypatch.setitem(RECORDS, ELLIPSE, EffectRecord(ELLIPSE, poses=poses, role="angle"))


@pytest.mark.usefixtures("_drag")
def test_a_new_torque_is_named_in_time_series_written_and_fed_forward(tmp_path: Path) -> None:
    arm = arm_with_friction()
    log = log_of(arm, lambda j, q, speed, link: DRAG_Nm_s2_rad2 * speed * np.abs(speed) * (j == 1))
    found = find_in_series(arm, log, candidates=(DRAG, "viscous_friction", "load_friction"))
    (named,) = found.effects
    assert named.name == EffectName(DRAG, 2)
    value, sd = named.parameters["coefficient_Nm_s2_rad2"]
    assert value == pytest.approx(DRAG_Nm_s2_rad2, rel=0.1)
    assert 0.0 < sd < 0.2 * value
    save_arm(updated_arm(arm, found), tmp_path / "arm.toml")
    model = load_arm(str(tmp_path / "arm.toml"))
    still, moving = (0.0, 0.0, 0.0), (0.0, 0.5, 0.0)
    added = torque_model(model)(still, moving, still)[1] - torque_model(arm)(still, moving, still)[1]
    assert added == pytest.approx(value * 0.25, rel=1e-3)


@pytest.mark.usefixtures("_ellipse")
def test_a_new_error_of_an_angle_is_named_in_poses_and_written() -> None:
    points = case(41)
    q = points.q_rad.copy()
    q[:, 1] -= AMPLITUDE_rad * np.sin(2.0 * q[:, 1] + PHASE_rad)
    found = find_in_poses(ARM, dataclasses.replace(points, q_rad=q))
    (named,) = (one for one in found.finding.effects if one.name.effect != "link_geometry")
    assert named.name == EffectName(ELLIPSE, 2)
    amplitude, sd = named.parameters["amplitude_rad"]
    assert amplitude == pytest.approx(AMPLITUDE_rad, abs=3.0 * sd + 1e-4)
    assert named.parameters["phase_rad"][0] == pytest.approx(PHASE_rad, abs=0.1)
    (written,) = updated_arm(found.fitted_arm, found.finding).effects
    assert (written.effect, written.joint) == (ELLIPSE, 2)
