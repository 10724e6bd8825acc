"""Street views from the database to the database."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from featuredb.errors import MapNotFoundError, RegistrationError
from featuredb.features.decode import INGEST_LIMITS, decode_gray
from featuredb.lidar.load import load_cloud
from featuredb.maps.feature_map import FeatureMap, MapImage
from featuredb.store import CommitResult, Database
from ingest.register.anchor.photo_files import find_photos
from ingest.street.street_map import StreetOptions, street_map

_MARGIN_M = 60.0  # scan around the map that views from its rim may show


def make_street_map(
    database: Database, map_id: str, photos: Path, options: StreetOptions | None = None
) -> tuple[FeatureMap, CommitResult]:
    """Draw the views, build the map, commit it as quarantined.

    Args:
        map_id: or its first letters, if no other live map begins so.
        photos: folder of the map's photos.

    Raises:
        RegistrationError: photos, scan or ground are missing, or nothing could be recognised.
        MapNotFoundError, ScanNotFoundError, ScanError, StoreError, MissingExtraError
    """
    snapshot = database.snapshot()
    maps = snapshot.maps()
    found = [m for m in maps if m.map_id == map_id] or [m for m in maps if m.map_id.startswith(map_id)]
    if len(found) != 1:
        raise MapNotFoundError(
            f"snapshot {snapshot.version} has {len(found)} live maps {map_id}; `featuredb maps` lists them"
        )
    aerial = snapshot.load_map(found[0].map_id)
    files = find_photos(aerial, photos)
    low, high = np.percentile(aerial.points_local()[:, :2], (1, 99), axis=0)
    (west, south), (east, north) = low - _MARGIN_M, high + _MARGIN_M
    box = float(west), float(south), float(east), float(north)
    cloud = load_cloud(database, aerial.frame, box)
    if not len(cloud):
        raise RegistrationError(
            f"no scan of {database.url} covers map {aerial.map_id}; see `featuredb lidar list`"
        )

    def gray(image: MapImage) -> NDArray[np.uint8]:
        return decode_gray(files.path(image), INGEST_LIMITS)

    made = street_map(aerial, cloud, gray, options)
    return made, database.commit_map(made)
