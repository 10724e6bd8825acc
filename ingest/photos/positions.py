"""Positions that photos tell, in a local frame."""

from collections.abc import Sequence

import numpy as np

from featuredb.adjust.terms import CenterPriors
from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.arrays import FloatArray
from ingest.photos.photo import Photo


def local_frame_of(photos: Sequence[Photo]) -> LocalFrame | None:
    """A frame at the photos' median position, rounded so that it does not hang on the last digit."""
    gps = np.array(
        [
            [p.gps.latitude_deg, p.gps.longitude_deg, p.gps.height_m or 0.0]
            for p in photos
            if p.gps is not None
        ]
    )
    if not len(gps):
        return None
    latitude, longitude, height = np.median(gps, axis=0)
    return LocalFrame(
        latitude_deg=round(float(latitude), 5),
        longitude_deg=round(float(longitude), 5),
        height_m=round(float(height)),
    )


def gps_positions(photos: Sequence[Photo], frame: LocalFrame | None = None) -> FloatArray:
    """East, north, up (n, 3) in metres of photos with GPS; height 0 where the photo has none."""
    geodetic = np.array(
        [
            [p.gps.latitude_deg, p.gps.longitude_deg, p.gps.height_m or 0.0]
            for p in photos
            if p.gps is not None
        ]
    )
    if frame is None:
        frame = LocalFrame(latitude_deg=geodetic[0, 0], longitude_deg=geodetic[0, 1], height_m=0.0)
    return frame.enu_from_geodetic(geodetic)


def gps_priors(photos: Sequence[Photo], frame: LocalFrame | None) -> tuple[FloatArray, FloatArray]:
    """Positions and sigmas (n, 3) in the frame: NaN for photos without GPS, infinite without height."""
    positions = np.full((len(photos), 3), np.nan)
    sigmas = np.full((len(photos), 3), np.nan)
    rows = [i for i, p in enumerate(photos) if p.gps is not None]
    if frame is not None and rows:
        positions[rows] = gps_positions([photos[i] for i in rows], frame)
        for i in rows:
            gps = photos[i].gps
            assert gps is not None
            vertical = gps.sigma_vertical_m if gps.height_m is not None else np.inf
            sigmas[i] = (gps.sigma_horizontal_m, gps.sigma_horizontal_m, vertical)
    return positions, sigmas


def capture_seconds(photos: Sequence[Photo]) -> FloatArray | None:
    """Times (n,) of capture; None where some photo does not say, or some do not say in which zone."""
    times = [photo.capture_time for photo in photos if photo.capture_time is not None]
    if len(times) < len(photos) or len({time.tzinfo is None for time in times}) != 1:
        return None
    return np.array([(time - times[0]).total_seconds() for time in times])


def center_priors(photos: Sequence[Photo], frame: LocalFrame) -> CenterPriors | None:
    """Measured centres for an adjustment in the frame: of positions that somebody answers for.

    Returns:
        None where fewer than three photos have one: they do not tell a similarity.
    """
    xyz, sigmas = gps_priors(photos, frame)
    hints = np.array([photo.gps_is_hint for photo in photos], dtype=np.bool_)
    rows = np.flatnonzero(np.isfinite(sigmas).all(axis=1) & ~hints)
    if len(rows) < 3:
        return None
    covariance = np.array([np.diag(sigma**2) for sigma in sigmas[rows]])
    return CenterPriors(photo_of=rows, xyz=xyz[rows], covariance=covariance)
