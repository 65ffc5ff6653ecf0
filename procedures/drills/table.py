"""The outcome of drills as text: one line a drill."""

from collections.abc import Iterable

from procedures.drills.drill import WATCHED_S
from procedures.drills.promise import DrillOutcome, Promise

HEADER = ("drill", "during", "noticed", "stood", "off path", "ran on", "lost", "found")
WIDTHS = (26, 12, 9, 9, 9, 9, 11, 0)


def header() -> str:
    """The head of the table, with its units."""
    return f"{_line(HEADER)}\n{_line(('', '', '[ms]', '[ms]', '[mm]', '[mm]', '', ''))}"


def row(outcome: DrillOutcome) -> str:
    """One drill; a promise that was not kept follows in capitals."""
    promised = [code for code in outcome.found if code in outcome.drill.codes]
    found = next(iter((*promised, *outcome.found)), "goes on")
    if outcome.broken:
        found = f"{found}   BROKEN: {'; '.join(outcome.broken)}"
    return _line(
        (
            outcome.drill.name,
            outcome.drill.during,
            _ms(outcome.noticed_s),
            _ms(outcome.stood_s, f"> {WATCHED_S * 1e3:.0f}"),
            f"{outcome.off_path_mm:.1f}",
            f"{outcome.ran_on_mm:.0f}",
            outcome.lost,
            found,
        )
    )


def verdict(outcomes: Iterable[DrillOutcome]) -> str:
    """The last line of the table."""
    every = list(outcomes)
    broken = sum(bool(outcome.broken) for outcome in every)
    kept = f"{len(every)} drills, {len(every) - broken} as promised"
    return f"{kept}, {broken} not" if broken else kept


def in_words(outcome: DrillOutcome) -> str:
    """One drill for a reader."""
    drill = outcome.drill
    lines = [
        f"drill {drill.name}: {drill.says}, {drill.during}",
        f"  noticed     {_ms(outcome.noticed_s)} ms after the fault"
        if outcome.noticed_s is not None
        else "  noticed     nothing to report",
        "  stood       "
        + (
            f"not within {WATCHED_S:g} s"
            if outcome.stood_s is None
            else f"{_ms(outcome.stood_s)} ms after the fault"
        ),
        f"  off path    {outcome.off_path_mm:.1f} mm at most, from the path that was asked for",
        f"  ran on      {outcome.ran_on_mm:.0f} mm since the fault",
        f"  lost        {outcome.lost}",
    ]
    if outcome.message:
        lines.append(f"  message     {outcome.message}")
    lines.append(
        f"  promise     {'kept' if not outcome.broken else 'NOT kept: ' + '; '.join(outcome.broken)}"
    )
    return "\n".join(lines)


def _ms(value_s: float | None, none: str = "-") -> str:
    return none if value_s is None else f"{value_s * 1e3:.0f}"


def _line(cells: tuple[str, ...]) -> str:
    return " ".join(cell.ljust(width) for cell, width in zip(cells, WIDTHS, strict=True)).rstrip()


def listing(every: Iterable[Promise]) -> str:
    """The names of drills, with what each does."""
    return "\n".join(f"{drill.name.ljust(WIDTHS[0])} {drill.says}" for drill in every)
