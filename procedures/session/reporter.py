"""The dialogue of a session for another program, such as the console's screen: one JSON object per line out, the same answers in.

{"ask": "SEATED", "prompt": "...", "setup": "normal", "point": "13", "done": 12, "left": 87,
 "board": [{"name": "13", "x_m": 0.02, "y_m": 0.0, "mark": "now"}, ...]}
{"recorded": "normal 13", "text": "...", "error_mm": 20.77, "deviation_mm": 1.22, "deviation_sd": 0.8, "is_suspect": false}
{"message": "...", "is_warning": false}
"""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Mapping

import numpy as np

from calib.session.dialogue import GO, Ask, Command, Recorded, Saying
from calib.session.moves import Vector
from calib.session.state import Mark, SessionState
from procedures.session.operator import Operator


def report(message: Mapping[str, object]) -> None:
    """Print a message as one line, flushed."""
    sys.stdout.write(json.dumps(message) + "\n")
    sys.stdout.flush()


def tell(text: str) -> None:
    """Report a text of the session as a message."""
    is_warning = text.startswith("! ")
    report({"message": text.removeprefix("! ").rstrip("\n"), "is_warning": is_warning})


class Reporter(Operator):
    """An `Operator` whose questions and records are messages. Its `say` is `tell`."""

    def _answer(self, saying: Saying) -> Command:
        if not isinstance(saying, Recorded):
            return super()._answer(saying)
        verdict = saying.verdict
        report(
            {
                "recorded": self._folder.state.targets[saying.record.key].name,
                "point": saying.record.point,
                "text": self._recorded(saying).removeprefix("! "),
                "error_mm": _mm(float(np.linalg.norm(verdict.error_m))),
                "deviation_mm": _mm(verdict.off_m),
                "deviation_sd": _finite(verdict.off_sd),
                "is_suspect": verdict.is_suspect,
            }
        )
        if verdict.is_suspect:
            self._auto = 0
        return GO

    def _asked(self, ask: Ask) -> Command:
        state, target = self._folder.state, ask.target
        setup = target.setup if target is not None else self._folder.standing
        report(
            {
                "ask": ask.question.name,
                "prompt": self._prompt(ask),
                "setup": setup,
                "point": target.point if target is not None else "",
                "done": state.count(Mark.DONE),
                "left": state.count(Mark.LEFT),
                "board": board(
                    state, self._words.cavities_m, setup, target.point if target is not None else ""
                ),
            }
        )
        return super()._asked(ask)


def board(
    state: SessionState, cavities_m: Mapping[str, Vector], setup: str, now: str
) -> list[dict[str, object]]:
    """Each cavity of a setup that the session uses: its place on the board and whether it is done."""
    found: list[dict[str, object]] = []
    for name, (x, y, _) in cavities_m.items():
        marks = {state.marks[key] for key in state.targets if key[:2] == (setup, name)}
        if marks:
            mark = "now" if name == now else (marks.pop().value if len(marks) == 1 else "partly")
            found.append({"name": name, "x_m": x, "y_m": y, "mark": mark})
    return found


def _mm(length_m: float) -> float | None:
    return _finite(1e3 * length_m)


def _finite(value: float) -> float | None:
    return round(value, 4) if math.isfinite(value) else None
