"""What commands print: one JSON for programs or one text for people, and tables whose columns stand under each other."""

import argparse
import io
import json
import math
import shlex
import sys
from pathlib import Path

import pytest

from console.commands.progress import answer
from console.main import main
from control.plain_text import aligned


def test_columns_are_as_wide_as_their_widest_cell_and_numbers_end_under_each_other() -> None:
    rows = [("joint", "angle"), ("1", "-0.25"), ("a long name", "1.5")]
    assert aligned(rows).splitlines() == ["joint        angle", "1            -0.25", "a long name    1.5"]
    assert aligned(rows, left=2, indent="  ").splitlines()[1] == "  1            -0.25"
    assert aligned([], left=2) == ""


def test_with_json_the_result_is_one_document_in_which_what_is_not_finite_is_null(capsys: pytest.CaptureFixture[str]) -> None:
    answer(argparse.Namespace(json=True), {"error_m": math.nan, "most_m": math.inf}, "in words")
    assert json.loads(capsys.readouterr().out) == {"error_m": None, "most_m": None}


def test_with_json_a_written_file_is_printed_as_it_stands(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "result.json").write_text('{"a": 1}\n', "utf-8")
    answer(argparse.Namespace(json=True), tmp_path / "result.json", "in words")
    assert capsys.readouterr().out == '{"a": 1}\n'


def test_without_json_the_words_come_first_and_then_where_the_files_are(capsys: pytest.CaptureFixture[str]) -> None:
    answer(argparse.Namespace(json=False), {}, "in words\n", {"report": Path("out/report.html")})
    assert capsys.readouterr().out == "in words\n\n  report  out/report.html\n"
    answer(argparse.Namespace(json=False), {}, "in words")
    assert capsys.readouterr().out == "in words\n"


def test_a_command_that_is_printed_can_be_typed_whatever_the_file_is_called(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["new", "--out", "my läb's arm.toml", "--joints", "3", "--yes"]) == 0
    printed = capsys.readouterr().out.splitlines()[-2]
    assert shlex.split(printed) == ["armwright", "arm", "my läb's arm.toml"]
    assert main(shlex.split(printed)[1:]) == 0


def test_on_a_narrow_terminal_sentences_break_between_words_and_commands_stay_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    terminal = io.StringIO()
    monkeypatch.setattr(terminal, "isatty", lambda: True, raising=False)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "60")
    monkeypatch.setattr(sys, "stdout", terminal)
    assert main(["new", "--out", f"{'a' * 60}.toml", "--joints", "3", "--yes"]) == 0
    wide = [line.split()[:2] for line in terminal.getvalue().splitlines() if len(line) > 60 and "armwright" in line]
    assert wide == [["armwright", "arm"], ["armwright", "mock"]]
    assert all(len(line) <= 60 for line in terminal.getvalue().splitlines() if "a" * 60 not in line)
