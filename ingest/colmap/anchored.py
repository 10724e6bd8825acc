"""Adjustment of a model against points and photos that stay where they are, lenses under their priors.

Like ingest.colmap.bridge and ingest.colmap.adjust this module knows pycolmap's reconstructions.
"""

import tempfile
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from featuredb.adjust.problem import Problem
from featuredb.adjust.terms import (
    Block,
    LensPrior,
    LensWidths,
    Marks,
    Terms,
    lens_prior,
    whole_camera,
    whole_lens,
)
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from ingest.colmap.adjust import AdjustOptions, block_variance_px2, lens_prior_of, longest_side
from ingest.colmap.bridge import (
    Model,
    SfmPhoto,
    TwoView,
    model_of,
    posed,
    quiet,
    triangulation_settings,
    with_observations,
    write_database,
)

_FUNCTION_TOLERANCE = 1e-6  # relative
_ROUNDS = 3  # of adjusting and dropping
# Of the Cauchy loss, and of observations that are dropped between rounds, at images of 1600: a SIFT keypoint
# is good to about half a pixel of the image that it was found on, and reconstruction itself allows four.
KEYPOINT_PX, _MAX_ERROR_PX = 0.5, 4.0
# Of a lens that a map lends, against that map's points. They were made with that very lens: what it trades
# for height, they trade alike. Photos were localised with it, so it is no mistake that photos could find out,
# and its prior never lets go. Of the coefficients of a lens that is not whole no more is known than of any.
_LENT = LensWidths(focal_rel=0.003, aspect_rel=0.0005, center_rel=0.001, radial=0.0005, tangential=0.0005)
# What is known of other lenses, what observations count against it, and the solver: as where reconstructions
# are made.
MAPPING = AdjustOptions()


def pixel_scale(*cameras: Camera) -> float:
    """Pixels of the longest side for one of an image of 1600, on which SIFT locates keypoints; at least 1."""
    return max(1.0, longest_side(cameras) / 1600.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class Lenses:
    """What is known of a model's lenses, by camera, without its photos.

    Attributes:
        held: cameras whose lens stays.
        lent: lenses of maps.
        focal_px: focal lengths of EXIF.
    """

    held: Collection[int] = ()
    lent: Mapping[int, Camera] = field(default_factory=dict)
    focal_px: Mapping[int, float] = field(default_factory=dict)

    def priors(self, cameras: Sequence[Camera]) -> tuple[LensPrior | None, ...]:
        """Of whole lenses; None for those that are held."""

        def prior(c: int, camera: Camera) -> LensPrior | None:
            if c in self.held:
                return None
            if c in self.lent:
                lens, widths = whole_camera(self.lent[c]), _LENT
                if lens != self.lent[c]:  # the map did not ask for the other coefficients
                    any_lens = MAPPING.lens
                    widths = replace(widths, radial=any_lens.radial, tangential=any_lens.tangential)
                return lens_prior(lens, widths, robust=False)
            return lens_prior_of(whole_camera(camera), self.focal_px.get(c), MAPPING)

        return tuple(prior(c, camera) for c, camera in enumerate(cameras))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FixedPoints:
    """Points that stay where they are and the pixels in which a model's photos see them.

    Attributes:
        xyz: (q, 3) in the model's frame.
        point_of, photo_of: (m,) rows of xyz and of the model's photos.
        pixels: (m, 2).
    """

    xyz: FloatArray
    point_of: NDArray[np.int64]
    photo_of: NDArray[np.int64]
    pixels: FloatArray

    @classmethod
    def none(cls) -> "FixedPoints":
        """No points."""
        rows = np.zeros(0, dtype=np.int64)
        return cls(xyz=np.zeros((0, 3)), point_of=rows, photo_of=rows, pixels=np.zeros((0, 2)))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Anchored:
    """An adjusted model.

    Attributes:
        model: poses, lenses and free points; observations that fit, points with at least two of them.
        fixed_kept: (m,) observations of fixed points that fit.
    """

    model: Model
    fixed_kept: NDArray[np.bool_]


def adjust_anchored(
    model: Model, keypoints: Sequence[FloatArray], fixed: FixedPoints, lenses: Lenses
) -> Anchored:
    """Adjust poses, free points and whole lenses; without fixed points the first photo's pose stays.

    Args:
        keypoints: pixels (n, 2) of each photo of the model, in the order of its rows.
    """
    observation = _in_tracks(model, np.ones(len(model.point_of), dtype=np.bool_))
    kept = np.ones(len(fixed.point_of), dtype=np.bool_)
    priors, pixels = lenses.priors(model.cameras), model.pixels(keypoints)
    state = model
    keypoint_px = KEYPOINT_PX * pixel_scale(*model.cameras)
    variance_px2 = keypoint_px**2  # until the model has settled
    for _ in range(_ROUNDS):
        block, marks = block_and_marks(state, observation, keypoints, fixed, kept)
        terms = Terms(
            keypoint_px=keypoint_px,
            dilution=MAPPING.dilution * variance_px2 / keypoint_px**2,
            lenses=priors,
            marks=replace(marks, sigma_px=keypoint_px),
            held_photos=() if len(fixed.point_of) else (0,),
        )
        problem = Problem(block, terms, MAPPING.threads)
        problem.solve(MAPPING.max_iterations, _FUNCTION_TOLERANCE)
        found = problem.block()
        variance_px2 = block_variance_px2(found, marks)
        cameras = zip(model.cameras, found.cameras, priors, strict=True)
        state = replace(
            state,
            cameras=tuple(given if prior is None else own for given, own, prior in cameras),
            cam_from_sfm=found.cam_from_block,
            xyz=found.xyz,
        )
        observation = _fitting(state, state.xyz, state.point_of, state.photo_of, pixels)
        kept = _fitting(state, fixed.xyz, fixed.point_of, fixed.photo_of, fixed.pixels)
        observation &= _in_tracks(state, observation)
    return Anchored(model=with_observations(state, observation), fixed_kept=kept)


def block_and_marks(
    model: Model,
    observation: NDArray[np.bool_],
    keypoints: Sequence[FloatArray],
    fixed: FixedPoints,
    kept: NDArray[np.bool_],
) -> tuple[Block, Marks]:
    """The model with whole lenses, and what its free photos see of points that stay.

    Args:
        observation: (m,) those of the model that take part. kept: those of the fixed points.
    """
    xy = model.pixels(keypoints)
    block = replace(
        model.block(xy),
        point_of=model.point_of[observation],
        photo_of=model.photo_of[observation],
        xy=xy[observation],
    )
    marks = Marks(xyz=fixed.xyz[fixed.point_of[kept]], photo_of=fixed.photo_of[kept], xy=fixed.pixels[kept])
    return whole_lens(block), marks


def _fitting(
    model: Model,
    xyz: FloatArray,
    point_of: NDArray[np.int64],
    photo_of: NDArray[np.int64],
    pixels: FloatArray,
) -> NDArray[np.bool_]:
    """(m,) which observations of points xyz (n, 3) at pixels (m, 2) lie within the tolerance."""
    fits = np.zeros(len(point_of), dtype=np.bool_)
    for k, pose in enumerate(model.cam_from_sfm):
        camera = model.cameras[int(model.camera_of[k])]
        mine = np.flatnonzero(photo_of == k)
        off = camera.project(pose.act(xyz[point_of[mine]])) - pixels[mine]
        fits[mine] = np.linalg.norm(off, axis=1) < _MAX_ERROR_PX * pixel_scale(camera)
    return fits


def _in_tracks(model: Model, observation: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Observations of points that at least two of them hold."""
    counts = np.bincount(model.point_of[observation], minlength=len(model.xyz))
    return np.asarray(counts[model.point_of] >= 2)


def triangulate_posed(
    cameras: Sequence[Camera],
    photos: Sequence[SfmPhoto],
    poses: Sequence[Rigid3],
    geometries: Mapping[tuple[int, int], TwoView],
) -> Model:
    """Points from the verified matches of photos whose poses and lenses are known, and stay as they are.

    Args:
        photos: their camera_row names the camera. poses: cam_from_sfm of each.
        geometries: of pairs of rows.
    """
    with quiet(), tempfile.TemporaryDirectory(prefix="featuredb-points-") as scratch:
        database = Path(scratch) / "colmap.db"
        write_database(database, [(camera, True) for camera in cameras], photos, geometries)
        settings = triangulation_settings()
        error_px = _MAX_ERROR_PX * pixel_scale(*cameras)
        settings.triangulation.create_max_angle_error = 2.0
        settings.mapper.filter_max_reproj_error = error_px
        settings.triangulation.complete_max_reproj_error = error_px
        settings.triangulation.merge_max_reproj_error = error_px
        settings.ba_refine_focal_length = False
        settings.ba_refine_extra_params = False
        output = Path(scratch) / "points"
        output.mkdir()
        found = pycolmap.triangulate_points(
            posed(cameras, photos, dict(enumerate(poses))),
            *(str(database), scratch, str(output)),
            clear_points=True,
            options=settings,
        )
        return model_of(found)
