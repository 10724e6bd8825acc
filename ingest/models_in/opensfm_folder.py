"""A reconstruction of OpenSfM or OpenDroneMap on disk, as arrays.

`reconstruction.json` has cameras, shots and points in a topocentric frame (x east, y north, z up at the
reference, on the ellipsoid of WGS84), `tracks.csv` what sees them. OpenSfM keeps outliers in the tracks and
leaves them out by their residual whenever it reads them; so does this.
"""

import re
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter

from featuredb.errors import IngestError, InvalidValueError
from featuredb.features.exif.gps import DEFAULT_SIGMA_HORIZONTAL_M, DEFAULT_SIGMA_VERTICAL_M
from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.rotation import so3_exp
from featuredb.maps.feature_map import GeoPrior
from ingest.colmap.bridge import Model
from ingest.models_in.opensfm_parts import (
    UNKNOWN_DOP,
    OpensfmReconstruction,
    OpensfmReference,
    OpensfmShot,
    OpensfmTracks,
    camera_from_opensfm,
    checked,
    read_json,
    read_tracks,
)
from ingest.models_in.stored import Keypoints, ModelSource, StoredModel

TRACKS, REFERENCE, CONFIG = "tracks.csv", "reference_lla.json", "config.yaml"
# OpenDroneMap writes projected coordinates over reconstruction.json, and keeps what it was as the first.
_RECONSTRUCTIONS = ("reconstruction.topocentric.json", "reconstruction.json")
# Larger residuals are outliers, over the longer side: 4 px at 1600, as in an ingest of photos.
_OUTLIER = 0.0025
_MOST_OUTLIERS, _MOST_UNSEEN = 0.5, 0.1  # more, and the files do not belong together
_OF_VLFEAT = ("HAHOG", "DSPSIFT")  # the first is OpenSfM's default, the second OpenDroneMap's
_SAME_DEG, _SAME_M = 1e-9, 1e-3


def opensfm_folder(folder: Path) -> Path | None:
    """Where the reconstruction lies: in the folder, or its `opensfm`; None: nowhere there."""
    for place in (folder, folder / "opensfm"):
        if any((place / name).is_file() for name in _RECONSTRUCTIONS):
            return place
    return None


def read_opensfm(place: Path, chosen: int | None = None) -> ModelSource:
    """The reconstruction in one of the places of `opensfm_folder`, without shots that see no point.

    Args:
        chosen: which of several, counted from 0.

    Raises:
        IngestError: it is broken, or its files do not belong together; there are several and none is chosen;
            a lens that maps do not have.
    """
    path = next(place / name for name in _RECONSTRUCTIONS if (place / name).is_file())
    listed = read_json(path, TypeAdapter(list[dict[str, Any]]))
    found = checked(_chosen(listed, chosen, path), TypeAdapter(OpensfmReconstruction), path)
    shots, points = list(found.shots.items()), list(found.points.values())
    unknown = sorted({shot.camera for _, shot in shots} - found.cameras.keys())
    if unknown:
        raise IngestError(
            f"{path}: shots: expected cameras of {list(found.cameras)[:5]}, found {unknown[:5]}"
        )
    camera_names = list(found.cameras)
    camera_rows, camera_of = np.unique(
        [camera_names.index(shot.camera) for _, shot in shots], return_inverse=True
    )
    used = [
        camera_from_opensfm(found.cameras[camera_names[row]], f"{path}: camera {camera_names[row]!r}")
        for row in camera_rows
    ]
    poses = [_pose(shot, f"{path}: shot {name!r}") for name, shot in shots]
    xyz = np.array([point.coordinates for point in points])
    rgb = np.array([point.color for point in points])
    tracks = read_tracks(place / TRACKS, list(found.shots), list(found.points))
    parts = _Parts(
        cameras=used, camera_rows=camera_rows, camera_of=camera_of, poses=poses, xyz=xyz, tracks=tracks
    )
    xy = _pixels(parts)
    kept = _kept(parts, xy, place / TRACKS)
    stored, rows, images = _stored(parts, xy, kept, list(found.shots), np.clip(np.rint(rgb), 0, 255))
    size = _sizes(parts)[tracks.image] * _diameter_over_size(place / CONFIG)
    reference = _reference(found, place, path)
    diameters = [(tracks.scale * size)[r].astype(np.float32) for r in rows]

    def keypoints(index: int, with_descriptors: bool) -> Keypoints:
        """Without orientations and descriptors, which OpenSfM keeps in its own way."""
        xy = stored.xy[index].astype(np.float32)
        return Keypoints(xy=xy, scale=diameters[index], angle=None, descriptors=None)

    return ModelSource(
        format="opensfm",
        place=place,
        stored=stored,
        open_keypoints=lambda: nullcontext(keypoints),
        has_descriptors=False,
        photos=next((p for p in (place / "images", place.absolute().parent / "images") if p.is_dir()), None),
        choice="" if chosen is None else f"reconstruction {chosen}",
        reference=reference,
        gps=tuple(_gps(shots[i][1], reference, f"{path}: shot {shots[i][0]!r}") for i in images),
        files=tuple(p for p in (path, place / TRACKS, place / REFERENCE, place / CONFIG) if p.is_file()),
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Parts:
    """What the files hold: the shots' cameras, their rows in the file, and for each shot its camera's row."""

    cameras: list[Camera]
    camera_rows: NDArray[np.int64]
    camera_of: NDArray[np.int64]
    poses: list[Rigid3]
    xyz: FloatArray
    tracks: OpensfmTracks


def _chosen(found: Sequence[dict[str, Any]], chosen: int | None, path: Path) -> dict[str, Any]:
    if not found:
        raise IngestError(f"{path}: expected a list of reconstructions, found none; is this OpenSfM's file?")
    if chosen is None and len(found) > 1:
        shots = [len(one.get("shots", ())) for one in found]
        raise IngestError(
            f"{path}: expected one reconstruction, found {len(found)} of {shots} shots; choose one by "
            f"--reconstruction 0 to {len(found) - 1}"
        )
    if chosen is not None and not 0 <= chosen < len(found):
        raise IngestError(
            f"--reconstruction {chosen}: expected one of the {len(found)} in {path}, counted from 0"
        )
    return found[chosen or 0]


def _pose(shot: OpensfmShot, where: str) -> Rigid3:
    try:
        return Rigid3(rotation=so3_exp(shot.rotation), translation=np.array(shot.translation))
    except (InvalidValueError, ValueError) as error:
        raise IngestError(f"{where}: expected a pose, found {shot!r:.200}: {error}") from error


def _sizes(parts: _Parts) -> FloatArray:
    """Longer side (images,) in pixels."""
    longer = np.array([max(c.width, c.height) for c in parts.cameras], dtype=np.float64)
    return np.asarray(longer[parts.camera_of], dtype=np.float64)


def _pixels(parts: _Parts) -> FloatArray:
    """Of each observation (m, 2). OpenSfM's (0, 0) is the middle of the image, as is half its size for us."""
    middles = np.array([[c.width / 2.0, c.height / 2.0] for c in parts.cameras])[parts.camera_of]
    image = parts.tracks.image
    return np.asarray(parts.tracks.xy * _sizes(parts)[image, None] + middles[image], dtype=np.float64)


def _kept(parts: _Parts, xy: FloatArray, path: Path) -> NDArray[np.bool_]:
    """Observations (m,) that are no outliers, of points that two or more of them see."""
    tracks, count = parts.tracks, len(parts.xyz)
    unseen = int((np.bincount(tracks.track, minlength=count) < 2).sum())
    if unseen > _MOST_UNSEEN * count:
        raise IngestError(
            f"{path}: expected the observations of {count} points, found none or one of {unseen} of them: "
            "it is cut off, or belongs to another reconstruction; copy or create the tracks again"
        )
    residual = np.full(len(xy), np.inf)
    for row, (pose, mine) in enumerate(
        zip(parts.poses, _of_each(tracks.image, len(parts.poses)), strict=True)
    ):
        if len(mine):
            drawn = parts.cameras[parts.camera_of[row]].project(pose.act(parts.xyz[tracks.track[mine]]))
            residual[mine] = np.linalg.norm(drawn - xy[mine], axis=1)
    kept = residual <= _OUTLIER * _sizes(parts)[tracks.image]  # false for NaN: behind the camera
    if kept.sum() < (1.0 - _MOST_OUTLIERS) * len(kept):
        seen = residual[np.isfinite(residual)]
        raise IngestError(
            f"{path}: expected observations where the reconstruction's points are, found "
            f"{len(kept) - kept.sum()} of {len(kept)} far from there (median "
            f"{np.median(seen) if len(seen) else np.nan:.0f} px): it belongs to another reconstruction, or "
            "to images of another size"
        )
    kept &= (np.bincount(tracks.track[kept], minlength=count) >= 2)[tracks.track]
    if not kept.any():
        raise IngestError(f"{path}: expected points that two images see, found none")
    return np.asarray(kept)


def _of_each(image: NDArray[np.int64], count: int) -> list[NDArray[np.int64]]:
    """For each of `count` images, the rows that are its own, rising."""
    ends = np.cumsum(np.bincount(image, minlength=count))
    return np.split(np.argsort(image, kind="stable"), ends[:-1])


def _stored(
    parts: _Parts, xy: FloatArray, kept: NDArray[np.bool_], names: list[str], rgb: FloatArray
) -> tuple[StoredModel, list[NDArray[np.int64]], list[int]]:
    """The model of what is kept; for each of its images rows of the tracks, and its own among the shots."""
    tracks = parts.tracks
    seen = np.flatnonzero(kept)
    images = np.unique(tracks.image[seen]).tolist()
    rows = [seen[r] for r in _of_each(tracks.image[seen], len(parts.poses)) if len(r)]
    points = np.unique(tracks.track[kept])
    photo_of = np.concatenate([np.full(len(r), k) for k, r in enumerate(rows)])
    keypoint_of = np.concatenate([np.arange(len(r)) for r in rows])
    point_of = np.searchsorted(points, tracks.track[np.concatenate(rows)])
    order = np.lexsort((keypoint_of, photo_of, point_of))
    used = np.unique(parts.camera_of[images])
    model = Model(
        cameras=tuple(parts.cameras[c] for c in used),
        rows=np.arange(len(images), dtype=np.int64),
        camera_of=np.searchsorted(used, parts.camera_of[images]),
        cam_from_sfm=tuple(parts.poses[i] for i in images),
        xyz=parts.xyz[points],
        point_of=point_of[order],
        photo_of=photo_of[order],
        keypoint_of=keypoint_of[order],
    )
    stored = StoredModel(
        model=model,
        names=tuple(names[i] for i in images),
        camera_ids=tuple(int(c) + 1 for c in parts.camera_rows[used]),
        xy=tuple(xy[r] for r in rows),
        rgb=rgb[points].astype(np.uint8),
    )
    return stored, rows, images


def _diameter_over_size(config: Path) -> float:
    """What a detector says of a feature's size is OpenCV's diameter, but of VLFeat's a standard deviation."""
    if not config.is_file():
        return 1.0
    found = re.search(r"^\s*feature_type\s*:\s*[\"']?(\w+)", config.read_text(errors="replace"), re.MULTILINE)
    return 2.0 if found is None or found[1].upper() in _OF_VLFEAT else 1.0


def _reference(found: OpensfmReconstruction, place: Path, path: Path) -> LocalFrame | None:
    """Of the reconstruction itself, or of the data set."""
    frames: list[LocalFrame] = []
    if found.reference_lla is not None:
        frames.append(_frame(found.reference_lla, f"{path}: reference_lla"))
    if (place / REFERENCE).is_file():
        of_set = read_json(place / REFERENCE, TypeAdapter(OpensfmReference))
        frames.append(_frame(of_set, str(place / REFERENCE)))
    if len(frames) == 2 and not _same(*frames):
        raise IngestError(
            f"{place / REFERENCE}: expected the reference of {path}, {frames[0]}, found {frames[1]}; remove "
            "the file that does not belong to the reconstruction"
        )
    return frames[0] if frames else None


def _frame(told: OpensfmReference, where: str) -> LocalFrame:
    try:
        return LocalFrame(latitude_deg=told.latitude, longitude_deg=told.longitude, height_m=told.altitude)
    except InvalidValueError as error:
        raise IngestError(f"{where}: {error}") from error


def _same(one: LocalFrame, other: LocalFrame) -> bool:
    return (
        abs(one.latitude_deg - other.latitude_deg) < _SAME_DEG
        and abs(one.longitude_deg - other.longitude_deg) < _SAME_DEG
        and abs(one.height_m - other.height_m) < _SAME_M
    )


def _gps(shot: OpensfmShot, reference: LocalFrame | None, where: str) -> GeoPrior | None:
    """What the shot's photo said of its position, on Earth."""
    if reference is None or shot.gps_position is None:
        return None
    dop = UNKNOWN_DOP if shot.gps_dop is None else shot.gps_dop
    if isinstance(dop, tuple):
        horizontal, vertical = max(dop[:2]), dop[2]
    else:
        horizontal = dop
        vertical = horizontal * DEFAULT_SIGMA_VERTICAL_M / DEFAULT_SIGMA_HORIZONTAL_M
    try:
        latitude, longitude, height = (float(v) for v in reference.geodetic_from_enu(shot.gps_position))
        return GeoPrior(
            latitude_deg=latitude,
            longitude_deg=longitude,
            height_m=height,
            sigma_horizontal_m=horizontal,
            sigma_vertical_m=vertical,
        )
    except InvalidValueError as error:
        raise IngestError(f"{where}: {error}") from error
