"""The log evidence of sets of terms, and what each further term would add to a set, all variants and sizes at once.

The model is linear, y = geometry + C s + noise, s ~ N(0, V). With the geometry projected out, a set S has, beside nothing,
  ln Z = h' M h / 2 - ln det(I + V^1/2 G V^1/2) / 2,   M = V^1/2 (I + V^1/2 G V^1/2)^-1 V^1/2
(MacKay, Information Theory, Inference, and Learning Algorithms, 2003, ch. 28), and a term beside S the same of what S leaves of
its own G and h (a Schur complement). The tips' noise may be kappa times the floor: what a set leaves is then noise to it.
Columns of prior variance nought, as the departures of an exact law, change neither and are left out. A search asks for the few
terms that add most; so of each only a bound is reckoned first (`Offer.bounds`), and its scales where that is not below those few.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.linalg import solve_triangular
from scipy.linalg.blas import dtrsm
from scipy.special import log_ndtr

from calib.arrays import Array
from calib.gap.posterior.constants import LAW_LEAST
from calib.gap.posterior.term import Key, Term

WIDER = 2  # times as many keys as are asked for are looked at before the bounds are compared with what these add
ROUNDING = 1e-9  # of log evidence, by which a bound may be too small
NEVER = -1e6  # log evidence of a play or a softness below nought, of departures without a law

Places = npt.NDArray[np.intp]
Member = tuple[int, int]  # number of the term, number of its scales


@dataclass(frozen=True, slots=True)
class Weighed:
    """A set with its best variants and scales, its noise over the floor, and its log posterior up to a constant.

    `gains`: what each member adds to the log posterior beside the others.
    """

    members: tuple[Member, ...]
    kappa: float
    log: float
    gains: tuple[float, ...] = ()


@dataclass(frozen=True, slots=True)
class Gram:
    """What evidence needs of any number of measurements: G (p, p) and h (p,) of tips and of currents, in standard deviations;
    y'My of the tips, and their degrees of freedom. `current`: None without currents; as zeros it would cost as much as the tips.
    """

    tip: Array
    pull: Array
    current: Array | None
    current_pull: Array
    left: float
    freedom: float

    def among(self, rows: Places | slice, columns: Places | slice, kappa: float = 1.0) -> Array:
        """G of some columns with others, by tips whose noise is `kappa` times the floor and by currents; of all it is large."""
        across = (rows, columns) if isinstance(rows, slice) or isinstance(columns, slice) else np.ix_(rows, columns)
        seen = self.tip[across] / kappa**2
        if self.current is not None:
            seen += self.current[across]
        return np.asarray(seen)

    def of(self, at: Places) -> Gram:
        """Of some columns."""
        across = np.ix_(at, at)
        current = None if self.current is None else self.current[across]
        return Gram(self.tip[across], self.pull[at], current, self.current_pull[at], self.left, self.freedom)

    def drawn(self, at: Places | slice, kappa: float = 1.0) -> Array:
        """The same of h."""
        return np.asarray(self.pull[at] / kappa**2 + self.current_pull[at])


@dataclass(frozen=True, slots=True)
class Batch:
    """Terms that have the same scales, sd (h, c): places (t, c), log weights (t, h), what a coefficient lies between (t, 1);
    how many coefficients of the law are bounded together, and from below by what in sd, at each of the scales (h,).
    """

    numbers: Array
    places: Array
    sd: Array
    weight: Array
    is_positive: bool
    least: Array
    most: Array
    bounded: int
    law_least: Array
    tip: Array
    current: Array | None

    def only(self, rows: Places) -> Batch:
        """Some of its terms."""
        return dataclasses.replace(
            self,
            numbers=self.numbers[rows],
            places=self.places[rows],
            weight=self.weight[rows],
            least=self.least[rows],
            most=self.most[rows],
        )


@dataclass(frozen=True, slots=True)
class TermGroup:
    """All terms of c columns: numbers (t,), places (t, c), least and largest standard deviation of each column over all scales
    (t, c), G of tips and of currents (t, c, c).
    """

    numbers: Places
    places: Places
    least: Array
    most: Array
    tip: Array
    current: Array | None


@dataclass(frozen=True, slots=True)
class Inside:
    """A set's own columns: places and prior standard deviations (k,), G and h of the whole and of these, and
    I + V^1/2 G V^1/2 (k, k) at a noise of `kappa` times the floor.
    """

    whole: Gram
    members: tuple[Member, ...]
    kappa: float
    at: Places
    sd: Array
    own: Gram
    inner: Array


class Evidence:
    """Of the sets of `terms` around one linearisation. `doubt`: the standard deviation of the floor's logarithm."""

    def __init__(self, gram: Gram, terms: Sequence[Term], doubt: float) -> None:
        self.gram, self.terms, self.doubt = gram, tuple(terms), doubt
        ends = np.cumsum([term.count for term in terms])
        self.places = [np.arange(end - term.count, end) for term, end in zip(terms, ends.tolist(), strict=True)]
        self.of_key: dict[Key, list[int]] = {}
        for k, term in enumerate(terms):
            self.of_key.setdefault(term.key, []).append(k)
        self.scales = [term.scales() for term in terms]
        share = [math.log(len(self.of_key[term.key])) for term in terms]
        self.weights = [logs - own for (_, logs), own in zip(self.scales, share, strict=True)]
        self._starts = np.cumsum([0, *(len(numbers) for numbers in self.of_key.values())])[:-1]
        self._by_key = np.concatenate([np.zeros(0, np.intp), *self.of_key.values()]).astype(np.intp)
        self._odds = np.array([terms[numbers[0]].log_odds for numbers in self.of_key.values()])
        # of all scales together, with twice the density of what is positive
        twice = [math.log(2.0) * term.is_positive for term in terms]
        self._most = np.array([np.logaddexp.reduce(own) + more for own, more in zip(self.weights, twice, strict=True)])
        self._needed = {key: np.concatenate([self.places[k] for k in numbers]) for key, numbers in self.of_key.items()}
        self._batches = self._batched()
        by_count: dict[int, list[int]] = {}
        for k, term in enumerate(terms):
            by_count.setdefault(term.count, []).append(k)
        self._groups = [self._group(np.array(numbers)) for numbers in by_count.values()]
        self._row = np.empty((2, len(terms)), np.intp)  # of each term its group and its row there
        for number, group in enumerate(self._groups):
            self._row[0, group.numbers], self._row[1, group.numbers] = number, np.arange(len(group.numbers))
        self._acting: dict[Member, tuple[Places, Places, Array]] = {}
        self._last: Inside | None = None

    def _batched(self) -> list[Batch]:
        """All terms."""
        groups: dict[object, list[int]] = {}
        for k, term in enumerate(self.terms):
            sd = self.scales[k][0]
            groups.setdefault((sd.shape, sd.tobytes(), term.laws, term.is_positive, term.is_name), []).append(k)
        return [self._batch(numbers) for numbers in groups.values()]

    def _batch(self, numbers: list[int]) -> Batch:
        places, term = np.array([self.places[k] for k in numbers]), self.terms[numbers[0]]
        # a departure is a share of the law: without the law there is none
        departs = np.any(self.scales[numbers[0]][0][:, term.laws :] > 0.0, axis=1) & term.is_name
        across = places[:, :, None], places[:, None, :]
        return Batch(
            np.array(numbers),
            places,
            self.scales[numbers[0]][0],
            np.array([self.weights[k] for k in numbers]),
            term.is_positive,
            np.array([[self.terms[k].least] for k in numbers]),
            np.array([[self.terms[k].most] for k in numbers]),
            1 if term.is_positive else term.laws if departs.any() else 0,
            np.where(departs, LAW_LEAST, -np.inf),
            self.gram.tip[across],
            None if self.gram.current is None else self.gram.current[across],
        )

    def _group(self, numbers: Places) -> TermGroup:
        places = np.array([self.places[k] for k in numbers])
        least, most = (np.array([extreme(self.scales[k][0], axis=0) for k in numbers]) for extreme in (np.min, np.max))
        across = places[:, :, None], places[:, None, :]
        current = None if self.gram.current is None else self.gram.current[across]
        return TermGroup(numbers, places, least, most, self.gram.tip[across], current)

    def _acts(self, member: Member) -> tuple[Places, Places, Array]:
        """A member's columns whose prior standard deviation is not nought: which of its own, their places, and that deviation."""
        if member not in self._acting:
            number, scale = member
            sd = self.scales[number][0][scale]
            own = np.flatnonzero(sd)
            self._acting[member] = own, self.places[number][own], sd[own]
        return self._acting[member]

    def _columns(self, members: Sequence[Member]) -> tuple[Places, Array]:
        """Places and prior standard deviations of a set's columns that may be something."""
        if not members:
            return np.zeros(0, np.intp), np.zeros(0)
        _, places, sd = zip(*map(self._acts, members), strict=True)
        return np.concatenate(places), np.concatenate(sd)

    def _inside(self, members: tuple[Member, ...], kappa: float) -> Inside:
        """A set's own columns; the last set's are kept, as it is asked for one member after the other, and G is too large for a
        processor's cache.
        """
        last = self._last
        if last is None or last.whole is not self.gram or last.members != members:
            at, sd = self._columns(members)
            own = self.gram.of(at)
        elif last.kappa == kappa:
            return last
        else:
            at, sd, own = last.at, last.sd, last.own
        inner = self._inner(own.among(slice(None), slice(None), kappa), sd)
        self._last = Inside(self.gram, members, kappa, at, sd, own, inner)
        return self._last

    def _inner(self, seen: Array, sd: Array) -> Array:
        """I + V^1/2 G V^1/2, from G (k, k), which is overwritten."""
        seen *= sd[:, None]
        seen *= sd
        seen.flat[:: len(sd) + 1] += 1.0
        return seen

    def taken(self, at: Places, sd: Array, others: Places | slice, kappa: float) -> Array:
        """What columns at places (k,) of prior deviations (k,) take of G and h of some others, (k, p + 1): T with T'T of it.

        Schur's complement, which is what they leave, is G - T'T and h - T't, t the last column.
        """
        return self._taken(_root(self._inner(self.gram.among(at, at, kappa), sd)), at, sd, others, kappa)

    def _taken(self, root: Array, at: Places, sd: Array, others: Places | slice, kappa: float) -> Array:
        """The same with Cholesky's factor of I + V^1/2 G V^1/2."""
        if not len(at):
            return np.zeros((0, len(self.gram.pull[others]) + 1))
        both = np.column_stack((self.gram.among(at, others, kappa), self.gram.drawn(at, kappa)))
        both *= sd[:, None]
        # L T = B as T' L' = B', which lie in memory as BLAS wants them, so that nothing is copied
        return np.asarray(dtrsm(1.0, root.T, both.T, side=1, overwrite_b=1).T)

    def added(self, members: Sequence[Member], kappa: float) -> Added:
        """What every term would add to a set."""
        return self.offer(members, kappa).added(range(len(self.terms)))

    def added_in_place(self, members: Sequence[Member], kappa: float, first: int = 0) -> Added:
        """What the terms of each member's key, from the first on, would add to its others (`offers_without_each`)."""
        inside, keys = self._inside(tuple(members), kappa), [self.terms[number].key for number, _ in members[first:]]
        factor, asked = _root(inside.inner), [self._needed[key] for key in keys]
        at = np.concatenate(asked)
        both = self._taken(factor, inside.at, inside.sd, at, kappa)
        taken, root = np.ascontiguousarray(both[:, :-1].T), _inverse(factor)
        pull, widths = self.gram.drawn(slice(None), kappa), [len(self._acts(member)[0]) for member in members]
        pull[at] -= taken @ both[:, -1]
        returned, start, begin = np.zeros((len(at), max(widths))), sum(widths[:first]), 0
        for width, places in zip(widths[first:], asked, strict=True):
            mine, own = slice(begin, begin + len(places)), root[start:, start : start + width]
            back = _returned(own, np.column_stack((both[start:, mine], both[start:, -1])))
            returned[mine, :width] = back[:-1]
            pull[places] += back[:-1] @ back[-1]
            start, begin = start + width, mine.stop
        within = np.zeros(len(pull), np.intp)
        within[at] = np.arange(len(at))
        batches, left = self._asked([number for key in keys for number in self.of_key[key]]), []
        for batch, rows in batches:
            own_places = within[batch.places[rows]]
            part = returned[own_places]
            left.append(_left(batch, taken[own_places], kappa, rows) + part @ part.transpose(0, 2, 1))
        return self._added([batch.only(rows) for batch, rows in batches], left, pull)

    def offer(self, members: Sequence[Member], kappa: float) -> Offer:
        """What terms would add to a set, as it is asked for."""
        both = self.taken(*self._columns(members), slice(None), kappa)
        factor = np.ascontiguousarray(both[:, :-1].T)
        left = [_left(group, factor[group.places], kappa) for group in self._groups]
        return Offer(self, left, self.gram.drawn(slice(None), kappa) - factor @ both[:, -1])

    def offers_without_each(self, members: Sequence[Member], kappa: float) -> Iterator[Offer]:
        """What terms would add to a set without one of its members, in turn.

        With A = I + V^1/2 G V^1/2 of the set and B its rows of all columns, V^1/2 G, the set takes B' A^-1 B of these; without
        the columns c of a member that is less by W_c' ((A^-1)_cc)^-1 W_c, W = A^-1 B (the inverse of a partitioned matrix).
        """
        inside, whole = self._inside(tuple(members), kappa), self.offer(members, kappa)
        factor = _root(inside.inner)
        both = self._taken(factor, inside.at, inside.sd, slice(None), kappa)
        root, first = _inverse(factor), 0
        for member in members:
            own = root[first:, first : first + len(self._acts(member)[0])]  # A^-1 = root' root, and root is lower
            returned = _returned(own, both[first:])
            first += own.shape[1]
            parts = [returned[group.places] for group in self._groups]
            left = [of_set + part @ part.transpose(0, 2, 1) for of_set, part in zip(whole.left, parts, strict=True)]
            yield Offer(self, left, whole.pull + returned[:-1] @ returned[-1])

    def _added(self, batches: Sequence[Batch], left: Sequence[Array], pull: Array) -> Added:
        found = [self._of_batch(batch, seen, pull[batch.places]) for batch, seen in zip(batches, left, strict=True)]
        return Added.of([batch.numbers for batch in batches], found, len(self.terms))

    def _asked(self, numbers: Sequence[int] | Places) -> list[tuple[Batch, Places]]:
        """Batches that have some of the terms by number, and these terms' rows there."""
        is_asked = np.zeros(len(self.terms), dtype=bool)
        is_asked[numbers] = True
        asked = ((batch, np.flatnonzero(is_asked[batch.numbers])) for batch in self._batches)
        return [(batch, rows) for batch, rows in asked if len(rows)]

    def added_of(self, left: Sequence[Array], pull: Array, numbers: Sequence[int] | Places) -> Added:
        """What some terms add, from the G that a set leaves of each group (t, c, c) and the h of all columns (p,)."""
        batches = [batch.only(rows) for batch, rows in self._asked(numbers)]
        group, row = self._row
        seen = [left[group[batch.numbers[0]]][row[batch.numbers]] for batch in batches]
        return self._added(batches, seen, pull)

    def bounds(self, left: Sequence[Array], pull: Array) -> Array:
        """What each key, in the order of `of_key`, adds to the log posterior at most, from what a set leaves.

        Of a term h' (G + V^-1)^-1 h / 2 grows with V and ln det(I + V^1/2 G V^1/2) >= ln(1 + tr V G) does, too: the one at its
        largest scales less half the other at its least is more than any of its scales adds, but for twice the density of what
        is known to be positive.
        """
        log = np.empty(len(self.terms))
        for group, seen in zip(self._groups, left, strict=True):
            drawn = pull[group.places] * group.most
            inner = group.most[:, :, None] * seen * group.most[:, None, :]
            at = np.arange(inner.shape[1])
            inner[:, at, at] += 1.0
            chi_square = np.sum(drawn * np.linalg.solve(inner, drawn[:, :, None])[:, :, 0], axis=1)
            trace = np.sum(np.maximum(seen[:, at, at], 0.0) * group.least**2, axis=1)
            log[group.numbers] = 0.5 * (chi_square - np.log1p(trace))
        log += self._most
        bounds = np.logaddexp.reduceat(log[self._by_key], self._starts) + self._odds
        return np.asarray(bounds + ROUNDING * np.max(np.abs(log)))

    def _of_batch(self, batch: Batch, seen: Array, pull: Array) -> tuple[Array, Array, Array, Array]:
        """Of terms with G (t, c, c) and h (t, c): the log evidence that each adds, the best of its scales, what that one alone
        adds, and the part of bounds in that.
        """
        sd = batch.sd
        law_sizes, width, log = _estimates(seen, pull, sd, batch.bounded)
        log += batch.weight
        bound = np.zeros(log.shape)
        if batch.is_positive:
            law, least, most = law_sizes[..., 0], batch.least / sd[:, 0], batch.most / sd[:, 0]
            # what is known to be positive is so with twice the density; a secant says nothing beyond its reach
            is_beyond = np.isfinite(most) & ((law <= least) | (law >= most))
            bound += math.log(2.0) + log_ndtr((most - law) / width) + np.where(is_beyond, NEVER, 0.0)
            bound += log_ndtr((law - np.maximum(least, batch.law_least)) / width)
        elif batch.bounded:
            bound += log_ndtr((np.sqrt((law_sizes**2).sum(axis=2)) - batch.law_least) / width)
        log += bound
        best, rows = log.argmax(axis=1), np.arange(len(log))
        top = log[rows, best]
        return top + np.log(np.exp(log - top[:, None]).sum(axis=1)), best, top, bound[rows, best]

    def value(self, members: Sequence[Member], kappa: float) -> float:
        """Ln Z of a set over nothing at the floor, the priors of its scales and of kappa included, without bounds of laws."""
        inside, gram = self._inside(tuple(members), kappa), self.gram
        total = -gram.freedom * math.log(kappa) - 0.5 * gram.left * (kappa**-2 - 1.0) + self.log_inflation(kappa)
        if members:
            root = _root(inside.inner)
            half = solve_triangular(root, inside.sd * inside.own.drawn(slice(None), kappa), lower=True, check_finite=False)
            total += 0.5 * float(half @ half) - float(np.sum(np.log(np.diag(root))))
            total += sum(float(self.weights[k][h]) for k, h in members)
        return float(total)

    def estimate(self, members: Sequence[Member], kappa: float) -> tuple[Array, Array]:
        """Coefficients of all columns of a set, in usual sizes, and their covariance."""
        ends = np.cumsum([0, *(len(self.places[k]) for k, _ in members)]).tolist()
        size, covariance = np.zeros(ends[-1]), np.zeros((ends[-1], ends[-1]))
        if members:
            acting = np.concatenate([first + self._acts(member)[0] for first, member in zip(ends, members, strict=False)])
            size[acting], covariance[np.ix_(acting, acting)] = self._posterior(self._inside(tuple(members), kappa))
        return size, covariance

    def _posterior(self, inside: Inside) -> tuple[Array, Array]:
        """Coefficients of a set's columns that may be something, and their covariance."""
        if not len(inside.at):
            return np.zeros(0), np.zeros((0, 0))
        root = solve_triangular(_root(inside.inner), np.diag(inside.sd), lower=True, overwrite_b=True, check_finite=False)
        covariance = np.asarray(root.T @ root)
        return np.asarray(covariance @ inside.own.drawn(slice(None), inside.kappa)), covariance

    def sizes(self, weighed: Weighed) -> dict[int, Array]:
        """Coefficients (c,) of each term of a set by number, in usual sizes."""
        size, _ = self.estimate(weighed.members, weighed.kappa)
        ends = np.cumsum([self.terms[k].count for k, _ in weighed.members])[:-1]
        numbers = (k for k, _ in weighed.members)
        return dict(zip(numbers, np.split(size, ends), strict=False))

    def inflation(self, members: Sequence[Member], kappa: float) -> float:
        """The tips' noise over the floor that a set asks for; not below what the floor's own doubt allows.

        A set that fits few poses too well would else call nothing noise.
        """
        inside = self._inside(tuple(members), kappa)
        (size, covariance), own = self._posterior(inside), inside.own
        chi_square = self.gram.left - 2.0 * float(size @ own.pull) + float(size @ own.tip @ size)
        used = float(np.sum(covariance * own.tip)) / kappa**2
        free = max(self.gram.freedom - used, 1.0)
        wanted = 0.5 * math.log(max(chi_square, 1e-12) / free)
        held = 1.0 / (1.0 + 1.0 / (2.0 * free * self.doubt**2))
        most = 3.0 * self.doubt
        return math.exp(wanted if wanted > most else max(held * wanted, -most))

    def log_inflation(self, kappa: float) -> float:
        """Log prior of kappa: the floor's own doubt, or, one time in two, anything above it."""
        wanted = math.log(kappa)
        near = -0.5 * (wanted / self.doubt) ** 2 - math.log(self.doubt * math.sqrt(2.0 * math.pi))
        return float(np.logaddexp(near, -wanted if wanted > 0.0 else -np.inf))


def _root(inner: Array) -> Array:
    """Cholesky's factor."""
    return np.asarray(np.linalg.cholesky(inner))


def _inverse(root: Array) -> Array:
    """Of Cholesky's factor."""
    return np.asarray(solve_triangular(root, np.eye(len(root)), lower=True, check_finite=False))


def _returned(own: Array, both: Array) -> Array:
    """What G and h get back without columns of a set, as R (p + 1, c) with R R' of it: `own` (k, c), of the inverse of Cholesky's
    factor, and T (k, p + 1) of the whole set.
    """
    return np.asarray(np.linalg.solve(np.linalg.cholesky(own.T @ own), own.T @ both).T)


def _left(of: Batch | TermGroup, taken: Array, kappa: float, rows: Places | slice = slice(None)) -> Array:
    """What a set leaves of the terms' own G (t, c, c), of which it takes (t, c, k); of all terms, or of some rows."""
    seen = of.tip[rows] / kappa**2
    if of.current is not None:
        seen += of.current[rows]
    if taken.size:
        seen -= taken @ taken.transpose(0, 2, 1)
    return np.asarray(seen)


def _estimates(seen: Array, pull: Array, sd: Array, laws: int) -> tuple[Array, Array, Array]:
    """Of terms (t,) with G (t, c, c) and h (t, c), at each of their scales sd (h, c): the first coefficients (t, h, laws)
    and the standard deviation of the first (t, h), in sd, and ln Z (t, h).

    With A = I + V^1/2 G V^1/2 and b = V^1/2 h, the bordered matrix [A b; b' m] has Cholesky's factor [L 0; z' .], L z = b, for
    every m > b'b, as A > I: ln Z = z'z / 2 - sum ln diag L. Columns go from the last to the first, so that the coefficients
    A^-1 b of the laws are those which L' gives first, and the first one's variance is the square of 1 / the last of diag L.
    """
    terms, count = pull.shape
    if count == 1:  # most blocks
        inner, drawn = 1.0 + seen[:, :, 0] * sd[:, 0] ** 2, pull * sd[:, 0]
        size = drawn / inner
        return size[..., None], np.sqrt(1.0 / inner), 0.5 * (drawn * size - np.log(inner))
    back = sd[:, ::-1]
    bordered = np.empty((terms, len(sd), count + 1, count + 1))
    np.multiply(seen[:, None, ::-1, ::-1], back[:, :, None] * back[:, None, :], out=bordered[..., :-1, :-1])
    bordered[..., :-1, :-1] += np.eye(count)
    drawn = np.multiply(pull[:, None, ::-1], back, out=bordered[..., -1, :-1])
    bordered[..., -1, -1] = 1.0 + (drawn**2).sum(axis=2)
    root = np.linalg.cholesky(bordered)  # of the lower triangle alone
    solved, diagonal = root[..., -1, :-1], np.diagonal(root, axis1=2, axis2=3)[..., :-1]
    size = np.empty((terms, len(sd), laws))
    for k in range(laws):
        at = count - 1 - k
        known = (root[..., at + 1 : -1, at] * size[..., :k][..., ::-1]).sum(axis=2)
        size[..., k] = (solved[..., at] - known) / diagonal[..., at]
    return size, 1.0 / diagonal[..., -1], 0.5 * (solved**2).sum(axis=2) - np.log(diagonal).sum(axis=2)


@dataclass(frozen=True, slots=True)
class Added:
    """What each term adds to a set: log evidence summed over its scales, its best scales, what these alone add, and how much of
    that says whether its law lies within its bounds.
    """

    log: Array
    best: Array
    top: Array
    bound: Array

    @classmethod
    def of(cls, numbers: Sequence[Array], added: Sequence[tuple[Array, Array, Array, Array]], count: int) -> Added:
        """From batches; minus infinity where a term was not asked for."""
        whole = cls(np.full(count, -np.inf), np.zeros(count, dtype=int), np.full(count, -np.inf), np.zeros(count))
        for own, (log, best, top, bound) in zip(numbers, added, strict=True):
            whole.log[own], whole.best[own], whole.top[own], whole.bound[own] = log, best, top, bound
        return whole


@dataclass(frozen=True, slots=True)
class Offer:
    """What terms would add to a set: G that it leaves of each group of terms (t, c, c), and h of all columns (p,)."""

    evidence: Evidence
    left: list[Array]
    pull: Array

    def added(self, numbers: Sequence[int] | Places) -> Added:
        """What terms by number add."""
        return self.evidence.added_of(self.left, self.pull, numbers)

    def largest(self, keys: Collection[Key], width: int, least: float) -> list[tuple[Key, Member, float]]:
        """Of the keys those that add most to the log posterior and more than `least`, best first: in their best variant and
        scale, with what they add.
        """
        evidence = self.evidence
        places = np.array([place for place, key in enumerate(evidence.of_key) if key in keys], np.intp)
        bounds = evidence.bounds(self.left, self.pull)[places]
        first = np.argsort(-bounds)[: WIDER * width]
        found = self._exact(places[first[bounds[first] > least]])
        threshold = max([least, *sorted((gain for _, _, gain in found), reverse=True)[width - 1 : width]])
        rest = np.setdiff1d(np.flatnonzero(bounds > threshold), first)
        found += self._exact(places[rest])
        found = [one for one in found if one[2] > least]
        return sorted(found, key=lambda one: (one[2], evidence.of_key[one[0]]), reverse=True)[:width]

    def _exact(self, places: Places) -> list[tuple[Key, Member, float]]:
        """Of keys by their place among all."""
        if not len(places):
            return []
        evidence, keys = self.evidence, list(self.evidence.of_key)
        numbers = [evidence.of_key[keys[place]] for place in places.tolist()]
        added, found = self.added([number for own in numbers for number in own]), []
        for place, own in zip(places.tolist(), numbers, strict=True):
            number = own[int(np.argmax(added.log[own]))]
            gain = float(np.logaddexp.reduce(added.log[own])) + evidence.terms[number].log_odds
            found.append((keys[place], (number, int(added.best[number])), gain))
        return found
