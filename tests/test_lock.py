"""What the Makefile installs: exactly what the locks name, and all that it needs, as installed metadata say it."""

from __future__ import annotations

import re
import sys
import tomllib
from functools import cache
from importlib.metadata import Distribution, version
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[1]
RUNNING, DEVELOPMENT, WITNESSES = "requirements.lock", "requirements-dev.lock", "tests/witnesses.lock"
PIN = re.compile(r"^([a-z0-9-]+)==(\S+)(?: ; (.+?))? \\\n    --hash=sha256:", re.MULTILINE)
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))
NEEDED = {
    RUNNING: [*PROJECT["build-system"]["requires"], *PROJECT["project"]["dependencies"]],
    DEVELOPMENT: PROJECT["project"]["optional-dependencies"]["dev"],
    WITNESSES: PROJECT["dependency-groups"]["witnesses"],
}
SUPPORTED = ("3.11", "3.12", "3.13")
HERE = f"{sys.version_info.major}.{sys.version_info.minor}"


@cache
def distribution(name: str) -> Distribution:
    """An installed package."""
    return Distribution.from_name(name)


def holds(requirement: Requirement, python: str, extra: str = "") -> bool:
    """Whether its marker holds on this machine with another Python."""
    wanted = {"python_version": python, "python_full_version": f"{python}.0", "extra": extra}
    return requirement.marker is None or requirement.marker.evaluate(wanted)


def pins(locks: tuple[str, ...], python: str) -> dict[str, str]:
    """Versions by name, of what is installed from these locks one after the other."""
    found: dict[str, str] = {}
    for lock in locks:
        for name, pinned, marker in PIN.findall((ROOT / lock).read_text("utf-8")):
            if holds(Requirement(f"{name}; {marker}" if marker else name), python):
                assert name not in found, f"{lock}: {name} for Python {python} for the second time"
                found[name] = pinned
    return found


def closure(needed: list[str], pinned: dict[str, str], python: str) -> tuple[set[str], set[str]]:
    """Names that `needed` leads to, through each requirement of each extra, and what of it `pinned` does not meet."""
    open_ones = [("pyproject.toml", Requirement(line)) for line in needed]
    reached: set[tuple[str, str]] = set()
    unmet: set[str] = set()
    while open_ones:
        wanted_by, wanted = open_ones.pop()
        name = canonicalize_name(wanted.name)
        if name not in pinned:
            unmet.add(f"{wanted} (from {wanted_by})")
            continue
        # Another Python may have another version, whose own requirements only its own environment can tell.
        is_same = wanted_by == "pyproject.toml" or distribution(wanted_by).version == pinned[wanted_by]
        if is_same and not wanted.specifier.contains(pinned[name]):
            unmet.add(f"{wanted} (from {wanted_by}), pinned is {pinned[name]}")
        for extra in {"", *wanted.extras} - {extra for of, extra in reached if of == name}:
            reached.add((name, extra))
            for line in distribution(name).requires or ():
                requirement = Requirement(line)
                if holds(requirement, python, extra):
                    open_ones.append((name, requirement))
    return {name for name, _ in reached}, unmet


@pytest.mark.parametrize("python", SUPPORTED)
@pytest.mark.parametrize(
    "locks",
    [
        pytest.param((RUNNING,), id="demo"),
        pytest.param((RUNNING, DEVELOPMENT), id="test"),
        pytest.param((RUNNING, DEVELOPMENT, WITNESSES), id="test-all", marks=pytest.mark.nightly),
    ],
)
def test_the_locks_name_what_pyproject_leads_to_and_nothing_else(locks: tuple[str, ...], python: str) -> None:
    pinned = pins(locks, python)
    reached, unmet = closure([line for lock in locks for line in NEEDED[lock]], pinned, python)
    assert unmet == set()
    assert set(pinned) == reached


@pytest.mark.parametrize("python", SUPPORTED)
def test_no_pinned_package_refuses_a_supported_python(python: str) -> None:
    for name, pinned in pins((RUNNING, DEVELOPMENT), python).items():
        if version(name) != pinned:  # that of another Python, whose metadata its own environment has
            continue
        allowed = distribution(name).metadata.get("Requires-Python", "")
        assert Requirement(f"{name}{allowed}").specifier.contains(f"{python}.0"), name


def test_installed_is_what_the_locks_name() -> None:
    pinned = pins((RUNNING, DEVELOPMENT), HERE)
    assert {name: version(name) for name in pinned} == pinned


def test_every_installation_of_a_lock_is_by_hash_and_without_dependencies() -> None:
    makefile = (ROOT / "Makefile").read_text("utf-8")
    installs = [line for line in makefile.splitlines() if re.search(r"pip install.* -r ", line)]
    assert len(installs) == 2  # of .venv and of .venv-fuzz
    peers = (ROOT / "benchmarks/peers/peer.py").read_text("utf-8").replace('", "', " ")
    for line in (*installs, *re.findall(r"--.*-r", peers)):
        assert "--no-deps --require-hashes" in line
