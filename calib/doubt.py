"""A guess about input: what it looks like, the figures for and against, and what settles it.

A guess is said aloud and the work goes on. It refuses only input that cannot be right as it stands, and then names
`--as-given`, the option that takes a file at its word.
"""

from __future__ import annotations

from dataclasses import dataclass

from calib.errors import UnusablePointsError

AS_GIVEN = "--as-given takes the file at its word"


@dataclass(frozen=True, slots=True)
class Doubt:
    """What input looks like, with the figure if it is that (`then`), the figure as it stands (`as_given`), and what to do."""

    looks: str
    then: str
    as_given: str
    remedy: str

    def in_words(self) -> str:
        """One sentence, for a warning."""
        return f"{self.looks}: {self.then}; with the file as given {self.as_given}; {self.remedy}"

    def refusal(self) -> UnusablePointsError:
        """The error where the input cannot be right as it stands."""
        return UnusablePointsError(f"{self.in_words()}, or {AS_GIVEN}")
