"""The evidence of sets: exact beside the integral, a Schur complement beside the whole, no law below nought."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from calib.gap.effects.catalogue import RECORDS
from calib.gap.effects.motor import SAMPLING
from calib.gap.finding import EffectName
from calib.gap.posterior.constants import CHECKED_sd
from calib.gap.posterior.decide import decide, included, sureness, sureness_of_file
from calib.gap.posterior.evidence import Evidence, Gram, Weighed
from calib.gap.posterior.search import MergingSearch, Search
from calib.gap.posterior.term import Block, Term

ROWS = 240


def _term(key, columns: int = 1, departures: int = 0, is_positive: bool = False, **more: Any) -> Term:
    slope = np.zeros((columns, 1, 1))
    return Term(key, str(key), columns - departures, departures, 1.0, slope_rad=slope, is_positive=is_positive, **more)


def _evidence(terms, columns: np.ndarray, y: np.ndarray) -> Evidence:
    gram = Gram(columns.T @ columns, columns.T @ y, None, np.zeros(columns.shape[1]), float(y @ y), float(len(y)))
    return Evidence(gram, terms, 0.03)


def _world(seed: int, size: float, count: int = 4) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    columns = 5.0 * rng.normal(size=(ROWS, count)) / np.sqrt(ROWS) * np.sqrt(10.0)
    return columns, size * columns[:, 0] + rng.normal(size=ROWS)


def test_the_evidence_of_a_set_is_that_of_the_gaussian_integral() -> None:
    columns, y = _world(1, 1.0)
    terms = [_term(EffectName("encoder_scale", j + 1)) for j in range(4)]
    evidence = _evidence(terms, columns, y)
    members = [(0, 1), (2, 3)]
    variance = np.array([evidence.scales[k][0][h][0] ** 2 for k, h in members])
    used = columns[:, [0, 2]]
    whole = np.eye(ROWS) + used @ np.diag(variance) @ used.T
    expected = -0.5 * np.linalg.slogdet(whole)[1] - 0.5 * y @ np.linalg.solve(whole, y) + 0.5 * y @ y
    priors = sum(float(evidence.weights[k][h]) for k, h in members) + evidence.log_inflation(1.0)
    assert evidence.value(members, 1.0) == pytest.approx(expected + priors, abs=1e-6)


def test_what_a_term_adds_is_the_difference_of_the_whole_evidence() -> None:
    columns, y = _world(2, 1.0)
    evidence = _evidence([_term(EffectName("encoder_scale", j + 1)) for j in range(4)], columns, y)
    added = evidence.added([(0, 1)], 1.0)
    scale = int(added.best[3])
    whole = evidence.value([(0, 1), (3, scale)], 1.0) - evidence.value([(0, 1)], 1.0)
    assert added.top[3] == pytest.approx(whole, abs=1e-6)


def test_what_terms_add_without_each_member_is_what_they_add_to_the_others() -> None:
    columns, y = _world(6, 1.0, 9)
    columns[:, 1] += 3.0 * columns[:, 0]  # each does much of what the other does
    terms = [_term(EffectName("encoder_scale", j + 1)) for j in range(3)]
    terms += [_term(Block(j + 1, "drag"), 3, 1) for j in range(2)]
    evidence = _evidence(terms, columns, y)
    members = [(3, 1), (0, 2), (1, 0)]
    each = list(evidence.offers_without_each(members, 1.1))
    assert len(each) == len(members)
    for place, (member, offer) in enumerate(zip(members, each, strict=True)):
        expected, added = evidence.added([other for other in members if other is not member], 1.1), offer.added(range(5))
        for first in range(place + 1):
            in_place = evidence.added_in_place(members, 1.1, first)
            assert in_place.log[member[0]] == pytest.approx(expected.log[member[0]], rel=1e-9)
        assert added.log == pytest.approx(expected.log, rel=1e-9, abs=1e-9)
        assert np.array_equal(added.best, expected.best)


def _many_terms(seed: int) -> tuple[Evidence, list[tuple[int, int]]]:
    """Thirty terms, some in variants, with departures or positive, and a set of three of them."""
    rng = np.random.default_rng(seed)
    terms = [_term(EffectName("encoder_scale", j + 1), 3, 2) for j in range(8)]
    terms += [_term(EffectName("backlash", j // 3 + 1), 2, 1, is_positive=True) for j in range(9)]
    terms += [_term(Block(j + 1, "drag"), 1 + j % 4) for j in range(13)]
    columns = rng.normal(size=(ROWS, sum(term.count for term in terms)))
    columns[:, ::2] += 0.7 * columns[:, :1]  # much is alike
    y = columns @ (rng.normal(size=columns.shape[1]) * (rng.random(columns.shape[1]) < 0.2)) + rng.normal(size=ROWS)
    return _evidence(terms, columns, y), [(1, 5), (9, 2), (20, 3)]


def test_all_variants_of_each_member_are_weighed_beside_its_others() -> None:
    evidence, members = _many_terms(5)
    in_place = evidence.added_in_place(members, 0.9)
    keys = [evidence.terms[number].key for number, _ in members]
    assert np.array_equal(np.flatnonzero(np.isfinite(in_place.log)), sorted(k for key in keys for k in evidence.of_key[key]))
    for key, member in zip(keys, members, strict=True):
        numbers, expected = evidence.of_key[key], evidence.added([other for other in members if other is not member], 0.9)
        assert len(numbers) == (3 if key == EffectName("backlash", 1) else 1)
        for found, wanted in ((in_place.log, expected.log), (in_place.top, expected.top), (in_place.bound, expected.bound)):
            assert found[numbers] == pytest.approx(wanted[numbers], rel=1e-9, abs=1e-9)
        assert np.array_equal(in_place.best[numbers], expected.best[numbers])


@pytest.mark.parametrize("seed", range(4))
def test_the_terms_that_add_most_are_those_of_all_terms_worked_out(seed: int) -> None:
    """Bounds decide which terms are looked at; no term that belongs among the few may be left out by its bound."""
    evidence, members = _many_terms(seed)
    added, offer = evidence.added(members, 1.05), evidence.offer(members, 1.05)
    gains = {
        key: float(np.logaddexp.reduce(added.log[numbers])) + evidence.terms[numbers[0]].log_odds
        for key, numbers in evidence.of_key.items()
    }
    bounds = dict(zip(evidence.of_key, evidence.bounds(offer.left, offer.pull), strict=True))
    assert all(gains[key] <= bounds[key] for key in gains)
    ranked = sorted(gains, key=lambda key: -gains[key])
    for width, least in ((1, -1e9), (3, -1e9), (3, gains[ranked[1]] - 1e-6), (2, 1e9)):
        largest = offer.largest(set(gains) - {ranked[0]}, width, least)
        expected = [key for key in ranked[1 : 1 + width] if gains[key] > least]
        assert [key for key, _, _ in largest] == expected
        for key, (number, scale), gain in largest:
            assert gain == pytest.approx(gains[key], rel=1e-12)
            assert number == max(evidence.of_key[key], key=lambda k: added.log[k])
            assert scale == added.best[number]


def test_columns_of_an_exact_law_are_as_if_they_were_not_there() -> None:
    """A departure of prior variance nought: the set is that of the law alone, and the estimate has noughts in its place."""
    columns, y = _world(5, 1.0)
    whole = _evidence([_term(EffectName("encoder_scale", 1), 4, 3)], columns, y)
    alone = _evidence([_term(EffectName("encoder_scale", 1))], columns[:, :1], y)
    exact = next(h for h, sd in enumerate(whole.scales[0][0]) if not sd[1:].any() and sd[0] == alone.scales[0][0][1][0])
    size, covariance = whole.estimate([(0, exact)], 1.0)
    own_size, own_covariance = alone.estimate([(0, 1)], 1.0)
    assert size == pytest.approx(np.concatenate((own_size, np.zeros(3))))
    assert covariance == pytest.approx(np.pad(own_covariance, ((0, 3), (0, 3))))
    priors = float(whole.weights[0][exact] - alone.weights[0][1])
    assert whole.value([(0, exact)], 1.0) - alone.value([(0, 1)], 1.0) == pytest.approx(priors, abs=1e-9)


def test_currents_that_tell_nothing_are_none() -> None:
    columns, y = _world(4, 1.0)
    terms = [_term(EffectName("encoder_scale", j + 1)) for j in range(4)]
    none = _evidence(terms, columns, y)
    nothing = Evidence(replace(none.gram, current=np.zeros((4, 4))), terms, 0.03)
    for evidence in (none, nothing):
        evidence.gram.tip.setflags(write=False)
    members = [(0, 1), (2, 3)]
    assert nothing.value(members, 1.1) == none.value(members, 1.1)
    assert np.array_equal(nothing.added(members, 1.1).log, none.added(members, 1.1).log)
    at = np.array([0, 2])
    assert np.array_equal(nothing.gram.of(at).among(at[:1], slice(None), 1.1), none.gram.of(at).among(at[:1], slice(None), 1.1))


def test_a_play_below_nought_is_never_in_a_set() -> None:
    columns, y = _world(3, -2.0)
    terms = [
        _term(EffectName("backlash", 1), is_positive=True),
        _term(Block(1, "direction")),
        *[_term(Block(j, "q")) for j in (2, 3)],
    ]
    evidence = _evidence(terms, columns, y)
    best = Search(evidence).run()[0]
    assert EffectName("backlash", 1) not in {terms[k].key for k, _ in best.members}


def test_a_friction_that_drives_is_in_no_set_although_it_explains_more_than_anything_else() -> None:
    """Beside another friction it came in as it should be, and turned below nought once a third term stood beside the two."""
    columns, y = _world(3, 6.0)
    y -= 4.0 * columns[:, 1]
    terms = [_term(EffectName(f"{law}_friction", 1), is_positive=True) for law in ("coulomb", "viscous")]
    search = Search(_evidence([*terms, _term(Block(1, "speed")), _term(Block(2, "q"))], columns, y))
    both, one = search.of([term.key for term in terms]), search.of([terms[0].key])
    evidence = search.evidence
    assert evidence.value(both.members, both.kappa) > evidence.value(one.members, one.kappa) + 100.0
    assert both.log < one.log


def test_two_terms_that_are_the_same_to_the_data_are_ambiguous_and_neither_is_named() -> None:
    columns, y = _world(4, 2.0)
    columns[:, 1] = columns[:, 0]
    evidence = _evidence([_term(EffectName("encoder_scale", j + 1)) for j in range(4)], columns, y)
    found = decide(evidence, Search(evidence).run())
    assert found.names == ()
    assert {frozenset(one) for one in found.ambiguous} == {
        frozenset({EffectName("encoder_scale", 1), EffectName("encoder_scale", 2)})
    }


def test_noise_alone_names_nothing_and_leaves_nothing() -> None:
    for seed in range(20):
        columns, y = _world(100 + seed, 0.0)
        terms = [_term(EffectName("encoder_scale", 1)), *[_term(Block(j, "q")) for j in (1, 2, 3)]]
        found = decide(evidence := _evidence(terms, columns, y), Search(evidence).run())
        assert (found.names, found.ambiguous, found.remainders) == ((), (), ())


def test_scatter_beyond_the_floor_is_noise_and_no_name() -> None:
    columns, y = _world(5, 0.0)
    evidence = _evidence([_term(EffectName("encoder_scale", j + 1)) for j in range(4)], columns, 2.0 * y)
    best = Search(evidence).run()[0]
    assert best.members == ()
    assert best.kappa == pytest.approx(2.0 * np.sqrt(np.mean(y**2)), rel=0.02)


def test_an_effect_that_the_file_has_is_in_every_set() -> None:
    columns, y = _world(6, 0.0)
    evidence = _evidence([_term(EffectName("encoder_scale", j + 1)) for j in range(4)], columns, y)
    found = Search(evidence, [EffectName("encoder_scale", 2)]).run()
    assert all((1 in [k for k, _ in one.members]) for one in found)
    assert isinstance(found[0], Weighed)


def test_a_secant_says_nothing_beyond_its_reach() -> None:
    columns, y = _world(5, 1.0)
    play = EffectName("backlash", 1)
    for reach, speaks in (((0.5, 2.0), True), ((2.0, 8.0), False), ((0.1, 0.5), False)):
        term = _term(play, is_positive=True, least=reach[0], most=reach[1])
        found = Search(_evidence([term], columns[:, :1], y)).run()[0]
        assert bool(found.members) == speaks, reach


@pytest.mark.parametrize(
    ("names", "are_one"),
    [
        ((EffectName("command_delay"), EffectName(SAMPLING)), True),
        ((EffectName("joint_compliance", 1), EffectName("backlash", 1)), False),
    ],
)
def test_two_that_are_one_thing_are_never_in_one_set_and_a_gear_may_be_soft_and_loose(
    names: tuple[EffectName, ...], are_one: bool
) -> None:
    rng = np.random.default_rng(6)
    columns = rng.normal(size=(ROWS, 2))
    y = columns @ np.ones(2) + 0.1 * rng.normal(size=ROWS)
    terms = [_term(name, is_positive=True, traits=RECORDS[name.effect].traits) for name in names]
    evidence = _evidence(terms, columns, y)
    found = [{evidence.terms[k].key for k, _ in one.members} for one in MergingSearch(evidence).run()]
    assert (set(names) in found) != are_one
    assert (found[0] == set(names)) != are_one


@pytest.mark.parametrize("seed", range(3))
def test_a_search_goes_on_without_barred_keys_and_finds_what_one_without_their_terms_finds(seed: int) -> None:
    rng = np.random.default_rng(seed)
    columns = rng.normal(size=(ROWS, 9))
    columns[:, 1] += columns[:, 0]  # may stand for the first
    terms = [_term(EffectName("encoder_scale", j + 1)) for j in range(5)] + [_term(Block(j + 1, "drag")) for j in range(4)]
    evidence = _evidence(terms, columns, columns[:, [0, 2, 6]] @ np.array([1.0, -0.5, 0.7]) + rng.normal(size=ROWS))
    search, barred = MergingSearch(evidence), terms[0].key
    first = search.run()
    assert barred in search.keys(first[0].members)
    search.bar({barred})
    again = search.run([search.keys(first[0].members)])
    anew = MergingSearch(evidence)
    anew.bar({barred})
    assert all(barred not in search.keys(weighed.members) for weighed in again)
    assert search.keys(again[0].members) == search.keys(anew.run()[0].members)


def test_what_a_set_leads_to_is_looked_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    evidence, _ = _many_terms(4)
    search = Search(evidence)
    search.run()
    search._improve(set())
    before = set(search.seen)

    def again(*_: object) -> None:
        raise AssertionError("what terms would add to a set was asked for again")

    monkeypatch.setattr(Evidence, "offer", again)
    monkeypatch.setattr(Evidence, "offers_without_each", again)
    search._improve(set())
    assert set(search.seen) == before


def _weighed_as(evidence: Evidence, logs: dict[int, float]) -> list[Weighed]:
    """Sets of one term each, with given log posteriors, the best first."""
    sets = [Weighed(((number, 1),), 1.0, log) for number, log in logs.items()]
    return sorted(sets, key=lambda one: -one.log)


def test_a_name_needs_more_where_another_may_stand_in_its_place() -> None:
    soft, bent = EffectName("joint_compliance", 3), EffectName("link_flexure", 3)
    evidence = _evidence([_term(soft), _term(bent)], *_world(7, 1.0, 2))
    near, far = (_weighed_as(evidence, {0: 0.0, 1: log}) for log in (-4.0, -6.0))
    assert decide(evidence, near).ambiguous == ((soft, bent),)
    assert decide(evidence, far).names == (soft,)
    assert included(evidence, near).names == (soft,)


@pytest.mark.parametrize(("law", "is_rival"), [(0.0, True), (1.0, False)])
def test_a_law_that_nothing_shows_may_act_by_its_departures_alone(law: float, is_rival: bool) -> None:
    """A play that never leaves one flank is an offset, which the geometry takes; how it is worn looks like an eccentricity."""
    rng = np.random.default_rng(11)
    worn = 5.0 * rng.normal(size=(ROWS, 2))
    columns = np.column_stack((worn, 5.0 * law * rng.normal(size=ROWS), worn))
    wave, play = EffectName("encoder_eccentricity", 1), EffectName("backlash", 1)
    terms = [_term(wave, 2), _term(play, 3, departures=2, is_positive=True)]
    evidence = _evidence(terms, columns, 0.15 * worn[:, 0] + rng.normal(size=ROWS))
    assert decide(evidence, Search(evidence).run()).names == (() if is_rival else (wave,))


def test_a_name_that_leads_its_rivals_by_too_little_is_ambiguous_with_all_of_them() -> None:
    columns, y = _world(5, 4.0)
    names = [EffectName("encoder_scale", j + 1) for j in range(4)]
    found = decide(*_weighed(columns, y, names))
    assert found.names == (names[0],)
    near = found.with_sets([(names[0], names[1]), (names[0], names[2])])
    assert near.names == ()
    assert near.ambiguous == ((names[0], names[1], names[2]),)


def _weighed(columns: np.ndarray, y: np.ndarray, names: list[EffectName]) -> tuple[Evidence, list[Weighed]]:
    evidence = _evidence([_term(name) for name in names], columns, y)
    return evidence, Search(evidence).run()


def test_what_acts_beside_a_name_is_not_taken_for_what_may_act_in_its_place() -> None:
    columns, y = _world(4, 2.0)
    names = [EffectName("encoder_scale", j + 1) for j in range(4)]
    evidence = _evidence([_term(name) for name in names], columns, y)
    likely = (((0, 2), 0.0), ((1, 2), -2.5), ((0, 3), -2.6))  # 1 and 3, or 2 for 1, or 4 for 3
    found = [Weighed(tuple((k, 1) for k in numbers), 1.0, log) for numbers, log in likely]
    assert {frozenset(group) for group in decide(evidence, found).ambiguous} == {frozenset(names[:2]), frozenset(names[2:])}


def test_a_rival_of_a_name_acts_in_its_place_and_not_beside_it() -> None:
    columns, y = _world(4, 2.0)
    names = [EffectName("encoder_scale", j + 1) for j in range(4)]
    evidence = _evidence([_term(name) for name in names], columns, y)
    likely = (((0, 2), 0.0), ((2,), -3.7), ((1, 2), -3.9))  # 1 and 3; or 3 alone, or 2 for 1
    found = [Weighed(tuple((k, 1) for k in numbers), 1.0, log) for numbers, log in likely]
    assert decide(evidence, found).ambiguous == ((names[0], names[1]),)


@pytest.mark.parametrize(("bend", "is_named"), [(0.1, True), (0.9, False)])
def test_a_block_that_bends_a_law_no_more_than_real_parts_do_is_that_law(bend: float, is_named: bool) -> None:
    """A softness and a smooth function of the same load share the probability of one thing."""
    rng = np.random.default_rng(9)
    load = rng.uniform(-1.0, 1.0, ROWS)
    columns = np.column_stack((load, load, load**2))
    softness, block = EffectName("joint_compliance", 1), Block(1, "load")
    y = load + bend * load**2 + 0.01 * rng.normal(size=ROWS)
    terms = [_term(softness, is_positive=True, traits=RECORDS["joint_compliance"].traits), _term(block, columns=2)]
    slopes = columns[:, :1], columns[:, 1:]
    terms = [replace(one, slope_rad=own.T[:, :, None]) for one, own in zip(terms, slopes, strict=True)]
    evidence = _evidence(terms, columns, y)
    decision = decide(evidence, _weighed_as(evidence, {0: 0.0, 1: -2.5}))
    assert decision.probability[softness] == pytest.approx(1.0 if is_named else 1.0 / (1.0 + np.exp(-2.5)))
    assert (decision.names == (softness,)) == is_named


def test_how_sure_an_effect_is_does_not_depend_on_its_axes() -> None:
    value, covariance = np.array([3.0, 0.1]), np.diag([1.0, 0.2])
    turn = np.array([[0.6, -0.8], [0.8, 0.6]])
    turned = sureness(turn @ value, turn @ covariance @ turn.T, CHECKED_sd)
    assert turned == pytest.approx(sureness(value, covariance, CHECKED_sd), rel=1e-12)
    assert sureness(np.array([CHECKED_sd]), np.eye(1), CHECKED_sd) == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("of_posterior", "is_there"), [(4.0, True), (2.1, True), (0.1, True), (-0.1, False), (9.0, True), (4.4, True)]
)
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_files_interval_reaches_the_posteriors_value_on_its_side_alone(
    of_posterior: float, is_there: bool, sign: float
) -> None:
    """Of a value of 4.4 in the file: nought is in it where it lies between the two, no sooner where the posterior has more."""
    file, posterior, covariance = np.array([sign * 4.4]), np.array([sign * of_posterior]), np.array([[1e-6]])
    assert (sureness_of_file(file, posterior, covariance) > 1.0) == is_there
    beyond = sureness_of_file(file, np.array([sign * 9.0]), covariance)
    assert beyond == pytest.approx(sureness(file, covariance, CHECKED_sd))
