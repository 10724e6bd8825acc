"""Which picture of a rendering is compared with the photo."""

import numpy as np

from featuredb.errors import InvalidValueError
from featuredb.render.rendering import Rendering
from featuredb.render.shading import shaded_relief
from ingest.register.frame.oriented_gradients import FloatImage
from ingest.register.frame_registration import RenderSource

_LUMA = np.array([0.299, 0.587, 0.114], np.float32)


def source_picture(rendering: Rendering, source: RenderSource) -> FloatImage:
    """The grey picture (h, w) float32, 0..255, of a rendering.

    Raises:
        InvalidValueError: the scan has no such values.
    """
    if source == "rgb" and rendering.rgb is not None:
        return np.asarray(rendering.rgb.astype(np.float32) @ _LUMA, dtype=np.float32)
    if source == "intensity" and rendering.intensity is not None:
        return rendering.intensity.astype(np.float32)
    if source == "shaded":
        return shaded_relief(rendering).astype(np.float32)
    raise InvalidValueError(
        f"source_picture: expected a source that the scan has, found {source!r}; see available_sources()"
    )
