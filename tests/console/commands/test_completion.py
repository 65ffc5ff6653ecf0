"""Completion: bash itself runs the script and is asked; the other shells' scripts know every command."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

from console.commands.completion import script
from console.main import main
from console.specs.table import COMMANDS

BASH = shutil.which("bash")
needs_bash = pytest.mark.skipif(BASH is None, reason="bash is not installed here")
ASK = """
source "$1"
COMP_WORDS=("${@:2}")
COMP_CWORD=$(( ${#COMP_WORDS[@]} - 1 ))
COMP_LINE="${COMP_WORDS[*]}"
COMP_POINT=${#COMP_LINE}
_shtab_armwright
printf '%s\\n' "${COMPREPLY[@]}"
"""


@pytest.fixture(scope="module")
def bash_script(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("bash") / "armwright.bash"
    path.write_text(script("bash"))
    return path


def completed(bash_script: Path, folder: Path, *words: str) -> set[str]:
    """What bash offers for the last word, in `folder`."""
    assert BASH is not None
    ended = subprocess.run(
        [BASH, "--norc", "-c", ASK, "bash", str(bash_script), "armwright", *words],
        capture_output=True,
        text=True,
        check=True,
        cwd=folder,
        timeout=120,
    )
    assert "syntax error" not in ended.stderr
    return set(ended.stdout.split())


@needs_bash
def test_bash_takes_the_script(bash_script: Path) -> None:
    ended = subprocess.run([BASH or "", "-n", str(bash_script)], capture_output=True, text=True, check=False)
    assert (ended.returncode, ended.stderr) == (0, "")


@needs_bash
def test_bash_completes_commands_options_choices_names_and_files(bash_script: Path, tmp_path: Path) -> None:
    (tmp_path / "run.armlog").write_text("")
    (tmp_path / "runs").mkdir()

    def offers(*words: str) -> set[str]:
        return completed(bash_script, tmp_path, *words)

    assert offers("pl") == {"plan-contacts", "plan-path", "plan-poses", "plot"}
    assert {command.name for command in COMMANDS} <= offers("")
    assert offers("plot", "--wh") == {"--what"}
    assert offers("export-arm", "--export", "") == {"urdf", "mjcf", "json", "lerobot", "python"}
    assert offers("plot", "run") == {"run.armlog", "runs"}
    assert offers("export", "run.armlog", "--out", "run") == {"runs"}
    assert {"right", "left", "run.armlog"} <= offers("status", "--arm", "")
    assert {"demo", "ideal", "paper"} <= offers("mock", "--scenario", "")
    assert offers("plot", "x", "--joints", "") == set()  # numbers: nothing to offer


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish", "tcsh"])
def test_every_shells_script_knows_every_command(shell: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["completion", shell]) == 0
    text = capsys.readouterr().out
    assert "armwright" in text
    for command in COMMANDS:
        assert command.name in text


def test_another_shell_is_refused_with_those_that_there_are(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["completion", "ksh"])
    assert ended.value.code == 2
    assert "fish" in capsys.readouterr().err
