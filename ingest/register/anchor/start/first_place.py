"""Where a person's help puts frames of a map, and with them a map that has no place yet."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from featuredb.errors import RegistrationError
from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.camera import Camera
from featuredb.lidar.load import load_cloud
from featuredb.maps.feature_map import FeatureMap, MapImage
from featuredb.maps.unplaced_map import AnyMap, UnplacedMap
from featuredb.render.cloud import PointCloud
from featuredb.store import Database
from featuredb.store.scans import ScanSummary, list_scans
from ingest.register.anchor.start.files import RoughPose, read_picks, read_pose
from ingest.register.anchor.start.picks import Picks, focal_sigma_rel, pose_from_picks
from ingest.register.anchor.start.priors import image_named
from ingest.register.frame_registration import FramePrior
from ingest.register.place_map import place_by_photo

# Scan around a map's points and cameras that may be seen, metres: errors of GPS, and what frames show beside
# the map's points.
MARGIN_M = 60.0
_FIRST_REACH_M = 300.0  # scan around the picks of the first photo: what a drone's photo shows


@dataclass(frozen=True, slots=True, kw_only=True)
class StartFiles:
    """Files by which a person helps, and the photo that they speak of where they do not say it."""

    pose: Path | None = None
    picks: Path | None = None
    image: str | None = None

    def words(self) -> list[str]:
        """As arguments of the command."""
        named = (("--pose", self.pose), ("--picks", self.picks), ("--image", self.image))
        return [word for option, value in named if value is not None for word in (option, str(value))]

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
    """A map without a place, put where a person's first photo says.

    Attributes:
        feature_map: the map there; a start, not a placement. cloud: the scan around it, in its frame.
        starts: priors of the person's photos by image id. notes: a line on each.
    """

    feature_map: FeatureMap
    cloud: PointCloud
    scan_ids: tuple[str, ...]
    starts: Mapping[int, FramePrior]
    notes: tuple[str, ...]


def started_images(
    feature_map: AnyMap, told: Sequence[RoughPose | Picks], frame: LocalFrame, epsg: int
) -> list[StartedImage]:
    """The photos that a person has put somewhere.

    Args:
        told: by `StartFiles.read`, in the zone `epsg`. frame: of the priors.

    Raises:
        RegistrationError: no such photo, or picks do not determine a pose.
    """
    return [
        _by_picks(feature_map, one, frame, epsg)
        if isinstance(one, Picks)
        else _by_pose(feature_map, one, frame, epsg)
        for one in told
    ]


def _by_picks(feature_map: AnyMap, picks: Picks, frame: LocalFrame, epsg: int) -> StartedImage:
    image = image_named(feature_map, picks.image)
    upright = not isinstance(feature_map, UnplacedMap) or feature_map.frame.upright
    prior, fit = pose_from_picks(
        picks,
        frame.enu_from_utm(picks.utm, epsg),
        feature_map.cameras[image.camera_id],
        image.cam_from_local if upright else None,
        focal_sigma_rel(feature_map, image),
    )
    note = (
        f"{image.name} starts from {len(picks.pixels)} picks, median residual "
        f"{float(np.median(fit.distances_px[fit.believed])):.1f} px"
    )
    if fit.wrong:
        note += f"; they contradict the others: line {', '.join(str(i + 1) for i in fit.wrong)}"
    return StartedImage(image=image, prior=prior, camera=fit.camera, note=note)


def first_place(
    database: Database, unplaced: UnplacedMap, files: StartFiles, scan_ids: Sequence[str]
) -> FirstPlace:
    """Put a map without a place where a person's photo says, on the scans of the database.

    Raises:
        RegistrationError: nothing says where, or the photo does not see the scan from there.
    """
    if files.pose is None and files.picks is None:
        raise RegistrationError(
            f"map {unplaced.map_id} has no place ({unplaced.no_place.reason}); say where one photo is: "
            "--page (click the same spots in photo and scan), --picks FILE or --pose FILE"
        )
    scans, told = chosen_scans(database, scan_ids), files.read()
    ids, epsg = tuple(scan.scan_id for scan in scans), scans[0].epsg
    east, north, up = np.median(np.vstack([one.utm for one in told]), axis=0).tolist()
    frame = LocalFrame.from_utm(east, north, up, epsg)
    started = started_images(unplaced, told, frame, epsg)
    first, reach = started[0], _FIRST_REACH_M
    x, y, _ = first.prior.cam_from_local.center.tolist()
    cloud = load_cloud(database, frame, (x - reach, y - reach, x + reach, y + reach), scan_ids=ids)
    if not len(cloud):
        raise RegistrationError(
            f"no scan of {database.url} lies within {reach:.0f} m of where the photo is put"
        )
    feature_map = place_by_photo(unplaced, first.image, first.camera, first.prior, cloud)
    return FirstPlace(
        feature_map=feature_map,
        cloud=load_cloud(database, frame, plan_box(feature_map), scan_ids=ids),
        scan_ids=ids,
        starts={s.image.image_id: s.prior for s in started},
        notes=tuple(s.note for s in started),
    )


def chosen_scans(database: Database, scan_ids: Sequence[str]) -> list[ScanSummary]:
    """The scans of these ids, or all, which must be of one zone.

    Raises:
        RegistrationError: there is none, or they are of several zones.
    """
    scans = [s for s in list_scans(database) if not scan_ids or s.scan_id in scan_ids]
    if not scans:
        raise RegistrationError(f"{database.url} has no such scan; add one by `featuredb lidar add`")
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


def _by_pose(feature_map: AnyMap, rough: RoughPose, frame: LocalFrame, epsg: int) -> StartedImage:
    image = image_named(feature_map, str(rough.image))
    return StartedImage(
        image=image,
        prior=rough.prior(frame, epsg),
        camera=feature_map.cameras[image.camera_id],
        note=f"{image.name} starts from the pose given for it",
    )
