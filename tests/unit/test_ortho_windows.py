"""The offset between ortho image and scan is measured; limits of one half are tried on the other."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from tools.autzen_windows import WindowOutcome, figures_of
from tools.ortho_over_scan import OrthoOverScan, halves_of, measured_offset

_CELL_M = 0.5
_SHIFT_PX = (7, -4)  # columns, rows


def _place(related: bool = True) -> OrthoOverScan:
    """A town of bright and dark parts in an image, and elsewhere, otherwise bright, in sparse intensities."""
    rng = np.random.default_rng(3)
    towns = []
    for _ in range(2):
        town = np.full((500, 800), 90.0, np.float32)
        for _ in range(300):
            center, size = (rng.uniform(0, 800), rng.uniform(0, 500)), rng.uniform(8, 40, 2).tolist()
            corners = cv2.boxPoints((center, size, float(rng.uniform(0, 90))))
            cv2.fillPoly(town, [np.round(corners).astype(np.int32)], float(rng.uniform(40, 250)))
        towns.append(town)
    seen = np.roll(towns[0] if related else towns[1], _SHIFT_PX[::-1], axis=(0, 1))
    intensity = np.abs(seen - 140.0) + rng.normal(0.0, 15.0, seen.shape)
    intensity[rng.random(seen.shape) < 0.4] = np.nan
    return OrthoOverScan(
        gray=towns[0].astype(np.uint8),
        corner=np.zeros(2),
        cell=_CELL_M,
        shown=np.ones(seen.shape, np.bool_),
        intensity=intensity.astype(np.float32),
        edges=np.zeros((2, *seen.shape), np.bool_),
        ground=np.zeros(seen.shape, np.float32),
        high=np.zeros(seen.shape, np.bool_),
    )


def test_the_offset_is_measured_everywhere_and_in_each_half() -> None:
    place = _place()
    halves = halves_of(place)
    assert list(halves) == ["west", "east"]
    for part in ((slice(None), slice(None)), *halves.values()):
        offset = measured_offset(place, part)
        assert offset.metres == pytest.approx((7 * _CELL_M, 4 * _CELL_M), abs=0.1)
        assert (offset.sigma < 0.1).all()


def test_an_offset_of_what_is_not_there_is_uncertain() -> None:
    place = _place(related=False)
    assert np.linalg.norm(measured_offset(place, (slice(None), slice(None))).sigma) > 2.0


def test_halves_are_of_what_is_shown() -> None:
    place = _place()
    shown = place.shown.copy()
    shown[:, 300:] = False
    assert halves_of(replace(place, shown=shown)) == {
        "west": (slice(0, 500), slice(0, 150)),
        "east": (slice(0, 500), slice(150, 300)),
    }


def _outcome(half: str, kind: str, error_m: float | None, log_nfa: float, accepted: bool) -> WindowOutcome:
    return WindowOutcome(
        kind=kind,
        half=half,
        has_structure=True,
        accepted=accepted,
        error_m=error_m,
        log_nfa=log_nfa,
    )


def test_each_half_is_judged_by_the_verdict_and_by_the_limit_of_the_other() -> None:
    figures = figures_of(
        [
            _outcome("west", "window", 0.4, 9.0, True),
            _outcome("west", "window", 1.9, 4.0, False),
            _outcome("west", "mirrored", 80.0, 3.0, False),
            _outcome("east", "window", 0.4, 12.0, True),
            _outcome("east", "window", 30.0, 5.0, False),
            _outcome("east", "photo", None, 2.0, True),
        ]
    )
    assert (figures["structured"], figures["close"], figures["foreign"], figures["largest_m"]) == (
        4,
        2,
        2,
        0.4,
    )
    assert (figures["west_structured"], figures["west_rate"], figures["west_wrong"]) == (2, 0.5, 0)
    assert (figures["west_chosen_limit"], figures["west_chosen_rate"]) == (5.0, 0.5)
    assert figures["east_foreign_accepted"] == 1
    assert (figures["east_chosen_limit"], figures["east_chosen_close"]) == (3.0, 1)
    assert (figures["east_chosen_wrong"], figures["east_chosen_foreign_accepted"]) == (1, 0)
