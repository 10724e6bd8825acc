"""Pictures of photos, as small as the page needs them.

Pixels are shown as they are stored, like everywhere here: a photo's camera and pose belong to the stored
pixels, so EXIF's orientation is not applied and not passed on.
"""

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from featuredb.errors import ImageError, InvalidValueError
from featuredb.features.decode import INGEST_LIMITS, decode_rgb
from featuredb.features.shrink import shrunk
from featuredb.maps.feature_map import MapImage
from featuredb.maps.photo_files import PhotoFolder

PICTURE_PX = 1200  # longer side on the page
THUMBNAIL_PX = 480  # in a file that is sent
_QUALITY = 82


class Pictures:
    """Where pictures come from; threads may share it."""

    def __init__(self, folder: Path | None) -> None:
        """Without a folder there are none, and the page says so.

        Raises:
            InvalidValueError: no such folder.
        """
        if folder is not None and not folder.is_dir():
            raise InvalidValueError(f"--photos {folder}: expected the folder of the photos, found none")
        self._folder = None if folder is None else PhotoFolder(folder)

    def jpeg(self, image: MapImage, longer_side_px: int) -> tuple[bytes | None, str]:
        """The picture as JPEG, its longer side at most so many pixels; or None and why, in words."""
        if self._folder is None:
            return None, "no folder of photos was given (--photos FOLDER)"
        path, reason = self._folder.find(image)
        if path is None:
            return None, f"not found in the folder of photos: {reason}"
        try:
            pixels = decode_rgb(path, INGEST_LIMITS)
        except ImageError as error:
            return None, f"the file cannot be shown: {error}"
        return jpeg_of(np.ascontiguousarray(pixels[:, :, ::-1]), longer_side_px), ""


def jpeg_of(bgr: NDArray[np.uint8], longer_side_px: int) -> bytes:
    """Pixels (h, w, 3) uint8 BGR as JPEG without metadata, shrunk to the given longer side."""
    small = shrunk(bgr, longer_side_px)
    encoded, data = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
    assert encoded
    return data.tobytes()
