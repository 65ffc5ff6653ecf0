"""The confusion matrix and the figures of the gap workflow's scores, the same for poses, time series and the mock arm.

Each case is run once. The hidden effects are `Truth` (as in truth.json), the workflow's finding becomes an `Answer`, and
`matrix` and `figures` format many of them. Rows are hidden effects, columns answers.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from calib.gap.finding import EffectName, GapFinding

GEOMETRY = "link_geometry"  # in poses it is refitted beside everything, and naming it is no claim
COLUMNS = ("right", "doubts", "part", "set with", "set w/o", "unknown", "nothing", "wrong")
LEGEND = (
    "right: all hidden effects and nothing else; doubts: those, but also unknown or a set; part: some of them;  "
    "set with, set w/o: an ambiguous set, with or without a hidden effect; wrong: a name that is not hidden"
)
NOTHING, OFF_THE_LIST, ONE, TWO = "nothing hidden", "off the list", "one hidden", "two hidden"
CLOSE = 0.1  # of a parameter


@dataclass(frozen=True, slots=True)
class Hidden:
    """One effect of truth.json."""

    name: EffectName
    parameters: Mapping[str, float]


@dataclass(frozen=True, slots=True)
class Truth:
    """Hidden effects of a case; `is_listed`: all of them are among those that may be named.

    `is_crooked`: the geometry is off, too, and may be listed among the effects.
    """

    hidden: tuple[Hidden, ...]
    is_listed: bool = True
    is_crooked: bool = False

    @property
    def sort(self) -> str:
        """Which of the four kinds of case this is."""
        if not self.hidden:
            return NOTHING
        if not self.is_listed:
            return OFF_THE_LIST
        return ONE if len(self.hidden) == 1 else TWO


@dataclass(frozen=True, slots=True)
class Answer:
    """Result of a case. `error` is that of the worst parameter, None without a right name; times in seconds."""

    case: str
    sort: str
    row: str
    column: str
    is_nameable: bool
    has_all: bool
    is_exact: bool
    error: float | None
    gap_before: float
    gap_after: float
    seconds: float
    finding: str

    @property
    def is_right(self) -> bool:
        """Whether this is the best possible answer."""
        wanted = {NOTHING: "nothing", OFF_THE_LIST: "unknown"}
        return self.column == wanted.get(self.sort, "right")


def answer(case: str, truth: Truth, found: GapFinding, could_name: Collection[EffectName], seconds: float) -> Answer:
    """Compare the finding with the hidden effects; `could_name`: effects that the workflow predicted as nameable."""
    wanted = {one.name for one in truth.hidden}
    listed = wanted if truth.is_listed else set()
    named = {e.name for e in found.effects if not (truth.is_crooked and e.name.effect == GEOMETRY)}
    return Answer(
        case,
        truth.sort,
        " + ".join(sorted({one.name.effect for one in truth.hidden})) or NOTHING,
        _column(listed, named, found),
        bool(listed) and all(name in could_name for name in listed),
        bool(listed) and listed <= named,
        bool(listed) and listed == named,
        _worst(truth, found) if listed and listed <= named else None,
        found.gap_before,
        found.gap_after,
        seconds,
        finding_text(found),
    )


def _column(listed: set[EffectName], named: set[EffectName], found: GapFinding) -> str:
    if named - listed:
        return "wrong"
    in_sets = {name for names in found.ambiguous for name in names}
    if listed and named == listed:
        return "doubts" if found.unknown is not None or in_sets else "right"
    if named:
        return "part"
    if in_sets & listed:
        return "set with"
    if found.unknown is not None:
        return "unknown"
    return "set w/o" if in_sets else "nothing"


def _worst(truth: Truth, found: GapFinding) -> float:
    """Largest relative error of the hidden parameters, of angles within a turn in radians; damping is no target."""
    errors = [0.0]
    for one in truth.hidden:
        values = next(effect.parameters for effect in found.effects if effect.name == one.name)
        for name, true in one.parameters.items():
            if name.startswith("damping"):
                continue
            if name not in values:
                errors.append(1.0)
            elif name == "phase_rad":
                errors.append(abs((values[name][0] - true + np.pi) % (2.0 * np.pi) - np.pi))
            else:
                errors.append(abs(values[name][0] - true) / max(abs(true), 1e-12))
    return float(max(errors))


def finding_text(found: GapFinding) -> str:
    """The finding in one line."""
    parts = [str(effect.name) for effect in found.effects if effect.name.effect != GEOMETRY]
    parts += ["{" + ", ".join(str(name) for name in names) + "}" for names in found.ambiguous]
    if found.unknown is not None:
        near = found.unknown.nearest
        proxy = f"; nearest {near}, {found.unknown.explained:.0%}" if near is not None else ""
        parts.append(f"unknown ({found.unknown.where}{proxy})")
    return "; ".join(parts) or "nothing"


def matrix(answers: Sequence[Answer]) -> str:
    """Rows: what is hidden, by sort of case; columns: `COLUMNS`."""
    lines = [f"{'hidden':62}" + "".join(f"{name:>11}" for name in COLUMNS)]
    for sort in (NOTHING, ONE, TWO, OFF_THE_LIST):
        some = [one for one in answers if one.sort == sort]
        for row in sorted({one.row for one in some}):
            counts = [sum(one.row == row and one.column == name for one in some) for name in COLUMNS]
            label = row if sort in (NOTHING, ONE) else f"{row} ({sort})"
            lines.append(f"{label:62}" + "".join(f"{count or '.':>11}" for count in counts))
    return "\n".join([*lines, LEGEND])


def figures(answers: Sequence[Answer], gap_target: float) -> str:
    """The figures of the targets, among nameable effects and over all cases beside them."""
    listed = [one for one in answers if one.sort in (ONE, TWO)]
    lines = [_rates(sort, [one for one in listed if one.sort == sort]) for sort in (ONE, TWO)]
    nulls = [one for one in answers if one.sort == NOTHING]
    quiet = sum(one.column == "nothing" for one in nulls)
    if nulls:
        bare = sum(one.column != "wrong" for one in nulls)
        lines.append(f"nothing hidden: no name in {bare} of {len(nulls)}; neither name, set nor unknown in {quiet}")
    strange = [one for one in answers if one.sort == OFF_THE_LIST]
    if strange:
        bare = sum(one.column != "wrong" for one in strange)
        lines.append(
            f"off the list: no wrong name in {bare} of {len(strange)}; "
            f"unknown in {sum(one.column == 'unknown' for one in strange)}"
        )
    errors = [one.error for one in listed if one.error is not None]
    if errors:
        close = sum(error <= CLOSE for error in errors)
        lines.append(
            f"worst parameter: median {np.median(errors):.1%}, largest {max(errors):.1%}; "
            f"within {CLOSE:.0%} in {close} of {len(errors)}"
        )
    after = [one.gap_after for one in listed if one.is_exact]
    if after:
        closed = sum(gap <= gap_target for gap in after)
        lines.append(
            f"gap after naming: median {np.median(after):.3f}, largest {max(after):.3f} times the floor; "
            f"at most {gap_target} in {closed} of {len(after)}"
        )
    seconds = [one.seconds for one in answers]
    if seconds:
        lines.append(f"time of a case: median {np.median(seconds):.1f} s, largest {max(seconds):.1f} s")
    return "\n".join(line for line in lines if line)


def _rates(sort: str, some: Sequence[Answer]) -> str:
    if not some:
        return ""
    nameable = [one for one in some if one.is_nameable]
    return (
        f"{sort}, nameable: effect and joint right in {_of(nameable, 'has_all')}, exact set in {_of(nameable, 'is_exact')}; "
        f"all: {_of(some, 'has_all')}, exact {_of(some, 'is_exact')}"
    )


def _of(some: Sequence[Answer], claim: str) -> str:
    count = sum(getattr(one, claim) for one in some)
    return f"{count} of {len(some)}" + (f" ({count / len(some):.0%})" if some else "")


def misses(answers: Iterable[Answer]) -> str:
    """A line for every case without the best possible answer."""
    return "\n".join(
        f"  {one.case}: {one.row} -> {one.column}: {one.finding} "
        f"(gap {one.gap_before:.2f} -> {one.gap_after:.2f}{'' if one.is_nameable else '; not called nameable'})"
        for one in answers
        if not one.is_right
    )


def score_text(title: str, answers: Sequence[Answer], gap_target: float) -> str:
    """All of it."""
    parts = [f"{title}: {len(answers)} cases", matrix(answers), figures(answers, gap_target), misses(answers)]
    return "\n".join(part for part in parts if part) + "\n"
