"""A third of the cases at each change, of claims that are made for many kinds; all of them at night."""

from __future__ import annotations

from collections.abc import Iterable

import pytest


def third_of(cases: Iterable[object], place: int = 0) -> list[object]:
    """Parameters: each third case, from `place` on, and the others `nightly`; each claim may take its own `place`."""
    return [
        case if (number - place) % 3 == 0 else pytest.param(case, marks=pytest.mark.nightly) for number, case in enumerate(cases)
    ]
