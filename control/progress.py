"""Progress of long tasks."""

from __future__ import annotations

from collections.abc import Callable

Advance = Callable[[str, float], None]
"""Called with the present step and the share done, 0 to 1."""


def silent(what: str, share: float) -> None:
    """Show no progress."""
