"""Whose package a name is: ours beside armwright, whatever the working directory or the environment holds."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from firmware_iface import installation

ROOT = Path(__file__).parents[2]
FOREIGN = "raise RuntimeError('the folder of the user was imported')\n"


def python(*arguments: str, cwd: Path, path: Path | None = None) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "PYTHONPATH": str(path) if path else ""}
    return subprocess.run(
        [sys.executable, *arguments], cwd=cwd, env=environment, capture_output=True, text=True, check=False, timeout=300
    )


@pytest.fixture
def laboratory(tmp_path: Path) -> Path:
    """A working directory that has a folder of each of our names but one."""
    folder = tmp_path / "Übung"
    for name in set(installation.PACKAGES) - {"armwright"}:
        (folder / name).mkdir(parents=True)
        (folder / name / "__init__.py").write_text(FOREIGN)
    shutil.rmtree(folder / "hil_mocks")
    (folder / "hil_mocks").mkdir()  # a namespace package
    return folder


@pytest.fixture
def shared(tmp_path: Path) -> Path:
    """A folder of an environment in which python-control is installed."""
    folder = tmp_path / "site"
    (folder / "control").mkdir(parents=True)
    (folder / "control" / "__init__.py").touch()
    (folder / "control" / "xferfcn.py").touch()
    return folder


def test_the_packages_are_those_that_are_built_and_whose_imports_are_checked() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["tool"]
    built = project["setuptools"]["packages"]["find"]["include"]
    assert {name.removesuffix("*") for name in built} == set(installation.PACKAGES)
    assert set(project["importlinter"]["root_packages"]) == set(installation.PACKAGES)


def test_folders_of_our_names_in_the_working_directory_are_passed_over(laboratory: Path) -> None:
    program = f"import armwright, {', '.join(installation.PACKAGES)}; print(control.__file__, armwright.load_arm('right').name)"
    script = laboratory / "script.py"
    script.write_text(program)
    for how in (("-c", program), (str(script),)):
        ended = python(*how, cwd=laboratory)
        assert (ended.stdout, ended.stderr) == (f"{ROOT / 'control' / '__init__.py'} right\n", "")


def test_the_command_works_in_such_a_directory(laboratory: Path) -> None:
    ended = python("-m", "armwright", "arm", "right", cwd=laboratory)
    assert ended.returncode == 0, ended.stderr
    assert ended.stdout.startswith("arm right")


def test_a_child_process_works_in_such_a_directory_and_with_it_on_the_path(laboratory: Path) -> None:
    """The printer of the runtime's events."""
    command = installation.command("control.server.printer")
    ended = subprocess.run(
        command,
        cwd=laboratory,
        env={**os.environ, "PYTHONPATH": str(laboratory)},
        input=b"a line\n",
        capture_output=True,
        check=False,
    )
    assert ended.returncode == 0, ended.stderr
    assert ended.stdout == b"a line\n"


def test_every_child_process_is_started_through_the_helper() -> None:
    started = [
        file.relative_to(ROOT).as_posix()
        for package in installation.PACKAGES
        for file in (ROOT / package).rglob("*.py")
        if "sys.executable" in file.read_text("utf-8")
    ]
    assert started == ["firmware_iface/installation.py"]


def test_a_foreign_package_that_was_imported_before_is_named_with_its_file(laboratory: Path) -> None:
    (laboratory / "control" / "__init__.py").write_text("")
    ended = python("-c", "import control, armwright", cwd=laboratory)
    said = ended.stderr.splitlines()[-1]
    assert said.startswith("ImportError: armwright needs its own package `control`")
    assert str(laboratory / "control" / "__init__.py") in said
    assert "import armwright first" in said


def test_a_foreign_folder_without_init_that_was_imported_before_is_named_too(laboratory: Path) -> None:
    program = f"import sys; sys.path.remove({str(ROOT)!r}); import hil_mocks; sys.path.append({str(ROOT)!r}); import armwright"
    ended = python("-c", program, cwd=laboratory)
    said = ended.stderr.splitlines()[-1]
    assert said.startswith("ImportError: armwright needs its own package `hil_mocks`")
    assert str(laboratory / "hil_mocks") in said


@pytest.mark.parametrize("name", sorted(set(installation.PACKAGES) - {"control", "firmware_iface"}))
def test_beside_python_control_every_package_ends_in_one_sentence(name: str, shared: Path, tmp_path: Path) -> None:
    ended = python("-c", f"import {name}", cwd=tmp_path, path=shared)
    said = ended.stderr.splitlines()[-1]
    assert said.startswith("ImportError: armwright and the package control (python-control) both install a folder `control`")
    assert str(shared / "control" / "xferfcn.py") in said
    assert said.endswith("install armwright in a separate virtual environment")


def test_beside_python_control_the_command_ends_in_one_sentence(shared: Path, tmp_path: Path) -> None:
    script = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]["armwright"]
    module, function = script.split(":")
    program = f"import sys; from {module} import {function}; sys.exit({function}())"
    ended = python("-c", program, "--version", cwd=tmp_path, path=shared)
    assert ended.returncode == 2
    assert ended.stderr.count("\n") == 1
    assert ended.stderr.startswith("armwright: armwright and the package control (python-control) both install")
    well = python("-c", program, "--version", cwd=tmp_path)
    assert (well.returncode, well.stdout.split()[0]) == (0, "armwright")


@pytest.mark.parametrize("order", ["ours last", "theirs last"])
@pytest.mark.parametrize("module", ["control.model.arm", "control.motion.plan", "calib", "armwright"])
def test_in_one_folder_with_python_control_the_order_of_installation_does_not_matter(
    order: str, module: str, tmp_path: Path
) -> None:
    site = tmp_path / "site"
    for package in installation.PACKAGES:
        shutil.copytree(ROOT / package, site / package, ignore=shutil.ignore_patterns("__pycache__"))
    (site / "control" / "xferfcn.py").touch()
    if order == "theirs last":
        (site / "control" / "__init__.py").write_text("")
    ended = python("-c", f"import {module}", cwd=tmp_path, path=site)
    assert "ImportError: armwright and the package control (python-control)" in ended.stderr.splitlines()[-1]


def test_a_package_whose_init_was_taken_away_is_said_to_be_damaged(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    installation.claim()  # as every import of ours has done, if there was one
    (tmp_path / "control").mkdir()
    monkeypatch.setattr(installation, "ROOT", tmp_path)
    finder = next(finder for finder in sys.meta_path if type(finder).__module__ == "firmware_iface.installation")
    with pytest.raises(ImportError, match=r"control/__init__.py is missing.*install armwright again"):
        finder.find_spec("control", None)
    assert finder.find_spec("numpy", None) is None
