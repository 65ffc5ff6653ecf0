"""The arm that is meant: option, then environment, then the user's config.toml, then the one that is built in."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from console.main import main
from control.model.description import load_arm, save_arm


@pytest.fixture(autouse=True)
def config(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The user's config.toml, which is not there yet."""
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    monkeypatch.delenv("ARMWRIGHT_ARM", raising=False)
    (tmp_path / "armwright").mkdir()
    return tmp_path / "armwright" / "config.toml"


def arm_meant(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    assert main(["arm", *arguments, "--json"]) == 0
    return str(json.loads(capsys.readouterr().out)["name"])


def test_option_comes_before_environment_before_config_before_the_built_in_arm(
    config: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert arm_meant(capsys) == "right"
    config.write_text('arm = "left"\n')
    assert arm_meant(capsys) == "left"
    monkeypatch.setenv("ARMWRIGHT_ARM", "right")
    assert arm_meant(capsys) == "right"
    assert arm_meant(capsys, "left") == "left"


def test_a_path_in_the_config_is_seen_from_its_folder(config: Path, capsys: pytest.CaptureFixture[str]) -> None:
    save_arm(load_arm("left"), config.with_name("mine.toml"))
    config.write_text('arm = "mine.toml"\n')
    assert arm_meant(capsys) == "left"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("arm = [\n", "not valid TOML"),
        ("arm = 3\n", "expected the path of an arm.toml"),
        ('arn = "left"\n', "unknown key 'arn'"),
        ('arm = "none.toml"\n', "no file"),
        ('arm = ""\n', "expected the path"),
    ],
)
def test_what_is_wrong_with_the_config_is_one_sentence_that_names_it(
    config: Path, text: str, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    config.write_text(text)
    assert main(["arm"]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert str(config) in error or "none.toml" in error
    assert said in error


def test_an_environment_variable_that_leads_nowhere_is_named(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("ARMWRIGHT_ARM", "/none.toml")
    assert main(["arm"]) == 2
    assert capsys.readouterr().err == "armwright: ARMWRIGHT_ARM: no file /none.toml\n"
