"""The search through sets: best first, with removals and exchanges, from several starts, so that it does not get stuck.

The log posterior of a set S of keys, each in its best variant and scales, with the noise kappa that S itself asks for, is
  ln P(S | y) = ln Z(S, kappa) + sum over S of (ln of the sum over variants and scales of their evidence, over the best's)
                + sum over S of ln (P(law within its bounds | y, the others) / P(law within its bounds))
                + sum over S of ln (p / (1 - p)),   p the prior of a name or a block,
with ln Z of `evidence.py` (the weights of scales in it): a friction that drives is none, whatever it explains. Variants and
scales are polished one member at a time, kappa after each round (coordinate ascent); a set is weighed once, whatever way leads
to it. What one key more would add is known for all keys at once from the Schur complement of `Evidence.offer`, so that only the
few that add most are weighed.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from itertools import combinations, groupby

import numpy as np

from calib.gap.finding import EffectName
from calib.gap.posterior.constants import REMAINS
from calib.gap.posterior.evidence import Evidence, Member, Offer, Weighed
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


@dataclass(frozen=True, slots=True)
class Successors:
    """What a set led to, all of it weighed: keys that were tried, and whether in the place of its members, too."""

    tried: frozenset[Key]
    is_exchanged: bool


class Search:
    """Over the sets of an Evidence; `forced` keys are in every set: what the arm's file has already."""

    def __init__(self, evidence: Evidence, forced: Collection[Key] = ()) -> None:
        self.evidence, self.forced = evidence, frozenset(forced) & evidence.of_key.keys()
        self._every = frozenset(evidence.of_key)
        self.seen: dict[frozenset[Key], Weighed] = {}
        self.expanded: dict[frozenset[Key], Successors] = {}

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
            best = self._best
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
            for members in self._larger(regrown.members, self.evidence.offer(regrown.members, regrown.kappa), 1, but, 0.0):
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

    def may_join(self, present: frozenset[Key]) -> frozenset[Key]:
        """The other keys that can be in one set with those present."""
        return self._every - present

    def _plain(self, key: Key) -> Member:
        """Any variant and scales of a key, to be polished."""
        numbers = self.evidence.of_key[key]
        number = numbers[len(numbers) // 2]
        return number, len(self.evidence.weights[number]) // 2

    def _expand(self, weighed: Weighed) -> None:
        """Weigh what is one term more, and, where nothing more pays, what is one less or one other; once."""
        keys, before = self.keys(weighed.members), self.expanded.get(self.keys(weighed.members))
        if before is not None and (before.is_exchanged or self._best > weighed.log + 1.0):
            return
        larger = self._larger(weighed.members, self.evidence.offer(weighed.members, weighed.kappa), WIDTH)
        for members in larger[:GROWTH]:
            self.weigh(members)
        if self._best > weighed.log + 1.0:  # it is not at its best yet
            self.expanded[keys] = Successors(self._tried(larger), False)
            return
        for members in larger[GROWTH:]:
            self.weigh(members)
        is_best = weighed.log >= self._best - EXCHANGED
        without = self.evidence.offers_without_each(weighed.members, weighed.kappa) if is_best else [None] * len(weighed.members)
        for member, gain, offer in zip(weighed.members, weighed.gains, without, strict=True):
            key = self.evidence.terms[member[0]].key
            if key in self.forced:
                continue
            rest = [present for present in weighed.members if present is not member]
            if gain < 2.0 * WINDOW:
                self.weigh(rest)
            if offer is not None:
                exchanged = self._larger(rest, offer, EXCHANGES, key, gain - 2.0 * WINDOW)
                for members in exchanged:
                    self.weigh(members)
                larger += exchanged
        self.expanded[keys] = Successors(self._tried(larger), is_best)

    @property
    def _best(self) -> float:
        """The largest log posterior so far."""
        return max(weighed.log for weighed in self.seen.values())

    def _tried(self, sets: Sequence[Sequence[Member]]) -> frozenset[Key]:
        """All keys of sets."""
        return frozenset[Key]().union(*map(self.keys, sets))

    def _larger(
        self, members: Sequence[Member], offer: Offer, width: int, but: Key | None = None, least: float = GAIN_LEAST
    ) -> list[list[Member]]:
        """A set with one term more, of those that add most, best first. `offer`: what each would add."""
        present = self.keys(members)
        blocks_count = sum(not isinstance(key, EffectName) for key in present)
        open_ = self.may_join(present) - {but}
        if blocks_count >= BLOCKS_MOST:  # no further name where a block would explain more
            blocks = {key for key in open_ if not isinstance(key, EffectName)}
            least = max([least, *(gain for _, _, gain in offer.largest(blocks, 1, least))])
            open_ -= blocks
        return [[*members, member] for _, member, _ in offer.largest(open_, width, least)]

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
            beyond, gains, added = 0.0, [], None
            for place, member in enumerate(before[0]):
                if added is None:
                    added = evidence.added_in_place(current, kappa, place)
                numbers = np.array(evidence.of_key[evidence.terms[member[0]].key])
                number = int(numbers[np.argmax(added.top[numbers])])
                current[place] = number, int(added.best[number])
                more = float(np.log(np.sum(np.exp(added.log[numbers] - added.top[number]))))
                beyond += more + float(added.bound[number])
                gains.append(float(added.top[number]) + more + evidence.terms[number].log_odds)
                if current[place] != member:
                    added = None  # what the next ones add beside it is something else
            kappa = evidence.inflation(current, kappa)
            if tuple(current) == before[0] and abs(kappa / before[1] - 1.0) < 1e-3:
                break
        odds = sum(evidence.terms[k].log_odds for k, _ in current if evidence.terms[k].key not in self.forced)
        weighed = Weighed(tuple(current), kappa, evidence.value(current, kappa) + beyond + odds, tuple(gains))
        self.seen[keys] = weighed
        return weighed


class MergingSearch(Search):
    """The search with one more step, two members make room for one other; without keys that are barred.

    Friction laws of a joint look alike: two wrong ones that grew first (viscous, and Coulomb of the other sign) do what one
    block (drag) does better, and no exchange of single members gets there.
    """

    def __init__(self, evidence: Evidence) -> None:
        super().__init__(evidence)
        self.barred: frozenset[Key] = frozenset()
        self._alike: dict[Key, set[Key]] = {}  # names that are one thing, of each of them
        for (_, alternative), names in groupby(sorted(self._every, key=self._thing), self._thing):
            together = set(names)
            self._alike |= dict.fromkeys(together if alternative else (), together)

    def bar(self, keys: Collection[Key]) -> None:
        """Look for sets without these from now on; those that were weighed and have none of them stay."""
        self.barred |= frozenset(keys)
        self.seen = {present: weighed for present, weighed in self.seen.items() if not present & self.barred}
        # what took the places that barred keys had among the few that were tried is not known yet
        self.expanded = {present: past for present, past in self.expanded.items() if not (present | past.tried) & self.barred}

    def run(self, known: Iterable[frozenset[Key]] = ()) -> list[Weighed]:
        """All sets that were weighed, best first; `known`: sets to start from besides."""
        ranked = super().run((start & self.evidence.of_key.keys()) - self.barred for start in known)
        for _ in range(MERGES):
            best = ranked[0]
            for pair in combinations(best.members, 2):
                if self._joint(pair[0][0]) == self._joint(pair[1][0]):
                    self._merge(best, pair)
            self._improve(set())
            ranked = sorted(self.seen.values(), key=lambda weighed: -weighed.log)
            if ranked[0] is best:
                break
        return ranked

    def _merge(self, best: Weighed, pair: tuple[Member, Member]) -> None:
        """What may do what two members of the best set do, or nearly so, and the set without the two."""
        rest, evidence = [member for member in best.members if member not in pair], self.evidence
        gain = evidence.value(best.members, best.kappa) - evidence.value(rest, best.kappa)
        gain += sum(evidence.terms[number].log_odds for number, _ in pair)
        if gain < 2.0 * WINDOW:
            self.weigh(rest)
        least = max(GAIN_LEAST, gain - max(2.0 * WINDOW, REMAINS * gain))  # a rival may lack so much and be looked at
        for members in self._larger(rest, evidence.offer(rest, best.kappa), BESIDE, None, least):
            self.weigh(members)

    def may_join(self, present: frozenset[Key]) -> frozenset[Key]:
        """Not two that are one thing: with both, each hides what the other does."""
        return (super().may_join(present) - self.barred).difference(*(self._alike.get(key, ()) for key in present))

    def _thing(self, key: Key) -> tuple[int, str]:
        """A name's joint, and what it is there as others are."""
        return key.joint or 0, self._traits(key).alternative if isinstance(key, EffectName) else ""

    def _starts(self) -> list[frozenset[Key]]:
        return [some for some in super()._starts() if all(key in self.may_join(some - {key}) for key in some)]

    def _joint(self, number: int) -> int:
        key = self.evidence.terms[number].key
        return key.joint or 0
