"""Results of a study on disk, task by task: what a stopped study has done is not done again, and memory holds one task's."""

from __future__ import annotations

import hashlib
import io
import json
import shutil
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np

from calib.errors import CalibrationError
from calib.studies.executor import Executor, Results, S, Work
from control.files import parsed_json, read_bytes, write_whole
from control.progress import Advance, silent

FORMAT = "study/1"


class ChunkStore:
    """A folder with a file for each finished task, and study.json, which says of what study."""

    def __init__(self, folder: Path, about: Mapping[str, object]) -> None:
        """`about` (JSON) is everything that results depend on. CalibrationError if the folder holds another study's."""
        self._folder = folder
        key = hashlib.sha256(json.dumps(about, sort_keys=True).encode()).hexdigest()
        file = folder / "study.json"
        if not file.exists():
            folder.mkdir(parents=True, exist_ok=True)
            content = {"format": FORMAT, "key": key, "about": about}
            write_whole(file, json.dumps(content, indent=2, sort_keys=True) + "\n")
        elif _key_in(file) != key:
            raise CalibrationError(
                f"{folder}: holds unfinished results of another study (its input or options differ): remove it, or choose"
                " another --out"
            )

    def has(self, number: int) -> bool:
        """Whether a task is finished."""
        return self._file(number).exists()

    def write(self, number: int, results: Results) -> None:
        """Store the results of a task, complete or not at all."""
        content = io.BytesIO()
        arrays: dict[str, Any] = dict(results)
        np.savez(content, **arrays)
        write_whole(self._file(number), content.getvalue())

    def read(self, number: int) -> Results:
        """The results of a finished task. CalibrationError if its file is damaged."""
        try:
            with self._file(number).open("rb") as file, np.load(file, allow_pickle=False) as content:
                return {name: content[name] for name in content.files}
        except (
            OSError,
            ValueError,
            KeyError,
            EOFError,
            NotImplementedError,
            MemoryError,
            BadZipFile,
            zlib.error,
        ) as error:
            raise CalibrationError(
                f"{self._file(number)}: damaged ({type(error).__name__}): remove it, and start the study again"
            ) from None

    def remove(self) -> None:
        """Delete the folder, once the study's own result is written."""
        shutil.rmtree(self._folder)

    def _file(self, number: int) -> Path:
        return self._folder / f"{number:06}.npz"


def run_study(
    work: Work[S, Results],
    shared: S,
    count: int,
    executor: Executor,
    store: ChunkStore,
    advance: Advance = silent,
) -> None:
    """Run the tasks 0 .. count - 1 that the store does not have, and store them."""
    missing = [number for number in range(count) if not store.has(number)]
    done = count - len(missing)
    for number, results in executor.results(work, shared, missing):
        store.write(number, results)
        done += 1
        advance(f"task {done} of {count}", done / count)


def _key_in(file: Path) -> str | None:
    try:
        content = parsed_json(read_bytes(file))
    except (OSError, ValueError):
        return None
    return content.get("key") if isinstance(content, dict) else None
