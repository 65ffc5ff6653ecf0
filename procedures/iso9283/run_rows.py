"""The rows of a run, taken from the runtime's recording while it is still being written."""

from pathlib import Path

import numpy as np
import numpy.typing as npt

from control.recording.record import Recording, has_part, next_part


class RunRows:
    """Reads the new rows of a growing recording, across its files."""

    def __init__(self, recording: Path) -> None:
        opened = self._open(recording)
        codes = {"d": "<f8", "f": "<f4", "I": "<u4", "i": "<i4", "B": "u1"}
        packing = opened.layout.packing.format.lstrip("<")
        self._row = np.dtype([(n, codes[c]) for n, c in zip(opened.layout.names, packing, strict=True)])

    def skip(self) -> None:
        """Skip all rows so far."""
        self._read()

    def of_run(self, number: int) -> npt.NDArray[np.void]:
        """New rows of a run, as a structured array with the recording's names; an incomplete last row is left."""
        rows = np.frombuffer(self._read(), dtype=self._row)
        return np.asarray(rows[rows["run"] == number])

    def _open(self, path: Path) -> Recording:
        opened = Recording.open(path)
        self._path, self._at = path, opened.offset
        return opened

    def _read(self) -> bytes:
        """Complete rows not read yet; a part is finished once there is a next one."""
        read = b""
        while True:
            is_finished = has_part(next_part(self._path))
            with self._path.open("rb") as file:
                file.seek(self._at)
                content = file.read()
            whole = len(content) // self._row.itemsize * self._row.itemsize
            self._at += whole
            read += content[:whole]
            if not is_finished:
                return read
            self._open(next_part(self._path))
