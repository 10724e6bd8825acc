"""Step: localised photos that no reconstruction holds form groups where two-view geometry bears them out.

Each of them was placed by matches with existing points. Matches between two of them are something else: if
their geometry, estimated without any pose, fits the two poses, two independent statements agree. A single
localised photo is never enough.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from ingest.colmap.anchored import AnchoredOptions, FixedPoints, Lenses, adjust_anchored, triangulate_posed
from ingest.colmap.bridge import Model, SfmPhoto, TwoView, verify_pair
from ingest.growth.place.localised import in_frame
from ingest.growth.values import TOLERANCE_PX, FeaturesOf, LocalisedPhoto, pixel_scale, tied_together
from ingest.sfm.matching import MatchOptions, mutual_matches

_PARTNERS = 6  # photos that each one is compared with, those first that share most existing points
_MOST_FEATURES = 6000  # of each photo, strongest and best spread first
_LEAST_FITTING = 0.7  # share of a pair's verified matches that must fit the poses
# Median between the rays. Below, any two photos from one spot fit, and two copies of one picture.
_LEAST_ANGLE_DEG = 1.0
_MATCHING = MatchOptions()


@dataclass(frozen=True, slots=True, kw_only=True)
class PairCheck:
    """What two photos say of each other's poses.

    Attributes:
        verified: matches with a two-view geometry of their own.
        fitting: share of these that fits the two poses.
        angle_deg: median angle between the rays of those that fit.
    """

    verified: int
    fitting: float
    angle_deg: float

    @property
    def agrees(self) -> bool:
        """Whether the pair bears the two poses out."""
        return (
            self.verified >= _MATCHING.min_inliers
            and self.fitting >= _LEAST_FITTING
            and self.angle_deg >= _LEAST_ANGLE_DEG
        )


def lone_groups(
    localised: Mapping[int, LocalisedPhoto], features_of: FeaturesOf
) -> tuple[list[Model], dict[int, str]]:
    """Groups among localised photos that no reconstruction holds, and for those in none the reason.

    Args:
        localised: the lone photos by row, those of one camera with one lens.

    Returns:
        A model of each group, of its matches alone, with the lenses of the localisations and near their
        poses; its rows are those of the photos.
    """
    if not localised:
        return [], {}
    frame = next(iter(localised.values())).frame
    photos = {r: in_frame(p, frame) for r, p in sorted(localised.items())}
    geometries: dict[tuple[int, int], TwoView] = {}
    for a, b in _candidate_pairs(photos):
        view = _verified(photos[a], photos[b], features_of)
        if _check_pair(photos[a], photos[b], view, features_of).agrees:
            geometries[a, b] = view
    reasons = dict.fromkeys(photos, "ALONE: no other photo bears its pose out")
    groups: list[Model] = []
    group_of = dict(zip(photos, tied_together(list(photos), geometries), strict=True))
    for group in sorted(set(group_of.values())):
        rows = [r for r in photos if group_of[r] == group]
        if len(rows) >= 2:
            own = {pair: view for pair, view in geometries.items() if pair[0] in rows}
            groups.append(_triangulated(rows, photos, own, features_of))
            for r in rows:
                reasons.pop(r)
    return groups, reasons


def _candidate_pairs(photos: Mapping[int, LocalisedPhoto]) -> list[tuple[int, int]]:
    """Pairs that share existing points or look at the same place, most shared first."""
    seen = {
        r: {(p.map_ids[m], q) for m, q in zip(p.map_of.tolist(), p.point_of.tolist(), strict=True)}
        for r, p in photos.items()
    }
    scene = {r: np.median(p.points, axis=0) for r, p in photos.items()}
    reach = {
        r: float(np.median(np.linalg.norm(p.points - p.cam_from_local.center, axis=1)))
        for r, p in photos.items()
    }
    pairs: set[tuple[int, int]] = set()
    for r in photos:
        scores = []
        for other in photos.keys() - {r}:
            shared = len(seen[r] & seen[other])
            gap = float(np.linalg.norm(scene[r] - scene[other]))
            if shared or gap < 0.5 * min(reach[r], reach[other]):
                scores.append((-shared, gap, other))
        pairs |= {(min(r, other), max(r, other)) for _, _, other in sorted(scores)[:_PARTNERS]}
    return sorted(pairs)


def _verified(a: LocalisedPhoto, b: LocalisedPhoto, features_of: FeaturesOf) -> TwoView:
    """Two-view geometry of the pair; the lenses are those of the localisations, no pose takes part."""
    one, two = features_of(a.row).features, features_of(b.row).features
    matches = mutual_matches(one.descriptors[:_MOST_FEATURES], two.descriptors[:_MOST_FEATURES], _MATCHING)
    return verify_pair(
        a.camera,
        one.xy,
        b.camera,
        two.xy,
        matches,
        focal_known=True,
        max_error_px=_MATCHING.max_error_px * pixel_scale(a.camera, b.camera),
        seed=_MATCHING.seed,
    )


def _check_pair(a: LocalisedPhoto, b: LocalisedPhoto, view: TwoView, features_of: FeaturesOf) -> PairCheck:
    """How far a pair's verified matches fit the two localised poses, both in one frame."""
    pixels_a = features_of(a.row).features.xy[view.inliers[:, 0]].astype(np.float64)
    pixels_b = features_of(b.row).features.xy[view.inliers[:, 1]].astype(np.float64)
    if not len(pixels_a):
        return PairCheck(verified=0, fitting=0.0, angle_deg=0.0)
    points, angle = intersections(a.camera, a.cam_from_local, pixels_a, b.camera, b.cam_from_local, pixels_b)
    fits = np.ones(len(points), dtype=np.bool_)
    for photo, pixels in ((a, pixels_a), (b, pixels_b)):
        error = np.linalg.norm(photo.camera.project(photo.cam_from_local.act(points)) - pixels, axis=1)
        fits &= np.nan_to_num(error, nan=np.inf) < TOLERANCE_PX * pixel_scale(photo.camera)
    return PairCheck(
        verified=len(points),
        fitting=float(fits.mean()),
        angle_deg=float(np.median(np.degrees(angle[fits]))) if fits.any() else 0.0,
    )


def intersections(
    camera_a: Camera,
    pose_a: Rigid3,
    pixels_a: FloatArray,
    camera_b: Camera,
    pose_b: Rigid3,
    pixels_b: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Midpoints (m, 3) of the shortest lines between the rays of pixel pairs, and the rays' angles (rad)."""
    ray_a, ray_b = _rays(camera_a, pose_a, pixels_a), _rays(camera_b, pose_b, pixels_b)
    base = pose_b.center - pose_a.center
    cosine = np.einsum("mi,mi->m", ray_a, ray_b)
    sine2 = np.maximum(1.0 - cosine**2, 1e-12)
    along_a, along_b = ray_a @ base, ray_b @ base
    depth_a = (along_a - cosine * along_b) / sine2
    depth_b = (cosine * along_a - along_b) / sine2
    middle = 0.5 * (pose_a.center + depth_a[:, None] * ray_a + pose_b.center + depth_b[:, None] * ray_b)
    return middle, np.arccos(np.clip(cosine, -1.0, 1.0))


def _rays(camera: Camera, pose: Rigid3, pixels: FloatArray) -> FloatArray:
    """Unit vectors (m, 3) in the local frame; along the axis for pixels that the lens cannot reach."""
    xy = np.nan_to_num(camera.unproject(pixels))
    rays = np.column_stack([xy, np.ones(len(xy))]) @ pose.rotation
    return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))


def _triangulated(
    rows: Sequence[int],
    photos: Mapping[int, LocalisedPhoto],
    geometries: Mapping[tuple[int, int], TwoView],
    features_of: FeaturesOf,
) -> Model:
    """A model of the group from its verified matches; rows are those of the photos.

    The localisations' poses are the start; then the model is adjusted to its matches alone, in a gauge of its
    own. Whether it still fits the localisations is asked when it is placed, as of any reconstruction.
    """
    place = {r: k for k, r in enumerate(rows)}
    cameras = list(dict.fromkeys(photos[r].camera for r in rows))
    sfm = [
        SfmPhoto(
            name=str(r), camera_row=cameras.index(photos[r].camera), keypoints=features_of(r).features.xy
        )
        for r in rows
    ]
    model = triangulate_posed(
        cameras,
        sfm,
        [photos[r].cam_from_local for r in rows],
        {(place[a], place[b]): view for (a, b), view in geometries.items()},
    )
    keypoints = [sfm[int(k)].keypoints.astype(np.float64) for k in model.rows]
    lenses = Lenses(held=range(len(model.cameras)))
    free = adjust_anchored(model, keypoints, FixedPoints.none(), lenses, AnchoredOptions()).model
    return replace(free, rows=np.array([rows[int(k)] for k in model.rows], dtype=np.int64))
