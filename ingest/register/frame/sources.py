"""What can be rendered of a scan: its colours, the laser's intensity, the relief."""

import cv2
import numpy as np
from numpy.typing import NDArray

from featuredb.errors import InvalidValueError
from featuredb.render.cloud import PointCloud
from featuredb.render.rendering import Rendering
from featuredb.render.shading import shaded_relief
from ingest.register.frame_registration import RenderSource


def available_sources(cloud: PointCloud) -> tuple[RenderSource, ...]:
    """What can be rendered of a scan, most telling first."""
    sources: list[RenderSource] = []
    if cloud.rgb is not None:
        sources.append("rgb")
    if cloud.intensity is not None:
        sources.append("intensity")
    return (*sources, "shaded")


def searched_sources(cloud: PointCloud) -> tuple[RenderSource, ...]:
    """Those in which poses are searched, and not only compared.

    Shaded relief has nothing to match and few edges (docs/measurements/descriptors.md): it is searched where
    the scan has no more to show.
    """
    *telling, shaded = available_sources(cloud)
    return tuple(telling) or (shaded,)


def source_image(rendering: Rendering, source: RenderSource) -> NDArray[np.uint8]:
    """(h, w) uint8, what the render shows by one of the scan's properties.

    Raises:
        InvalidValueError: the scan does not have it.
    """
    if source == "shaded":
        return shaded_relief(rendering)
    if source == "rgb" and rendering.rgb is not None:
        return np.asarray(cv2.cvtColor(rendering.rgb, cv2.COLOR_RGB2GRAY), dtype=np.uint8)
    if source == "intensity" and rendering.intensity is not None:
        return rendering.intensity
    raise InvalidValueError(f"source_image: expected a scan with {source}, found one without")
