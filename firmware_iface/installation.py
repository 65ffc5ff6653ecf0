"""Ensures that armwright's top-level packages are imported from beside this one, not from elsewhere on the path.

python-control installs `control` too, and a user's working directory may well contain a folder `control/`, `console/` or
`calib/`. Two distributions that install into one folder cannot be used together: this is refused with a clear error. A
folder of the same name elsewhere on `sys.path` is ignored: a finder resolves our names beside this package. It costs
a few stat(2) calls at the first import.

As a program (`python installation.py MODULE ARGUMENT...`) it runs a module like `python -m`, with the same protection; `command`
returns that command line for every process that armwright starts.
"""

import importlib
import os
import sys
from collections.abc import Sequence
from importlib.machinery import ModuleSpec, PathFinder
from pathlib import Path
from types import ModuleType

PACKAGES = ("armwright", "console", "procedures", "calib", "hil_mocks", "control", "firmware_iface")
ROOT = Path(__file__).resolve().parents[1]
# Our package, a file that only the other distribution has in a folder of that name, and that distribution's name.
OTHERS = (
    ("control", "xferfcn.py", "control (python-control)"),
    ("console", "detection.py", "console"),
    ("calib", "manager.py", "calib"),
)


def claim() -> None:
    """Claim our package names in this process. ImportError names the conflicting file and the remedy."""
    if not any(isinstance(finder, _Beside) for finder in sys.meta_path):
        _refuse_shared_environment()
        _refuse_imported()
        sys.meta_path.insert(0, _Beside())


def command(module: str, *arguments: str) -> list[str]:
    """The command line of a Python process that runs `module` of armwright, from any working directory.

    Start it within `interrupts.held()`.
    """
    return [sys.executable, "-P", str(Path(__file__).resolve()), module, *arguments]


def run_command() -> int:
    """As `interrupts.run_command`: here the scripts of editable installations look for it until they are installed again."""
    status: int = importlib.import_module("firmware_iface.interrupts").run_command()
    return status


class _Beside:
    """Finds our top-level packages beside this one, before any other finder."""

    def find_spec(self, name: str, path: Sequence[str] | None = None, target: ModuleType | None = None) -> ModuleSpec | None:
        """The spec of one of our packages, None for other names. ImportError if its folder is incomplete."""
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
    """ImportError if another distribution provides one of our names."""
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
    """ImportError if this process has already imported another package by one of our names."""
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
    importlib.import_module("firmware_iface.interrupts").end_at_once()
    del sys.argv[0]
    runpy.run_module(sys.argv[0], run_name="__main__", alter_sys=True)
