"""The test of marks and points calls as many good observations wrong as it says, and finds wrong ones."""

import numpy as np

from featuredb.adjust.marginals import Whitened
from featuredb.geometry.arrays import FloatArray
from ingest.register.control.residuals import chance_of

_RNG = np.random.default_rng(0)
_BY_UNKNOWNS = _RNG.normal(0, 1, (20, 6))
_TOGETHER = np.eye(20) - _BY_UNKNOWNS @ np.linalg.pinv(_BY_UNKNOWNS)
_ROWS = np.array([4, 5])


def _chance(errors: FloatArray) -> float:
    """Of the residuals of twenty observations of six unknowns."""
    return chance_of(Whitened(residual=(_TOGETHER @ errors)[:, None], together=_TOGETHER), _ROWS)[1]


def test_good_observations_are_called_wrong_at_the_stated_rate() -> None:
    """Whatever the variance is: it is estimated from the other observations."""
    chances = np.array(
        [_chance(_RNG.normal(0, sigma, 20)) for sigma in (0.1, 1.0, 30.0) for _ in range(1000)]
    )
    for rate in (0.01, 0.05, 0.5):
        assert abs((chances < rate).mean() - rate) < 4.0 * np.sqrt(rate * (1 - rate) / len(chances))


def test_a_wrong_observation_does_not_hide_in_the_variance() -> None:
    errors = _RNG.normal(0, 1.0, 20)
    errors[_ROWS] += [1e4, -2e4]
    assert _chance(errors) < 1e-12
    alone, others = Whitened(residual=(_TOGETHER @ errors)[:, None], together=_TOGETHER).left_out(_ROWS)
    np.testing.assert_allclose(alone, errors[_ROWS], atol=6.0)
    # The others' residuals are those of an adjustment without it.
    kept = np.setdiff1d(np.arange(20), _ROWS)
    part = _BY_UNKNOWNS[kept]
    np.testing.assert_allclose(
        others.residual[:, 0],
        errors[kept] - part @ np.linalg.lstsq(part, errors[kept], rcond=None)[0],
        atol=1e-6,
    )
