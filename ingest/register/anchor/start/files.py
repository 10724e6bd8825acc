"""Files by which a person helps a registration: picked correspondences (CSV) and a rough pose (JSON)."""

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, ValidationError, model_validator

from featuredb.errors import RegistrationError
from ingest.register.anchor.start.picks import Picks
from ingest.register.anchor.start.priors import RoughPose, look_at_angles

_HOW_ROUGH = {"roll_deg", "sigma_horizontal_m", "sigma_vertical_m", "sigma_heading_deg", "sigma_tilt_deg"}
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
    rows = [
        (n, [cell.strip() for cell in next(csv.reader([line], delimiter=separator))]) for n, line in numbered
    ]
    columns = _header(rows[0][1])
    if columns is not None:
        rows = rows[1:]
    picks: dict[str, list[list[float]]] = {}
    for number, cells in rows:
        name, values = _pick(path, number, cells, columns, image)
        picks.setdefault(name, []).append(values)
    return [
        Picks(image=name, pixels=np.array(values)[:, :2], utm=np.array(values)[:, 2:])
        for name, values in picks.items()
    ]


def _header(cells: list[str]) -> dict[str, int] | None:
    """Column of each name, or None where the line is no header."""
    names = {cell.lower(): i for i, cell in enumerate(cells)}
    return names if all(column in names for column in _COLUMNS) else None


def _pick(
    path: Path, number: int, cells: list[str], columns: dict[str, int] | None, image: str | None
) -> tuple[str, list[float]]:
    order = columns or {name: i for i, name in enumerate((*_COLUMNS, "image"))}
    try:
        values = [float(cells[order[name]]) for name in _COLUMNS]
    except (IndexError, ValueError) as error:
        raise RegistrationError(
            f"picks {path}, line {number}: expected x, y, easting, northing, height, found {cells} ({error})"
        ) from error
    if not np.isfinite(values).all():
        raise RegistrationError(f"picks {path}, line {number}: expected finite numbers, found {cells}")
    at = order.get("image", len(cells))
    name = cells[at] if at < len(cells) and cells[at] else image
    if not name:
        raise RegistrationError(
            f"picks {path}, line {number}: names no photo; add a column image, or give --image"
        )
    return name, values


class _PoseFile(BaseModel):
    """A rough pose as a person writes it."""

    model_config = ConfigDict(extra="forbid")
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
    def _one_direction(self) -> "_PoseFile":
        if self.look_at is None and (self.yaw_deg is None or self.pitch_deg is None):
            raise ValueError("give yaw_deg and pitch_deg, or look_at")
        if self.look_at is not None and self.pitch_deg is not None:
            raise ValueError("give pitch_deg or look_at, not both")
        return self


def read_pose(path: Path, image: str | None) -> RoughPose:
    """A rough pose from a JSON file: easting, northing, height, and yaw_deg, pitch_deg, roll_deg or look_at.

    `look_at` is easting, northing, height of what the middle of the photo shows; `yaw_deg` with it says where
    the top of the photo points where the camera looks straight down.

    Args:
        image: the photo, where the file names none.

    Raises:
        RegistrationError: unreadable or incomplete.
    """
    try:
        document: Any = json.loads(path.read_text(encoding="utf-8"))
        pose = _PoseFile.model_validate(document)
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
    utm = np.array([pose.easting, pose.northing, pose.height])
    if pose.look_at is not None:
        yaw, pitch = look_at_angles(utm, np.array(pose.look_at))
        yaw = pose.yaw_deg if pose.yaw_deg is not None and pitch < -89.0 else yaw
    else:
        assert pose.yaw_deg is not None
        assert pose.pitch_deg is not None
        yaw, pitch = pose.yaw_deg, pose.pitch_deg
    return RoughPose(
        image=name,
        utm=utm,
        yaw_deg=yaw,
        pitch_deg=pitch,
        **pose.model_dump(include=_HOW_ROUGH),
    )
