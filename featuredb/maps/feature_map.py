"""A feature map with a place: a sparse reconstruction, placed on Earth, with descriptors.

A reconstruction whose place nobody knows yet is an `UnplacedMap` (featuredb/maps/unplaced_map.py).

One map has one UTM zone and one local east-north-up frame. Poses and covariances are held in the
local frame, points in UTM, as they are stored; `featuredb.geo.LocalFrame` goes between the two.
"""

from dataclasses import dataclass, field, fields, replace
from datetime import datetime
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from featuredb.errors import InvalidValueError
from featuredb.features.exif.read import ExifInfo
from featuredb.geo.checks import check_place
from featuredb.geo.datum import check_datum
from featuredb.geo.local_frame import LocalFrame
from featuredb.geo.utm import zone_of
from featuredb.geometry.arrays import FloatArray, freeze, frozen_array
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.sim3 import Sim3
from featuredb.maps.lineage import GROWTH
from featuredb.maps.statuses import MAP_METHODS as MAP_METHODS
from featuredb.maps.statuses import MAP_STATUSES as MAP_STATUSES
from featuredb.maps.statuses import MapMethod as MapMethod
from featuredb.maps.statuses import MapStatus as MapStatus


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class GeoPrior:
    """Where the photo says it was taken.

    Attributes:
        latitude_deg, longitude_deg: WGS84 degrees.
        height_m: metres in the photo's own datum (rarely a known one), or None.
        sigma_horizontal_m, sigma_vertical_m: one standard deviation, metres.
    """

    latitude_deg: float
    longitude_deg: float
    height_m: float | None
    sigma_horizontal_m: float
    sigma_vertical_m: float

    def __post_init__(self) -> None:
        check_place("GeoPrior", self.latitude_deg, self.longitude_deg)
        if self.height_m is not None and not np.isfinite(self.height_m):
            raise InvalidValueError(
                f"GeoPrior.height_m: expected a finite number or None, found {self.height_m}"
            )
        if not (0 < self.sigma_horizontal_m < np.inf and 0 < self.sigma_vertical_m < np.inf):
            raise InvalidValueError(
                "GeoPrior: expected finite standard deviations > 0 m, "
                f"found {self.sigma_horizontal_m}, {self.sigma_vertical_m}"
            )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MapImage:
    """One registered image of a map.

    Attributes:
        image_id: number within the map, unique, from 0.
        name: path within the ingested folder, with forward slashes.
        sha256: hex digest of the file's bytes.
        camera_id: index into FeatureMap.cameras.
        cam_from_local: pose, local ENU frame of the map to camera (x right, y down, z forward), metres.
        covariance: (6, 6) of cam_from_local's left perturbation, relative to the map's placement, or None.
        capture_time: as the photo says, timezone-aware where it says so, or None.
        owner, licence: attribution, "" where unknown.
    """

    image_id: int
    name: str
    sha256: str
    camera_id: int
    cam_from_local: Rigid3
    covariance: FloatArray | None = None
    capture_time: datetime | None = None
    gps: GeoPrior | None = None
    owner: str = ""
    licence: str = ""

    def __post_init__(self) -> None:
        if self.covariance is not None:
            object.__setattr__(self, "covariance", _covariance("MapImage.covariance", self.covariance, 6))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PointColumns:
    """What is known of 3D points besides their coordinates; see `MapPoints` and `OwnPoints`.

    Attributes:
        rgb: (n, 3) uint8.
        track_length: (n,) int32, number of images that see the point.
        error_px: (n,) float32, mean reprojection error in full-size pixels.
        covariance: (n, 6) float32, upper triangle (xx, xy, xz, yy, yz, zz) of the covariance along the axes
            of the map's frame, square units of it, relative to the map's gauge.
    """

    rgb: NDArray[np.uint8]
    track_length: NDArray[np.int32]
    error_px: NDArray[np.float32]
    covariance: NDArray[np.float32]

    coordinates: ClassVar[str]
    """Name of the field with the (n, 3) coordinates, which decides how many points there are."""

    def __post_init__(self) -> None:
        freeze(self, **{self.coordinates: (None, 3)})
        n = len(self)
        freeze(self, np.uint8, rgb=(n, 3))
        freeze(self, np.int32, track_length=(n,))
        freeze(self, np.float32, error_px=(n,), covariance=(n, 6))

    def __len__(self) -> int:
        return len(getattr(self, self.coordinates))

    def take(self, rows: NDArray[np.bool_] | NDArray[np.int64]) -> Self:
        """Some rows, by a mask (n,) or their numbers."""
        coordinates = {self.coordinates: getattr(self, self.coordinates)[rows]}
        return replace(self, **coordinates, **self.columns(rows))

    def columns(self, rows: NDArray[np.bool_] | NDArray[np.int64]) -> dict[str, Any]:
        """Some rows of each column but the coordinates, by name."""
        return {f.name: getattr(self, f.name)[rows] for f in fields(PointColumns)}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MapPoints(PointColumns):
    """The 3D points of a map with a place.

    Attributes:
        utm: (n, 3) float64 easting, northing, height in metres; EPSG code and datum are the map's.
        covariance: as in PointColumns: (ee, en, eu, nn, nu, uu) in the map's local frame, square metres.
    """

    coordinates = "utm"
    utm: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MapObservations:
    """Keypoints that see the map's points. Only tracks long enough carry descriptors.

    Attributes:
        point_index: (m,) int64, row in MapPoints.
        image_id: (m,) int32.
        xy: (m, 2) float32, full-size pixels, top-left pixel centre at (0.5, 0.5).
        scale, angle: (m,) float32, as in Features.
        has_descriptor: (m,) bool.
        descriptors: (m, 128) uint8 RootSIFT; zeros where has_descriptor is false.
    """

    point_index: NDArray[np.int64]
    image_id: NDArray[np.int32]
    xy: NDArray[np.float32]
    scale: NDArray[np.float32]
    angle: NDArray[np.float32]
    has_descriptor: NDArray[np.bool_]
    descriptors: NDArray[np.uint8]

    def __post_init__(self) -> None:
        freeze(self, np.int64, point_index=(None,))
        m = len(self.point_index)
        freeze(self, np.int32, image_id=(m,))
        freeze(self, np.float32, xy=(m, 2), scale=(m,), angle=(m,))
        freeze(self, np.bool_, has_descriptor=(m,))
        freeze(self, np.uint8, descriptors=(m, 128))

    def __len__(self) -> int:
        return len(self.point_index)

    def take(self, rows: NDArray[np.bool_] | NDArray[np.int64]) -> "MapObservations":
        """Some rows, by a mask (m,) or their numbers; `point_index` names the same points as before."""
        return MapObservations(**{f.name: getattr(self, f.name)[rows] for f in fields(self)})

    def none(self) -> "MapObservations":
        """No observations."""
        return self.take(np.zeros(0, np.int64))  # no view of the others


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Placement:
    """How the map came to its place on Earth.

    Attributes:
        method: gps, lidar, gcp or map (placed by other maps).
        local_from_sfm: the similarity that placed the reconstruction in the local frame.
        covariance: (7, 7) of its left perturbation (sigma, omega, nu), local frame: the map's own
            uncertainty on Earth, shared by all its points.
        residual_rms_m: root mean square of what the placement could not explain, metres.
        evidence: figures behind the decision (counts, residuals, gates), JSON-able.
    """

    method: MapMethod
    local_from_sfm: Sim3
    covariance: FloatArray
    residual_rms_m: float
    evidence: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.method not in MAP_METHODS:
            raise InvalidValueError(f"Placement.method: expected one of {MAP_METHODS}, found {self.method!r}")
        if not 0 <= self.residual_rms_m < np.inf:
            raise InvalidValueError(
                f"Placement.residual_rms_m: expected a finite number >= 0, found {self.residual_rms_m}"
            )
        object.__setattr__(self, "covariance", _covariance("Placement.covariance", self.covariance, 7))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MapParts:
    """What maps with and without a place have in common.

    Attributes:
        map_id: unique in the database; ingest derives it from the photos and options, so that the same
            job gives the same map.
        cameras: intrinsics; images name them by index.
        extractor_fingerprint: of all descriptors.
        status: one of `statuses`.
        camera_keys: for each camera the EXIF key (make, model, size, focal, saved anew) that a query may
            share, "" where the camera belongs to one image only; same length as cameras, or empty.
        parents: map ids that placed this one.
        provenance: options and versions that made it, JSON-able.

    Raises:
        InvalidValueError: parts that contradict each other, or an unknown status.
    """

    statuses: ClassVar[tuple[str, ...]]

    map_id: str
    name: str
    cameras: tuple[Camera, ...]
    images: tuple[MapImage, ...]
    points: PointColumns
    observations: MapObservations
    extractor_fingerprint: str
    status: str
    camera_keys: tuple[str, ...] = ()
    parents: tuple[str, ...] = ()
    source: str = ""
    licence: str = ""
    provenance: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        where = f"{type(self).__name__} {self.map_id}"
        if not self.map_id:
            raise InvalidValueError(f"{type(self).__name__}: expected a map_id, found an empty one")
        if self.status not in self.statuses:
            raise InvalidValueError(f"{where}: expected a status of {self.statuses}, found {self.status!r}")
        if self.camera_keys and len(self.camera_keys) != len(self.cameras):
            raise InvalidValueError(
                f"{where}: expected as many camera keys as cameras ({len(self.cameras)}) or none, "
                f"found {len(self.camera_keys)}"
            )
        ids = [image.image_id for image in self.images]
        if len(set(ids)) != len(ids):
            raise InvalidValueError(f"{where}: image ids repeat")
        if any(not 0 <= image.camera_id < len(self.cameras) for image in self.images):
            raise InvalidValueError(f"{where}: an image names a camera that the map does not have")
        observations = self.observations
        if len(observations):
            if observations.point_index.min() < 0 or observations.point_index.max() >= len(self.points):
                raise InvalidValueError(f"{where}: an observation names a point that the map does not have")
            if not np.isin(observations.image_id, np.asarray(ids, dtype=np.int32)).all():
                raise InvalidValueError(f"{where}: an observation names an image that the map does not have")

    def with_status(self, status: str) -> Self:
        return replace(self, status=status)

    def image_rows(self, image_id: NDArray[np.int32]) -> NDArray[np.int64]:
        """Places (k,) in `images` of images with these ids (k,)."""
        ids = np.array([image.image_id for image in self.images], dtype=np.int32)
        by_id = np.argsort(ids)
        return np.asarray(by_id[np.searchsorted(ids[by_id], image_id)], dtype=np.int64)

    def points_in(self, image: MapImage) -> NDArray[np.int64]:
        """Rows (k,) of the points that an image sees, one for each of its observations, in their order."""
        return np.asarray(self.observations.point_index[self.observations.image_id == image.image_id])

    def image_sizes(self) -> FloatArray:
        """Width and height (i, 2) of each image, pixels."""
        cameras = [self.cameras[image.camera_id] for image in self.images]
        return np.array([(c.width, c.height) for c in cameras], dtype=np.float64).reshape(-1, 2)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FeatureMap(MapParts):
    """A geo-registered feature map, complete.

    Attributes:
        epsg: UTM zone of the points, 326zz or 327zz.
        height_datum: vertical datum of all heights, see featuredb.geo.datum.
        frame: the local east-north-up frame of poses and covariances.
        status: quarantined, active or retired; only active maps answer queries.
        generation: 0 for maps placed by GPS, LiDAR or control points; parents' maximum + 1 otherwise.

    Raises:
        InvalidValueError: parts that contradict each other, or an unknown status or datum.
        GeodesyError: `epsg` is no UTM zone.
    """

    statuses = MAP_STATUSES

    epsg: int
    height_datum: str
    frame: LocalFrame
    points: MapPoints
    placement: Placement
    status: MapStatus = "active"
    generation: int = 0

    def __post_init__(self) -> None:
        MapParts.__post_init__(self)
        zone_of(self.epsg)
        check_datum(self.height_datum)

    def points_local(self, frame: LocalFrame | None = None) -> FloatArray:
        """Points (n, 3) in metres in the given local frame (default: the map's own)."""
        return (frame or self.frame).enu_from_utm(self.points.utm, self.epsg)

    def bare(self) -> "FeatureMap":
        """The map without its images, points and observations: what is left is small.

        Of the evidence for its placement, what growth has written is kept: maps beside it need that.
        """
        none = self.points.take(np.zeros(0, np.int64))
        grown = {key: value for key, value in self.placement.evidence.items() if key == GROWTH}
        placement = replace(self.placement, evidence=grown)
        return replace(
            self, images=(), points=none, observations=self.observations.none(), placement=placement
        )


def _covariance(name: str, value: ArrayLike, size: int) -> FloatArray:
    """A read-only (size, size) covariance, after checking that it can be one.

    Eigenvalues are judged against the largest one, since rotations (radians) and positions (metres) differ by
    orders of magnitude and rounding leaves tiny negative ones.
    """
    covariance: FloatArray = frozen_array(name, value, (size, size))
    largest = float(np.abs(covariance).max())
    if np.abs(covariance - covariance.T).max() > 1e-6 * largest:
        raise InvalidValueError(f"{name}: expected a symmetric matrix, found {covariance.tolist()}")
    if np.linalg.eigvalsh(covariance).min() < -1e-6 * largest:
        raise InvalidValueError(f"{name}: expected no negative eigenvalue, found {covariance.tolist()}")
    return covariance


def prior_from_exif(exif: ExifInfo) -> GeoPrior | None:
    """The position with its deviations, or None where the photo has none."""
    if exif.latitude_deg is None or exif.longitude_deg is None:
        return None
    return GeoPrior(
        latitude_deg=exif.latitude_deg,
        longitude_deg=exif.longitude_deg,
        height_m=exif.altitude_m,
        sigma_horizontal_m=exif.sigma_horizontal_m,
        sigma_vertical_m=exif.sigma_vertical_m,
    )
