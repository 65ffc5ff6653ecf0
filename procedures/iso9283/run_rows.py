"""The rows of a run, taken from the runtime's recording while it is still being written."""

from pathlib import Path

import numpy as np
import numpy.typing as npt

from control.recording.record import Recording


class RunRows:
    """Reads a growing .armlog from where it was read last."""

    def __init__(self, recording: Path) -> None:
        opened = Recording.open(recording)
        self._path, self._at = recording, opened.offset
        codes = {"d": "<f8", "f": "<f4", "I": "<u4", "i": "<i4", "B": "u1"}
        packing = opened.layout.packing.format.lstrip("<")
        self._row = np.dtype([(n, codes[c]) for n, c in zip(opened.layout.names, packing, strict=True)])

    def skip(self) -> None:
        """Pass over all that is there."""
        self._at += (self._path.stat().st_size - self._at) // self._row.itemsize * self._row.itemsize

    def of_run(self, number: int) -> npt.NDArray[np.void]:
        """New rows of a run, as a structured array with the recording's names; a torn last row is left."""
        with self._path.open("rb") as file:
            file.seek(self._at)
            content = file.read()
        whole = len(content) // self._row.itemsize * self._row.itemsize
        self._at += whole
        rows = np.frombuffer(content[:whole], dtype=self._row)
        return np.asarray(rows[rows["run"] == number])
