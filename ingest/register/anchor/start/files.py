"""Files by which a person helps a registration: picked correspondences (CSV) and a rough pose (JSON)."""

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, ValidationError, model_validator

from featuredb.errors import RegistrationError
from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera_angles import cam_from_enu
from featuredb.geometry.rigid3 import Rigid3
from ingest.register.anchor.start.picks import Picks
from ingest.register.frame_registration import FramePrior

_COLUMNS = ("x", "y", "easting", "northing", "height")


def read_picks(path: Path, image: str | None) -> list[Picks]:
    """Picks from a CSV file, grouped by photo in the order of the file.

    Lines hold `x, y, easting, northing, height`: full-size pixels whose top-left one has its centre at (0.5,
    0.5), then metres. A header may name the columns in another order, and a column `image` besides; empty
    lines and lines that start with # are skipped.

    Args:
        image: photo of lines that name none.

    Raises:
        RegistrationError: unreadable, a line that is not five numbers, or no photo named.
    """
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise RegistrationError(f"picks {path}: cannot be read as text ({error})") from error
    numbered = [(n, line) for n, line in enumerate(lines, 1) if line.strip() and not line.startswith("#")]
    if not numbered:
        raise RegistrationError(
            f"picks {path}: expected lines of x, y, easting, northing, height, found none"
        )
    separator = max(",;\t", key=numbered[0][1].count)
    rows = [next(csv.reader([line], delimiter=separator)) for _, line in numbered]
    names = [cell.strip().lower() for cell in rows[0]]
    first = int(set(_COLUMNS) <= set(names))  # 1 behind a header
    picks: dict[str, list[list[float]]] = {}
    for (number, _), cells in zip(numbered[first:], rows[first:], strict=True):
        found = dict(zip(names if first else (*_COLUMNS, "image"), map(str.strip, cells), strict=False))
        try:
            values = [float(found[name]) for name in _COLUMNS]
        except (KeyError, ValueError) as error:
            raise RegistrationError(
                f"picks {path}, line {number}: expected x, y, easting, northing, height, found {cells} "
                f"({error})"
            ) from error
        if not np.isfinite(values).all():
            raise RegistrationError(f"picks {path}, line {number}: expected finite numbers, found {cells}")
        name = found.get("image") or image
        if not name:
            raise RegistrationError(
                f"picks {path}, line {number}: names no photo; add a column image, or give --image"
            )
        picks.setdefault(name, []).append(values)
    return [
        Picks(image=name, pixels=np.array(values)[:, :2], utm=np.array(values)[:, 2:])
        for name, values in picks.items()
    ]


class RoughPose(BaseModel):
    """A rough pose as a person writes it for one photo.

    Attributes:
        image: the photo's name.
        easting, northing, height: of the camera, in the zone of the map (or, without one, of the scan) and
            the scan's datum.
        yaw_deg: clockwise from grid north: where the optical axis points in plan; of a camera that looks
            straight down, where the top of the photo points.
        pitch_deg: of the optical axis above the horizon; -90 looks straight down.
        roll_deg: of the camera about its optical axis, clockwise as the camera sees it.
        look_at: easting, northing, height of what the middle of the photo shows, instead of the pitch.
        sigma_horizontal_m, sigma_vertical_m, sigma_heading_deg, sigma_tilt_deg: how rough.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)
    image: str | None = None
    easting: FiniteFloat
    northing: FiniteFloat
    height: FiniteFloat
    yaw_deg: FiniteFloat | None = None
    pitch_deg: float | None = Field(default=None, ge=-90, le=90)
    roll_deg: FiniteFloat = 0.0
    look_at: tuple[FiniteFloat, FiniteFloat, FiniteFloat] | None = None
    sigma_horizontal_m: float = Field(default=10.0, gt=0, lt=1e4)
    sigma_vertical_m: float = Field(default=10.0, gt=0, lt=1e4)
    sigma_heading_deg: float = Field(default=10.0, gt=0, le=180)
    sigma_tilt_deg: float = Field(default=5.0, gt=0, le=90)

    @model_validator(mode="after")
    def _one_direction(self) -> "RoughPose":
        if self.look_at is None and (self.yaw_deg is None or self.pitch_deg is None):
            raise ValueError("give yaw_deg and pitch_deg, or look_at")
        if self.look_at is not None and self.pitch_deg is not None:
            raise ValueError("give pitch_deg or look_at, not both")
        if self.look_at is not None and np.linalg.norm(np.subtract(self.look_at, self.utm)) < 1e-3:
            raise ValueError("look_at is the camera's own position; give a point that it looks at")
        return self

    @property
    def utm(self) -> FloatArray:
        """(3,) easting, northing, height."""
        return np.array([self.easting, self.northing, self.height])

    def angles(self) -> tuple[float, float]:
        """Yaw and pitch in degrees, by look_at where it is given."""
        if self.look_at is None:
            assert self.yaw_deg is not None
            assert self.pitch_deg is not None
            return self.yaw_deg, self.pitch_deg
        east, north, up = np.asarray(self.look_at) - self.utm
        yaw, pitch = np.degrees([np.arctan2(east, north), np.arctan2(up, np.hypot(east, north))])
        return self.yaw_deg if self.yaw_deg is not None and pitch < -89.0 else float(yaw), float(pitch)

    def prior(self, frame: LocalFrame, epsg: int) -> FramePrior:
        """The pose, given in a UTM zone, in a local frame."""
        center = frame.enu_from_utm(self.utm, epsg)
        rotation = cam_from_enu(*self.angles(), self.roll_deg) @ frame.grid_from_enu(center, epsg)
        return FramePrior(
            cam_from_local=Rigid3(rotation=rotation, translation=-rotation @ center),
            sigma_horizontal_m=self.sigma_horizontal_m,
            sigma_vertical_m=self.sigma_vertical_m,
            sigma_heading_deg=self.sigma_heading_deg,
            sigma_tilt_deg=self.sigma_tilt_deg,
        )


def read_pose(path: Path, image: str | None) -> RoughPose:
    """A rough pose from a JSON file: easting, northing, height, and yaw_deg, pitch_deg, roll_deg or look_at.

    `yaw_deg` with `look_at` says where the top of the photo points where the camera looks straight down.

    Args:
        image: the photo, where the file names none.

    Raises:
        RegistrationError: unreadable or incomplete.
    """
    try:
        document: Any = json.loads(path.read_text(encoding="utf-8"))
        pose = RoughPose.model_validate(document)
    except (OSError, UnicodeDecodeError, json.JSONDecodeError) as error:
        raise RegistrationError(f"pose {path}: cannot be read as JSON ({error})") from error
    except ValidationError as error:
        problems = "; ".join(
            f"{'.'.join(map(str, e['loc'])) or 'pose'}: {e['msg']}" for e in error.errors(include_url=False)
        )
        raise RegistrationError(
            f"pose {path}: {problems}. Expected easting, northing, height in metres, and yaw_deg, pitch_deg "
            "or look_at"
        ) from error
    name = pose.image or image
    if not name:
        raise RegistrationError(f"pose {path}: names no photo; add image, or give --image")
    return pose.model_copy(update={"image": name})
