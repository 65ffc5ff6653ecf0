"""What `armwright arm` says: figures that hold against the model itself, and what is missing for what."""

from __future__ import annotations

import dataclasses
import json
import math

import numpy as np
import pytest

from console.main import main
from control.dynamics.dynamics import Dynamics
from control.model.arm import Arm, CanBus
from control.model.description import load_arm, save_arm
from procedures.arm_sheet import missing, sheet, sheet_lines, warnings
from procedures.on_boards import on_boards
from tests.cell import with_drive, with_drives
from tests.places import ARMS

RIGHT = load_arm("right")
WEIGHTLESS = dataclasses.replace(RIGHT, links=tuple(dataclasses.replace(k, mass_kg=None) for k in RIGHT.links))

SLOW_BUS = dataclasses.replace(RIGHT, can=CanBus("virtual", "slow", bitrate=50_000))


def test_the_reference_arm_reaches_as_far_as_its_links() -> None:
    reach = sheet(RIGHT).reach
    assert 0.74 < reach.farthest_m <= math.hypot(0.4 + 0.3543, 0.012)
    assert 0.8 < reach.highest_m <= 0.076 + 0.4 + 0.3543
    assert 0.0 < reach.above_floor < 1.0


def test_the_payload_is_what_the_weakest_joint_holds_in_the_worst_pose() -> None:
    payload = sheet(RIGHT).payload
    assert payload is not None
    q = np.random.default_rng(5).uniform(*np.array(RIGHT.limits_rad).T, (2000, 3))
    limits = [drive.torque_limit_Nm for drive in RIGHT.drives]
    stretched = np.array([[0.0, -math.pi / 2, math.pi / 2 - 0.02]])  # joint 2 as loaded as it can be
    torques = np.abs(Dynamics(RIGHT, payload.everywhere_kg).torques(q, 0 * q, 0 * q))
    assert (torques <= 1.02 * np.array(limits)).all()
    worst = np.abs(Dynamics(RIGHT, 1.1 * payload.everywhere_kg).torques(stretched, 0 * stretched, 0 * stretched))
    assert worst[0, 1] > limits[1]


def test_the_payload_that_is_moved_is_what_the_weakest_joint_accelerates_whichever_way_the_others_go() -> None:
    payload = sheet(RIGHT).payload
    assert payload is not None
    random = np.random.default_rng(5)
    q = random.uniform(*np.array(RIGHT.limits_rad).T, (2000, 3))
    fastest = [drive.joint_acceleration_limit_rad_s2 for drive in RIGHT.drives]
    accelerations = random.choice([-1.0, 1.0], (2000, 3)) * fastest
    limits = np.array([drive.torque_limit_Nm for drive in RIGHT.drives])
    loads = [np.abs(Dynamics(RIGHT, kg).torques(q, 0 * q, accelerations)) / limits for kg in (payload.moving_kg, 4.0)]
    assert 0.8 < loads[0].max() <= 1.02
    assert loads[0].max(axis=0).argmax() == payload.moving_joint - 1
    assert loads[1].max() > 1.3


def test_the_buses_are_as_loaded_as_doctor_computes() -> None:
    buses = sheet(RIGHT).buses
    assert buses is not None
    assert buses.can == pytest.approx(6 * 135 * 500 / 1e6)
    assert buses.serial == (pytest.approx(1000 * 250 / 1e6),)


@pytest.mark.parametrize(
    ("arm", "says"),
    [
        (with_drive(RIGHT, 2, current_limit_A=1.0), "joint 2 does not hold the arm"),
        (with_drive(RIGHT, 2, current_limit_A=1.6), "joint 2 has little torque left"),
        (with_drive(RIGHT, 2, current_limit_A=2.5), "joint 2 cannot accelerate as its limit says"),
        (with_drive(RIGHT, 1, joint_speed_limit_rad_s=9.0), "joint 1 is slower than its speed limit"),
        (SLOW_BUS, "the CAN bus is too slow"),
    ],
)
def test_what_cannot_work_is_a_warning(arm: Arm, says: str) -> None:
    assert [text for text in warnings(sheet(arm)) if says in text] != []


def test_the_reference_arm_has_no_warning_and_lacks_nothing() -> None:
    assert list(warnings(sheet(RIGHT))) == []
    assert missing(RIGHT) == ()


@pytest.mark.parametrize(
    ("arm", "what", "needed_for"),
    [
        (dataclasses.replace(RIGHT, drives=()), "[[drive]] of joints 1, 2, 3", "every motion"),
        (dataclasses.replace(RIGHT, can=None), "[can]", "serve"),
        (dataclasses.replace(RIGHT, table=None), "[table]", "session"),
        (with_drives(RIGHT, home=None), "[drive.home] of joints 1, 2, 3", "home"),
        (with_drive(RIGHT, 2, inductance_H=0.0), "inductance_H of joint 2", "gap"),
        (with_drive(RIGHT, 2, joint_jerk_limit_rad_s3=math.inf), "joint_jerk_limit_rad_s3 of joint 2", "every motion"),
        (with_drive(RIGHT, 3, current_limit_A=math.inf), "current_limit_A of joint 3", "torque"),
        (WEIGHTLESS, "mass_kg", "payload"),
    ],
)
def test_what_is_missing_is_said_with_what_it_is_for(arm: Arm, what: str, needed_for: str) -> None:
    found = [one for one in missing(arm) if what in one.what]
    assert [needed_for in one.needed_for for one in found] == [True]
    assert "\n".join(sheet_lines(arm, sheet(arm), missing(arm)))


def test_an_arm_of_nothing_but_geometry_is_shown(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["arm", str(ARMS / "panda.toml")]) == 0
    said = capsys.readouterr().out
    assert "reach:" in said
    assert "missing: [[drive]] of joints 1, 2, 3, 4, 5, 6, 7" in said
    assert main(["arm", str(ARMS / "panda.toml"), "--json"]) == 0
    content = json.loads(capsys.readouterr().out)
    assert content["figures"]["payload"] is None
    assert content["figures"]["joints"][0]["torque_Nm"] is None


def test_every_arm_with_some_keys_less_is_shown(tmp_path, capsys: pytest.CaptureFixture[str]) -> None:  # type: ignore[no-untyped-def]
    for number, less in enumerate(("drives", "encoder_boards", "table", "camera", "can", "rest")):
        bare = () if isinstance(getattr(RIGHT, less), tuple) else None
        arm = dataclasses.replace(RIGHT, **{less: bare})
        if less == "encoder_boards":
            arm = dataclasses.replace(arm, can=None)
        file = tmp_path / f"{number}.toml"
        save_arm(arm, file)
        assert main(["arm", str(file)]) == 0
    capsys.readouterr()


def test_an_absolute_encoder_that_is_not_said_to_be_at_the_joint_is_named() -> None:
    told = on_boards(load_arm("right"), "odrive")
    assert all(board.absolute_turns for board in told.boards)
    untold = dataclasses.replace(told, boards=tuple(dataclasses.replace(board, absolute_turns=None) for board in told.boards))
    said, left = ({item.what for item in missing(arm)} for arm in (untold, told))
    assert said - left == {"absolute_turns of the boards of joints 1, 2, 3"}
