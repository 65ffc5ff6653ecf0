"""cell.toml: the supplied cell, and what is refused with file, line, key and remedy."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from console.main import main
from control.errors import ArmError, ArmFileError
from control.model.cell import cell_of_one, load_cell, save_cell
from control.model.description import arm_names, load_arm

PAIR = load_cell("pair")
KNOWN = " or ".join(f'"{name}"' for name in arm_names())
TWO = """name = "two"
[[arm]]
file = "left"
[[arm]]
file = "right"
motor_nodes = [4, 5, 6]
encoder_ports = ["/dev/ttyACM1"]
camera_port = 47311
"""


def written(folder: Path, text: str) -> Path:
    file = folder / "cell.toml"
    file.write_text(text)
    return file


def test_the_supplied_pair_is_the_two_supplied_arms_on_one_bus() -> None:
    left, right = PAIR.arms
    assert PAIR.names == ("left", "right")
    assert [drive.motor_node for placed in PAIR.arms for drive in placed.arm.drives] == [1, 2, 3, 4, 5, 6]
    assert left.arm.can == right.arm.can
    assert left.arm.links == load_arm("left").links


def test_a_base_that_is_turned_and_moved_takes_points_there_and_back(tmp_path: Path) -> None:
    half = math.sqrt(0.5)
    text = TWO + f"origin_m = [1.0, 2.0, 0.0]\norientation = [{half}, 0.0, 0.0, {half}]\n"
    right = load_cell(written(tmp_path, text)).placed("right")
    assert right.in_cell((0.5, 0.0, 0.1)) == pytest.approx((1.0, 2.5, 0.1))
    assert right.in_base(right.in_cell((0.1, 0.2, 0.3))) == pytest.approx((0.1, 0.2, 0.3))


@pytest.mark.parametrize(
    ("old", "new", "line", "said"),
    [
        ("[4, 5, 6]", "[3, 5, 6]", 6, "expected a motor node (here 3) that no other arm of the cell has, got that of"),
        ("[4, 5, 6]", "[4, 5]", 6, "arm.2.motor_nodes: expected 3 nodes, one per drive, got 2"),
        ("ttyACM1", "ttyACM0", 7, "expected a port that no other arm of the cell has, got that of arm 'left'"),
        ("47311", "47310", 8, "expected a camera port that no other arm of the cell has"),
        ("motor_nodes", "nodes", 6, "got an unknown key (did you mean motor_nodes?)"),
        ('"right"', '"left"', 4, "expected a name that no other arm of the cell has, got that of arm 'left'"),
        ('"right"', '"right"\norientation = [1.0, 1.0, 0.0, 0.0]', 6, "expected a unit quaternion"),
        ('"right"', '"right"\norientation = [0.0, 1.0, 0.0, 0.0]', 6, "expected gravity as of arm 'left'"),
        ('"right"', '"right"\norigin_m = [0.0, -250.0, 0.0]', 6, "this looks like millimetres: write [0, -0.25, 0]"),
        ('"right"', '"rigth"', None, f"expected a path to an arm.toml, or {KNOWN}"),
        ("[[arm]]", "[arm]", 2, "expected"),
    ],
)
def test_what_cannot_be_is_refused_with_its_line(tmp_path: Path, old: str, new: str, line: int | None, said: str) -> None:
    text = TWO.replace(old, new) if old != "[[arm]]" else TWO.partition('[[arm]]\nfile = "right"')[0].replace(old, new)
    with pytest.raises(ArmFileError) as refused:
        load_cell(written(tmp_path, text))
    assert said in str(refused.value)
    assert refused.value.line == line


def test_what_is_no_toml_is_refused_with_its_line(tmp_path: Path) -> None:
    file = written(tmp_path, TWO.replace('file = "right"', "file = right"))
    with pytest.raises(ArmFileError, match=r"cell\.toml, line 5: .*expected valid TOML"):
        load_cell(file)


def test_a_saved_cell_is_read_back_with_its_arms(tmp_path: Path) -> None:
    again = load_cell(save_cell(PAIR, tmp_path))
    assert again == PAIR


def test_an_unknown_arm_or_cell_is_refused_with_the_names() -> None:
    with pytest.raises(ArmError, match="no arm 'middle': expected one of left, right"):
        PAIR.placed("middle")
    with pytest.raises(ArmFileError, match='or "pair", got an unknown name'):
        load_cell("trio")


def test_an_arm_alone_stands_at_the_origin_of_its_cell() -> None:
    cell = cell_of_one(load_arm("right"))
    assert cell.placed("right").in_cell((0.1, 0.2, 0.3)) == (0.1, 0.2, 0.3)


BOUGHT = """name = "two"
[[arm]]
name = "a"
file = "{0}.toml"
[[arm]]
name = "b"
file = "{1}.toml"
"""


def saved(folder: Path, *kinds: str) -> None:
    """Arms of three joints on these kinds of boards, as `new` writes them."""
    for kind in kinds:
        options = ["--joints", "3", "--boards", kind, "--yes", "--out", str(folder / f"{kind}.toml")]
        assert main(["new", *options]) == 0


@pytest.mark.parametrize(
    ("kind", "said"),
    [
        ("feetech", "arm.2.board_ports: expected a port for its [[board]]s (here /dev/ttyACM0) that no other arm"),
        ("cia402", "arm.2.file: expected an address of a cia402 (here 1) on can0 that no other arm of the cell has"),
    ],
)
def test_two_arms_never_command_one_board(tmp_path: Path, kind: str, said: str) -> None:
    saved(tmp_path, kind)
    with pytest.raises(ArmFileError) as refused:
        load_cell(written(tmp_path, BOUGHT.format(kind, kind)))
    assert said in str(refused.value)


def test_the_ports_of_bought_boards_are_those_of_the_cell(tmp_path: Path) -> None:
    saved(tmp_path, "feetech")
    text = BOUGHT.format("feetech", "feetech")
    cell = load_cell(written(tmp_path, text + 'board_ports = ["/dev/ttyACM7"]\n'))
    assert {board.port for board in cell.placed("b").arm.boards} == {"/dev/ttyACM7"}
    with pytest.raises(ArmFileError, match="expected 1 ports, one for each of /dev/ttyACM0 in"):
        load_cell(written(tmp_path, text + 'board_ports = ["/dev/ttyACM7", "/dev/ttyACM8"]\n'))


def test_boards_that_take_each_others_frames_are_no_neighbours_on_a_bus(tmp_path: Path) -> None:
    saved(tmp_path, "reference", "odrive")
    with pytest.raises(ArmFileError, match="no odrive beside reference motor boards on one CAN bus"):
        load_cell(written(tmp_path, BOUGHT.format("reference", "odrive")))
