"""Step: localised photos that no reconstruction holds form groups where two-view geometry bears them out.

Each of them was placed by matches with existing points. Matches between two of them are something else: if
their geometry, estimated without any pose, fits the two poses, two independent statements agree. A single
localised photo is never enough.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from itertools import chain

import numpy as np

from featuredb.geometry.arrays import FloatArray
from ingest.colmap.anchored import FixedPoints, Lenses, adjust_anchored, pixel_scale, triangulate_posed
from ingest.colmap.bridge import Model, SfmPhoto, TwoView
from ingest.growth.gates import AGREEING_SHARE
from ingest.growth.place.localised import in_frame
from ingest.growth.values import TOLERANCE_PX, FeaturesOf, LocalisedPhoto, tied_together
from ingest.sfm.pairs import Pair
from reloc.localise.pose import reprojection_errors

# Median between the rays. Below, any two photos from one spot fit, and two copies of one picture.
_LEAST_ANGLE_DEG = 1.0


def lone_groups(
    localised: Mapping[int, LocalisedPhoto],
    features_of: FeaturesOf,
    overlaps: Collection[Pair],
    geometry_of: Callable[[Pair], TwoView],
) -> tuple[list[Model], dict[int, str]]:
    """Groups among localised photos that no reconstruction holds, and for those in none the reason.

    Args:
        localised: the lone photos by row, those of one camera with one lens.
        overlaps: pairs of rows with verified matches. geometry_of: theirs, in which no pose takes part.

    Returns:
        A model of each group, of its matches alone, with the lenses of the localisations.
    """
    if not localised:
        return [], {}
    frame = next(iter(localised.values())).frame
    photos = {r: in_frame(p, frame) for r, p in sorted(localised.items())}
    geometries: dict[Pair, TwoView] = {}
    for a, b in sorted(pair for pair in overlaps if photos.keys() >= set(pair)):
        view = geometry_of((a, b))
        pixels = [features_of(r).features.xy[view.inliers[:, k]] for k, r in enumerate((a, b))]
        if poses_fit(photos[a], photos[b], pixels[0].astype(np.float64), pixels[1].astype(np.float64)):
            geometries[a, b] = view
    alone = photos.keys() - set(chain(*geometries))
    groups: list[Model] = []
    group_of = np.array(tied_together(list(photos), geometries))
    for group in np.unique(group_of):
        rows = np.array(list(photos))[group_of == group].tolist()
        if len(rows) >= 2:
            own = {pair: view for pair, view in geometries.items() if pair[0] in rows}
            groups.append(_triangulated(rows, photos, own, features_of))
    return groups, dict.fromkeys(alone, "ALONE: no other photo bears its pose out")


def poses_fit(a: LocalisedPhoto, b: LocalisedPhoto, pixels_a: FloatArray, pixels_b: FloatArray) -> bool:
    """Whether the verified matches of two photos, pixels (m, 2) of each, bear out the poses in one frame."""
    points, angle = intersections((a, b), (pixels_a, pixels_b))
    fits = np.ones(len(points), dtype=np.bool_)
    for photo, pixels in ((a, pixels_a), (b, pixels_b)):
        errors = reprojection_errors(pixels, points, photo.camera, photo.cam_from_local)
        fits &= errors < TOLERANCE_PX * pixel_scale(photo.camera)
    enough = fits.sum() >= AGREEING_SHARE * len(fits)
    return bool(enough and np.degrees(np.median(angle[fits])) >= _LEAST_ANGLE_DEG)


def intersections(
    photos: tuple[LocalisedPhoto, LocalisedPhoto], pixels: tuple[FloatArray, FloatArray]
) -> tuple[FloatArray, FloatArray]:
    """Midpoints (m, 3) of the shortest lines between the rays of pixel pairs, and the rays' angles (rad).

    The lens may not reach a pixel; its ray is the optical axis.
    """
    poses, rays = [photo.cam_from_local for photo in photos], []
    for photo, pose, xy in zip(photos, poses, pixels, strict=True):
        ray = np.column_stack([np.nan_to_num(photo.camera.unproject(xy)), np.ones(len(xy))]) @ pose.rotation
        rays.append(ray / np.linalg.norm(ray, axis=1, keepdims=True))
    base = poses[1].center - poses[0].center
    cosine = np.einsum("mi,mi->m", *rays)
    sine2 = np.maximum(1.0 - cosine**2, 1e-12)
    along = [ray @ base for ray in rays]
    depths = ((along[0] - cosine * along[1]) / sine2, (cosine * along[0] - along[1]) / sine2)
    ends = [p.center + d[:, None] * ray for p, d, ray in zip(poses, depths, rays, strict=True)]
    return 0.5 * (ends[0] + ends[1]), np.arccos(np.clip(cosine, -1.0, 1.0))


def _triangulated(
    rows: Sequence[int],
    photos: Mapping[int, LocalisedPhoto],
    geometries: Mapping[Pair, TwoView],
    features_of: FeaturesOf,
) -> Model:
    """A model of the group from its verified matches; rows are those of the photos.

    The localisations' poses are the start; then the model is adjusted to its matches alone, in a gauge of its
    own. Whether it still fits the localisations is asked when it is placed, as of any reconstruction.
    """
    cameras = list(dict.fromkeys(photos[r].camera for r in rows))
    sfm = []
    for r in rows:
        camera_row, xy = cameras.index(photos[r].camera), features_of(r).features.xy
        sfm.append(SfmPhoto(name=str(r), camera_row=camera_row, keypoints=xy))
    views = {(rows.index(a), rows.index(b)): view for (a, b), view in geometries.items()}
    model = triangulate_posed(cameras, sfm, [photos[r].cam_from_local for r in rows], views)
    keypoints = [sfm[int(k)].keypoints.astype(np.float64) for k in model.rows]
    lenses = Lenses(held=range(len(model.cameras)))
    free = adjust_anchored(model, keypoints, FixedPoints.none(), lenses).model
    return replace(free, rows=np.array([rows[int(k)] for k in model.rows], dtype=np.int64))
