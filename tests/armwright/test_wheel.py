"""What a wheel holds, by its list of files: nothing is built."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from firmware_iface.installation import PACKAGES

ROOT = Path(__file__).parents[2]
LIST = """
from setuptools.dist import Distribution
project = Distribution({"script_name": "setup.py"})
project.parse_config_files(["pyproject.toml"])
project.include_package_data = False  # what pyproject.toml names, without what lies about in a work tree
build = project.get_command_obj("build_py")
build.ensure_finalized()
build.build_lib = "wheel"
for _, module, file in build.find_all_modules():
    print(file)
for _, folder, _, names in build._get_data_files():
    print(*(f"{folder}/{name}" for name in names), sep="\\n")
"""


def test_a_wheel_has_every_module_and_every_file_of_data() -> None:
    ended = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", LIST], cwd=ROOT, capture_output=True, text=True, check=True, timeout=300
    )
    listed = {(ROOT / line).resolve() for line in ended.stdout.splitlines() if line}
    there = {
        file
        for package in PACKAGES
        for file in (ROOT / package).rglob("*")
        if file.is_file() and not any(part == "__pycache__" or part.endswith(".egg-info") for part in file.parts)
    }
    assert there - listed == set()
    kinds = {file.suffix for file in listed}
    assert {".py", ".toml", ".dbc", ".tcss", ".typed"} <= kinds
