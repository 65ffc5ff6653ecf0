"""How a long task says how far it is."""

from __future__ import annotations

from collections.abc import Callable

Advance = Callable[[str, float], None]
"""Called with what is being done and how much of the whole is done, 0 to 1."""


def silent(what: str, share: float) -> None:
    """Show no progress."""
