"""A photo's EXIF position as the prior that ingest and localisation take."""

from featuredb.features.exif.read import ExifInfo
from featuredb.maps.feature_map import GeoPrior


def prior_from_exif(exif: ExifInfo) -> GeoPrior | None:
    """The position with its deviations, or None where the photo has none."""
    if exif.latitude_deg is None or exif.longitude_deg is None:
        return None
    return GeoPrior(
        latitude_deg=exif.latitude_deg,
        longitude_deg=exif.longitude_deg,
        height_m=exif.altitude_m,
        sigma_horizontal_m=exif.sigma_horizontal_m,
        sigma_vertical_m=exif.sigma_vertical_m,
    )
