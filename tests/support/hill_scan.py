"""A coloured scan of the hills of tests.support.hill_photos, as a LAZ file."""

from pathlib import Path

import cv2
import numpy as np

from tests.support.hill_photos import FRAME, hill_height
from tests.support.las_files import write_scan
from tests.support.planar_map import field_texture

EPSG = 32632
_SIDE_M, _TEXEL_M = 120.0, 0.08  # of field_texture


def write_hill_scan(
    path: Path,
    *,
    offset_m: tuple[float, float, float] = (0.0, 0.0, 0.0),
    texture_seed: int = 1,
    half_side_m: float = 45.0,
    spacing_m: float = 0.3,
    laser: bool = False,
) -> Path:
    """Write a scan with points about `spacing_m` apart, under another light than the photos.

    Args:
        offset_m: the scan lies so far east, north and up of where the photos' GPS has the hills.
        texture_seed: another seed is another field.
        laser: intensities in place of colours, which grow with the grey value, then fall, with speckle.
    """
    rng = np.random.default_rng(texture_seed)
    steps = np.arange(-half_side_m, half_side_m, spacing_m)
    east, north = (g.ravel() for g in np.meshgrid(steps, steps))
    east, north = (g + rng.uniform(-0.4, 0.4, len(g)) * spacing_m for g in (east, north))
    u = ((east + _SIDE_M / 2) / _TEXEL_M - 0.5).astype(np.float32)
    v = ((_SIDE_M / 2 - north) / _TEXEL_M - 0.5).astype(np.float32)
    # A point of a scan has the mean of its footprint.
    blurred = cv2.GaussianBlur(field_texture(texture_seed), (0, 0), 0.4 * spacing_m / _TEXEL_M)
    grey = cv2.remap(blurred, u.reshape(len(steps), -1), v.reshape(len(steps), -1), cv2.INTER_LINEAR)
    other_light = 255.0 * (grey.ravel() / 255.0) ** 1.3 * 0.85
    height = hill_height(east, north) + rng.normal(0, 0.02, len(east))
    utm = FRAME.utm_from_enu(np.column_stack([east, north, height]) + offset_m, EPSG)
    if laser:
        returned = np.abs(grey.ravel() - np.median(grey)) * rng.uniform(0.8, 1.2, len(east))
        intensity = (returned * 256.0).astype(np.uint16)
        return write_scan(path, utm, crs=f"EPSG:{EPSG}", point_format=6, intensity=intensity)
    value = (other_light * 256.0).astype(np.uint16)
    return write_scan(path, utm, crs=f"EPSG:{EPSG}", red=value, green=value, blue=value)
