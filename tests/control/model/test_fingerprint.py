"""The runtime and its clients have the same arm: what is compared, what is not, and how a difference is said."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from benchmarks.arms import SIX
from control.model.arm import Arm, Calibration, Camera, CanBus, Effect, EncoderBoardPort, Rest, Table, Tool
from control.model.cell import load_cell
from control.model.description import arm_text, load_arm, parse_arm
from control.model.end_effector import CameraStream, Digital, Gripper
from control.model.fingerprint import NOT_COMPARED, AnotherArm, content_of, fingerprint, places_of, require_same
from control.model.maps import CorrectionMap
from control.model.reader import keys_of

PAGE = (Path(__file__).parents[3] / "docs" / "socket.md").read_text("utf-8")
FULL = replace(
    load_arm("left"),
    tool=Tool((0.01, 0.0, 0.1), name="pen", mass_kg=0.1),
    spare_tools=(Tool((0.0, 0.0, 0.2), name="probe"),),
    table=Table((0.5, 0.0, 0.0), 0.1, 8, cavities_m={"extra": (0.1, 0.0, 0.0)}),
    camera=Camera(stream=CameraStream("vicon", "tip", origin_m=(0.1, 0.2, 0.3))),
    gripper=Gripper(0.08, 0.002, 0.02, 1.0, 12.0, 2.0, 0.1, motor_node=9),
    digital=(Digital("lamp", 1, 0, "output"),),
    effects=(Effect("backlash", 2, {"width_rad": 1e-3}), Effect("coulomb_friction", 1, {"torque_Nm": 1.0})),
    maps=(CorrectionMap(1, "angle_rad", "angle_rad", (0.0, 1e-4, 2e-4, 1e-4), -1.0, 1.0),),
    rest=Rest((0.0, 0.0, 0.0)),
    can=CanBus("socketcan", "can0"),
    encoder_boards=(EncoderBoardPort("enc0", "/dev/ttyUSB0"),),
    calibration=Calibration("arm.toml", {"points.csv": "0"}, "2026-01-01", "tips", "0"),
)


def changes(value: Any, key: str) -> Iterator[tuple[str, Any]]:
    """Every value of a table changed, one at a time, with its key in the schema."""
    if isinstance(value, bool):
        yield key, not value
    elif isinstance(value, int | float):
        yield key, 0.75 * value + 1.1
    elif isinstance(value, str):
        yield key, f"{value}x"
    elif isinstance(value, Mapping):
        for name, inner in value.items():
            yield from ((k, {**value, name: new}) for k, new in changes(inner, f"{key}.{name}"))
    elif isinstance(value, tuple):
        for at, inner in enumerate(value):
            for k, new in changes(inner, key):
                yield k, (*value[:at], new, *value[at + 1 :])
    elif dataclasses.is_dataclass(value) and not isinstance(value, type):
        for name, field in keys_of(type(value)).items():
            for k, new in changes(getattr(value, field.name), f"{key}.{name}".lstrip(".")):
                yield k, replace(value, **{field.name: new})


def is_left_out(key: str) -> bool:
    parts = key.split(".")
    return any(".".join(parts[:n]) in NOT_COMPARED for n in range(1, len(parts) + 1))


def test_every_key_is_compared_or_named_as_one_that_is_not() -> None:
    missed, moved = set(), set()
    for key, changed in changes(FULL, ""):
        is_seen = content_of(changed) != content_of(FULL) and fingerprint(changed) != fingerprint(FULL)
        (missed if is_left_out(key) else moved).update([key] if is_seen == is_left_out(key) else [])
    assert (missed, moved) == (set(), set())


def test_the_page_names_every_key_that_is_not_compared() -> None:
    (section,) = re.findall(r"## Whose arm\n(.*?)\n## ", PAGE, re.DOTALL)
    named = set(re.findall(r"`([\w.]+)`", section))
    assert {key.rpartition(".")[2] for key in NOT_COMPARED} - {key.rpartition(".")[2] for key in named} == set()


@pytest.mark.parametrize("arm", [FULL, SIX, load_arm("right")], ids=lambda arm: arm.name)
def test_comments_order_and_usual_values_make_no_difference(arm: Arm, tmp_path: Path) -> None:
    text = arm_text(arm)
    tables = re.split(r"(?m)^(?=\[)", text)
    # A table of tables keeps its order; arrays in a line are the same with spaces and remarks about them.
    spaced = "# a remark\n" + "\n\n".join(table.replace(" = ", "   =  ") for table in tables)
    read = parse_arm(spaced, tmp_path / "elsewhere.toml")
    turned = replace(read, effects=read.effects[::-1], maps=read.maps[::-1])
    if turned.spare_tools:
        turned = turned.with_tool(turned.spare_tools[0].name)
    assert fingerprint(turned) == fingerprint(arm)
    whole, decimal = (replace(arm, gravity_m_s2=(0, 0, value)) for value in (-10, -10.0))
    assert fingerprint(whole) == fingerprint(decimal)


def test_a_difference_names_the_key_and_both_values_and_the_way_out() -> None:
    theirs = {"file": "/etc/arm.toml", "content": content_of(FULL)}
    require_same(FULL, theirs)
    links = (FULL.links[0], replace(FULL.links[1], L_m=0.35), *FULL.links[2:])
    with pytest.raises(AnotherArm) as error:
        require_same(replace(FULL, links=links, path=Path("my.toml")), theirs)
    assert f"link 2, L_m: {FULL.links[1].L_m:g}, in my.toml 0.35" in str(error.value)
    assert "another arm than my.toml: start it with this file, or give the one that it has (/etc/arm.toml)" in str(error.value)
    with pytest.raises(AnotherArm, match=r"^/etc/arm.toml has changed since the runtime read it"):
        require_same(replace(FULL, links=links, path=Path("/etc/arm.toml")), theirs)
    with pytest.raises(AnotherArm, match=r"effect backlash of joint 2, parameters, width_rad: 0.001, in my.toml nothing"):
        require_same(replace(FULL, effects=FULL.effects[1:], path=Path("my.toml")), theirs)


def test_a_runtime_of_an_earlier_version_is_no_guess() -> None:
    with pytest.raises(AnotherArm, match="does not say which arm it has"):
        require_same(FULL, {"ok": False, "error": "unknown request 'arm'"})


def test_of_two_effects_of_a_name_both_are_compared() -> None:
    effects = tuple(Effect("encoder_sine", 1, {"amplitude_rad": a}) for a in (1e-3, 2e-3))
    both = replace(FULL, effects=effects)
    assert fingerprint(both) == fingerprint(replace(FULL, effects=effects[::-1]))
    assert fingerprint(both) != fingerprint(replace(FULL, effects=effects[:1]))


def test_an_arm_of_a_cell_stands_where_the_runtime_has_it() -> None:
    cell = load_cell("pair")
    arm = cell.arms[0].arm
    theirs = {"file": "", "content": content_of(arm), "cell": places_of(cell)}
    require_same(arm, theirs, cell)
    moved = replace(cell, arms=(cell.arms[0], replace(cell.arms[1], origin_m=(1.0, 2.0, 3.0))))
    with pytest.raises(AnotherArm, match=r"arm \w+, origin_m: .*\[1, 2, 3\]"):
        require_same(arm, theirs, moved)
    require_same(arm, {"file": "", "content": content_of(arm)}, moved)  # served alone
