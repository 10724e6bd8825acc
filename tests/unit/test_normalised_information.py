"""The measure of agreement against scipy."""

import numpy as np
import pytest
from scipy.stats import entropy

from tools.intensity_refinement import normalised_information


def test_normalised_information_is_the_ratio_of_entropies() -> None:
    table = np.random.default_rng(2).integers(0, 9, (16, 16)).astype(np.float64)
    own = entropy(table.sum(axis=1)) + entropy(table.sum(axis=0))
    assert normalised_information(table) == pytest.approx(own / entropy(table.ravel()) - 1.0, abs=1e-9)


def test_one_grey_value_says_nothing() -> None:
    table = np.zeros((8, 8))
    table[3, 5] = 100.0
    assert normalised_information(table) == 0.0
