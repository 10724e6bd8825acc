"""Where a person's help puts frames of a map, and with them a map that has no place yet."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np

from featuredb.errors import InvalidValueError, RegistrationError
from featuredb.geo.local_frame import LocalFrame
from featuredb.geo.words import way_words
from featuredb.geometry.camera import Camera
from featuredb.lidar.load import chosen_scans, load_cloud
from featuredb.maps.feature_map import FeatureMap, MapImage
from featuredb.maps.subset import only_images
from featuredb.maps.unplaced_map import AnyMap, UnplacedMap
from featuredb.render.cloud import PointCloud
from featuredb.store import Database
from featuredb.store.scans import ScanSummary
from ingest.register.anchor.files import PhotoFiles
from ingest.register.anchor.ground.place import place_on_outlines
from ingest.register.anchor.ground.street_plan import looks_level
from ingest.register.anchor.start.from_above import found_from_above
from ingest.register.anchor.start.from_ortho import found_by_ortho
from ingest.register.anchor.start.picks import Picks, focal_sigma_rel, pose_from_picks, read_picks
from ingest.register.anchor.start.priors import RoughPose, image_named, place_by_photo, placed_on, read_pose
from ingest.register.frame_registration import FramePrior

# Scan around a map's points and cameras that may be seen, metres: errors of GPS, and what frames show beside
# the map's points.
MARGIN_M = 60.0
_MOST_LAT, _MOST_LON = 84.0, 180.0  # UTM ends there
_LEAST_RADIUS_M, _MOST_RADIUS_M = 10.0, 1000.0
_CIRCLE = (
    f"LAT,LON or LAT,LON,RADIUS_M in WGS84 degrees and {_LEAST_RADIUS_M:.0f} to {_MOST_RADIUS_M:.0f} metres, "
    "such as 46.8450,-91.9942,250"
)
_FIRST_REACH_M = 300.0  # scan around the picks of the first photo: what a drone's photo shows


@dataclass(frozen=True, slots=True)
class Circle:
    """Where a map lies, roughly: WGS84 degrees and metres.

    Raises:
        InvalidValueError: no place of a UTM zone, or a radius that is not searched.
    """

    lat: float
    lon: float
    radius_m: float = 250.0

    def __post_init__(self) -> None:
        on_earth = abs(self.lat) <= _MOST_LAT and abs(self.lon) <= _MOST_LON
        if not (on_earth and _LEAST_RADIUS_M <= self.radius_m <= _MOST_RADIUS_M):
            raise InvalidValueError(f"near: expected {_CIRCLE}, found {self}")

    @classmethod
    def parse(cls, text: str) -> Self:
        """`LAT,LON` or `LAT,LON,RADIUS_M`.

        Raises:
            InvalidValueError: it is neither.
        """
        try:
            return cls(*(float(part) for part in text.split(",")))
        except (TypeError, ValueError) as error:
            raise InvalidValueError(f"--near: expected {_CIRCLE}, found {text!r}") from error

    def __str__(self) -> str:
        return f"{self.lat!r},{self.lon!r},{self.radius_m!r}"

    @property
    def middle(self) -> str:
        """For people."""
        return f"{self.lat:.6f}, {self.lon:.6f}"


@dataclass(frozen=True, slots=True, kw_only=True)
class StartFiles:
    """Files by which a person helps, and the photo that they speak of where they do not say it.

    Attributes:
        near: instead of files: where the map is looked for.

    Raises:
        InvalidValueError: near, and files besides.
    """

    pose: Path | None = None
    picks: Path | None = None
    image: str | None = None
    near: Circle | None = None

    def __post_init__(self) -> None:
        if self.near is not None and (self.pose or self.picks):
            raise InvalidValueError("expected near, or pose and picks, found both")

    def __bool__(self) -> bool:
        """Whether a person says where the map is."""
        return any(said is not None for said in (self.pose, self.picks, self.near))

    def words(self) -> list[str]:
        """As arguments of the command; with an equals sign, since latitudes may be negative."""
        named = (("pose", self.pose), ("picks", self.picks), ("image", self.image), ("near", self.near))
        return [f"--{option}={value}" for option, value in named if value is not None]

    def read(self) -> list[RoughPose | Picks]:
        """What they say of single photos.

        Raises:
            RegistrationError: they cannot be read.
        """
        rough = [] if self.pose is None else [read_pose(self.pose, self.image)]
        return [*rough, *([] if self.picks is None else read_picks(self.picks, self.image))]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StartedImage:
    """A photo that a person has put somewhere: prior, the lens that goes with it, a line for people."""

    image: MapImage
    prior: FramePrior
    camera: Camera
    note: str


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FirstPlace:
    """A map without a place, put where a person's first photo says, or where it was found.

    Attributes:
        feature_map: the map there; a start, not a placement. cloud: the scan around it, in its frame.
        starts: priors of the person's photos by image id. notes: a line on each, or on how it was found.
        by_look: it was put where its picture from above is most like the scan's, which chance may be.
        on_outlines: it was placed by what street photos and the scan have in common; its frames need none.
    """

    feature_map: FeatureMap
    cloud: PointCloud
    scan_ids: tuple[str, ...]
    starts: Mapping[int, FramePrior]
    notes: tuple[str, ...]
    by_look: bool = False
    on_outlines: bool = False


def started_images(
    feature_map: AnyMap, told: Sequence[RoughPose | Picks], frame: LocalFrame, epsg: int
) -> list[StartedImage]:
    """The photos that a person has put somewhere.

    Args:
        told: by `StartFiles.read`, in the zone `epsg`. frame: of the priors.

    Raises:
        RegistrationError: no such photo, or picks do not determine a pose.
    """
    upright = not isinstance(feature_map, UnplacedMap) or feature_map.frame.upright
    started = []
    for one in told:
        image = image_named(feature_map, str(one.image))
        camera = feature_map.cameras[image.camera_id]
        if isinstance(one, Picks):
            points, present = frame.enu_from_utm(one.utm, epsg), image.cam_from_local if upright else None
            prior, fit = pose_from_picks(one, points, camera, present, focal_sigma_rel(feature_map, image))
            camera, residual_px = fit.camera, float(np.median(fit.distances_px[fit.believed]))
            note = f"{image.name} starts from {len(one.pixels)} picks, median residual {residual_px:.1f} px"
            if fit.wrong:
                note += f"; they contradict the others: line {', '.join(str(i + 1) for i in fit.wrong)}"
        else:
            prior, note = one.prior(frame, epsg), f"{image.name} starts from the pose given for it"
        started.append(StartedImage(image=image, prior=prior, camera=camera, note=note))
    return started


def check_on_scan(told: Sequence[RoughPose | Picks], cloud: PointCloud, epsg: int) -> None:
    """
    Args:
        told: by `StartFiles.read`, in the zone `epsg`. cloud: the scan around the map.

    Raises:
        RegistrationError: a pose or picks so far outside of the scan that no photo of a drone shows both.
    """
    low, high = cloud.xyz[:, :2].min(axis=0), cloud.xyz[:, :2].max(axis=0)
    for one in told:
        xy = np.median(np.atleast_2d(cloud.frame.enu_from_utm(one.utm, epsg))[:, :2], axis=0)
        way = xy - np.clip(xy, low, high)
        if np.hypot(*way) > _FIRST_REACH_M:
            what = "picks" if isinstance(one, Picks) else "pose"
            raise RegistrationError(
                f"{what} of {one.image}: expected a place on the scan around the map, found one that lies "
                f"{way_words(*way.tolist())} of it; check easting, northing and their zone, EPSG:{epsg}"
            )


def first_place(
    database: Database, unplaced: UnplacedMap, files: StartFiles, scan_ids: Sequence[str], photos: PhotoFiles
) -> FirstPlace:
    """Put a map without a place where a person's photo says, or where it is found near, on the scans.

    Args:
        photos: of the map, for the picture that they make from above.

    Raises:
        RegistrationError: nothing says where, the photo does not see the scan from there, or the map is not
            found.
        ScanNotFoundError: the database has no scan, or not the one that is meant.
    """
    if not files:
        raise RegistrationError(
            f"map {unplaced.map_id} has no place ({unplaced.no_place.reason}); say where it is: "
            "--near=LAT,LON (looks for it within 250 m), --page (click the same spots in photo and scan), "
            "--picks FILE or --pose FILE"
        )
    scans = scans_of_one_zone(database, scan_ids)
    ids, epsg = tuple(scan.scan_id for scan in scans), scans[0].epsg
    started: list[StartedImage] = []
    by_look, on_outlines = False, files.near is not None and looks_level(unplaced)
    if files.near is not None:
        frame = LocalFrame(latitude_deg=files.near.lat, longitude_deg=files.near.lon, height_m=0.0)
        where = f"{files.near.middle}; `featuredb lidar list` tells where scans lie"
        cloud = _cloud_within(database, frame, (0.0, 0.0), files.near.radius_m, ids, where)
        if on_outlines:
            feature_map, note = _on_outlines(unplaced, files.near, cloud)
        else:
            feature_map, note, by_look = _found_near(unplaced, files.near, cloud, ids, photos)
        notes: tuple[str, ...] = (note,)
    else:
        told = files.read()
        east, north, up = np.median(np.vstack([one.utm for one in told]), axis=0).tolist()
        frame = LocalFrame.from_utm(east, north, up, epsg)
        started = started_images(unplaced, told, frame, epsg)
        first = started[0]
        x, y, _ = first.prior.cam_from_local.center.tolist()
        cloud = _cloud_within(database, frame, (x, y), _FIRST_REACH_M, ids, "where the photo is put")
        feature_map = place_by_photo(unplaced, first.image, first.camera, first.prior, cloud)
        notes = tuple(s.note for s in started)
    return FirstPlace(
        feature_map=feature_map,
        cloud=load_cloud(database, feature_map.frame, plan_box(feature_map), scan_ids=ids),
        scan_ids=ids,
        starts={s.image.image_id: s.prior for s in started},
        notes=notes,
        by_look=by_look,
        on_outlines=on_outlines,
    )


def _cloud_within(
    database: Database,
    frame: LocalFrame,
    xy: tuple[float, float],
    reach: float,
    ids: tuple[str, ...],
    where: str,
) -> PointCloud:
    """The scans within metres of a place, of which there must be some; `where` says for people where."""
    x, y = xy
    cloud = load_cloud(database, frame, (x - reach, y - reach, x + reach, y + reach), scan_ids=ids)
    if not len(cloud):
        raise RegistrationError(f"no scan of {database.url} lies within {reach:.0f} m of {where}")
    return cloud


def _on_outlines(unplaced: UnplacedMap, near: Circle, cloud: PointCloud) -> tuple[FeatureMap, str]:
    """The street photos that lie where fronts and the scan's outlines agree, with a line."""
    found = place_on_outlines(unplaced, cloud)
    if found.local_from_own is None or found.covariance is None or found.reason is not None:
        raise RegistrationError(
            f"map {unplaced.map_id}, of photos from the street, is not found within {near.radius_m:.0f} m of "
            f"{near.middle} by the fronts that it shows: {found.reason}: {found.message}. A "
            "smaller radius has fewer places that look alike (--near=LAT,LON,RADIUS_M); or say where a photo "
            "is: --page, --picks FILE, --pose FILE"
        )
    evidence = {"outlines": {"near": str(near), "words": found.message, **found.figures}}
    kept, sim = only_images(unplaced, found.image_ids), found.local_from_own
    placed = placed_on(kept, cloud, sim, found.covariance, evidence, found.residual_rms_m)
    return placed, f"placed by outlines: {found.message}"


def _found_near(
    unplaced: UnplacedMap, near: Circle, cloud: PointCloud, scan_ids: tuple[str, ...], photos: PhotoFiles
) -> tuple[FeatureMap, str, bool]:
    """The map where the scans near a place show the same, a line on it, and whether it was only its look."""
    if cloud.rgb is None and cloud.intensity is None:
        raise RegistrationError(
            f"scan {', '.join(scan_ids)} has neither colours nor intensities, and nothing is looked for by "
            "heights alone; say where one photo is: --page, --picks FILE, --pose FILE"
        )
    by_features = found_from_above(unplaced, cloud)
    by_look = by_features is None or not by_features.sure
    found = found_by_ortho(unplaced, cloud, photos) if by_look else by_features
    if found is None:
        words = "nothing of it matches the scan"
        if by_features is not None:
            words = f"{by_features.words}, which chance gives, too"
        raise RegistrationError(
            f"map {unplaced.map_id} is not found within {near.radius_m:.0f} m of {near.middle}: "
            f"{words}. A smaller radius shows the scan finer (--near=LAT,LON,RADIUS_M), colours show "
            "more than intensities; or say where one photo is: --page, --picks FILE, --pose FILE"
        )
    evidence = {"start": {"near": str(near), "no_place": unplaced.no_place.reason_code}}
    note = f"{'tried' if by_look else 'found'} near {near.middle}: {found.words}"
    if by_look:
        note += (
            "; if no photo is registered from there, name a smaller circle (--near=LAT,LON,RADIUS_M), or say "
            "where one photo is: --page, --picks FILE, --pose FILE"
        )
    return placed_on(unplaced, cloud, found.local_from_own, found.covariance, evidence), note, by_look


def scans_of_one_zone(database: Database, scan_ids: Sequence[str]) -> list[ScanSummary]:
    """The scans of these ids or their first letters, or all, which must be of one zone.

    Raises:
        ScanNotFoundError: there is none, or letters do not say which.
        RegistrationError: they are of several zones.
    """
    scans = chosen_scans(database, scan_ids or None)
    if len({scan.epsg for scan in scans}) > 1:
        raise RegistrationError(
            "the scans are of several UTM zones, and nothing says in which the map lies; name one by --scan"
        )
    return scans


def plan_box(feature_map: FeatureMap) -> tuple[float, float, float, float]:
    """Plan box in the map's frame around its points and cameras."""
    centers = np.array([image.cam_from_local.center for image in feature_map.images])
    points = feature_map.points_local()
    # A few wild points must not ask for a whole county.
    inner = np.percentile(points[:, :2], (1, 99), axis=0)
    both = np.vstack([inner, centers[:, :2]])
    low, high = both.min(axis=0) - MARGIN_M, both.max(axis=0) + MARGIN_M
    return float(low[0]), float(low[1]), float(high[0]), float(high[1])
