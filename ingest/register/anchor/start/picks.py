"""A pose from points that a person picked in a photo and in the scan, and the files (CSV) that hold them."""

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from featuredb.errors import RegistrationError
from featuredb.geometry.arrays import FloatArray, freeze
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.maps.feature_map import MapImage
from featuredb.maps.unplaced_map import AnyMap
from featuredb.video.telemetry.formats.text import decode_text
from featuredb.video.telemetry.formats.text import number as decimal
from ingest.register.anchor.start.pick_fit import PickFit, fit_picks
from ingest.register.anchor.start.priors import honest_prior
from ingest.register.frame_registration import FramePrior
from reloc.tracking.pose_fit import of_camera

KNOWN_FOCAL_REL = 0.03  # EXIF rounds, and reconstructions over flat ground drift from it by as much
UNKNOWN_FOCAL_REL = 0.3
# Picks on a line or close together leave the pose open.
_MAX_PICK_SIGMA_M = 20.0
_MAX_PICK_SIGMA_DEG = 10.0
# Between the vertical by the picks and by the map: reconstructions placed by GPS know it to degrees, and
# swapped columns turn the ground upside down.
_MAX_PICK_TILT_DEG = 45.0

_COLUMNS = ("x", "y", "easting", "northing", "height")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Picks:
    """Correspondences that a person picked in one photo.

    Attributes:
        image: the photo's name.
        pixels: (n, 2) full-size pixels, the centre of the top-left one at (0.5, 0.5).
        utm: (n, 3) easting, northing, height in the map's zone and the scan's datum, metres.
    """

    image: str
    pixels: FloatArray
    utm: FloatArray

    def __post_init__(self) -> None:
        freeze(self, pixels=(None, 2), utm=(len(self.pixels), 3))


def read_picks(path: Path, image: str | None) -> list[Picks]:
    """Picks from a CSV file, grouped by photo in the order of the file.

    Lines hold `x, y, easting, northing, height`: full-size pixels whose top-left one has its centre at (0.5,
    0.5), then metres. Commas, semicolons, tabs or spaces separate; between all but commas, commas may be
    decimal. A header may name the columns in another order, and a column `image` besides; empty lines and
    lines that start with # are skipped.

    Args:
        image: photo of lines that name none.

    Raises:
        RegistrationError: unreadable, a line that is not five numbers, or no photo named.
    """
    try:
        lines = decode_text(path.read_bytes()).splitlines()
    except OSError as error:
        raise RegistrationError(f"picks {path}: cannot be read ({error})") from error
    numbered = [(n, line) for n, line in enumerate(lines, 1) if line.strip() and not line.startswith("#")]
    none = f"picks {path}: expected lines of x, y, easting, northing, height, found none"
    if not numbered:
        raise RegistrationError(none)
    # Five columns have four separators; semicolons before commas, which are decimal between them.
    separator = next((mark for mark in ";\t," if numbered[0][1].count(mark) >= 4), None)
    rows = [
        next(csv.reader([line], delimiter=separator)) if separator else line.split() for _, line in numbered
    ]
    names = [cell.strip().lower() for cell in rows[0]]
    first = int(set(_COLUMNS) <= set(names))  # 1 behind a header
    picks: dict[str, list[list[float]]] = {}
    for (number, _), cells in zip(numbered[first:], rows[first:], strict=True):
        found = dict(zip(names if first else (*_COLUMNS, "image"), map(str.strip, cells), strict=False))
        where = f"picks {path}, line {number}"
        try:
            values = [decimal(found[name]) for name in _COLUMNS]
        except KeyError as error:
            words = "expected x, y, easting, northing, height"
            raise RegistrationError(f"{where}: {words}, found {cells}") from error
        if not np.isfinite(values).all():
            raise RegistrationError(f"{where}: expected finite numbers, found {cells}")
        name = found.get("image") or image
        if not name:
            raise RegistrationError(f"{where}: names no photo; add a column image, or give --image")
        picks.setdefault(name, []).append(values)
    if not picks:
        raise RegistrationError(none)
    return [
        Picks(image=name, pixels=np.array(values)[:, :2], utm=np.array(values)[:, 2:])
        for name, values in picks.items()
    ]


def focal_sigma_rel(feature_map: AnyMap, image: MapImage) -> float:
    """How well the focal length of a photo's camera is known, relative.

    An EXIF focal length held the reconstruction's within some percent; photos over flat ground trade a
    free one for height.
    """
    keys = feature_map.camera_keys
    known = bool(keys) and bool(keys[image.camera_id])
    return KNOWN_FOCAL_REL if known else UNKNOWN_FOCAL_REL


def least_picks(focal_rel: float) -> int:
    """P3P takes three, a fourth chooses its solution; a focal length takes one, a check another."""
    return 4 if focal_rel <= KNOWN_FOCAL_REL else 6


def pose_from_picks(
    picks: Picks, points: FloatArray, camera: Camera, present: Rigid3 | None, focal_rel: float
) -> tuple[FramePrior, PickFit]:
    """Pose by picked correspondences, if they determine it and do not contradict each other.

    Args:
        points: (n, 3) the picks' coordinates in the local frame, metres.
        present: see `prior_of_picks`.
        focal_rel: standard deviation of the focal length, relative.

    Raises:
        RegistrationError: too few, contradictory, or badly spread picks.
    """
    count, least = len(picks.pixels), least_picks(focal_rel)
    if count < least:
        unknown = "" if least == 4 else ", since the focal length of its lens is not known"
        raise RegistrationError(
            f"picks of {picks.image}: expected at least {least}{unknown}, found {count}; "
            "add well-spread points"
        )
    fit = fit_picks(picks.pixels, points, camera, focal_rel)
    if fit is None:
        raise RegistrationError(f"picks of {picks.image}: {_contradictory('')}")
    return prior_of_picks(picks.image, points, fit, present), fit


def prior_of_picks(image: str, points: FloatArray, fit: PickFit, present: Rigid3 | None) -> FramePrior:
    """The pose of fitted picks with its deviations.

    Args:
        points: (n, 3) the picks' coordinates in the local frame, metres.
        present: where the map has the camera now, in the local frame, of which only the vertical counts; None
            where the map does not know up.

    Raises:
        RegistrationError: contradictory or badly spread picks.
    """
    objection = _objection(points, fit, present)
    if objection:
        raise RegistrationError(f"picks of {image}: {objection}")
    pose = fit.cam_from_local
    tilt, other, heading, *plan, up = np.sqrt(np.diag(of_camera(pose, fit.covariance))).tolist()
    heading_deg, tilt_deg = np.degrees([heading, max(tilt, other)]).tolist()
    prior = honest_prior(pose, max(plan), up, heading_deg, tilt_deg)
    turn_deg = max(prior.sigma_heading_deg, prior.sigma_tilt_deg)
    if prior.sigma_horizontal_m > _MAX_PICK_SIGMA_M or turn_deg > _MAX_PICK_SIGMA_DEG:
        raise RegistrationError(
            f"picks of {image}: they leave the pose open to {prior.sigma_horizontal_m:.0f} m and "
            f"{turn_deg:.0f} degrees; spread them over the photo"
        )
    return prior


def _objection(points: FloatArray, fit: PickFit, present: Rigid3 | None) -> str:
    """Why a pose is not to be had by picks, or ""; arguments as those of `prior_of_picks`."""
    pose, swapped = fit.cam_from_local, "are easting and northing, or pixel x and y, swapped?"
    if not fit.consistent:
        return _contradictory(f"; they miss one pose by up to {fit.distances_px.max():.0f} px")
    if fit.doubtful:
        numbers = ", ".join(str(i + 1) for i in fit.doubtful)
        return f"one of {numbers} is wrong, and the others do not tell which; add a pick"
    if fit.other_pose:
        return "two poses explain them equally well; add a pick, best where the ground is higher or lower"
    if pose.rotation[2, 2] > 0.5 and pose.center[2] < float(points[:, 2].min()):
        return f"the camera would look at the scan from below; {swapped}"
    if present is not None:
        cosine = pose.rotation[:, 2] @ present.rotation[:, 2]
        tilt = float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))
        if tilt > _MAX_PICK_TILT_DEG:
            return f"they turn the camera's vertical by {tilt:.0f} degrees against the map; {swapped}"
    return ""


def _contradictory(far: str) -> str:
    return (
        f"they contradict each other{far}; check the order of the columns (pixel x, pixel y, easting, "
        "northing, height), the zone, the heights and the photo, or add picks: of eight, two wrong ones are "
        "found"
    )
