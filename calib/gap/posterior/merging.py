"""The search with one more step: two members make room for one other.

Friction laws of a joint look alike: two wrong ones that grew first (viscous, and Coulomb of the other sign) do what one
nameless block (drag) does better, and no exchange of single members gets there.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable
from itertools import combinations

from calib.gap.finding import EffectName
from calib.gap.posterior.evidence import Evidence
from calib.gap.posterior.search import Search, Weighed
from calib.gap.posterior.term import Key

# A gear is soft or loose, and no model follows one that is both; a command is late, or what is read of it is.
EITHER = (("joint_compliance", "backlash"), ("command_delay", "sampling time"))
MERGES = 3
BESIDE = 2  # terms that are tried in the place of two


class MergingSearch(Search):
    """Over the sets of an Evidence without keys that are `barred`."""

    def __init__(self, evidence: Evidence, barred: Collection[Key] = ()) -> None:
        super().__init__(evidence)
        self.barred = frozenset(barred)

    def run(self, known: Iterable[frozenset[Key]] = ()) -> list[Weighed]:
        """All sets that were weighed, best first; `known`: sets to start from besides."""
        found = super().run((start & self.evidence.of_key.keys()) - self.barred for start in known)
        for _ in range(MERGES):
            best = found[0]
            for pair in combinations(best.members, 2):
                places = {self._joint(number) for number, _ in pair}
                if len(places) == 1:
                    rest = [one for one in best.members if one not in pair]
                    self._weigh(rest)
                    self._grow(rest, best.kappa, BESIDE)
            self._improve(set())
            found = sorted(self.seen.values(), key=lambda one: -one.log)
            if found[0] is best:
                break
        return found

    def may_join(self, key: Key, present: Collection[Key]) -> bool:
        """Not two that are one thing: with both, each hides what the other does."""
        if key in self.barred:
            return False
        if not isinstance(key, EffectName):
            return True
        either = next((some for some in EITHER if key.effect in some), ())
        return not any(
            isinstance(one, EffectName) and one != key and one.effect in either and one.joint == key.joint
            for one in present
        )

    def _starts(self) -> list[frozenset[Key]]:
        return [some for some in super()._starts() if all(self.may_join(key, some - {key}) for key in some)]

    def _joint(self, number: int) -> int:
        key = self.evidence.terms[number].key
        return key.joint or 0
