"""What the program that measures tracked films takes for good, and for bad."""

from dataclasses import replace

import pytest

from tools.track_evaluation import Tracked, film_options, verdicts

_GOOD = Tracked(
    frames=1200, lost=0, invented=0, mean_m=0.05, p95_m=0.1, largest_m=0.3, mean_deg=0.05, first_m=0.05,
    last_m=0.05, found_s=0.0, rate_hz=80.0, gap_s=0.1, overlay_hz=25.0, load=1.0,
    position_68=0.7, position_95=0.95, orientation_68=0.7, orientation_95=0.95, squared=3.0,
    few_position_95=0.95, few_orientation_95=0.95, few_squared=3.0,
)  # fmt: skip


@pytest.mark.parametrize(
    ("film", "bad", "name"),
    [
        ("smooth", {"mean_m": 0.11}, "smooth, position"),
        ("smooth", {"largest_m": 1.5}, "smooth, wrong"),
        ("smooth", {"p95_m": 0.26}, "smooth, 95 %"),
        ("smooth", {"mean_deg": 0.11}, "smooth, orientation"),
        ("smooth", {"last_m": 0.07}, "smooth, drift"),
        ("smooth", {"lost": 1}, "smooth, lost"),
        ("smooth", {"few_position_95": 0.89}, "smooth, bounds"),
        ("jerky", {"few_orientation_95": 0.89}, "jerky, bounds"),
        ("smooth", {"rate_hz": 59.0}, "smooth, speed"),
        ("smooth", {"gap_s": 0.16}, "smooth, speed"),
        ("smooth", {"overlay_hz": 19.0}, "smooth, with overlay"),
        ("jerky", {"mean_m": 0.26}, "jerky, position"),
        ("cut", {"invented": 1}, "cut, invented"),
        ("cut", {"found_s": 1.1}, "cut, found again"),
        ("cut", {"found_s": float("inf")}, "cut, found again"),
    ],
)
def test_each_line_can_fail(film: str, bad: dict[str, float], name: str) -> None:
    assert all(verdict.holds for verdict in verdicts({film: _GOOD}))
    found = verdicts({film: replace(_GOOD, **bad)})  # type: ignore[arg-type]
    assert [verdict.name for verdict in found if not verdict.holds] == [name]


def test_only_one_film_is_cut() -> None:
    assert film_options("cut", "short", 1, 100).cut == (40, 55)
    assert film_options("smooth", "short", 1, 100).cut is None
    assert film_options("jerky", "short", 1, 100).path.style == "jerky"
