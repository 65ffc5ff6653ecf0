"""The rows of a run, taken from the runtime's recording while it is still being written."""

from pathlib import Path

import numpy as np
import numpy.typing as npt

from control.recording.frame_decoder import row_type
from control.recording.parts import has_part, next_part
from control.recording.reading import Recording, RowReader


class RunRows:
    """Reads the new rows of a growing recording, across its files."""

    def __init__(self, recording: Path) -> None:
        opened = self._open(recording)
        self._row = row_type(opened.layout.names, opened.layout.packing)

    def skip(self) -> None:
        """Skip all rows so far."""
        self._read()

    def of_run(self, number: int) -> npt.NDArray[np.void]:
        """New rows of a run, as a structured array with the recording's names; an incomplete last row is left."""
        rows = np.frombuffer(self._read(), dtype=self._row)
        return np.asarray(rows[rows["run"] == number])

    def _open(self, path: Path) -> Recording:
        opened = Recording.open(path)
        self._path, self._reader = path, RowReader(opened)
        return opened

    def _read(self) -> bytes:
        """Complete rows not read yet; a part is finished once there is a next one."""
        read = b""
        while True:
            is_finished = has_part(next_part(self._path))
            read += self._reader.new()
            if not is_finished:
                return read
            self._open(next_part(self._path))
