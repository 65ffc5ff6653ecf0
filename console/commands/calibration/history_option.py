"""The options --history and --measured: the result's line in the record of an arm."""

import argparse
import dataclasses
import datetime
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path

from calib.ageing import (
    FORMAT,
    Entry,
    GeometryRecord,
    Quantity,
    append_entry,
    measured_at,
    require_appendable,
)
from calib.errors import CalibrationError


@dataclasses.dataclass(frozen=True, slots=True)
class HistoryRecord:
    """Where and when; asked for and checked before anything is computed."""

    path: Path
    measured: datetime.datetime
    by: str
    arm: str

    def append(
        self,
        inputs: Mapping[str, str],
        geometry: GeometryRecord | None = None,
        quantities: Mapping[str, Quantity] | None = None,
    ) -> None:
        """Write the line, after the command's own results."""
        program = f"armwright {version('armwright')}"
        append_entry(
            self.path,
            Entry(
                FORMAT,
                self.measured,
                self.by,
                self.arm,
                program,
                dict(inputs),
                geometry,
                dict(quantities or {}),
            ),
        )


def record_of(given: argparse.Namespace, by: str, arm: str) -> HistoryRecord | None:
    """None without --history; CalibrationError if the record cannot be continued."""
    if given.history is None:
        if given.measured is not None:
            raise CalibrationError("--measured: needs --history, the record that the date is for")
        return None
    record = HistoryRecord(Path(given.history), measured_at(given.measured), by, arm)
    require_appendable(record.path, arm)
    return record
