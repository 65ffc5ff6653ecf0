"""Millimetres, degrees and grams in an arm.toml are recognised; plausible arms, tiny and huge, are not."""

import dataclasses
from pathlib import Path

import pytest

from control.errors import ArmFileError
from control.model.arm import Arm, Drive, Link, Tool
from control.model.description import arm_text, load_arm, parse_arm

ROOT = Path(__file__).parents[3]
RIGHT = (ROOT / "control" / "arms" / "right.toml").read_text(encoding="utf-8")
FILE = Path("my_arm.toml")


@pytest.mark.parametrize(
    ("old", "new", "key", "looks_like"),
    [
        ("L_m = 0.4\n", "L_m = 400.0\n", "L_m of [[link]] 2", "millimetres: write 0.4"),
        ("d_m = -0.012", "d_m = -12", "d_m of [[link]] 3", "millimetres: write -0.012"),
        ("[0.0, 0.0, 0.15]", "[0.0, 0.0, 150]", "com_m of [[link]] 3", "millimetres: write [0, 0, 0.15]"),
        ("circle_radius_m = 0.09", "circle_radius_m = 90", "table.circle_radius_m", "millimetres: write 0.09"),
        ("line_pitch_m = 0.02", "line_pitch_m = 20", "table.line_pitch_m", "millimetres"),
        ("[0.50, 0.0, 0.0]", "[500, 0.0, 0.0]", "table.origin_m", "millimetres: write [0.5, 0, 0]"),
        ("_noise_m = 0.00014", "_noise_m = 0.14", "camera.position_noise_m", "millimetres: write 0.00014"),
        ("tip_speed_m_s = 1.0", "tip_speed_m_s = 1000", "limits.tip_speed_m_s", "millimetres per second"),
        ("base_radius_m = 0.06", "base_radius_m = 60", "limits.base_radius_m", "millimetres: write 0.06"),
        ("floor_tolerance_m = 0.01", "floor_tolerance_m = 10", "limits.floor_tolerance_m", "millimetres"),
        ("0.0, -9.81]", "0.0, -9810]", "gravity_m_s2", "millimetres per s^2: write [0, 0, -9.81]"),
        ("mass_kg = 1.1", "mass_kg = 1100", "mass_kg of [[link]] 2", "grams: write 1.1"),
        ("payload_limit_kg = 5.0", "payload_limit_kg = 5000", "limits.payload_limit_kg", "grams: write 5"),
        ("[0.0015, 0.018, 0.018]", "[1500, 18000, 18000]", "inertia_kg_m2 of [[link]] 2", "kg mm^2"),
        ("rotor_inertia_kg_m2 = 1.42e-5", "rotor_inertia_kg_m2 = 142", "rotor_inertia_kg_m2 of [[drive]] 1", "g cm^2"),
        ("speed_limit_rad_s = 2.0", "speed_limit_rad_s = 120", "joint_speed_limit_rad_s of [[drive]] 1", "degrees per second"),
        ("n_limit_rad_s2 = 10.0", "n_limit_rad_s2 = 4000", "joint_acceleration_limit_rad_s2 of [[drive]] 1", "degrees per"),
        ("joint_upper_rad = 2.6", "joint_upper_rad = 149", "joint_upper_rad of [[drive]] 1", "degrees: write 2.60054"),
        ("\nspeed_rad_s = 0.3", "\nspeed_rad_s = 17", "home.speed_rad_s of [[drive]] 1", "degrees per second"),
        ("backoff_rad = 0.05", "backoff_rad = 3", "home.backoff_rad of [[drive]] 1", "degrees: write 0.0523599"),
        ("q_rad = [0.0, 0.15, 0.75]", "q_rad = [0.0, 8.6, 43]", "rest.q_rad[3]", "degrees: write 0.750492"),
    ],
)
def test_a_value_in_another_unit_is_refused_with_what_it_looks_like(old: str, new: str, key: str, looks_like: str) -> None:
    assert old in RIGHT
    with pytest.raises(ArmFileError) as caught:
        parse_arm(RIGHT.replace(old, new, 1), FILE)
    assert caught.value.key == key
    assert f"this looks like {looks_like}" in caught.value.hint
    assert caught.value.line is not None


def test_an_effects_parameter_in_degrees_or_millimetres_is_refused() -> None:
    for effect, joint, key, value in (
        ("encoder_eccentricity", 1, "amplitude_rad = 0.001, phase_rad", 90),
        ("link_geometry", None, "link2_L_m", 4),
    ):
        where = f"joint = {joint}\n" if joint else ""
        text = f'{RIGHT}\n[[effect]]\neffect = "{effect}"\n{where}parameters = {{ {key} = {value} }}\n'
        with pytest.raises(ArmFileError, match="this looks like"):
            parse_arm(text, FILE)


def a_robot(lengths: tuple[float, ...], kg: tuple[float, ...], drive: Drive | None, tool: float = 0.0) -> Arm:
    """A chain of links of these lengths and masses, with the same drive at every joint."""
    links = tuple(
        Link("revolute", 0.0, 0.0, length, 1.5707963, mass, (0.5 * length, 0.0, 0.0), (1e-6, 1e-6, 1e-6))
        for length, mass in zip(lengths, kg, strict=True)
    )
    drives = (
        ()
        if drive is None
        else tuple(
            dataclasses.replace(drive, joint=j, motor_node=j, encoder_board=(j - 1) // 3, encoder_channel=(j - 1) % 3)
            for j in range(1, len(links) + 1)
        )
    )
    return Arm("plausible", links, drives=drives, tool=Tool((tool, 0.0, 0.0)))


HOBBY = Drive(1, 300.0, 28, 0.003, 8.0, 6.0, current_limit_A=0.6, joint_speed_limit_rad_s=6.0)
HEAVY = Drive(
    1,
    240.0,
    8192,
    1.6,
    0.1,
    400.0,
    rotor_inertia_kg_m2=0.05,
    current_limit_A=120.0,
    joint_speed_limit_rad_s=1.5,
    joint_acceleration_limit_rad_s2=20.0,
)
QUICK = Drive(
    1,
    50.0,
    4096,
    0.05,
    0.4,
    48.0,
    rotor_inertia_kg_m2=1e-5,
    current_limit_A=15.0,
    joint_speed_limit_rad_s=15.0,
    joint_acceleration_limit_rad_s2=600.0,
)
DIRECT = Drive(1, 1.0, 65536, 8.0, 2.0, 48.0, current_limit_A=10.0, joint_speed_limit_rad_s=6.0)

ON_JOINT = Drive(1, 1.0, 6283185, 35.2, 1.0, 1000.0, rotor_inertia_kg_m2=47.6, current_limit_A=10.0)
BENCH = Drive(1, 1.0, 20000, 0.025, 0.3, 24.0, rotor_inertia_kg_m2=1.2e-5, joint_speed_limit_rad_s=600.0)


@pytest.mark.parametrize("convention", ["standard", "modified"])
def test_a_column_that_no_joint_lifts_may_be_heavy_and_a_tilted_one_not(convention: str) -> None:
    """Joints 1 and 2 turn about the vertical: nothing but joint 3 and what hangs on it is a load of weight."""
    links = tuple(
        Link("revolute", height, 0.0, length, alpha, mass)
        for height, length, alpha, mass in (
            (1.0, 0.0, 0.0, 8.0),
            (1.5, 0.0, 1.5707963 if convention == "standard" else 0.0, 8.0),
            (0.0, 0.05, 0.0 if convention == "standard" else 1.5707963, 0.02),
        )
    )
    drives = tuple(dataclasses.replace(HOBBY, joint=j, motor_node=j, encoder_channel=j - 1) for j in (1, 2, 3))
    arm = Arm("column", links, drives=drives, dh_convention=convention)  # type: ignore[arg-type]
    assert parse_arm(arm_text(arm), FILE).joint_count == 3
    lifted = dataclasses.replace(arm, links=(*links[:2], dataclasses.replace(links[2], mass_kg=500.0)))
    for wrong in (lifted, dataclasses.replace(arm, gravity_m_s2=(6.9, 0.0, -6.9))):
        with pytest.raises(ArmFileError, match="this looks like grams"):
            parse_arm(arm_text(wrong), FILE)


@pytest.mark.parametrize(
    "arm",
    [
        pytest.param(a_robot((0.0, 0.06, 0.05), (0.05, 0.02, 0.01), HOBBY), id="hobby servos, 0.1 m"),
        pytest.param(a_robot((0.03, 0.08, 0.08, 0.04), (0.1, 0.09, 0.06, 0.03), None), id="desk arm, no drives"),
        pytest.param(a_robot((0.6, 1.5, 1.6, 0.3, 0.3), (4000, 3000, 2000, 300, 200), HEAVY), id="a car's body lifted"),
        pytest.param(a_robot((0.6, 1.5, 1.6, 0.3, 0.3), (4000, 3000, 2000, 300, 200), None), id="the same, no drives"),
        pytest.param(a_robot((0.3, 7.0, 7.0, 0.5), (100, 300, 300, 100), None), id="space station"),
        pytest.param(a_robot((0.0, 0.1, 0.1, 0.05), (1.5, 1.2, 0.8, 0.5), QUICK), id="small and quick"),
        pytest.param(a_robot((0.1, 0.3, 0.3), (5.0, 4.0, 2.0), DIRECT), id="direct drive"),
        pytest.param(a_robot((0.1, 0.3), (50.0, 20.0), ON_JOINT), id="constants on the joint's side"),
        pytest.param(a_robot((0.05,), (0.2,), BENCH), id="a motor on a bench"),
        pytest.param(a_robot((0.0, 0.0), (20.0, 8.0), None), id="pan and tilt"),
    ],
)
def test_no_false_alarm_on_plausible_arms(arm: Arm) -> None:
    assert parse_arm(arm_text(arm), FILE) == arm


IN_MM = a_robot((0.0, 150, 120), (0.3, 0.2, 0.1), None)
IN_GRAMS = a_robot((0.1, 0.1, 0.1), (300, 200, 100), None)


@pytest.mark.parametrize("arm", [IN_MM, IN_GRAMS])
def test_a_whole_small_arm_in_millimetres_or_grams_is_refused_without_drives(arm: Arm) -> None:
    with pytest.raises(ArmFileError, match=r"this looks like (millimetres|grams)"):
        parse_arm(arm_text(arm), FILE)


def test_a_refusal_that_rests_on_other_values_names_the_key_that_overrides_it() -> None:
    text = RIGHT.replace("mass_kg = 1.1", "mass_kg = 1100", 1)
    with pytest.raises(ArmFileError, match="write as_given = true"):
        parse_arm(text, FILE)
    arm = parse_arm(f"as_given = true\n{text}", FILE)
    assert arm.links[1].mass_kg == 1100.0
    assert parse_arm(arm_text(arm), FILE) == arm
    with pytest.raises(ArmFileError, match="millimetres"):  # which no arm has
        parse_arm(f"as_given = true\n{text.replace('L_m = 0.4', 'L_m = 400.0', 1)}", FILE)


@pytest.mark.parametrize("place_m", [1.2, 4.07, -60.0])
def test_a_tracker_may_stand_metres_away(place_m: float) -> None:
    text = f'{RIGHT}\n[[effect]]\neffect = "base_frame"\nparameters = {{ y_m = {place_m} }}\n'
    assert parse_arm(text, FILE).effects[-1].parameters["y_m"] == place_m
    with pytest.raises(ArmFileError, match="millimetres"):
        parse_arm(text.replace(f"y_m = {place_m}", "y_m = 4070.0"), FILE)


def test_the_arms_that_ship_are_plausible() -> None:
    assert [load_arm(name).name for name in ("right", "left")] == ["right", "left"]
