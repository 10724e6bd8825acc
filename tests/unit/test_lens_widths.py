"""Widths of lens priors, measured on lenses that were drawn with known ones."""

from dataclasses import replace

import numpy as np
import pytest

from featuredb.adjust.terms import LensWidths, lens_prior
from featuredb.geometry.camera import Camera
from ingest.colmap.adjust import AdjustOptions
from tools.lens_widths import WIDTHS, Told, limits_of, measured_widths

TRUE = LensWidths(focal_rel=0.01, aspect_rel=0.0005, center_rel=0.004, radial=0.03, tangential=0.001)


def told_of(count: int, seed: int) -> list[Told]:
    """Lenses of those widths, of which photos say more or less."""
    generator = np.random.default_rng(seed)
    mean = Camera.from_focal(1600, 1200, 1400.0, "OPENCV")
    told = []
    for k in range(count):
        has_exif = k % 3 > 0
        widths = TRUE if has_exif else replace(TRUE, focal_rel=AdjustOptions().lens.focal_rel)
        unit = replace(TRUE, focal_rel=0.0)  # so that photos tell the aspect, too
        sigma = generator.uniform(0.2, 2.0) * np.sqrt(np.diag(lens_prior(mean, unit).covariance))
        lens = generator.multivariate_normal(np.zeros(8), lens_prior(mean, widths).covariance)
        said = lens + sigma * generator.normal(size=8)
        told.append(
            Told(mean=mean, information=np.diag(sigma**-2), vector=said / sigma**2, has_exif=has_exif)
        )
    return told


def test_the_widths_that_lenses_were_drawn_with_are_found() -> None:
    told = told_of(100, 0)
    measured = measured_widths(told)
    for k, name in enumerate(WIDTHS):
        assert measured[k] == pytest.approx(getattr(TRUE, name), rel=0.4), name


def test_the_limits_hold_the_truth_about_as_often_as_they_say() -> None:
    held = []
    for seed in range(12):
        told = told_of(30, seed)
        measured = measured_widths(told)
        for k, name in enumerate(WIDTHS):
            low, high = limits_of(told, measured, k)
            held.append(low <= getattr(TRUE, name) <= high)
    assert np.mean(held) >= 0.85, np.mean(held)
