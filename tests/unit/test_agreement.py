"""Measures of agreement against direct formulas, loops and other libraries."""

import numpy as np
import pytest
from scipy.stats import entropy, pearsonr
from scipy.stats.contingency import crosstab

from featuredb.errors import InvalidValueError
from ingest.register.frame.agreement import gradient_correlation, mutual_information, oriented_agreement


def _pictures(seed: int, shape: tuple[int, int] = (37, 53)) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    first = rng.integers(0, 200, shape).astype(np.float64)
    return first, 0.5 * first + rng.normal(0, 25, shape)


def _bins_of(values: np.ndarray, bins: int) -> np.ndarray:
    low, high = np.percentile(values, (1, 99))
    edges = np.linspace(low, high, bins + 1)[1:-1]
    return np.digitize(values, edges)


@pytest.mark.parametrize("bins", [8, 32])
def test_mutual_information_is_the_sum_over_the_joint_histogram(bins: int) -> None:
    """Equation 5 of the paper, with scipy's contingency table and numpy's own binning."""
    a, b = _pictures(0)
    valid = np.random.default_rng(1).random(a.shape) < 0.8
    table = crosstab(_bins_of(a[valid], bins), _bins_of(b[valid], bins)).count
    p = table / table.sum()
    expected = 0.0
    for i in range(p.shape[0]):
        for j in range(p.shape[1]):
            if p[i, j] > 0:
                expected += p[i, j] * np.log(p[i, j] / (p[i].sum() * p[:, j].sum()))
    assert mutual_information(a, b, valid, bins=bins) == pytest.approx(expected, abs=1e-9)


def test_normalised_mutual_information_is_the_ratio_of_entropies() -> None:
    a, b = _pictures(2)
    table = crosstab(_bins_of(a.ravel(), 16), _bins_of(b.ravel(), 16)).count
    own = entropy(table.sum(axis=1)) + entropy(table.sum(axis=0))
    expected = own / entropy(table.ravel()) - 1.0
    assert mutual_information(a, b, bins=16, normalised=True) == pytest.approx(expected, abs=1e-9)


def test_mutual_information_of_two_gaussians_is_the_closed_form() -> None:
    rng, rho = np.random.default_rng(3), 0.8
    x = rng.normal(size=(700, 700))
    y = rho * x + np.sqrt(1 - rho**2) * rng.normal(size=x.shape)
    # Binning loses a little information; the bias of empty cells is 31 * 31 / (2 * 490000).
    assert mutual_information(x, y, bins=32) == pytest.approx(-0.5 * np.log(1 - rho**2), rel=0.04)


def test_mutual_information_bears_any_relation_of_grey_values() -> None:
    a, _ = _pictures(4)
    turned = np.abs(a - 100.0)
    assert mutual_information(a, turned) > 2.0
    assert abs(pearsonr(a.ravel(), turned.ravel()).statistic) < 0.1
    shuffled = np.random.default_rng(5).permutation(turned.ravel()).reshape(a.shape)
    # Independent pictures of n pixels have (bins - 1)^2 / (2 n) by chance.
    assert mutual_information(a, shuffled, bins=8) == pytest.approx(49 / (2 * a.size), abs=0.01)


def test_smoothing_keeps_little_of_what_single_pixels_say() -> None:
    a, _ = _pictures(6, (20, 20))
    b = np.random.default_rng(7).normal(size=a.shape)
    plain, smooth = (mutual_information(a, b, bins=16, smoothing_bins=s) for s in (0.0, 2.0))
    assert smooth < 0.3 * plain


def _gradient_correlation_by_loops(a: np.ndarray, b: np.ndarray, valid: np.ndarray) -> float:
    pairs: dict[str, list[tuple[float, float]]] = {"x": [], "y": []}
    for r in range(1, a.shape[0] - 1):
        for c in range(1, a.shape[1] - 1):
            if valid[r, c - 1] and valid[r, c + 1] and valid[r - 1, c] and valid[r + 1, c]:
                pairs["x"].append(((a[r, c + 1] - a[r, c - 1]) / 2, (b[r, c + 1] - b[r, c - 1]) / 2))
                pairs["y"].append(((a[r + 1, c] - a[r - 1, c]) / 2, (b[r + 1, c] - b[r - 1, c]) / 2))
    return float(np.mean([pearsonr(*np.array(p).T).statistic for p in pairs.values()]))


def test_gradient_correlation_is_the_mean_of_both_axes_correlations() -> None:
    a, b = _pictures(8, (25, 31))
    valid = np.random.default_rng(9).random(a.shape) < 0.9
    expected = _gradient_correlation_by_loops(a, b, valid)
    assert gradient_correlation(a, b, valid) == pytest.approx(expected, abs=1e-9)


def test_gradient_correlation_turns_with_contrast_and_magnitudes_do_not() -> None:
    a, _ = _pictures(10)
    assert gradient_correlation(a, 255.0 - a) == pytest.approx(-1.0)
    assert gradient_correlation(a, 255.0 - a, magnitudes=True) == pytest.approx(1.0)


def test_too_little_to_compare_says_nothing() -> None:
    a, b = _pictures(11)
    few = np.zeros(a.shape, bool)
    few[0, :10] = True
    assert mutual_information(a, b, few) == 0.0
    assert gradient_correlation(a, b, few) == 0.0
    assert mutual_information(a, np.full_like(a, 7.0)) == 0.0
    assert gradient_correlation(a, np.full_like(a, 7.0)) == 0.0


def test_pictures_of_two_shapes_are_refused() -> None:
    with pytest.raises(InvalidValueError, match="one shape"):
        mutual_information(np.zeros((4, 5)), np.zeros((5, 4)))
    with pytest.raises(InvalidValueError, match="one shape"):
        oriented_agreement(np.zeros((2, 4, 5), np.float32), np.zeros((2, 5, 4), np.float32))


def test_oriented_agreement_is_the_cosine_over_valid_pixels() -> None:
    rng = np.random.default_rng(12)
    a, b = rng.normal(size=(2, 4, 11, 13)).astype(np.float32)
    valid = rng.random((11, 13)) < 0.5
    x = np.concatenate([channel[valid] for channel in a]).astype(np.float64)
    y = np.concatenate([channel[valid] for channel in b]).astype(np.float64)
    expected = float(x @ y / np.linalg.norm(x) / np.linalg.norm(y))
    assert oriented_agreement(a, b, valid) == pytest.approx(expected, abs=1e-6)
