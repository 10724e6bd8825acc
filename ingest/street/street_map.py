"""A map of street-level views: what a photo taken there can be localised against.

Views are drawn around each place where a person can stand (`synthesis`), described by the extractor of all
maps, and keypoints that show one place of the scan in several views become a point, as tracks do. The result
is an ordinary map, placed by the one whose photos were drawn.
"""

import hashlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from featuredb.errors import InvalidValueError, RegistrationError
from featuredb.features.extractor import ExtractorOptions, extract
from featuredb.features.features import Features
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.sim3 import Sim3
from featuredb.maps.feature_map import FeatureMap, MapImage, MapObservations, MapPoints, Placement
from featuredb.maps.lineage import GROWTH
from featuredb.render.cloud import PointCloud
from ingest.growth.map_graph import StoredEdge, drift_m, growth_of, place_of, places_of
from ingest.street.stand import StandOptions, standing_places, views_around
from ingest.street.synthesis import (
    SourcePhoto,
    SynthesisedView,
    SynthesisOptions,
    source_photo,
    surfaces_of_scan,
    synthesise,
)

_PER_KEYPOINT = ("xy", "scale", "angle", "descriptors")


@dataclass(frozen=True, slots=True, kw_only=True)
class StreetOptions:
    """How the map is made.

    Attributes:
        width_px, height_px, focal_px: of the views: 75 degrees wide, and at 15 m as fine as an aerial photo
            of 3 cm per pixel, which has no more to show.
        extractor: fingerprint as that of the aerial map, else its queries could not be asked here.
        rim_scales: a keypoint needs so many of its diameters of drawn surface around it: a descriptor reaches
            about as far, and what is not drawn is no feature.
        max_step: depth around a keypoint (3 x 3 pixels) may vary by this share; beyond is a silhouette, which
            shows another place from the next view.
        same_place_m: keypoints of different views this near, and
        same_size: whose sizes on the surface differ by less than this factor, and
        max_angle_rad: whose descriptors differ by no more (COLMAP's 0.7), show one place.
        min_views: of a point; what one view alone shows may be an artefact of its drawing.
        sigma_m: standard deviation of a point on each axis, at least, and of what all share: scan, aerial
            poses and drawing. turn_sigma: of what all share in rotation (radians) and scale.
    """

    width_px: int = 640
    height_px: int = 480
    focal_px: float = 417.0
    extractor: ExtractorOptions = field(default_factory=lambda: ExtractorOptions(max_features=2000))
    rim_scales: float = 1.0
    max_step: float = 0.05
    same_place_m: float = 0.15
    same_size: float = 1.5
    max_angle_rad: float = 0.7
    min_views: int = 2
    sigma_m: float = 0.06
    turn_sigma: float = 3e-4
    stand: StandOptions = field(default_factory=StandOptions)
    synthesis: SynthesisOptions = field(default_factory=SynthesisOptions)

    @property
    def camera(self) -> Camera:
        return Camera(
            model="PINHOLE",
            width=self.width_px,
            height=self.height_px,
            params=(self.focal_px, self.focal_px, 0.5 * self.width_px, 0.5 * self.height_px),
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Described:
    """Keypoints of one view with the places that they show (n, 3) and their sizes there (n,), metres."""

    view: SynthesisedView
    features: Features
    places: FloatArray
    sizes: FloatArray


def street_map(
    aerial: FeatureMap,
    cloud: PointCloud,
    gray_of: Callable[[MapImage], NDArray[np.uint8]],
    options: StreetOptions | None = None,
) -> FeatureMap:
    """Views at street level around the points of an anchored map, as a map of its own, quarantined.

    Args:
        aerial: placed on the scan; its photos are drawn.
        cloud: the scan around it, in the map's frame.
        gray_of: pixels (h, w) uint8 of the map's photos.

    Raises:
        RegistrationError: the scan has no ground class, or no view shows enough.
        InvalidValueError: the options' extractor is not that of the map.
        MissingExtraError: numba is not installed.
    """
    options = options or StreetOptions()
    if options.extractor.fingerprint != aerial.extractor_fingerprint:
        raise InvalidValueError(
            f"street views: expected the extractor of the map, {aerial.extractor_fingerprint}, found "
            f"{options.extractor.fingerprint}"
        )
    low, high = np.percentile(aerial.points_local()[:, :2], (2, 98), axis=0)
    return street_map_at(aerial, cloud, gray_of, standing_places(cloud, low, high, options.stand), options)


def street_map_at(
    aerial: FeatureMap,
    cloud: PointCloud,
    gray_of: Callable[[MapImage], NDArray[np.uint8]],
    places: FloatArray,
    options: StreetOptions,
) -> FeatureMap:
    """`street_map` of views around given eye positions (n, 3), local frame of the map."""
    sources = [
        source_photo(cloud, gray_of(image), aerial.cameras[image.camera_id], image.cam_from_local)
        for image in aerial.images
    ]
    described = [d for d in street_views(cloud, places, sources, options) if len(d.features)]
    return _assembled(aerial, described, options)


def street_views(
    cloud: PointCloud, places: FloatArray, sources: Sequence[SourcePhoto], options: StreetOptions
) -> Iterator[_Described]:
    """The views around the places (n, 3), one after the other."""
    surfaces = surfaces_of_scan(cloud)
    for place in places:
        for pose in views_around(place, options.stand):
            yield _described(synthesise(surfaces, options.camera, pose, sources, options.synthesis), options)


def _described(view: SynthesisedView, options: StreetOptions) -> _Described:
    """Keypoints that lie within what is drawn, away from silhouettes."""
    features = extract(view.gray, options.extractor)
    pixel = np.clip(features.xy.astype(np.int64), 0, [view.camera.width - 1, view.camera.height - 1])
    rim = cv2.distanceTransform(view.drawn.astype(np.uint8), cv2.DIST_L2, 3)
    depth = view.cam_from_local.act(view.points.reshape(-1, 3))[:, 2].reshape(view.drawn.shape)
    filled = np.nan_to_num(depth, nan=1e9).astype(np.float32)
    box = np.ones((3, 3), np.uint8)
    step = cv2.dilate(filled, box) / np.maximum(cv2.erode(filled, box), 1e-6) - 1.0
    at = pixel[:, 1], pixel[:, 0]
    good = (rim[at] > options.rim_scales * features.scale) & (step[at] < options.max_step)
    features, at = features.take(good), (at[0][good], at[1][good])
    return _Described(
        view=view,
        features=features,
        places=view.points[at],
        sizes=features.scale * depth[at] / view.camera.focal_px,
    )


def tracks(views: Sequence[_Described], options: StreetOptions) -> NDArray[np.int64]:
    """Number of the point of each keypoint of all views, -1 where too few views show it."""
    places = np.concatenate([v.places for v in views])
    sizes = np.concatenate([v.sizes for v in views])
    descriptors = np.concatenate([v.features.descriptors for v in views]).astype(np.float32)
    view_of = np.repeat(np.arange(len(views)), [len(v.features) for v in views])
    pairs = cKDTree(places).query_pairs(options.same_place_m, output_type="ndarray")
    a, b = pairs.T
    near = (view_of[a] != view_of[b]) & (np.abs(np.log(sizes[a] / sizes[b])) < np.log(options.same_size))
    a, b = a[near], b[near]
    angle = 2.0 * np.arcsin(
        np.clip(np.linalg.norm(descriptors[a] - descriptors[b], axis=1) / 1024.0, 0.0, 1.0)
    )
    a, b = a[angle < options.max_angle_rad], b[angle < options.max_angle_rad]
    graph = coo_array((np.ones(len(a)), (a, b)), shape=(len(places), len(places)))
    count, label = connected_components(graph, directed=False)
    # A view may show a place twice, at two orientations; that is one view.
    seen = np.unique(np.stack([label, view_of]), axis=1)
    views_of = np.bincount(seen[0], minlength=count)
    number = np.cumsum(views_of >= options.min_views) - 1
    return np.where(views_of[label] >= options.min_views, number[label], -1).astype(np.int64)


def _assembled(aerial: FeatureMap, views: Sequence[_Described], options: StreetOptions) -> FeatureMap:
    number = tracks(views, options) if views else np.zeros(0, np.int64)
    if not (number >= 0).any():
        raise RegistrationError(
            "street views: no place is seen in two views; do the map's photos look at walls (oblique), and "
            "does the scan cover the map?"
        )
    kept = number >= 0
    point = number[kept]
    n = int(point.max()) + 1
    length = np.bincount(point, minlength=n)
    places = np.concatenate([v.places for v in views])[kept]
    mean = np.stack([np.bincount(point, weights=c, minlength=n) / length for c in places.T], axis=1)
    variance = np.stack(
        [np.bincount(point, weights=c, minlength=n) / length for c in ((places - mean[point]) ** 2).T], axis=1
    )
    covariance = np.zeros((n, 6), np.float32)
    covariance[:, [0, 3, 5]] = variance + options.sigma_m**2
    view_of = np.repeat(np.arange(len(views)), [len(v.features) for v in views])[kept]
    columns = {k: np.concatenate([getattr(v.features, k) for v in views])[kept] for k in _PER_KEYPOINT}
    images = tuple(_image(k, view.view) for k, view in enumerate(views))
    digest = hashlib.sha256("".join([aerial.map_id, *(i.sha256 for i in images)]).encode()).hexdigest()
    return FeatureMap(
        map_id=f"{digest[:24]}-street",
        name=f"{aerial.name}, street views",
        epsg=aerial.epsg,
        height_datum=aerial.height_datum,
        frame=aerial.frame,
        cameras=(options.camera,),
        camera_keys=("",),
        images=images,
        points=MapPoints(
            utm=aerial.frame.utm_from_enu(mean, aerial.epsg),
            rgb=np.full((n, 3), 128, np.uint8),
            track_length=length.astype(np.int32),
            error_px=np.zeros(n, np.float32),
            covariance=covariance,
        ),
        observations=MapObservations(
            point_index=point,
            image_id=view_of.astype(np.int32),
            has_descriptor=np.ones(len(point), np.bool_),
            **columns,
        ),
        placement=_placement(aerial, len(views), options),
        extractor_fingerprint=aerial.extractor_fingerprint,
        status="quarantined",
        generation=aerial.generation + 1,
        parents=(aerial.map_id,),
        source=aerial.source,
        licence=aerial.licence,
        provenance={"street_views_of": aerial.map_id},
    )


def _placement(aerial: FeatureMap, views: int, options: StreetOptions) -> Placement:
    """That of the aerial map, and what drawing adds, which all points share."""
    sigmas = np.array([options.turn_sigma] * 4 + [options.sigma_m] * 3)
    own = np.diag(sigmas**2)
    edge = StoredEdge(
        map_id=aerial.map_id,
        place=place_of(aerial),
        other_from_map=Sim3.identity(),
        covariance=own,
        shared_points=0,
        photos=len(aerial.images),
    )
    growth = growth_of(aerial.placement.evidence)
    relative = own + np.reshape(growth.get("covariance_relative", np.zeros(49)), (7, 7))
    return Placement(
        method="map",
        local_from_sfm=Sim3.identity(),
        covariance=aerial.placement.covariance + own,
        residual_rms_m=aerial.placement.residual_rms_m,
        evidence={
            "street": {"views": views, "photos": len(aerial.images)},
            GROWTH: {
                "edges": [edge.as_json()],
                "covariance_relative": relative.ravel().tolist(),
                "drift_m": drift_m(relative, places_of(aerial)),
            },
        },
    )


def _image(number: int, view: SynthesisedView) -> MapImage:
    return MapImage(
        image_id=number,
        name=f"street/{number:06d}",
        sha256=hashlib.sha256(view.gray.tobytes()).hexdigest(),
        camera_id=0,
        cam_from_local=view.cam_from_local,
    )
