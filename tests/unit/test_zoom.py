"""A focal length that changes within a shot is noticed, and a flight straight ahead is no zoom."""

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ingest.video.zoom import lenses_of

_WIDTH, _HEIGHT, _COUNT = 480, 320, 13


def _texture() -> NDArray[np.float64]:
    rng = np.random.default_rng(4)
    layers = [
        cv2.resize(rng.normal(0, 25, (1600 // s, 1600 // s)), (1600, 1600), interpolation=cv2.INTER_CUBIC)
        for s in (4, 12, 40)
    ]
    return np.asarray(np.clip(128 + sum(layers), 0, 255), dtype=np.float64)


def _shot(
    focals: list[float], step: tuple[float, float, float], turn_deg: float = 0.0
) -> list[NDArray[np.uint8]]:
    """Two floors, one 30 m below the camera and one, in checks of 12 m, 7 m higher; it looks down, askew.

    Args:
        focals: in pixels, of each picture. step: movement from one to the next, metres. turn_deg: that, too:
            a camera that never turns does not tell its focal length.
    """
    texture = _texture()
    y, x = np.mgrid[:_HEIGHT, :_WIDTH].astype(np.float64)
    pictures = []
    for k, focal in enumerate(focals):
        angles = [turn_deg * k, -30.0 + turn_deg * np.sin(k)]
        look = Rotation.from_euler("zx", angles, degrees=True).as_matrix()
        center = np.array(step) * (k - 0.5 * _COUNT)
        rays = (
            np.stack([(x - _WIDTH / 2) / focal, (y - _HEIGHT / 2) / focal, np.ones_like(x)], axis=-1) @ look.T
        )
        seen = []
        for depth in (30.0, 23.0):
            at = center + rays * ((depth - center[2]) / rays[..., 2])[..., None]
            gray = cv2.remap(
                texture,
                (8.0 * at[..., 0] + 800 + 9 * depth).astype(np.float32),
                (8.0 * at[..., 1] + 800).astype(np.float32),
                cv2.INTER_LINEAR,
                borderMode=cv2.BORDER_REFLECT,
            )
            seen.append((gray, (np.floor(at[..., 0] / 12) + np.floor(at[..., 1] / 12)) % 2 == 0))
        pictures.append(np.where(seen[1][1], seen[1][0], seen[0][0]).astype(np.uint8))
    return pictures


def test_a_zoom_while_the_camera_moves_gives_other_lenses() -> None:
    focals = [380.0] * 5 + [430.0, 490.0, 560.0] + [600.0] * 5
    lenses = lenses_of(_shot(focals, (1.6, 0.9, 0.0), 5.0), [0] * _COUNT)
    assert len(set(lenses[:4])) == 1
    assert len(set(lenses[-4:])) == 1
    assert lenses[-1] > lenses[0]


def test_coming_nearer_is_no_zoom() -> None:
    pictures = _shot([380.0] * _COUNT, (0.4, 0.0, 0.9))
    assert set(lenses_of(pictures, [0] * _COUNT)) == {0}


def test_a_camera_that_only_zooms_shows_no_parallax() -> None:
    focals = [380.0] * 4 + [400.0, 425.0, 450.0, 480.0, 510.0] + [510.0] * 4
    pictures = _shot(focals, (0.0, 0.0, 0.0))
    # The same frame twice has nothing to say.
    lenses = lenses_of(pictures, [0] * _COUNT)
    assert lenses == (0, 0, 0, 0, 1, 2, 3, 4, 5, 5, 5, 5, 5)
