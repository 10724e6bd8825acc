"""Simulated tilts: where keypoints land, and that they bridge a tilt that plain features do not."""

import cv2
import numpy as np
import pytest

from featuredb.errors import InvalidValueError
from featuredb.features.extractor import ExtractorOptions, extract
from featuredb.features.tilted import TiltOptions, extract_tilted, tilted
from featuredb.index.nearest import nearest
from tests.support.planar_map import field_texture


@pytest.mark.parametrize("tilt", [1.4, 2.8])
@pytest.mark.parametrize("turn_deg", [0.0, 77.0, 150.0])
def test_pixels_go_back_to_where_they_came_from(tilt: float, turn_deg: float) -> None:
    photo = np.zeros((300, 400), np.uint8)
    photo[99:102, 149:152] = 255  # its middle is at (150.5, 100.5)
    warped, photo_from_warped = tilted(photo, tilt, turn_deg)
    weight = warped.astype(np.float64)
    y, x = np.mgrid[: warped.shape[0], : warped.shape[1]] + 0.5
    middle = np.array([(weight * x).sum(), (weight * y).sum()]) / weight.sum()
    np.testing.assert_allclose(
        photo_from_warped[:, :2] @ middle + photo_from_warped[:, 2], [150.5, 100.5], atol=0.1
    )
    # Squeezed across, kept along: its corners' turned box, divided by the tilt in one direction.
    c, s = abs(np.cos(np.radians(turn_deg))), abs(np.sin(np.radians(turn_deg)))
    assert warped.shape[1] == pytest.approx((400 * c + 300 * s) / tilt, abs=2)
    assert warped.shape[0] == pytest.approx(400 * s + 300 * c, abs=2)


def test_tilts_bridge_what_plain_features_do_not() -> None:
    photo = field_texture(1)[:480, :640]
    squeeze = np.array([[1.0 / 3.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    oblique = cv2.warpAffine(cv2.GaussianBlur(photo, (0, 0), 2.2, sigmaY=0.01), squeeze, (214, 480))
    oblique = np.asarray(oblique, dtype=np.uint8)
    options = ExtractorOptions(max_features=1500)
    base = extract(oblique, options)

    def true_matches(features_xy: np.ndarray, descriptors: np.ndarray) -> int:  # type: ignore[type-arg]
        squared, row = nearest(descriptors, base.descriptors, 2)
        good = np.sqrt(squared[:, 0]) < 0.85 * np.sqrt(squared[:, 1])
        expected = (features_xy[good] - 0.5) * [1.0 / 3.0, 1.0] + 0.5
        near = np.linalg.norm(base.xy[row[good, 0]] - expected, axis=1) < 2.0
        return len(np.unique(row[good, 0][near]))

    plain = extract(photo, options)
    many = extract_tilted(photo, options, TiltOptions(tilts=(2.8,), features_per_tilt=800))
    assert many.fingerprint == plain.fingerprint
    np.testing.assert_array_equal(many.xy[: len(plain)], plain.xy)
    assert true_matches(many.xy, many.descriptors) > 3 * true_matches(plain.xy, plain.descriptors)
    assert ((many.xy > 0) & (many.xy < [640, 480])).all()
    assert ((many.angle >= 0) & (many.angle < 360)).all()


def test_tilts_below_one_are_refused() -> None:
    with pytest.raises(InvalidValueError, match="above 1"):
        TiltOptions(tilts=(0.5,))
