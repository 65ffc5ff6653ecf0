"""The top-level packages of armwright are those that stand beside this one, whatever else has one of their names.

`control` is also what python-control installs, and `control/`, `console/` or `calib/` are likely names of a folder in which
somebody works. Two distributions that write into one folder cannot be used together: that is refused with one sentence. A
folder of the same name elsewhere on `sys.path` is passed over: a finder takes our names from beside this package. It costs
some calls of stat(2) at the first import.

As a program (`python installation.py MODULE ARGUMENT...`) it runs a module as `python -m` does, with the same care; `command`
gives that line for every process that armwright starts.
"""

import os
import sys
from collections.abc import Sequence
from importlib.machinery import ModuleSpec, PathFinder
from pathlib import Path
from types import ModuleType

PACKAGES = ("armwright", "console", "procedures", "calib", "hil_mocks", "control", "firmware_iface")
ROOT = Path(__file__).resolve().parents[1]
# A package of ours, a file that only the other distribution has in a folder of that name, and what `pip` calls it.
OTHERS = (
    ("control", "xferfcn.py", "control (python-control)"),
    ("console", "detection.py", "console"),
    ("calib", "manager.py", "calib"),
)


def claim() -> None:
    """Make our names ours in this process. ImportError where they cannot be: says which file is in the way and what to do."""
    if not any(isinstance(finder, _Beside) for finder in sys.meta_path):
        _refuse_shared_environment()
        _refuse_imported()
        sys.meta_path.insert(0, _Beside())


def command(module: str, *arguments: str) -> list[str]:
    """The command line of a Python process that runs `module` of armwright, from any working directory."""
    return [sys.executable, "-P", str(Path(__file__).resolve()), module, *arguments]


class _Beside:
    """Finds our top-level packages beside this one, before anything else is asked."""

    def find_spec(
        self, name: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """The package of that name, None for a name that is not ours. ImportError where its folder is not whole."""
        if name not in PACKAGES:
            return None
        spec = PathFinder.find_spec(name, [str(ROOT)])
        if spec is None or spec.origin is None:
            raise ImportError(
                f"armwright is damaged: {ROOT / name / '__init__.py'} is missing, probably removed with a package of the"
                " same name; install armwright again (`pip install --force-reinstall --no-deps`)",
                name=name,
            )
        return spec


def _refuse_shared_environment() -> None:
    """ImportError where another distribution has put one of our names on the path."""
    for package, theirs, distribution in OTHERS:
        for entry in dict.fromkeys((str(ROOT), *sys.path)):
            file = Path(entry, package, theirs)
            if os.path.exists(file):  # noqa: PTH110 - Path.exists raises where an entry of sys.path may not be read
                raise ImportError(
                    f"armwright and the package {distribution} both install a folder `{package}` and cannot share an"
                    f" environment (found {file}): install armwright in a separate virtual environment",
                    name=package,
                    path=str(file),
                )


def _refuse_imported() -> None:
    """ImportError where this process uses another package by one of our names already."""
    for package in PACKAGES:
        module = sys.modules.get(package)
        if module is None:
            continue
        file = getattr(module, "__file__", None) or next(iter(getattr(module, "__path__", ())), "unknown")
        if Path(file).resolve().parent != ROOT / package:
            raise ImportError(
                f"armwright needs its own package `{package}`, but this program has imported another one from {file}:"
                " import armwright first, or rename the other package",
                name=package,
                path=file,
            )


if __name__ == "__main__":
    import runpy

    claim()
    del sys.argv[0]
    runpy.run_module(sys.argv[0], run_name="__main__", alter_sys=True)
