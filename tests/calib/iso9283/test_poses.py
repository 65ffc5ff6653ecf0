"""ISO 9283 pose characteristics: textbook values by hand, invariance, and what is wrong with the input."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from calib.iso9283 import pose_criteria
from calib.iso9283.pose_criteria import Iso9283Error, static_compliance

Array = npt.NDArray[np.float64]
MM = 1e-3
# A square of 2 mm about (1, 2, 3) mm: every corner lies sqrt(2) mm from the barycentre.
SQUARE = MM * np.array([[2.0, 3, 3], [2, 1, 3], [0, 1, 3], [0, 3, 3]])
EXACT = 1e-15  # rounding of millimetres


def moved(rng: np.random.Generator) -> tuple[Array, Array]:
    """A random rotation (3, 3) and shift (3,)."""
    q, r = np.linalg.qr(rng.normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    return q * np.sign(np.linalg.det(q)), rng.normal(size=3)


def test_pose_accuracy_is_the_distance_to_the_barycentre() -> None:
    accuracy = pose_criteria.pose_accuracy((0.0, 0.0, 0.0), SQUARE)
    assert accuracy.axes_m == pytest.approx([1 * MM, 2 * MM, 3 * MM], abs=EXACT)
    assert accuracy.total_m == pytest.approx(np.sqrt(14.0) * MM, abs=EXACT)


def test_pose_accuracy_of_a_single_visit_is_its_distance() -> None:
    assert pose_criteria.pose_accuracy((0, 0, 0), [(3 * MM, 4 * MM, 0)]).total_m == pytest.approx(5 * MM, abs=EXACT)


def test_pose_repeatability_is_mean_plus_three_sd_of_the_distances() -> None:
    # Equal distances have no scatter of their own: RP is their mean.
    assert pose_criteria.pose_repeatability(SQUARE) == pytest.approx(np.sqrt(2.0) * MM, abs=EXACT)
    # On a line at -3, 0, 3: l = 3, 0, 3; mean 2, S = sqrt((1 + 4 + 1) / 2) = sqrt(3).
    line = [(-3 * MM, 0, 0), (0, 0, 0), (3 * MM, 0, 0)]
    assert pose_criteria.pose_repeatability(line) == pytest.approx((2 + 3 * np.sqrt(3.0)) * MM, abs=EXACT)


def test_repeatability_of_normal_noise_is_what_the_maxwell_distribution_says() -> None:
    # l is Maxwell distributed: mean 1.5958 s, sd 0.6734 s, so RP = 3.616 s; 20,000 draws leave about 0.5 %.
    noise = np.random.default_rng(5).normal(size=(20_000, 3))
    assert pose_criteria.pose_repeatability(noise) == pytest.approx(3.616, rel=0.02)


def test_orientation_accuracy_and_repeatability_go_around_the_half_turn() -> None:
    commanded = (3.1, 0.0, 0.0)
    attained = np.array([(3.14, 0.01, 0.0), (-3.14, 0.03, 0.0)])  # -3.14 is 3.1432: 0.0432 ahead of the command
    found = pose_criteria.orientation_accuracy(commanded, attained)
    assert found == pytest.approx([(0.04 + 2 * np.pi - 6.24) / 2, 0.02, 0.0], abs=1e-12)
    scatter = pose_criteria.orientation_repeatability(attained)
    assert scatter == pytest.approx([3 * (2 * np.pi - 6.28) / np.sqrt(2), 3 * 0.02 / np.sqrt(2), 0.0], abs=1e-12)


def test_multidirectional_variation_is_the_largest_distance_between_barycentres() -> None:
    groups = [SQUARE, SQUARE + np.array((3, 4, 0)) * MM, SQUARE + np.array((0, 0, 1)) * MM]
    assert pose_criteria.multidirectional_variation(groups) == pytest.approx(np.sqrt(26.0) * MM, abs=EXACT)
    assert pose_criteria.exchangeability(groups) == pytest.approx(np.sqrt(26.0) * MM, abs=EXACT)


def test_distance_accuracy_and_repeatability_by_hand() -> None:
    first = np.zeros((2, 3))
    second = MM * np.array([(101.0, 0, 0), (103.0, 0, 0)])
    commanded = (0.1, 0, 0), (0, 0, 0)
    assert pose_criteria.distance_accuracy(*commanded, second, first).total_m == pytest.approx(2 * MM, abs=1e-13)
    repeatability = pose_criteria.distance_repeatability(second, first)
    assert repeatability.total_m == pytest.approx(3 * np.sqrt(2.0) * MM, abs=1e-13)  # S of 101 and 103 is sqrt(2)
    assert repeatability.axes_m == pytest.approx([3 * np.sqrt(2.0) * MM, 0, 0], abs=1e-13)


def test_drift_is_the_change_of_accuracy_and_the_way_of_the_barycentre_is_said_beside_it() -> None:
    first, last = (SQUARE - SQUARE.mean(axis=0) + MM * np.array(shift) for shift in ((1, 0, 0), (0, 1, 0)))
    drift = pose_criteria.drift((0, 0, 0), first, last)
    assert drift.accuracy_m == pytest.approx(0.0, abs=EXACT)  # 1 mm off before and after, elsewhere
    assert drift.barycentre_m == pytest.approx(np.sqrt(2.0) * MM, abs=EXACT)
    assert drift.repeatability_m == pytest.approx(0.0, abs=EXACT)
    wider = pose_criteria.drift((0, 0, 0), first, 2.0 * last)
    assert wider.accuracy_m == pytest.approx(MM, abs=EXACT)
    assert wider.repeatability_m == pytest.approx(np.sqrt(2.0) * MM, abs=EXACT)
    assert pose_criteria.drift((0, 0, 0), first[:1], last[:1]).repeatability_m is None


def test_where_the_frame_stands_changes_no_figure() -> None:
    rng = np.random.default_rng(3)
    commanded, attained = rng.normal(size=3), rng.normal(size=(30, 3))
    other = rng.normal(size=(30, 3))
    rotation, shift = moved(rng)

    def turned(points: Array) -> Array:
        return np.asarray(points @ rotation.T + shift)

    for figure in (
        lambda c, a, b: pose_criteria.pose_accuracy(c, a).total_m,
        lambda c, a, b: pose_criteria.pose_repeatability(a),
        lambda c, a, b: pose_criteria.multidirectional_variation([a, b]),
        lambda c, a, b: pose_criteria.distance_accuracy(c, a[0], a, b).total_m,
        lambda c, a, b: pose_criteria.distance_repeatability(a, b).total_m,
        lambda c, a, b: pose_criteria.drift(c, a, b).accuracy_m,
    ):
        before, after = (figure(commanded, attained, other), figure(turned(commanded), turned(attained), turned(other)))
        assert after == pytest.approx(before, rel=1e-12, abs=1e-12)


def test_compliance_is_the_slope_of_displacement_over_force() -> None:
    forces = np.array([(0, 0, -k) for k in range(5)] + [(k, 0, 0) for k in range(5)], dtype=float)
    true = np.array([(1e-5, 0, 3e-6), (0, 0, 1e-6), (0, 0, 2e-5)])
    found = static_compliance(forces, forces @ true.T + (0.4, 0.1, 0.2)).m_N
    assert found[:, [0, 2]] == pytest.approx(true[:, [0, 2]], abs=1e-15)
    assert np.isnan(found[:, 1]).all()  # never loaded along y


def test_the_standard_deviation_of_a_compliance_is_that_of_its_scatter() -> None:
    rng, forces = np.random.default_rng(8), np.tile([(0.0, 0, k) for k in range(11)], (3, 1))
    runs = [static_compliance(forces, rng.normal(scale=1e-5, size=forces.shape)) for _ in range(400)]
    said = np.sqrt(np.mean([run.sd_m_N[0, 2] ** 2 for run in runs]))
    assert np.std([run.m_N[0, 2] for run in runs]) == pytest.approx(said, rel=0.15)  # 400 draws: 3.5 % and margin
    assert np.isnan(static_compliance(forces[:2], forces[:2]).sd_m_N).all()


@pytest.mark.parametrize(
    ("call", "says"),
    [
        (lambda: pose_criteria.pose_repeatability(SQUARE[:1]), "at least 2 measurements, got 1"),
        (lambda: pose_criteria.pose_accuracy((0, 0, 0), np.zeros((0, 3))), "at least 1 measurements, got 0"),
        (lambda: pose_criteria.pose_accuracy((0, 0, 0), [(0, 0, np.nan)]), "measurement 1 of 1 is not finite"),
        (lambda: pose_criteria.pose_accuracy((0, 0, np.nan), SQUARE), "commanded"),
        (lambda: pose_criteria.pose_accuracy((0, 0, 0), SQUARE[:, :2]), r"expected positions \(n, 3\)"),
        (lambda: pose_criteria.multidirectional_variation([SQUARE]), "at least two approach directions, got 1"),
        (lambda: pose_criteria.exchangeability([]), "at least two robots, got 0"),
        (lambda: pose_criteria.distance_repeatability(SQUARE, SQUARE[:3]), "expected pairs, got 4 and 3"),
        (lambda: pose_criteria.distance_repeatability(SQUARE[:1], SQUARE[:1]), "at least 2"),
        (lambda: static_compliance([(0, 0, 1.0)] * 3, SQUARE[:3]), "two different loads"),
        (lambda: static_compliance([(0, 0, 0.0), (0, 1, 1), (0, 2, 2)], SQUARE[:3]), "one axis at a time"),
    ],
)
def test_what_is_wrong_is_said(call: object, says: str) -> None:
    with pytest.raises(Iso9283Error, match=says):
        call()  # type: ignore[operator]
