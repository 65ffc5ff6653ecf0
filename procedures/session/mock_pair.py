"""The mock cell of a session of two arms in contact, stepped in this process."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from calib.session.folder import SessionFolder
from control.model.cell import Cell
from hil_mocks.scenario import load_scenario
from procedures.mock import CellBench, as_bolted_down
from procedures.session.mock_session import free_log, saved_scenario


@contextmanager
def mock_pair(cell: Cell, folder: SessionFolder, scenario: str | None) -> Iterator[CellBench]:
    """All arms of the cell, homed and holding; the scenario is saved in the session's folder, so that a resumed one has the same.

    SessionError if it is resumed with another scenario, or belongs to real arms.
    """
    can_home = all(placed.arm.can_home for placed in cell.arms)
    hidden = load_scenario(saved_scenario(folder, scenario, was_homed=not can_home))
    bench = CellBench(as_bolted_down(cell, hidden.seed), hidden, free_log(folder.path))
    try:
        bench.home(cell)
        yield bench
        bench.stop()
    finally:
        bench.close()
