"""The search through sets: best first, with removals and exchanges, from several starts, so that it does not get stuck.

The log posterior of a set S of keys, each in its best variant and scales, with the noise kappa that S itself asks for, is
  ln P(S | y) = ln Z(S, kappa) + sum over S of (ln of the sum over variants and scales of their evidence, over the best's)
                + sum over S of ln (P(law within its bounds | y, the others) / P(law within its bounds))
                + sum over S of ln (p / (1 - p)),   p the prior of a name or a block,
with ln Z of `evidence.py` (the weights of scales in it): a friction that drives is none, whatever it explains. Variants and
scales are polished one member at a time, kappa after each round (coordinate ascent); a set is weighed once, whatever way leads
to it. What one key more would add is known for all keys at once from the Schur complement of `Evidence.added`, so that only the
few that add most are weighed.
"""

from __future__ import annotations

import heapq
from collections.abc import Collection, Iterable, Sequence
from itertools import combinations

import numpy as np

from calib.gap.finding import EffectName
from calib.gap.posterior.evidence import Added, Evidence, Member, Weighed
from calib.gap.posterior.term import Key, Traits

GROWTH = 2  # terms that are tried beside a set that still grows
WIDTH = 6  # terms that are tried beside a set
EXCHANGES = 1  # that are tried in the place of each of its members
WINDOW = 8.0  # log evidence below the best at which a set is still looked into
GAIN_LEAST = -4.0  # log odds below which a further term cannot matter
EXPANSIONS = 30
BLOCKS_MOST = 6  # nameless blocks in a set; what many small ones leave is noise
EXCHANGED = 3.0  # log evidence below the best within which members are exchanged
REGROWTH = 6
POLISHES = 3
MERGES = 3  # times that two members make room for one other
BESIDE = 2  # terms that are tried in the place of two


class Search:
    """Over the sets of an Evidence; `forced` keys are in every set: what the arm's file has already."""

    def __init__(self, evidence: Evidence, forced: Collection[Key] = ()) -> None:
        self.evidence, self.forced = evidence, frozenset(forced) & evidence.of_key.keys()
        self.seen: dict[frozenset[Key], Weighed] = {}

    def keys(self, members: Iterable[Member]) -> frozenset[Key]:
        """Of a set."""
        return frozenset(self.evidence.terms[k].key for k, _ in members)

    def run(self, known: Iterable[frozenset[Key]] = ()) -> list[Weighed]:
        """All sets that were weighed, best first; `known`: sets to start from besides."""
        expanded: set[frozenset[Key]] = set()
        for start in [*known, *self._starts()]:  # one after the other: many that fit anything would cut off the few
            self.of({*start, *self.forced})
            self._improve(expanded)
        best = max(self.seen.values(), key=lambda weighed: weighed.log)
        for number, _ in best.members:
            if not self.evidence.terms[number].is_name:
                self._regrow(best, number)
        self._improve(expanded)
        return sorted(self.seen.values(), key=lambda weighed: -weighed.log)

    def of(self, keys: Collection[Key]) -> Weighed:
        """The set of some keys, in the evidence's order: a set's own differs from run to run."""
        return self.weigh([self._plain(key) for key in self.evidence.of_key if key in keys])

    def _improve(self, expanded: set[frozenset[Key]]) -> None:
        """Best first, until nothing near the best is left to look into."""
        for _ in range(EXPANSIONS):
            best = max(weighed.log for weighed in self.seen.values())
            open_ = [(weighed.log, keys) for keys, weighed in self.seen.items() if keys not in expanded]
            if not open_:
                break
            top, keys = max(open_, key=lambda pair: pair[0])
            if top < best - WINDOW:
                break
            expanded.add(keys)
            self._expand(self.seen[keys])

    def _regrow(self, best: Weighed, block: int) -> None:
        """Several terms in the place of a block: it may have soaked up what two or three effects do together."""
        but = self.evidence.terms[block].key
        regrown = self.weigh([member for member in best.members if member[0] != block])
        for _ in range(REGROWTH):
            before = set(self.seen)
            for members in self._larger(regrown.members, self.evidence.added(regrown.members, regrown.kappa), 1, but, 0.0):
                self.weigh(members)
            new = [weighed for keys, weighed in self.seen.items() if keys not in before]
            more = max(new, key=lambda weighed: weighed.log, default=None)
            if more is None or more.log <= regrown.log:
                return
            regrown = more

    def _starts(self) -> list[frozenset[Key]]:
        """Nothing, and what all joints have at once, if one has."""
        names = [key for key in self.evidence.of_key if isinstance(key, EffectName)]
        everywhere = [key for key in names if self._traits(key).is_on_every_joint]
        effects = dict.fromkeys(key.effect for key in everywhere)
        some = [frozenset(key for key in everywhere if key.effect == effect) for effect in effects]
        return [frozenset(), *some, frozenset(everywhere)]

    def _traits(self, key: Key) -> Traits:
        return self.evidence.terms[self.evidence.of_key[key][0]].traits

    def may_join(self, key: Key, present: Collection[Key]) -> bool:
        """Whether a key can be in one set with those present."""
        return True

    def _plain(self, key: Key) -> Member:
        """Any variant and scales of a key, to be polished."""
        numbers = self.evidence.of_key[key]
        number = numbers[len(numbers) // 2]
        return number, len(self.evidence.weights[number]) // 2

    def _expand(self, weighed: Weighed) -> None:
        """Weigh what is one term more, and, where nothing more pays, what is one less or one other."""
        larger = self._larger(weighed.members, self.evidence.added(weighed.members, weighed.kappa), WIDTH)
        for members in larger[:GROWTH]:
            self.weigh(members)
        if max(rival.log for rival in self.seen.values()) > weighed.log + 1.0:
            return  # it is not at its best yet
        for members in larger[GROWTH:]:
            self.weigh(members)
        is_best = weighed.log >= max(rival.log for rival in self.seen.values()) - EXCHANGED
        without = self.evidence.added_without_each(weighed.members, weighed.kappa) if is_best else [None] * len(weighed.members)
        for member, gain, added in zip(weighed.members, weighed.gains, without, strict=True):
            key = self.evidence.terms[member[0]].key
            if key in self.forced:
                continue
            rest = [present for present in weighed.members if present is not member]
            if gain < 2.0 * WINDOW:
                self.weigh(rest)
            if added is not None:
                for members in self._larger(rest, added, EXCHANGES, key, gain - 2.0 * WINDOW):
                    self.weigh(members)

    def _larger(
        self, members: Sequence[Member], added: Added, width: int, but: Key | None = None, least: float = GAIN_LEAST
    ) -> list[list[Member]]:
        """A set with one term more, of those that add most, best first. `added`: what each would add."""
        present = self.keys(members)
        blocks_count = sum(not isinstance(key, EffectName) for key in present)
        gains = {
            key: gain
            for key, gain in zip(self.evidence.of_key, self.evidence.gains(added), strict=True)
            if key not in present and key != but and self.may_join(key, present)
        }
        if blocks_count >= BLOCKS_MOST:  # no further name where a block would explain more
            blocks = [gain for key, gain in gains.items() if not isinstance(key, EffectName)]
            least = max(least, *blocks) if blocks else least
        of_key = self.evidence.of_key
        larger = []
        for key in heapq.nlargest(width, gains, lambda key: (gains[key], of_key[key])):
            if gains[key] > least:
                numbers = of_key[key]
                number = numbers[int(np.argmax(added.log[numbers]))]
                larger.append([*members, (number, int(added.best[number]))])
        return larger

    def weigh(self, members: Sequence[Member]) -> Weighed:
        """The best variants and scales of a set, one member after the other, and the noise that it leaves."""
        keys = self.keys(members)
        if keys in self.seen:
            return self.seen[keys]
        current, evidence = list(members), self.evidence
        kappa, beyond = evidence.inflation(current, evidence.inflation(current, 1.0)), 0.0
        gains: list[float] = []
        for _ in range(POLISHES):
            before = tuple(current), kappa
            beyond, gains = 0.0, []
            for place in range(len(current)):
                rest = [*current[:place], *current[place + 1 :]]
                key = evidence.terms[current[place][0]].key
                added = evidence.added(rest, kappa, key)
                number = int(np.argmax(added.top))
                current[place] = number, int(added.best[number])
                numbers = evidence.of_key[key]
                more = float(np.log(np.sum(np.exp(added.log[numbers] - added.top[number]))))
                beyond += more + float(added.bound[number])
                gains.append(float(added.top[number]) + more + evidence.terms[number].log_odds)
            kappa = evidence.inflation(current, kappa)
            if tuple(current) == before[0] and abs(kappa / before[1] - 1.0) < 1e-3:
                break
        odds = sum(evidence.terms[k].log_odds for k, _ in current if evidence.terms[k].key not in self.forced)
        weighed = Weighed(tuple(current), kappa, evidence.value(current, kappa) + beyond + odds, tuple(gains))
        self.seen[keys] = weighed
        return weighed


class MergingSearch(Search):
    """The search with one more step, two members make room for one other; without keys that are `barred`.

    Friction laws of a joint look alike: two wrong ones that grew first (viscous, and Coulomb of the other sign) do what one
    block (drag) does better, and no exchange of single members gets there.
    """

    def __init__(self, evidence: Evidence, barred: Collection[Key] = ()) -> None:
        super().__init__(evidence)
        self.barred = frozenset(barred)

    def run(self, known: Iterable[frozenset[Key]] = ()) -> list[Weighed]:
        """All sets that were weighed, best first; `known`: sets to start from besides."""
        ranked = super().run((start & self.evidence.of_key.keys()) - self.barred for start in known)
        for _ in range(MERGES):
            best = ranked[0]
            for pair in combinations(best.members, 2):
                places = {self._joint(number) for number, _ in pair}
                if len(places) == 1:
                    rest = [member for member in best.members if member not in pair]
                    self.weigh(rest)
                    for members in self._larger(rest, self.evidence.added(rest, best.kappa), BESIDE):
                        self.weigh(members)
            self._improve(set())
            ranked = sorted(self.seen.values(), key=lambda weighed: -weighed.log)
            if ranked[0] is best:
                break
        return ranked

    def may_join(self, key: Key, present: Collection[Key]) -> bool:
        """Not two that are one thing: with both, each hides what the other does."""
        if key in self.barred:
            return False
        if not isinstance(key, EffectName):
            return True
        alternative = self._traits(key).alternative
        return not alternative or not any(
            isinstance(one, EffectName) and one != key and one.joint == key.joint and self._traits(one).alternative == alternative
            for one in present
        )

    def _starts(self) -> list[frozenset[Key]]:
        return [some for some in super()._starts() if all(self.may_join(key, some - {key}) for key in some)]

    def _joint(self, number: int) -> int:
        key = self.evidence.terms[number].key
        return key.joint or 0
