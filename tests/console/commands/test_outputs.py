"""Where commands write: only what writes demands a place, and a folder that is not there is made."""

import shlex
from itertools import pairwise
from pathlib import Path

import pytest

from calib.closed_chain.planning import plan_contacts
from console.main import main
from console.options import CommandSpec
from console.specs.table import COMMANDS
from control.model.table import board_cavities, table_of
from tests.cell import RIGHT
from tests.journeys import sheet
from tests.journeys.runner import JOURNEYS

WRITES_NOTHING = ("--plan-only", "--choose")  # of commands that write otherwise
MADE = """
new --out n/a/my_arm.toml --joints 3 --yes
export-arm --arm n/a/my_arm.toml --export urdf --out n/u/out.urdf
arm --from-urdf n/u/out.urdf --out n/b/arm.toml
import-points sheet.csv --arm n/a/my_arm.toml --out n/m
calibrate --arm n/a/my_arm.toml --points n/m/points.csv --fix base --out n/c --history n/h/history.jsonl
check-up --arm n/a/my_arm.toml --points n/m/points.csv --recorded n/m/points.csv --out n/k
iso9283 --arm n/a/my_arm.toml --points n/m/points.csv --out n/i
plan-poses --arm right --count 1 --only table --out n/p
plan-contacts --count 2 --out n/q/planned.csv
register --arm right --markers markers.csv --out n/r
camera board --board 5x7 --square 30mm --out n/s
""".strip().splitlines()
ELSEWHERE = {"bringup": "tests/procedures/bringup", "tune": "tests/procedures/tuning", "demo": "tests/procedures/demo"}


def _writes(command: CommandSpec) -> bool:
    return any("--out" in option.flags for option in command.options)


@pytest.mark.parametrize(
    "command",
    [one for one in COMMANDS if _writes(one) and {f for o in one.options for f in o.flags} & {*WRITES_NOTHING}],
    ids=lambda command: command.name,
)
def test_a_command_that_is_to_write_nothing_demands_no_place_and_otherwise_does(
    command: CommandSpec, capsys: pytest.CaptureFixture[str]
) -> None:
    (out,) = (option for option in command.options if "--out" in option.flags)
    (dry,) = (flag for option in command.options for flag in option.flags if flag in WRITES_NOTHING)
    assert (out.unless, out.details.get("required")) == (dry, None)
    demanded = [
        word
        for option in command.options
        if option.details.get("required")
        for word in [option.flags[0], *["none"] * option.details.get("nargs", 1)]
    ]
    with pytest.raises(SystemExit):
        main([command.name, *demanded])
    assert f"required: --out (only {dry} needs none)" in capsys.readouterr().err


@pytest.mark.parametrize("line", ["gap --record --mock --quick --plan-only", "iso9283 --mock --quick --plan-only"])
def test_a_plan_is_printed_and_nothing_written(
    line: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(line.split()) == 0
    assert "Arm right" in capsys.readouterr().out.replace("arm right", "Arm right")
    assert not list(tmp_path.iterdir())


@pytest.mark.usefixtures("unrendered")
def test_a_folder_that_is_not_there_is_made(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(plan_contacts, "__defaults__", (600,))  # poses that it chooses two contacts from
    board = board_cavities(table_of(RIGHT))
    marks = [f"normal,{name},{x},{y},{z}" for name, (x, y, z) in board.items()]
    Path("markers.csv").write_text("\n".join(["setup,marker,x_m,y_m,z_m", *marks]) + "\n")
    for line in MADE:
        words = shlex.split(line)
        assert main(words) == 0, line
        for word, place in pairwise(words):
            assert not word.startswith(("--out", "--history")) or Path(place).exists(), line
        if line is MADE[0]:
            sheet.main("n/a/my_arm.toml", "sheet.csv", "60", "1")


def test_every_command_that_writes_does_so_into_a_new_folder_in_some_test() -> None:
    walked = " ".join(step.command for journey in JOURNEYS.values() for step in journey.steps())
    tried = {line.split()[0] for line in MADE} | ELSEWHERE.keys()
    for command in filter(_writes, COMMANDS):
        assert command.name in tried or f"armwright {command.name} " in walked, command.name
