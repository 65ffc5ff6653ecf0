"""The log evidence of sets of terms, and what each further term would add to a set, all variants and sizes at once.

The model is linear, y = geometry + C s + noise, s ~ N(0, V). With the geometry projected out, a set S has, beside nothing,
  ln Z = h' M h / 2 - ln det(I + V^1/2 G V^1/2) / 2,   M = V^1/2 (I + V^1/2 G V^1/2)^-1 V^1/2
(MacKay, Information Theory, Inference, and Learning Algorithms, 2003, ch. 28), and a term beside S the same of what S leaves of
its own G and h (a Schur complement). The tips' noise may be kappa times the floor: what a set leaves is then noise to it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.linalg import solve_triangular
from scipy.special import log_ndtr

from calib.arrays import Array
from calib.gap.posterior.constants import LAW_LEAST
from calib.gap.posterior.term import Key, Term

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

    def among(self, rows: Places, columns: Places | slice, kappa: float = 1.0) -> Array:
        """G of some columns with others, by tips whose noise is `kappa` times the floor and by currents; of all it is large."""
        across = (rows, columns) if isinstance(columns, slice) else np.ix_(rows, columns)
        seen = self.tip[across]
        seen /= kappa**2
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
    """Terms that have the same scales, sd (h, c): places (t, c), log weights (t, h), what a coefficient lies between (t, 1)."""

    numbers: Array
    places: Array
    sd: Array
    weight: Array
    laws: int
    is_positive: bool
    least: Array
    most: Array
    is_name: bool
    tip: Array
    current: Array | None


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
        self._starts = np.cumsum([0, *(len(numbers) for numbers in self.of_key.values())])
        self._by_key = np.concatenate([np.zeros(0, np.intp), *self.of_key.values()]).astype(np.intp)
        self._odds = np.array([terms[numbers[0]].log_odds for numbers in self.of_key.values()])
        self._asked: dict[Key | None, tuple[list[Batch], Places | slice]] = {
            None: (self._batched(range(len(terms)))[0], slice(None))
        }
        self._asked |= {key: self._batched(numbers) for key, numbers in self.of_key.items()}

    def _batched(self, numbers: Sequence[int]) -> tuple[list[Batch], Places]:
        """Batches of some terms, and the columns that they need; places in a batch count within these."""
        groups: dict[object, list[int]] = {}
        for k in numbers:
            term, sd = self.terms[k], self.scales[k][0]
            groups.setdefault((sd.shape, sd.tobytes(), term.laws, term.is_positive, term.is_name), []).append(k)
        needed = np.concatenate([self.places[k] for k in numbers])
        within = np.zeros(int(needed.max()) + 1, dtype=int)
        within[needed] = np.arange(len(needed))
        return [self._batch(own, within) for own in groups.values()], needed

    def _batch(self, numbers: list[int], within: Array) -> Batch:
        places, term = np.array([self.places[k] for k in numbers]), self.terms[numbers[0]]
        across = places[:, :, None], places[:, None, :]
        return Batch(
            np.array(numbers),
            within[places],
            self.scales[numbers[0]][0],
            np.array([self.weights[k] for k in numbers]),
            term.laws,
            term.is_positive,
            np.array([[self.terms[k].least] for k in numbers]),
            np.array([[self.terms[k].most] for k in numbers]),
            term.is_name,
            self.gram.tip[across],
            None if self.gram.current is None else self.gram.current[across],
        )

    def _columns(self, members: Sequence[Member]) -> tuple[Places, Array]:
        """Places and prior standard deviations of a set's columns."""
        if not members:
            return np.zeros(0, np.intp), np.zeros(0)
        at = np.concatenate([self.places[k] for k, _ in members])
        return at, np.concatenate([self.scales[k][0][h] for k, h in members])

    def _inner(self, at: Places, sd: Array, kappa: float) -> Array:
        """Cholesky factor of I + V^1/2 G V^1/2."""
        return np.asarray(np.linalg.cholesky(np.eye(len(at)) + sd[:, None] * self.gram.among(at, at, kappa) * sd))

    def taken(self, at: Places, sd: Array, others: Places | slice, kappa: float) -> Array:
        """What columns at places (k,) of prior deviations (k,) take of G and h of some others, (k, p + 1): T with T'T of it.

        Schur's complement, which is what they leave, is G - T'T and h - T't, t the last column.
        """
        if not len(at):
            return np.zeros((0, len(self.gram.pull[others]) + 1))
        both = np.column_stack((self.gram.among(at, others, kappa), self.gram.drawn(at, kappa)))
        both *= sd[:, None]
        return np.asarray(solve_triangular(self._inner(at, sd, kappa), both, lower=True, overwrite_b=True, check_finite=False))

    def added(self, members: Sequence[Member], kappa: float, key: Key | None = None) -> Added:
        """What every term (or only those of a key) would add to a set."""
        batches, left, pull, _ = self._left(members, kappa, key)
        return self._added(batches, left, pull)

    def added_without_each(self, members: Sequence[Member], kappa: float) -> Iterator[Added]:
        """What every term would add to a set without one of its members, in turn.

        With A = I + V^1/2 G V^1/2 of the set and B its rows of all columns, V^1/2 G, the set takes B' A^-1 B of these; without
        the columns c of a member that is less by W_c' ((A^-1)_cc)^-1 W_c, W = A^-1 B (the inverse of a partitioned matrix).
        """
        batches, left, pull, both = self._left(members, kappa)
        root, first = np.linalg.inv(self._inner(*self._columns(members), kappa)), 0
        for number, _ in members:
            own = root[first:, first : first + len(self.places[number])]  # A^-1 = root' root, and root is lower
            returned = np.linalg.solve(np.linalg.cholesky(own.T @ own), own.T @ both[first:]).T
            first += own.shape[1]
            parts = [returned[batch.places] for batch in batches]
            seen = [of_set + part @ part.transpose(0, 2, 1) for of_set, part in zip(left, parts, strict=True)]
            yield self._added(batches, seen, pull + returned[:-1] @ returned[-1])

    def _left(
        self, members: Sequence[Member], kappa: float, key: Key | None = None
    ) -> tuple[list[Batch], list[Array], Array, Array]:
        """What a set leaves of all terms, or of those of a key: G of each batch (t, c, c) and h; and T of `taken`."""
        at, sd = self._columns(members)
        batches, asked = self._asked[key]
        both = self.taken(at, sd, asked, kappa)
        factor, left = np.ascontiguousarray(both[:, :-1].T), []
        for batch in batches:
            seen = batch.tip / kappa**2
            if batch.current is not None:
                seen += batch.current
            if factor.size:
                part = factor[batch.places]  # (t, c, k)
                seen -= part @ part.transpose(0, 2, 1)
            left.append(seen)
        return batches, left, self.gram.drawn(asked, kappa) - factor @ both[:, -1], both

    def _added(self, batches: Sequence[Batch], left: Sequence[Array], pull: Array) -> Added:
        found = [self._of_batch(batch, seen, pull[batch.places]) for batch, seen in zip(batches, left, strict=True)]
        return Added.of([batch.numbers for batch in batches], found, len(self.terms))

    def gains(self, added: Added) -> list[float]:
        """What each key, in the order of `of_key`, adds to the log posterior: its prior and all of its variants."""
        log = added.log[self._by_key]
        top = np.maximum.reduceat(log, self._starts[:-1])
        spread = np.add.reduceat(np.exp(log - np.repeat(top, np.diff(self._starts))), self._starts[:-1])
        gains: list[float] = (top + np.log(spread) + self._odds).tolist()
        return gains

    def _of_batch(self, batch: Batch, seen: Array, pull: Array) -> tuple[Array, Array, Array, Array]:
        """Of terms with G (t, c, c) and h (t, c): the log evidence that each adds, the best of its scales, what that one alone
        adds, and the part of bounds in that.
        """
        sd = batch.sd
        law_sizes, width, log = _estimates(seen, pull, sd, batch.laws)
        bound = np.zeros(log.shape)
        # sizes are counted in sd here; a departure is a share of the law: without the law there is none
        least = np.where(np.any(sd[:, batch.laws :] > 0.0, axis=1) & batch.is_name, LAW_LEAST, -np.inf)
        law = np.linalg.norm(law_sizes, axis=2)
        if batch.is_positive:
            law, own_least, most = law_sizes[..., 0], batch.least / sd[:, 0], batch.most / sd[:, 0]
            least = np.maximum(least, own_least)
            # what is known to be positive is so with twice the density; a secant says nothing beyond its reach
            is_beyond = np.isfinite(most) & ((law <= own_least) | (law >= most))
            bound = math.log(2.0) + log_ndtr((most - law) / width) + np.where(is_beyond, NEVER, 0.0)
        bound = bound + log_ndtr((law - least) / width)
        log = log + batch.weight + bound
        best = np.argmax(log, axis=1)
        top, of_bound = (np.take_along_axis(own, best[:, None], axis=1)[:, 0] for own in (log, bound))
        return top + np.log(np.sum(np.exp(log - top[:, None]), axis=1)), best, top, of_bound

    def value(self, members: Sequence[Member], kappa: float) -> float:
        """Ln Z of a set over nothing at the floor, the priors of its scales and of kappa included, without bounds of laws."""
        at, sd = self._columns(members)
        gram = self.gram
        total = -gram.freedom * math.log(kappa) - 0.5 * gram.left * (kappa**-2 - 1.0) + self.log_inflation(kappa)
        if len(at):
            inner = self._inner(at, sd, kappa)
            half = np.linalg.solve(inner, sd * gram.drawn(at, kappa))
            total += 0.5 * float(half @ half) - float(np.sum(np.log(np.diag(inner))))
            total += sum(float(self.weights[k][h]) for k, h in members)
        return float(total)

    def estimate(self, members: Sequence[Member], kappa: float) -> tuple[Array, Array]:
        """Coefficients of all columns of a set, in usual sizes, and their covariance."""
        at, sd = self._columns(members)
        if not len(at):
            return np.zeros(0), np.zeros((0, 0))
        inner = np.linalg.inv(self._inner(at, sd, kappa))
        covariance = sd[:, None] * (inner.T @ inner) * sd
        return np.asarray(covariance @ self.gram.drawn(at, kappa)), covariance

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
        at, _ = self._columns(members)
        size, covariance = self.estimate(members, kappa)
        seen = self.gram.tip[np.ix_(at, at)]
        chi_square = self.gram.left - 2.0 * float(size @ self.gram.pull[at]) + float(size @ seen @ size)
        used = float(np.sum(covariance * seen)) / kappa**2
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


def _estimates(seen: Array, pull: Array, sd: Array, laws: int) -> tuple[Array, Array, Array]:
    """Of terms (t,) with G (t, c, c) and h (t, c), at each of their scales sd (h, c): the coefficients of the laws (t, h, laws)
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
    bordered[..., -1, -1] = 1.0 + np.sum(drawn**2, axis=2)
    root = np.linalg.cholesky(bordered)  # of the lower triangle alone
    solved, diagonal = root[..., -1, :-1], np.diagonal(root, axis1=2, axis2=3)[..., :-1]
    size = np.empty((terms, len(sd), laws))
    for k in range(laws):
        at = count - 1 - k
        known = np.sum(root[..., at + 1 : -1, at] * size[..., :k][..., ::-1], axis=2)
        size[..., k] = (solved[..., at] - known) / diagonal[..., at]
    return size, 1.0 / diagonal[..., -1], 0.5 * np.sum(solved**2, axis=2) - np.sum(np.log(diagonal), axis=2)


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
