"""One [tool] without a name, or several [[tool]] by name of which the first is on; what is written is read back."""

import dataclasses
from pathlib import Path

import pytest

from control.dynamics.dynamics import Dynamics
from control.dynamics.feedforward import Loads
from control.errors import ArmError, ArmFileError
from control.kinematics.kinematics import ForwardKinematics
from control.model.arm import Arm, Tool
from control.model.description import arm_text, load_arm, parse_arm

RIGHT = load_arm("right")
PEN = Tool((0.0, 0.0, 0.12), name="pen", mass_kg=0.2, com_m=(0.0, 0.01, 0.05))
CUP = Tool((0.03, 0.0, 0.2), known=False, name="cup", mass_kg=0.6)
TWO = dataclasses.replace(RIGHT, tool=PEN, spare_tools=(CUP,))
STATE = ((0.3, -0.7, 0.4), (0.5, -0.2, 0.3), (1.0, 2.0, -1.0))
FILE = Path("own.toml")


def again(arm: Arm) -> Arm:
    return parse_arm(arm_text(arm), FILE)


@pytest.mark.parametrize("arm", [RIGHT, TWO, dataclasses.replace(RIGHT, tool=PEN)])
def test_tools_are_read_back_as_written(arm: Arm) -> None:
    assert again(arm).tools == arm.tools


def test_the_first_tool_of_a_file_is_on_and_another_may_be() -> None:
    arm = again(TWO)
    assert arm.tool == PEN
    assert arm.with_tool("cup").tools == (CUP, PEN)
    assert arm.with_tool("cup").with_tool("pen") == arm


def test_a_tool_that_is_not_there_is_refused_with_those_that_are() -> None:
    with pytest.raises(ArmError, match=r"no tool 'saw'.*pen, cup"):
        TWO.with_tool("saw")
    with pytest.raises(ArmError, match=r"its file names none"):
        RIGHT.with_tool("saw")


@pytest.mark.parametrize(
    ("old", "new", "match"),
    [
        ('name = "cup"', "", r"name of \[\[tool\]\] 2.*a name for every"),
        ('name = "cup"', 'name = "pen"', r"unique name.*pen a second time"),
        ('name = "cup"', 'name = "a cup"', r"letters, digits"),
        ("mass_kg = 0.6", "mass_kg = -0.6", r"mass_kg of \[\[tool\]\] 2.*not below 0"),
        ("mass_kg = 0.6", "mas_kg = 0.6", r"did you mean mass_kg"),
    ],
)
def test_a_wrong_key_of_a_tool_is_named(old: str, new: str, match: str) -> None:
    text = arm_text(TWO)
    assert old in text
    with pytest.raises(ArmFileError, match=match):
        parse_arm(text.replace(old, new), FILE)


def test_the_tip_is_that_of_the_tool_that_is_on() -> None:
    q_rad = STATE[0]
    bare = dataclasses.replace(RIGHT, tool=Tool(CUP.position_m))
    assert ForwardKinematics(TWO.with_tool("cup")).tip(*q_rad) == ForwardKinematics(bare).tip(*q_rad)


def test_the_mass_of_the_tool_that_is_on_is_in_the_dynamics() -> None:
    """A point mass at its centre is what a payload at a tip there would be."""
    point = dataclasses.replace(RIGHT, tool=Tool(PEN.centre_m))
    assert Dynamics(TWO).inverse(*STATE) == pytest.approx(Dynamics(point, PEN.mass_kg).inverse(*STATE), abs=1e-12)


def test_masses_follow_a_change_of_tool_at_the_given_rate() -> None:
    loads = Loads(TWO)
    loads.state(PEN, 1.0)
    loads.take_at_once()
    loads.state(CUP, 1.0)
    for _ in range(4):
        loads.follow(0.25)
    tip, centre = PEN.position_m, PEN.centre_m
    assert loads.masses_kg == pytest.approx({centre: 0.0, tip: 0.0, CUP.position_m: 1.0})
    for _ in range(3):
        loads.follow(0.25)
    assert loads.masses_kg == {CUP.position_m: 1.6}
    bare = dataclasses.replace(RIGHT, tool=Tool(CUP.position_m))
    laden, empty = Dynamics(bare, 1.6).inverse(*STATE), Dynamics(bare).inverse(*STATE)
    assert loads.torques(*STATE) == pytest.approx([w - e for w, e in zip(laden, empty, strict=True)], abs=1e-9)
