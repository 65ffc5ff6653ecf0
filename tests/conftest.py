"""Surroundings of every test, and fixtures that several packages' tests share."""

from __future__ import annotations

import gc
import io
import os
import shutil
import stat
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from tests.cell import Cell

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before numpy is imported, as console.main has it
REAL_BUSES = ("ARMWRIGHT_CAN", "ARMWRIGHT_CAN_FD")  # not settings of the product: they name hardware to test with


def pytest_configure(config: pytest.Config) -> None:
    """Nothing of the user's is seen or touched, while tests are collected, by fixtures of modules and by child processes either.

    The cache is one for the whole run, since the firmware in C and Matplotlib's fonts take seconds to make. What Hypothesis reads
    out of the sources, in some seconds of each worker, outlives the run beside pytest's own cache, where that can be written.
    """
    if not hasattr(config, "workerinput"):  # xdist's workers inherit it
        for name in [*os.environ]:
            if name.startswith(("ARMWRIGHT_", "XDG_")) and name not in REAL_BUSES:
                del os.environ[name]
        folder = tempfile.TemporaryDirectory(prefix="armwright-tests-", ignore_cleanup_errors=True)
        config.add_cleanup(folder.cleanup)
        cache = Path(folder.name, "cache")
        os.environ |= {
            "HOME": folder.name,
            "XDG_CACHE_HOME": str(cache),
            "HYPOTHESIS_STORAGE_DIRECTORY": str(config.rootpath / config.getini("cache_dir") / "hypothesis"),
        }
    _settle_hypothesis(at_night=not config.option.markexpr)


def pytest_collection_finish(session: pytest.Session) -> None:
    """What imports and collection have made stays: the collector need not look through it again and again."""
    gc.collect()
    gc.freeze()


def _settle_hypothesis(at_night: bool) -> None:
    """It tries the same examples at each change and new ones at night. Time decides nothing: the machine may be busy."""
    from hypothesis import settings

    settings.register_profile("armwright", deadline=None, derandomize=not at_night, database=None, print_blob=True)
    settings.load_profile("armwright")


@pytest.fixture(scope="session", autouse=True)
def home_of_the_run(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """For what fixtures of modules do."""
    with pytest.MonkeyPatch.context() as patch:
        _live_in(_furnished(tmp_path_factory.mktemp("home")), patch)
        yield


@pytest.fixture(scope="session")
def empty_homes() -> Iterator[list[Path]]:
    """Those that tests left as they found them: to remove three folders after each test, the kernel may wait for 12 ms."""
    homes: list[Path] = []
    yield homes
    for home in homes:
        shutil.rmtree(home, ignore_errors=True)


@pytest.fixture(autouse=True)
def at_home(home_of_the_run: None, empty_homes: list[Path]) -> Iterator[None]:
    """An empty HOME for each test, with a working folder and one for sockets, whose paths must be short."""
    home = empty_homes.pop() if empty_homes else _furnished(Path(tempfile.mkdtemp(prefix="armwright-test-")))
    with pytest.MonkeyPatch.context() as patch:
        _live_in(home, patch)
        yield
    if _is_as_furnished(home):
        empty_homes.append(home)
    else:
        shutil.rmtree(home, ignore_errors=True)


ROOMS = ("run", "work")


def _furnished(home: Path) -> Path:
    for name in ROOMS:
        (home / name).mkdir(mode=0o700)
    return home


def _is_as_furnished(home: Path) -> bool:
    try:
        folders = [home, *(home / name for name in ROOMS)]
        is_open = all(stat.S_IMODE(folder.stat().st_mode) == 0o700 for folder in folders)
        return is_open and [sorted(there.name for there in folder.iterdir()) for folder in folders] == [[*ROOMS], [], []]
    except OSError:
        return False


def _live_in(home: Path, patch: pytest.MonkeyPatch) -> None:
    patch.setenv("HOME", str(home))
    patch.setenv("XDG_RUNTIME_DIR", str(home / "run"))
    patch.setenv("ARMWRIGHT_RUNTIME_DIR", str(home / "run" / "armwright"))  # no test reaches an arm that this user runs
    patch.chdir(home / "work")


@pytest.fixture(scope="module")
def nobody_below() -> Iterator[None]:
    """A shutdown does not wait until the arm has sunk: for modules whose claims are others."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("control.loop.drives.SINK_LIMIT_S", 0.6)
        yield


@pytest.fixture
def unrendered() -> Iterator[None]:
    """Pictures of pages are drawn and not rendered, which takes most of a page's time: for tests whose claims are others.

    Each kind of page is rendered in the test of what it shows.
    """
    from matplotlib.figure import Figure

    rendered = Figure.savefig

    def save(figure: Figure, file: Any, **how: Any) -> None:
        if isinstance(file, io.StringIO):
            file.write('<svg width="1"></svg>')
        else:
            rendered(figure, file, **how)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Figure, "savefig", save)
        yield


@pytest.fixture
def cell() -> Iterator[Cell]:
    """A stretched, homed arm that is held; see tests/cell.py."""
    from tests.cell import holding_cell  # MuJoCo takes a second to import: not for tests that need no plant

    with holding_cell() as held:
        yield held
