"""The program that draws single strips: angles let them answer, which positions alone rarely do."""

import numpy as np

from tools.strip_draws import measure, simulated_strip


def test_strips_answer_with_angles_rather_than_without() -> None:
    strips = [simulated_strip(np.random.default_rng((3, draw))) for draw in range(4)]
    figures = measure("simulated", strips)
    assert figures["simulated_placed"] == 1.0
    assert figures["simulated_answer"] >= 0.5
    assert figures["simulated_without_answer"] < figures["simulated_answer"]
    assert figures["simulated_turn_deg"] < figures["simulated_without_turn_deg"]
