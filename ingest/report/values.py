"""What an ingest did: one value, and its JSON for programs; `ingest.report.page` writes it."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from datetime import datetime
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from featuredb.maps.place_bounds import PlaceBounds
from featuredb.plain_json import plain
from ingest.colmap.picture_shear import IMPOSSIBLE, UNUSUAL, shear_words
from ingest.plot_parts import PlanView
from ingest.register.control.placement import GcpPlacement
from ingest.report.films import FilmOutcome

FileStatus = Literal["registered", "unplaced", "not_registered", "skipped"]
MapOutcomeStatus = Literal["committed", "already_there", "unplaced", "retired", "refused"]
SCHEMA_ID = "featuredb/ingest/report/1"

# EXIF rounds to whole millimetres of 35 mm equivalent (2.5 % at 20 mm) and makers count the frame differently
# (4 %); beyond their sum something else is at work.
FOCAL_CHANGE_TO_WARN = 0.08

_TRACK_BINS = (2, 3, 4, 5, 6, 8, 10, 15, 20, 50)
_BETTER = (
    "better by: a scan (featuredb lidar add, then anchor) or control points (--gcp); somewhat by more photos "
    "over a larger area, or photos that tell their gimbal's angles"
)
_PERCENTILES = (50, 90, 99)
_AS_IT_IS = ("job_id", "database", "folder", "started", "seconds", "options", "versions", "warnings")
_DRAWN = ("errors_px", "track_lengths", "plan", "control")  # what the page shows of a map


@dataclass(frozen=True, slots=True, kw_only=True)
class StageTiming:
    """How long a stage took.

    Attributes:
        seconds: wall time.
        reused: results taken over from an earlier run, of `total`.
    """

    name: str
    seconds: float
    reused: int = 0
    total: int = 0


@dataclass(frozen=True, slots=True, kw_only=True)
class PhotoOutcome:
    """One file of the folder and what happened to it.

    Attributes:
        status: registered (part of a map), unplaced (part of a map without a place), not_registered (usable,
            but in no map), skipped (not usable).
        reason_code, reason: why it is in no map; "" where it is.
        width, height: pixels as stored, 0 where unknown.
        features: found in it, or None where it did not come so far.
        matches: verified with other photos.
        reprojection_px: mean reprojection error of the points that it observes, in all their photos.
        gps_residual_m: GPS position minus its place in the map along UTM's axes (east, north, up),
            metres; up is NaN without a height.
        gps_used: whether its GPS agrees with the others' (False: an outlier); None where that was not asked.
        warnings: what was wrong in its metadata.
    """

    name: str
    status: FileStatus
    reason_code: str = ""
    reason: str = ""
    width: int = 0
    height: int = 0
    camera_key: str = ""
    capture_time: datetime | None = None
    has_gps: bool = False
    features: int | None = None
    matches: int | None = None
    observations: int | None = None
    map_id: str = ""
    reprojection_px: float | None = None
    gps_residual_m: tuple[float, float, float] | None = None
    gps_used: bool | None = None
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraOutcome:
    """One set of intrinsics.

    Attributes:
        name: its EXIF key, or the photo's name.
        focal_before_px: from EXIF, None where that says nothing.
        focal_after_px: as refined with the map.
    """

    name: str
    model: str
    width: int
    height: int
    photos: int
    focal_before_px: float | None
    focal_after_px: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MapOutcome:
    """One connected component of the photos.

    Attributes:
        map_id: "" where it was refused.
        status: committed, already_there (an earlier run committed it), unplaced (kept without a place),
            retired (somebody has taken this very map out of service, and it stays so), refused.
        reason_code, reason: why it was refused or retired, or has no place.
        gates: figures of every gate, JSON-able.
        scale: metres per unit of the reconstruction.
        residual_rms_m: of the GPS positions that were used.
        place: what holds 95 % of the errors of its placement; None where it has none.
        picture_shear: `ingest.colmap.picture_shear.PictureShear.size`; 0 where it was not measured.
        errors_px: (n,) mean reprojection error of each point; track_lengths: (n,) photos that see it.
        plan: None where the map has no place.
    """

    map_id: str
    name: str
    status: MapOutcomeStatus
    reason_code: str = ""
    reason: str = ""
    photos: int = 0
    points: int = 0
    observations: int = 0
    descriptors: int = 0
    epsg: int | None = None
    height_datum: str = ""
    scale: float | None = None
    residual_rms_m: float | None = None
    place: PlaceBounds | None = None
    picture_shear: float = 0.0
    gates: Mapping[str, Any] = field(default_factory=dict)
    cameras: tuple[CameraOutcome, ...] = ()
    errors_px: NDArray[np.float32] = field(default_factory=lambda: np.zeros(0, np.float32))
    track_lengths: NDArray[np.int32] = field(default_factory=lambda: np.zeros(0, np.int32))
    plan: PlanView | None = None
    control: GcpPlacement | None = None

    @property
    def place_words(self) -> tuple[str, ...]:
        """What its place is worth, and what helps, a sentence each; nothing where it has no place."""
        if self.place is None:
            return ()
        if self.control is not None:
            return self.place.words()
        angles = self.gates.get("angles", {})
        level = "what they say of their angles" if angles.get("told") else "level"
        off_deg = angles.get("tilt_off_deg")
        off = () if off_deg is None else (f"tilt: its photos are {off_deg:.1f} degrees off {level} (median)",)
        return (*self.place.words(), *off, _BETTER)

    @property
    def warnings(self) -> tuple[str, ...]:
        """What a person should know before relying on the map."""
        focal = [
            f"The focal length of {c.name} became {c.focal_after_px:.0f} px, "
            f"EXIF says {c.focal_before_px:.0f}. "
            "Photos that all look the same way from one height cannot tell focal length from height, so "
            "heights above the ground may be wrong by the same share; add photos from other heights or "
            "directions, or keep the focal length fixed."
            for c in self.cameras
            if c.focal_before_px and abs(c.focal_after_px / c.focal_before_px - 1) > FOCAL_CHANGE_TO_WARN
        ]
        sheared = [
            f"Map {self.map_id}: {shear_words(self.picture_shear)}. That counts in the uncertainty of its "
            "poses, but its shape may bend; move more slowly, or use a mechanical shutter."
        ]
        return tuple(focal + sheared * (UNUSUAL < self.picture_shear <= IMPOSSIBLE))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class IngestReport:
    """All of an ingest.

    Attributes:
        job_id: digest of photos and options.
        database: address of the database, folder: of the photos.
        started: timezone-aware.
        options: of every stage, JSON-able; versions: of this program and the libraries.
        pairs: tried, verified_pairs: with enough verified matches.
        photos: every file of the folder, sorted by name.
        maps: largest first.
    """

    job_id: str
    database: str
    folder: str
    started: datetime
    options: Mapping[str, Any] = field(default_factory=dict)
    versions: Mapping[str, str] = field(default_factory=dict)
    pairs: int = 0
    verified_pairs: int = 0
    stages: tuple[StageTiming, ...] = ()
    photos: tuple[PhotoOutcome, ...] = ()
    maps: tuple[MapOutcome, ...] = ()
    films: tuple[FilmOutcome, ...] = ()
    warnings: tuple[str, ...] = ()

    def count(self, status: FileStatus) -> int:
        """Number of files with that status."""
        return sum(photo.status == status for photo in self.photos)

    @property
    def seconds(self) -> float:
        """Wall time of all stages."""
        return sum(stage.seconds for stage in self.stages)


def report_json(report: IngestReport) -> dict[str, Any]:
    """The report as JSON of `schemas/ingest/report.json`; NaN and infinity become null."""
    document: dict[str, Any] = plain(
        {
            "schema": SCHEMA_ID,
            **{name: getattr(report, name) for name in _AS_IT_IS},
            "pairs": {"tried": report.pairs, "verified": report.verified_pairs},
            "files": {
                "all": len(report.photos),
                **{status: report.count(status) for status in get_args(FileStatus)},
            },
            "stages": [asdict(stage) for stage in report.stages],
            "maps": [_map_json(outcome) for outcome in report.maps],
            "films": [asdict(film) | {"frames": film.frames} for film in report.films],
            "photos": [asdict(photo) for photo in report.photos],
        }
    )
    return document


def _map_json(outcome: MapOutcome) -> dict[str, Any]:
    tracks, errors = outcome.track_lengths, outcome.errors_px
    edges = [*_TRACK_BINS, 1 << 30]
    counts: list[int] = np.histogram(tracks, bins=edges)[0].tolist() if len(tracks) else []
    return {name: getattr(outcome, name) for name in MapOutcome.__slots__ if name not in _DRAWN} | {
        "place": outcome.place and asdict(outcome.place),
        "warnings": outcome.warnings,
        "cameras": [asdict(camera) for camera in outcome.cameras],
        "reprojection_px": {f"p{p}": float(np.percentile(errors, p)) for p in _PERCENTILES if len(errors)},
        "track_lengths": [{"from": low, "points": n} for low, n in zip(_TRACK_BINS, counts, strict=False)],
    }
