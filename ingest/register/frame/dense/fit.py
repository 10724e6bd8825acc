"""A pose from where all pieces of a render lie in the photo, each near where the pose puts it.

Like ICP: a render is made at the pose, each piece takes the highest place of its score map within a few
pixels, the pose is fitted to all of them with a robust loss, and a render is made anew. Coarse to fine.
A single piece is off by a pixel or two where laser intensity and photo show an edge differently; some
three hundred average.
"""

from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from featuredb.geometry.camera import Camera
from featuredb.render.rendering import Rendering
from ingest.register.frame.dense.oriented_gradients import GradientOptions, oriented_gradients
from ingest.register.frame.dense.scan_pictures import source_picture
from ingest.register.frame.dense.score_maps import TemplateOptions, cut_templates, peaks, search_around
from ingest.register.frame.features.matching import FrameMatches
from ingest.register.frame_registration import RenderSource


@dataclass(frozen=True, slots=True, kw_only=True)
class DenseFitOptions:
    """How pieces are matched; lengths in pixels of the render.

    Attributes:
        spacing_px: distance of neighbouring scan points in the renders, round by round: finer than the scan,
            since edges between splats are known better than their spacing.
        piece_px: side of a piece, round by round.
        more_rounds: at most, like the last one, until the pose moves less than settled_px.
        near_px: a piece's place is looked for this near, round by round: the first takes up what the search
            left.
        window_px: radius of the score map against whose spread a place is judged.
        min_score: height of a place in standard deviations of its map. Low: the robust loss weighs them, and
            a piece that has structure along one direction only still says where it is across.
        tolerance_px: of an inlier.
        max_pieces: per round.
    """

    spacing_px: tuple[float, ...] = (2.4, 3.75, 3.75)
    piece_px: tuple[int, ...] = (28, 40, 40)
    more_rounds: int = 8
    settled_px: float = 0.2
    near_px: tuple[int, ...] = (10, 6, 6)
    window_px: int = 12
    min_score: float = 1.5
    tolerance_px: float = 4.0
    max_pieces: int = 400
    gradients: GradientOptions = field(default_factory=GradientOptions)


def near_places(
    photo_gray: NDArray[np.uint8],
    camera: Camera,
    rendering: Rendering,
    source: RenderSource,
    piece_px: int,
    near_px: int,
    options: DenseFitOptions,
) -> FrameMatches:
    """Pieces of a render, and where in the photo they fit best near where the render's pose puts them.

    Args:
        photo_gray: (h, w) uint8 of `camera`'s size. rendering: made with that camera, shrunk.
    """
    channels = oriented_gradients(source_picture(rendering, source), rendering.valid, options.gradients)
    pieces = TemplateOptions(size_px=piece_px, spacing_px=piece_px // 2, max_count=options.max_pieces)
    templates = cut_templates(channels, rendering, pieces)
    size = (rendering.camera.width, rendering.camera.height)
    small = np.asarray(cv2.resize(photo_gray, size, interpolation=cv2.INTER_AREA))
    photo = oriented_gradients(small, None, options.gradients)
    maps = search_around(templates, photo, rendering.camera, rendering.cam_from_local, options.window_px)
    if len(maps) == 0:
        return FrameMatches(pixels=np.empty((0, 2)), points=np.empty((0, 3)))
    cut = options.window_px - near_px
    inner = np.ascontiguousarray(maps.maps[:, cut : maps.maps.shape[1] - cut, cut : maps.maps.shape[2] - cut])
    places, scores = peaks(inner)
    # A place on the rim has its top outside: the piece saw nothing here.
    good = (scores >= options.min_score) & (np.abs(places - near_px).max(axis=1) < near_px - 0.6)
    scale = np.array([camera.width / size[0], camera.height / size[1]])
    return FrameMatches(
        pixels=(maps.origin + cut + places)[good] * scale, points=np.asarray(maps.points_local)[good]
    )
