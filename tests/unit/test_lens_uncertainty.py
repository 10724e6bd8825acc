"""What a map's lenses leave open, and what that makes of a lens that is known exactly."""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import sparse

import featuredb.adjust.marginals as marginals_module
from featuredb.adjust.marginals import Marginals, inverse_without_points
from featuredb.adjust.terms import Block
from featuredb.errors import InvalidValueError
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.sim3 import Sim3
from featuredb.maps.lens_uncertainty import LensUncertainty, uncertainty_of_lenses
from ingest.colmap.map_errors import MapErrors, map_errors
from ingest.map_builder import _errors
from ingest.photos.photo import Photo
from reloc.localise.lens_prior import QueryLensPrior, seen_by_a_map
from reloc.localise.self_calibration import calibrate

_LENS = Camera(
    model="OPENCV", width=1600, height=1200, params=(1200.0, 1202.0, 805.0, 597.0, -0.02, 0.01, 4e-4, -3e-4)
)
_FISHEYE = Camera(
    model="OPENCV_FISHEYE", width=1600, height=1200, params=(800.0, 800.0, 800.0, 600.0, 0.0, 0.0, 0.0, 0.0)
)


def test_the_doubt_is_that_of_drawn_lenses() -> None:
    rng = np.random.default_rng(1)
    root = rng.normal(size=(8, 8)) * np.array([3.0, 3.0, 1.0, 1.0, 1e-3, 1e-3, 1e-4, 1e-4])[:, None]
    drawn = np.array(_LENS.params) + rng.normal(size=(200_000, 8)) @ root.T
    uncertainty = uncertainty_of_lenses([_LENS], [root @ root.T], [5], 50.0)
    assert uncertainty is not None
    assert uncertainty.focal_rel == pytest.approx(np.std(drawn[:, 0]) / 1200.0, rel=0.02)
    assert uncertainty.aspect == pytest.approx(np.std(drawn[:, 1] / drawn[:, 0]), rel=0.02)
    assert uncertainty.center_rel[1] == pytest.approx(np.std(drawn[:, 3]) / 1600.0, rel=0.02)
    assert uncertainty.tangential[0] == pytest.approx(np.std(drawn[:, 6]), rel=0.02)
    # Two lenses of as many photos each: the map's points are bent by their mean.
    both = uncertainty_of_lenses([_LENS, _LENS], [root @ root.T] * 2, [5, 5], 50.0)
    assert both is not None
    assert both.focal_rel == pytest.approx(uncertainty.focal_rel / 2**0.5)


def test_a_provenance_keeps_it_and_old_ones_have_none() -> None:
    uncertainty = LensUncertainty(
        focal_rel=1e-3,
        aspect=2e-3,
        center_rel=(3e-3, 4e-3),
        radial=(5e-3, 6e-3),
        tangential=(7e-4, 8e-4),
        dilution=50.0,
    )
    assert LensUncertainty.of_provenance(json.loads(json.dumps(uncertainty.as_provenance()))) == uncertainty
    assert LensUncertainty.of_provenance({"version": "1"}) is None


@pytest.mark.parametrize("written", [[0.1] * 8, [0.1] * 8 + [float("nan")], [-1.0] * 9, "0.1", {}])
def test_a_provenance_that_is_not_ours_is_an_error(written: object) -> None:
    with pytest.raises(InvalidValueError, match="expected 9 numbers"):
        LensUncertainty.of_provenance({"lens_uncertainty": written})


def test_lenses_of_other_models_have_none() -> None:
    assert uncertainty_of_lenses([_FISHEYE], [np.eye(8)], [3], 50.0) is None
    uncertainty = LensUncertainty(
        focal_rel=1e-3, aspect=1e-3, center_rel=(0, 0), radial=(0, 0), tangential=(0, 0), dilution=50.0
    )
    assert seen_by_a_map(_FISHEYE, uncertainty) is None


def test_points_bent_by_another_aspect_no_longer_move_a_photo_whose_lens_is_told() -> None:
    """A map whose lens is 0.3 % flatter than the truth: its scene is as much taller."""
    rng = np.random.default_rng(3)
    told = Camera(model="PINHOLE", width=1600, height=1200, params=(1200.0, 1200.0, 800.0, 600.0))
    scene = rng.uniform([-4, -3, 8], [4, 3, 14], (400, 3))
    pixels = told.project(scene) + rng.normal(0, 0.3, (400, 2))
    bent = scene * [1.0, 1.003, 1.0]
    uncertainty = LensUncertainty(
        focal_rel=1e-3,
        aspect=2e-3,
        center_rel=(1e-3, 1e-3),
        radial=(1e-3, 1e-3),
        tangential=(2e-4, 2e-4),
        dilution=50.0,
    )
    seen = seen_by_a_map(told, uncertainty)
    assert seen is not None
    by_doubt, *_ = calibrate(pixels, bent, Rigid3.identity(), *seen, 1.0)
    exact = QueryLensPrior(mean=seen[1].mean, sigma=np.full(8, 1e-7))
    as_told, *_ = calibrate(pixels, bent, Rigid3.identity(), seen[0], exact, 1.0)
    assert np.linalg.norm(by_doubt.center) < 0.5 * np.linalg.norm(as_told.center)


def test_more_photos_leave_less_open() -> None:
    few, many = (map_errors(_block(photos), {0: 1200.0}).lenses for photos in (4, 12))
    assert few is not None
    assert many is not None
    assert many.focal_rel < few.focal_rel
    assert many.center_rel[0] < few.center_rel[0]
    assert 1e-6 < many.focal_rel < 0.03  # EXIF says 0.02, and counts less where other parameters are off


def test_what_lenses_leave_open_counts_as_often_as_it_is_told_to() -> None:
    root = np.random.default_rng(5).normal(size=(14, 14))
    shared = root @ root.T
    found = Marginals(shared=shared, pose_start=np.array([0]), lens_start=np.array([6]), lens_size=(8,))
    exact = np.linalg.inv(np.linalg.inv(shared)[:6, :6])  # with lenses known
    by_lens = shared[:6, :6] - exact
    np.testing.assert_allclose(found.poses(9.0)[0], exact + 9.0 * by_lens, rtol=1e-6)
    np.testing.assert_allclose(found.poses()[0], shared[:6, :6])


def test_of_a_block_with_photos_that_share_no_points() -> None:
    """As in a grown map, some of whose photos are held by the points of others alone."""
    block, photos = _block(8), 8
    whole = map_errors(block, {0: 1200.0}).lenses
    without = block.photo_of < photos - 2
    less = map_errors(
        replace(
            block,
            point_of=block.point_of[without],
            photo_of=block.photo_of[without],
            xy=block.xy[without],
        ),
        {0: 1200.0},
    ).lenses
    assert whole is not None
    assert less is not None
    assert 0.0 < whole.focal_rel < less.focal_rel < 0.03  # as EXIF says, loosely
    # Neither depends on the unit of length.
    moved = block.moved(Sim3(scale=1e-3, rotation=np.eye(3), translation=np.zeros(3)))
    again = map_errors(moved, {0: 1200.0}).lenses
    assert again is not None
    assert again.focal_rel == pytest.approx(whole.focal_rel, rel=1e-3)
    assert again.tangential == pytest.approx(whole.tangential, rel=1e-3)


def _block(photos: int) -> Block:
    rng = np.random.default_rng(0)
    xyz = rng.uniform([-5, -4, 8], [5, 4, 13], (300, 3))
    poses = [
        Rigid3(rotation=np.eye(3), translation=np.array([0.8 * (k % 4) - 1.2, 0.7 * (k // 4) - 0.7, 0.0]))
        for k in range(photos)
    ]
    xy = np.concatenate([_LENS.project(pose.act(xyz)) for pose in poses])
    return Block(
        names=tuple(str(k) for k in range(photos)),
        cameras=(_LENS,),
        camera_of=np.zeros(photos, dtype=np.int64),
        cam_from_block=tuple(poses),
        xyz=xyz,
        point_of=np.tile(np.arange(300), photos),
        photo_of=np.repeat(np.arange(photos), 300),
        xy=xy + rng.normal(0, 0.3, xy.shape),
    )


def test_joint_errors_are_those_of_the_poses() -> None:
    """The modes are nearly all of the poses' covariances; a similarity of all is no error of shape."""
    block = _block(12)
    found = map_errors(block, {0: 1200.0})
    depth = np.median(np.linalg.norm(block.xyz[None] - block.centers()[:, None], axis=2), axis=1)
    unit = np.repeat([np.ones(12), 1.0 / depth], 3, axis=0).T
    whole = np.einsum("kii->ki", found.poses) * unit**2
    kept = (found.modes.poses**2).sum(axis=2)
    assert (kept <= whole * (1 + 1e-6)).all()
    assert kept.sum() > 0.998 * whole.sum()
    # Centres that all drift along, or grow apart, do so together with the placement.
    shifts = np.stack(
        [
            -pose.rotation.T @ found.modes.poses[k, 3:] * depth[k]
            for k, pose in enumerate(block.cam_from_block)
        ]
    )
    arms = block.centers() - block.centers().mean(axis=0)
    largest = np.abs(shifts).max()
    assert np.abs(shifts.mean(axis=0)).max() < 1e-6 * largest
    assert np.abs(np.einsum("ki,kir->r", arms, shifts)).max() < 1e-6 * largest


def test_a_map_whose_lenses_are_no_opencv_has_errors_of_poses_alone() -> None:
    block = _block(6)
    xyz = block.xyz[block.point_of]
    pixels = np.array(
        [
            _FISHEYE.project(block.cam_from_block[p].act(x[None]))[0]
            for p, x in zip(block.photo_of, xyz, strict=True)
        ]
    )
    found = map_errors(replace(block, cameras=(_FISHEYE,), xy=pixels + 0.1), {})
    assert found.lenses is None
    assert (found.modes.lenses == 0).all()
    assert np.isfinite(found.poses).all()


def test_covariances_that_nothing_determines_do_not_end_an_ingest(monkeypatch: pytest.MonkeyPatch) -> None:
    """A point that lies in a camera takes away more than all observations tell."""
    by_point, by_shared = sparse.csr_matrix(1e10 * np.eye(4, 3)), sparse.csr_matrix(np.eye(4, 2) * 1e10)
    monkeypatch.setattr(marginals_module, "inverse_blocks", lambda *_: 1.1e-20 * sparse.eye(3, format="csr"))
    with pytest.raises(np.linalg.LinAlgError):
        inverse_without_points(by_point, by_shared)

    def undetermined(*_: object) -> MapErrors:
        raise np.linalg.LinAlgError("a point lies in a camera")

    monkeypatch.setattr("ingest.map_builder.map_errors", undetermined)
    block = _block(4)
    photos = [Photo(name=name, path=Path(name)) for name in block.names]
    model = SimpleNamespace(camera_of=block.camera_of)
    assert _errors(block, photos, model, None) is None  # type: ignore[arg-type]
