"""What is burnt into a film is found and painted over; what stands still by itself is not."""

import cv2
import numpy as np
from numpy.typing import NDArray

from featuredb.features.extractor import ExtractorOptions, extract
from ingest.video.burnt_in import find_burnt_in, painted_over

_WIDTH, _HEIGHT = 480, 300
_LOGO = (slice(230, 270), slice(340, 460))


def _ground() -> NDArray[np.uint8]:
    """Texture at several scales."""
    rng = np.random.default_rng(2)
    layers = [
        cv2.resize(rng.normal(0, 22, (900 // s, 1200 // s)), (1200, 900), interpolation=cv2.INTER_CUBIC)
        for s in (3, 9, 30)
    ]
    return np.clip(128 + sum(layers), 0, 255).astype(np.uint8)


def _flown(ground: NDArray[np.uint8], count: int = 9) -> list[NDArray[np.uint8]]:
    """A camera that moves sideways, 14 pixels a picture."""
    return [ground[300 : 300 + _HEIGHT, 200 + 14 * k :][:, :_WIDTH].copy() for k in range(count)]


def _with_logo(picture: NDArray[np.uint8], share: float) -> NDArray[np.uint8]:
    marked = cv2.putText(picture.copy(), "SKY TV", (345, 262), cv2.FONT_HERSHEY_DUPLEX, 1.0, 255, 2)
    return np.asarray(cv2.addWeighted(marked, share, picture, 1.0 - share, 0), dtype=np.uint8)


def test_a_half_transparent_logo_and_bars_give_no_features_once_painted_over() -> None:
    pictures = [_with_logo(p, 0.6) for p in _flown(_ground())]
    for p in pictures:
        p[:36] = p[-24:] = 3
    found = find_burnt_in(pictures, [0] * len(pictures))[0]
    assert found.bars == (0, 38, 0, 26)
    writing = np.zeros((_HEIGHT, _WIDTH), dtype=np.bool_)
    writing[242:262, 350:445] = True
    assert found.mask[writing].mean() > 0.98
    assert found.overlay_share < 0.06
    clean = painted_over(np.repeat(pictures[4][:, :, None], 3, axis=2), found.mask)[:, :, 0]
    before, after = (extract(np.ascontiguousarray(p), ExtractorOptions()) for p in (pictures[4], clean))
    assert _inside(before.xy, writing) > 5
    assert _inside(after.xy, writing) == 0
    assert np.array_equal(clean[~found.mask], pictures[4][~found.mask])


def _inside(xy: NDArray[np.float32], mask: NDArray[np.bool_]) -> int:
    return int(mask[xy[:, 1].astype(int), xy[:, 0].astype(int)].sum())


def test_a_road_along_the_flight_and_what_is_far_away_are_not_burnt_in() -> None:
    """Straight ahead: a road's edges stay at the same pixels, and so does the middle of the picture."""
    ground = _ground()
    ground[:, 560:580] = 240  # from below to above, through the middle
    ahead = []
    for k in range(9):
        zoom = cv2.getRotationMatrix2D((570, 450), 0.0, 1.06**k)
        grown = cv2.warpAffine(ground, zoom, (1200, 900))
        ahead.append(grown[300 : 300 + _HEIGHT, 330 : 330 + _WIDTH].copy())
    assert find_burnt_in(ahead, [0] * len(ahead))[0].overlay_share < 0.01


def test_a_shot_too_short_to_tell_takes_the_films_logo() -> None:
    ground = _ground()
    pages = [*_flown(ground, 7), *_flown(ground[::-1], 2), *_flown(ground[:, ::-1], 2)]
    pictures = [_with_logo(p, 1.0) for p in pages]
    found = find_burnt_in(pictures, [0] * 7 + [1] * 2 + [2] * 2)
    assert found[1].mask[_LOGO].mean() > 0.4
    assert found[1].overlay_share < 0.08
