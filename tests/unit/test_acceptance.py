"""The line between believed and not: formula in exact integers, each gate on both sides."""

import itertools
import math
from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from featuredb.maps.feature_map import GeoPrior
from reloc.localise.acceptance import (
    AcceptanceOptions,
    Evidence,
    agreement,
    confidence,
    coverage,
    independent_inliers,
    log_nfa,
    prior_tells,
    spread,
    verdict,
)

OPTIONS = AcceptanceOptions()
GOOD = Evidence(inliers=40, log_nfa=30.0, coverage=0.2, agreement=0.8, spread=0.9)


@settings(deadline=None, max_examples=60)
@given(st.integers(5, 400), st.integers(4, 200), st.sampled_from([3, 4]), st.floats(0.5, 12.0))
def test_log_nfa_in_exact_integers(matches: int, inliers: int, sample: int, tolerance_px: float) -> None:
    inliers = min(inliers, matches)
    if inliers <= sample:
        return
    chance = Fraction(math.pi * tolerance_px**2 / (1200 * 900))
    nfa = (
        (matches - sample)
        * math.comb(matches, inliers)
        * math.comb(inliers, sample)
        * chance ** (inliers - sample)
    )
    expected = -(_log10(nfa.numerator) - _log10(nfa.denominator))
    assert log_nfa(matches, inliers, tolerance_px, 1200, 900, sample) == pytest.approx(expected, abs=1e-6)


def _log10(value: int) -> float:
    """Of integers beyond the range of floats."""
    digits = max(value.bit_length() - 1000, 0)
    return math.log10(value >> digits) + digits * math.log10(2.0)


def test_a_few_inliers_of_many_matches_are_expected_by_chance_and_many_are_not() -> None:
    assert log_nfa(300, 5, 3.0, 1200, 900, 3) < 0
    assert log_nfa(300, 20, 3.0, 1200, 900, 3) > 30


@settings(deadline=None, max_examples=40)
@given(st.integers(20, 300), st.sampled_from([3, 4]))
def test_more_inliers_of_as_many_matches_are_better_evidence(matches: int, sample: int) -> None:
    values = [log_nfa(matches, k, 2.5, 1000, 800, sample) for k in range(sample + 2, matches // 2)]
    assert all(b > a for a, b in itertools.pairwise(values))


def test_fewer_matches_tighter_tolerance_and_smaller_samples_are_better_evidence() -> None:
    base = log_nfa(200, 20, 3.0, 1000, 800, 4)
    assert log_nfa(150, 20, 3.0, 1000, 800, 4) > base
    assert log_nfa(200, 20, 2.0, 1000, 800, 4) > base
    assert log_nfa(200, 20, 3.0, 1000, 800, 3) > base


@pytest.mark.parametrize(("matches", "inliers"), [(0, 0), (3, 3), (10, 3), (5, 8), (4, 4)])
def test_no_more_than_the_sample_is_no_evidence(matches: int, inliers: int) -> None:
    assert log_nfa(matches, inliers, 3.0, 1000, 800, 4) == 0.0


def test_a_tolerance_as_large_as_the_image_is_no_evidence() -> None:
    assert log_nfa(100, 100, 5000.0, 1000, 800, 3) < 0


def test_coverage_counts_cells() -> None:
    assert coverage(np.zeros((0, 2)), 100, 100) == 0.0
    corners = np.array([[0, 0], [99.9, 0], [0, 99.9], [99.9, 99.9], [100, 100], [1, 1]])
    assert coverage(corners, 100, 100) == 0.04
    grid = np.stack(np.meshgrid(np.arange(5, 200, 10), np.arange(5, 100, 10)), -1).reshape(-1, 2)
    assert coverage(grid.astype(float), 200, 100) == 1.0


def test_agreement_asks_where_the_map_should_be_seen() -> None:
    # Map points are expected in the left half: fifty cells with four points each.
    expected = np.stack(np.meshgrid(np.arange(2.5, 50, 5), np.arange(2.5, 100, 5)), -1).reshape(-1, 2)
    patch = expected[(expected[:, 0] < 20) & (expected[:, 1] < 30)]
    assert agreement(expected, expected, 100, 100) == 1.0
    assert agreement(patch, expected, 100, 100) == pytest.approx(6 / 50)
    # Inliers elsewhere do not help, and two points in a cell are too few to expect anything there.
    assert agreement(np.add(expected, [50.0, 0.0]), expected, 100, 100) == 0.0
    assert agreement(patch, np.repeat(patch[:1], 2, axis=0), 100, 100) == 0.0


def test_spread_asks_how_far_so_many_inliers_should_reach() -> None:
    rng = np.random.default_rng(0)
    expected = rng.uniform(0, 100, (2000, 2))
    # Any number of inliers that lie like the map's points: about 1; agreement grows with the number.
    for count in (15, 40, 200, 1000):
        found = [spread(rng.permutation(expected)[:count], expected, 100, 100) for _ in range(20)]
        assert np.mean(found) == pytest.approx(1.0, abs=0.05)
        assert min(found) > 0.75
    # The same numbers in the left 40 %: few reach most of what they can, many do not.
    left = expected[expected[:, 0] < 40]
    shares = [
        np.mean([spread(rng.permutation(left)[:count], expected, 100, 100) for _ in range(20)])
        for count in (15, 40, 200, 700)
    ]
    assert shares[0] > 0.75
    assert shares == sorted(shares, reverse=True)
    assert shares[2] < OPTIONS.min_spread
    assert shares[3] == pytest.approx(0.4, abs=0.03)
    # Where the map has most of its points, most inliers should lie: that is no crowd.
    uneven = np.concatenate([rng.uniform(0, 100, (400, 2)), rng.uniform(0, 20, (4000, 2))])
    assert spread(rng.permutation(uneven)[:300], uneven, 100, 100) > 0.85
    assert spread(np.zeros((0, 2)), expected, 100, 100) == 0.0
    assert spread(expected[:20], expected[:2], 100, 100) == 0.0


def test_a_prior_that_tells_places_apart_makes_up_for_spread() -> None:
    crowded = replace(GOOD, spread=0.3)
    assert verdict(crowded, 0, OPTIONS) is not None
    assert verdict(crowded, 0, OPTIONS, told_by_prior=True) is None
    for sigma_m, tells in ((OPTIONS.prior_tells_m, True), (OPTIONS.prior_tells_m + 1.0, False)):
        prior = GeoPrior(
            latitude_deg=48.0,
            longitude_deg=9.0,
            height_m=None,
            sigma_horizontal_m=sigma_m,
            sigma_vertical_m=20.0,
        )
        assert prior_tells(prior, OPTIONS) == tells
    assert not prior_tells(None, OPTIONS)


def test_inliers_on_top_of_each_other_count_once() -> None:
    rng = np.random.default_rng(0)
    pixels = np.stack(np.meshgrid(np.arange(10), np.arange(10)), -1).reshape(-1, 2) * 10.0 + 1.0
    points = rng.uniform(0, 50, (100, 3))
    np.testing.assert_array_equal(independent_inliers(pixels, points, 3.0), np.arange(100))
    # The same structure at three scales: all pixels within one cell.
    thrice = np.concatenate([pixels, pixels + 0.4, pixels + 0.9])
    kept = independent_inliers(thrice, np.concatenate([points, points + 0.1, points + 0.2]), 3.0)
    np.testing.assert_array_equal(kept, np.arange(100))
    # One point of the map, at several pixels.
    kept = independent_inliers(np.concatenate([pixels, pixels + 5]), np.concatenate([points, points]), 3.0)
    assert len(kept) == 100
    assert len(independent_inliers(np.zeros((0, 2)), np.zeros((0, 3)), 3.0)) == 0


@pytest.mark.parametrize(
    ("evidence", "rival", "reason", "words"),
    [
        (GOOD, 0, None, ""),
        (replace(GOOD, inliers=OPTIONS.min_inliers), 0, None, ""),
        (replace(GOOD, inliers=OPTIONS.min_inliers - 1), 0, "TOO_FEW_INLIERS", "14 independent inliers"),
        (replace(GOOD, log_nfa=OPTIONS.min_log_nfa), 0, None, ""),
        (replace(GOOD, log_nfa=OPTIONS.min_log_nfa - 0.1), 0, "TOO_FEW_INLIERS", "chance"),
        (replace(GOOD, coverage=OPTIONS.min_coverage), 0, None, ""),
        (replace(GOOD, agreement=OPTIONS.min_agreement), 0, None, ""),
        (replace(GOOD, agreement=OPTIONS.min_agreement - 0.01), 0, "TOO_FEW_INLIERS", "picture of the place"),
        (replace(GOOD, coverage=OPTIONS.min_coverage - 0.01), 0, "TOO_FEW_INLIERS", "cover 4 %"),
        (replace(GOOD, spread=OPTIONS.min_spread), 0, None, ""),
        (replace(GOOD, spread=OPTIONS.min_spread - 0.01), 0, "AMBIGUOUS", "59 % of those that as many"),
        (GOOD, 23, None, ""),
        (GOOD, 24, "AMBIGUOUS", "24 inliers, this one 40"),
    ],
)
def test_each_gate_on_both_sides(evidence: Evidence, rival: int, reason: str | None, words: str) -> None:
    found = verdict(evidence, rival, OPTIONS)
    if reason is None:
        assert found is None
    else:
        assert found is not None
        assert found[0] == reason
        assert words in found[1]


def test_confidence_grows_with_evidence_and_falls_with_a_rival() -> None:
    values = [confidence(replace(GOOD, log_nfa=v), 0) for v in (0.0, 5.0, 12.0, 40.0, 1e4)]
    assert values == sorted(values)
    # The fit: one in a hundred without evidence, nearly sure with all of it.
    assert values[0] == pytest.approx(1.0 / (1.0 + math.exp(4.46)))
    assert values[-1] > 0.999
    assert confidence(GOOD, 10) < confidence(GOOD, 0)
    assert confidence(GOOD, 400) < 1e-6
    assert confidence(replace(GOOD, log_nfa=-5.0), 0) == values[0]
    assert confidence(replace(GOOD, inliers=0), 0) >= 0.0
