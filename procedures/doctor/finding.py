"""One line of the doctor: subject, measured value, expected value, remedy."""

import itertools
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from enum import IntEnum

FORMAT = "doctor/1"


class Level(IntEnum):
    """Severity; a larger number is worse."""

    OK = 0
    WARN = 1  # the arm works, but not as well as it could
    BAD = 2  # fix before the arm moves


@dataclass(frozen=True, slots=True)
class Finding:
    """`group` is host, ports, boards, timing, signals or arm; `remedy` is empty where nothing needs doing."""

    level: Level
    group: str
    what: str
    measured: str
    expected: str = ""
    remedy: str = ""


SUPPLY_LIMITS = (0.1, 0.25)  # of the nominal


def graded(group: str, what: str, value: float, limits: tuple[float, float], words: tuple[str, str, str]) -> Finding:
    """Grade a number: a warning above the first limit, bad above the second or if it is NaN.

    `words` are measured, expected and remedy.
    """
    warn_above, bad_above = limits
    level = Level.OK
    if not value <= bad_above:  # also NaN
        level = Level.BAD
    elif value > warn_above:
        level = Level.WARN
    measured, expected, remedy = words
    return Finding(level, group, what, measured, expected, remedy if level is not Level.OK else "")


def worst(findings: Sequence[Finding]) -> Level:
    """The worst of all."""
    return max((finding.level for finding in findings), default=Level.OK)


def as_text(findings: Sequence[Finding]) -> str:
    """A line for each finding, and a second one with the remedy if there is one."""
    lines = []
    for group, grouped in itertools.groupby(findings, key=lambda finding: finding.group):
        of_group = list(grouped)
        width = max(len(finding.what) for finding in of_group)  # a board's name may hold a long port
        lines.append(group)
        for finding in of_group:
            expected = f"  (expected {finding.expected})" if finding.expected else ""
            lines.append(f"  {finding.level.name.lower():<4}  {finding.what:<{width}}  {finding.measured}{expected}")
            if finding.remedy:
                lines.append(f"        -> {finding.remedy}")
    return "\n".join(lines)


def verdict(findings: Sequence[Finding]) -> str:
    """The result in one sentence."""
    bad = sum(finding.level is Level.BAD for finding in findings)
    warned = sum(finding.level is Level.WARN for finding in findings)
    if bad:
        return f"{bad} to fix before the arm moves, {warned} to check"
    if warned:
        return f"no errors; {warned} to check"
    return "no problems found"


def as_json(arm: str, findings: Sequence[Finding]) -> dict[str, object]:
    """The same for another program."""
    rows = [{**asdict(finding), "level": finding.level.name.lower()} for finding in findings]
    return {"format": FORMAT, "arm": arm, "worst": worst(findings).name.lower(), "verdict": verdict(findings), "findings": rows}


def percentile(values: Sequence[float], share: float) -> float:
    """Quantile of the values; NaN if there are none."""
    if not values:
        return math.nan
    ordered = sorted(values)
    return ordered[min(len(ordered) - 1, math.ceil(share * len(ordered)) - 1)]
