"""Photos that do not tell their focal length: the pairs do, and long lenses are reconstructed."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from ingest.colmap.bridge import SfmPhoto, TwoView, read_models, verify_pair, write_database
from ingest.sfm.mapper import SfmOptions, SfmTask, SfmView, reconstruct
from ingest.sfm.view_graph_focals import calibrate_focals, start_from
from ingest.workspace import write_arrays
from tests.support.scenes import looking_at

SIDE_PX = 1000
TRUE_PX = (800.0, 2900.0, 900.0, 2100.0, 2900.0, 1250.0, 2500.0)
"""Of the photos of a facade that came from anywhere."""


def camera(focal_px: float) -> Camera:
    return Camera.from_focal(SIDE_PX, 700, focal_px, "SIMPLE_RADIAL")


def facade(rng: np.random.Generator, relief_m: float) -> FloatArray:
    """Points (900, 3) on a wall of 30 x 20 m."""
    return np.column_stack(
        [rng.uniform(-15, 15, 900), rng.uniform(-relief_m, relief_m, 900), rng.uniform(0, 20, 900)]
    )


def seen(
    relief_m: float = 2.0, seed: int = 0, matches: int = 200, noise_px: float = 0.3
) -> tuple[list[FloatArray], dict[tuple[int, int], TwoView]]:
    """Keypoints (900, 2) of each photo, the n-th of which is the n-th point, and the verified pairs."""
    rng = np.random.default_rng(seed)
    points = facade(rng, relief_m)
    keypoints: list[FloatArray] = []
    for k, focal in enumerate(TRUE_PX):
        # Axes that meet in a point tell no focal length (Sturm): each photo looks at a spot of its own.
        away, side = 36.0 * focal / 1000.0, np.linspace(-0.6, 0.6, len(TRUE_PX))[(3 * k) % len(TRUE_PX)]
        eye = np.array([away * np.sin(side), -away * np.cos(side), rng.uniform(2.0, 25.0)])
        pose = looking_at(eye, np.array([rng.uniform(-6, 6), 0.0, rng.uniform(5, 15)]))
        pixels = camera(focal).project(pose.act(points))
        keypoints.append(pixels + rng.normal(0.0, noise_px, pixels.shape))
    pairs = {}
    for i, j in combinations(range(len(TRUE_PX)), 2):
        common = rng.choice(len(points), matches, replace=False)
        rows = np.column_stack([common, common]).astype(np.uint32)
        guess = camera(1.2 * SIDE_PX)
        a, b = (keypoints[n].astype(np.float32) for n in (i, j))
        pairs[i, j] = verify_pair(guess, a, guess, b, rows, focal_known=False, max_error_px=4.0, seed=0)
    return keypoints, pairs


def database_of(path: Path, known: Sequence[int] = (), relief_m: float = 2.0, seed: int = 0) -> Path:
    """COLMAP's database of the photos, all at the guess but those whose focal length is known."""
    keypoints, pairs = seen(relief_m, seed)
    cameras = [(camera(TRUE_PX[k] if k in known else 1.2 * SIDE_PX), k in known) for k in range(len(TRUE_PX))]
    photos = [
        SfmPhoto(name=f"{k}.jpg", camera_row=k, keypoints=xy.astype(np.float32))
        for k, xy in enumerate(keypoints)
    ]
    write_database(path / "colmap.db", cameras, photos, pairs)
    return path / "colmap.db"


@pytest.mark.parametrize("seed", range(3))
def test_pairs_tell_the_focal_lengths(tmp_path: Path, seed: int) -> None:
    found = calibrate_focals(database_of(tmp_path, seed=seed), tmp_path, seed=0)
    assert sorted(found) == list(range(1, len(TRUE_PX) + 1))
    np.testing.assert_allclose([found[k] for k in sorted(found)], TRUE_PX, rtol=0.05)


def stored(database: Path) -> dict[int, tuple[float, bool]]:
    opened = pycolmap.Database.open(str(database))
    try:
        return {
            c.camera_id: (c.mean_focal_length(), c.has_prior_focal_length) for c in opened.read_all_cameras()
        }
    finally:
        opened.close()


def test_what_is_known_stays(tmp_path: Path) -> None:
    database = database_of(tmp_path, known=(0, 1))
    before = stored(database)
    found = calibrate_focals(database, tmp_path, seed=0)
    assert found
    assert not {1, 2} & found.keys()
    assert stored(database) == before
    (tmp_path / "all").mkdir()
    assert calibrate_focals(database_of(tmp_path / "all", known=range(7)), tmp_path, seed=0) == {}


def test_a_start_is_not_taken_for_known(tmp_path: Path) -> None:
    database = database_of(tmp_path)
    start_from(database, {3: 2000.0})
    assert stored(database) == {k: (2000.0 if k == 3 else 1.2 * SIDE_PX, False) for k in range(1, 8)}


def test_a_plane_tells_nothing_that_is_no_lens(tmp_path: Path) -> None:
    for focal in calibrate_focals(database_of(tmp_path, relief_m=0.0), tmp_path, seed=0).values():
        assert 0.1 * SIDE_PX <= focal <= 5.0 * SIDE_PX


def task_of(folder: Path, options: SfmOptions) -> SfmTask:
    keypoints, pairs = seen(seed=1, matches=100, noise_px=1.0)
    views = []
    for k, xy in enumerate(keypoints):
        write_arrays(folder / "features" / f"{k}.npz", {"xy": xy.astype(np.float32)})
        views.append(SfmView(name=f"{k}.jpg", camera_row=k, features=folder / "features" / f"{k}.npz"))
    matches = []
    for (i, j), view in pairs.items():
        write_arrays(folder / "matches" / f"{i}-{j}.npz", view.arrays())
        matches.append((i, j, folder / "matches" / f"{i}-{j}.npz"))
    guess = (camera(1.2 * SIDE_PX), False)
    return SfmTask(
        cameras=(guess,) * len(TRUE_PX), views=tuple(views), matches=tuple(matches), options=options
    )


def test_long_lenses_without_exif_are_reconstructed(tmp_path: Path) -> None:
    found = {}
    for again in (False, True):
        options = replace(SfmOptions(), focal_from_view_graph=again)
        reconstruct(task_of(tmp_path, options), tmp_path / str(again))
        found[again] = [m for m in read_models(tmp_path / str(again)) if len(m.rows) > 2]
    assert found[False] == []
    (model,) = found[True]
    np.testing.assert_array_equal(model.rows, np.arange(len(TRUE_PX)))
    np.testing.assert_allclose([c.focal_px for c in model.cameras], TRUE_PX, rtol=0.1)
