"""The program that measures placements by positions: its flights are placed, and wrong bounds would show."""

import numpy as np
import pytest

from tools import position_draws
from tools.position_draws import bounds, simulated_flights, unrelated


@pytest.mark.evaluation
def test_bounds_of_simulated_flights_are_counted() -> None:
    figures = bounds([], 1) | unrelated(simulated_flights(0), 3)
    assert figures["flights"] == 8
    assert figures["placed"] >= 0.9
    assert figures["position_95"] >= 0.8
    assert figures["orientation_95"] >= 0.8
    assert (figures["random"], figures["random_answer"]) == (3, 0)
    assert figures["shuffled"] == 20
    assert figures["shuffled_answer"] == figures["other_answer"] == 0


def test_errors_that_positions_do_not_show_leave_the_bounds(monkeypatch: pytest.MonkeyPatch) -> None:
    """A bias of fifty metres under a plain receiver's four."""
    monkeypatch.setattr(
        position_draws,
        "_KINDS",
        {"far": lambda flight, rng: np.full(flight.xyz.shape, 50.0) + rng.normal(0, 0.3, flight.xyz.shape)},
    )
    figures = bounds([], 5)
    assert figures["placed"] == 1.0
    assert figures["position_95"] == 0.0
    assert figures["orientation_95"] >= 0.8
