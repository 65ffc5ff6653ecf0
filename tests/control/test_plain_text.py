"""Plain-ASCII terminals and file names of any bytes: no traceback, and nothing that cannot be read."""

from __future__ import annotations

import io
import os
import subprocess
import sys
from pathlib import Path

import pytest

from control.plain_text import HANDLER, IN_ASCII, aligned, folded, prepare_streams

PLAIN = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
ROOT = Path(__file__).parents[2]
SOURCES = [
    file
    for name in ("armwright", "calib", "console", "control", "firmware_iface", "hil_mocks", "procedures")
    for file in (ROOT / name).rglob("*.py")
    if "screen" not in file.parts  # it has signs of its own: console.screen.drawing
]


def _put(monkeypatch: pytest.MonkeyPatch, encoding: str) -> io.BytesIO:
    """Standard output on a terminal of this encoding; the test's own streams stay as they are."""
    shown = io.BytesIO()
    monkeypatch.setattr(sys, "stdin", None)
    monkeypatch.setattr(sys, "stderr", io.StringIO())
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(shown, encoding=encoding, write_through=True))
    return shown


@pytest.mark.parametrize(
    ("text", "plain"),
    [
        ("25 °C ± 0.1 µm", b"25 degC +- 0.1 um"),
        ("größe.toml", b"gr\\xf6\\xdfe.toml"),
        (b"by\xfcte".decode("utf-8", "surrogateescape"), b"by\xfcte"),
        ("a → b", b"a -> b"),
        ("\U0001f916", b"\\U0001f916"),
    ],
)
def test_what_a_terminal_cannot_show_is_said_in_ascii(monkeypatch: pytest.MonkeyPatch, text: str, plain: bytes) -> None:
    shown = _put(monkeypatch, "ascii")
    prepare_streams()
    sys.stdout.write(text)
    assert shown.getvalue() == plain


def test_every_symbol_that_the_program_writes_is_shown_as_one_that_is_there() -> None:
    used = {character for file in SOURCES for character in file.read_text("utf-8") if not character.isascii()}
    assert {character for character in used if not character.isalpha() or character in "µσ"} <= set(IN_ASCII)
    assert all(plain.isascii() for plain in IN_ASCII.values())


def test_a_utf_8_terminal_shows_everything_as_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    shown = _put(monkeypatch, "utf-8")
    prepare_streams()
    sys.stdout.write("3 °C in Prüfung\n")
    assert (shown.getvalue(), sys.stdout.errors) == ("3 °C in Prüfung\n".encode(), HANDLER)


@pytest.mark.parametrize(
    ("arguments", "status"),
    [
        (["export-arm", "--arm", "right", "--export", "urdf", "--out", "{}/arm.urdf"], 0),
        (["calibrate", "--arm", "right", "--points", "{}/none.csv", "--out", "{}"], 2),
        (["run", "{}/none.csv", "--arm", "right", "--plan-only"], 2),
        (["status", "--arm", "right", "--socket", "{}/none.sock"], 2),
        (["plot", "{}/none.armlog"], 2),
    ],
    ids=lambda given: given[0] if isinstance(given, list) else "",
)
def test_commands_take_any_path_on_a_plain_ascii_terminal(tmp_path: Path, arguments: list[str], status: int) -> None:
    name = "Prüfung ".encode() + b"by\xfcte"
    folder = os.fsencode(tmp_path) + b"/" + name
    Path(os.fsdecode(folder)).mkdir()
    given = [os.fsencode(one).replace(b"{}", folder) for one in arguments]
    command = [os.fsencode(sys.executable), b"-m", b"console.main", *given]
    done = subprocess.run(command, env={**os.environ, **PLAIN}, capture_output=True, check=False, timeout=120)
    said = done.stdout + done.stderr
    assert b"Traceback" not in said
    assert b"cannot be written in" not in said
    assert name in said
    assert done.returncode == status


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_a_terminal_gets_sentences_broken_between_words_and_tables_and_commands_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "30")
    row = "joint  angle  count  current  supply"
    command = "  armwright serve --arm a-long-path/arm.toml"
    text = f"{row}\n{command}\n  the arm rests: `armwright enable --arm left` holds it\nshort\n"
    assert folded(text, io.StringIO()) == text
    assert folded(text, Terminal()).splitlines() == [
        row,
        command,
        "  the arm rests:",
        "  `armwright enable --arm left`",
        "  holds it",
        "short",
    ]
    assert folded(text, Terminal()).endswith("short\n")


def test_a_table_that_is_wider_than_the_terminal_goes_on_below_beside_its_first_column(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "20")
    table = aligned([("joint", "angle", "speed", "a count"), ("1", "0.1", "-20.5", "7"), ("2", "0.25", "3", "")])
    assert folded(f"arm\n{table}\nat rest", Terminal()).splitlines() == [
        "arm",
        "joint  angle  speed",
        "1        0.1  -20.5",
        "2       0.25      3",
        "",
        "joint  a count",
        "1            7",
        "2",
        "at rest",
    ]
    by_text = "  ok  disk    365 MB/s, more than it needs\n  ok  room    365 GB/d, more than it needs\n              -> others\n"
    assert folded(by_text, Terminal()) == by_text
