"""Which photos share one set of intrinsics, and what is known of it beforehand."""

from collections.abc import Sequence
from datetime import UTC
from typing import Literal

from featuredb.geometry.camera import Camera
from ingest.photos.photo import Photo

CameraSharing = Literal["shared", "per-image"]

# 1.2 times the longer side is a field of view of 45 degrees, COLMAP's guess without EXIF.
_DEFAULT_FOCAL_OVER_SIDE = 1.2


def photo_cameras(
    photos: Sequence[Photo], sharing: CameraSharing, camera_model: str
) -> tuple[list[tuple[Camera, bool]], list[int]]:
    """Cameras (with whether EXIF gives the focal length) and the camera's row of each photo."""
    rows: dict[str, int] = {}
    cameras: list[tuple[Camera, bool]] = []
    of_photo: list[int] = []
    for photo in photos:
        key = shared_key(photo, sharing)
        if key not in rows:
            rows[key] = len(cameras)
            known = photo.focal_px is not None
            focal = photo.focal_px or _DEFAULT_FOCAL_OVER_SIDE * max(photo.width, photo.height)
            cameras.append((Camera.from_focal(photo.width, photo.height, focal, camera_model), known))
        of_photo.append(rows[key])
    return cameras, of_photo


def shared_key(photo: Photo, sharing: CameraSharing) -> str:
    """Photos with equal keys share intrinsics.

    Those of one make, model, size and focal length do. A photo that names no camera shares with those of the
    same owner (by the same contributor), day and size: left alone, a view straight down finds a focal length
    a quarter off and a height to go with it. Where no day is known, which is so for most contributions
    without EXIF, owner and size must do; without an owner it is alone.
    """
    if sharing == "per-image":
        return photo.name
    if photo.camera_key:
        return photo.camera_key
    if not photo.owner:
        return photo.name
    time = photo.capture_time
    day = "some day" if time is None else str((time.astimezone(UTC) if time.tzinfo else time).date())
    whose = f"{photo.owner} by {photo.contributor}" if photo.contributor else photo.owner
    focal = "" if photo.focal_px is None else f", {photo.focal_px:.1f} px"
    return f"unnamed camera of {whose}, {day}, {photo.width} x {photo.height}{focal}"
