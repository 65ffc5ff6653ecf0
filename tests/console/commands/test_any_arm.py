"""The operator's lines on mock arms of two, four, five, six (modified DH) and seven joints: the table of docs/new_arm.md."""

from pathlib import Path

import numpy as np
import pytest

from benchmarks.arms import ARMS
from console.lines import Grammar, LineOutcome, parse_lines, replay
from console.specs.table import COMMANDS
from control.model.description import save_arm
from tests.cell import Cell, holding_cell, scenario
from tests.thirds import third_of


def played(cell: Cell, grammar: Grammar, *lines: str) -> list[LineOutcome]:
    """Replay lines on a stepped mock arm."""
    outcomes: list[LineOutcome] = []
    replay(parse_lines(lines, grammar), lambda: cell.client, outcomes.append)
    return outcomes


@pytest.mark.parametrize("name", third_of(ARMS))
def test_teach_go_run_and_tip_jogs_work_with_any_number_of_joints(name: str, tmp_path: Path) -> None:
    arm, file = ARMS[name], tmp_path / "arm.toml"
    assert arm.rest is not None
    save_arm(arm, file)
    grammar = Grammar(COMMANDS, {"arm": str(file), "socket": None})
    taught, places = tmp_path / "taught.csv", tmp_path / "places.toml"
    there = np.array(arm.rest.q_rad) + 0.08 * np.where(np.arange(arm.joint_count) % 2, -1.0, 1.0)
    angles = " ".join(f"{q:.4f}" for q in there)
    with holding_cell(scenario(arm.rest.q_rad), arm) as cell:
        outcomes = played(
            cell,
            grammar,
            f"mark rest --places {places}",
            f"teach {taught}",
            f"move --joints {angles}",
            f"teach {taught}",
            f"go rest --places {places}",
            f"run {taught} --speed 0.2",
            "jog --axis z --by 0.004",
        )
        said = [f"{outcome.status} {outcome.transcript}" for outcome in outcomes]
        assert [outcome.status for outcome in outcomes[:6]] == [0] * 6, said
        wanted_m = [float(x) for x in taught.read_text().splitlines()[-1].split(",")]
        jogged_m = np.array(cell.client.status()["tip_m"])
        if arm.joint_count == 2:  # its tip moves on a surface: the jog goes along it, or says that it cannot
            assert np.linalg.norm(jogged_m - wanted_m) < 0.01
            return
        np.testing.assert_allclose(jogged_m - wanted_m, (0.0, 0.0, 0.004), atol=5e-4, err_msg=str(said))
        (turned,) = played(cell, grammar, "jog --axis rz --frame tip --by 0.02")
        moved_m = np.linalg.norm(np.array(cell.client.status()["tip_m"]) - jogged_m)
        assert moved_m < 5e-4
        assert turned.status == 0 or arm.joint_count < 6, turned.transcript
