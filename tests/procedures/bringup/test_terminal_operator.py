"""The operator at a terminal: answers, mistakes, an end of input, and a key that stops."""

from __future__ import annotations

import io
import math
import os
import termios

import pytest

from procedures.bringup.workbench import Stopped, TerminalOperator


def answering(monkeypatch: pytest.MonkeyPatch, text: str) -> TerminalOperator:
    monkeypatch.setattr("sys.stdin", io.StringIO(text))
    return TerminalOperator()


def test_enter_allows_and_anything_else_does_not(monkeypatch: pytest.MonkeyPatch) -> None:
    operator = answering(monkeypatch, "\ns\n")
    assert operator.allow("a motion")
    assert not operator.allow("a motion")


@pytest.mark.parametrize(
    ("typed", "answer"),
    [("2+\n", (2, 1)), (" 3 -\n", (3, -1)), ("0\n", None), ("nothing\n", None), ("left\n4+\n1\n1-\n", (1, -1))],
)
def test_what_moved_is_asked_until_the_answer_makes_sense(
    monkeypatch: pytest.MonkeyPatch, typed: str, answer: tuple[int, int] | None
) -> None:
    assert answering(monkeypatch, typed).what_moved(3) == answer


@pytest.mark.parametrize(("typed", "degrees"), [("17.5\n", 17.5), ("-3,5\n", -3.5), ("about ten\ninf\n10\n", 10.0), ("\n", None)])
def test_angles_are_read_in_degrees(monkeypatch: pytest.MonkeyPatch, typed: str, degrees: float | None) -> None:
    found = answering(monkeypatch, typed).angle_rad(1)
    assert found is None if degrees is None else found == pytest.approx(math.radians(degrees))


def test_an_end_of_input_stops(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(Stopped, match="input has ended"):
        answering(monkeypatch, "").allow("a motion")
    assert capsys.readouterr().out.endswith("\n")


def test_a_key_stops_and_the_terminal_is_left_as_it_was(monkeypatch: pytest.MonkeyPatch) -> None:
    ours, theirs = os.openpty()
    with os.fdopen(theirs, "r") as terminal:
        monkeypatch.setattr("sys.stdin", terminal)
        before = termios.tcgetattr(terminal)
        with TerminalOperator() as operator:
            os.write(ours, b"\n")
            assert operator.allow("a motion")
            assert not operator.wants_stop()
            os.write(ours, b"x")
            for _ in range(20_000):  # the kernel carries it in its own time
                if operator.wants_stop():
                    break
            else:
                pytest.fail("the key was not seen")
            assert termios.tcgetattr(terminal)[3] != before[3]
        assert termios.tcgetattr(terminal)[3] == before[3]
    os.close(ours)


def test_motions_begin_by_themselves_where_that_was_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.stdin", io.StringIO("0\n"))
    operator = TerminalOperator(without_confirmation=True)
    assert operator.allow("a motion")
    assert operator.what_moved(2) is None
