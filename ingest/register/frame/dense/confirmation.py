"""Whether pictures confirm a pose, of one photo or of all photos of a map together.

Each piece of the rendering at the pose is searched in the photo within a window; without any relation between
the two its best place is anywhere there. The evidence is the binomial tail. All photos of a map are asked
together of one similarity; how often chance agrees is then taken from wrong places, too.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp
from scipy.stats import betabinom, binom

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.sim3 import Sim3
from featuredb.maps.feature_map import MapImage
from featuredb.render.cloud import PointCloud
from ingest.register.frame.dense.pictures import finest_side_px, pinhole_view
from ingest.register.frame.dense.score_maps import PIECE_PX, peaks, score_maps_of
from ingest.register.frame.views import DEFAULTS, FrameViews
from ingest.register.frame_registration import RenderSource

_OVERLAP = 2  # pieces that overlap by half say about half as much as ones that do not

# Where the line between confirmed and not is; docs/measurements/registration.md shows the distributions.
_SIDE_PX = 480  # longer side of the view on which pieces are compared, where the scan is dense enough
_SEARCH_PX = 16  # radius of the window in which a piece is searched
_NEAR_PX = 3.0  # a piece agrees with the pose when its best place is this near
MIN_PIECES = 25  # fewer pieces with structure cannot confirm anything
_MAX_PIECES = 600
# A pose is refused when less than that share of the lower half of the pieces, by height, agrees while of the
# upper half that many times as many do, and the halves lie that far apart: then what stands on the ground was
# matched, which an ortho image shows displaced, and not the ground.
_MIN_LOW_AGREEING = 0.2
_MAX_LAYER_RATIO = 1.5
_MIN_LAYER_M = 2.0
# Smallest evidence, -log10 of the probability that chance puts as many so near, less six free parameters'
# worth.
MIN_LOG_NFA = 5.0
# Of a piece whose best place is anywhere in the window.
CHANCE = float(np.pi * (_NEAR_PX + 0.5) ** 2 / (2 * _SEARCH_PX + 1) ** 2)
_MIN_CELLS = 4  # of 16 parts of the photo, how many must hold a piece that agrees: a pose needs width


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Pieces:
    """Pieces of a photo that were compared with the scan at a pose.

    Attributes:
        points_local: (n, 3) of the scan at their middles, metres.
        pixels: (n, 2) of their best places, as shares of the photo's sides.
        near: (n,) whose best place is where the pose puts them; a share of CHANCE is so by accident.
        side_m: of a piece, at the median distance.
    """

    points_local: FloatArray
    pixels: FloatArray
    near: NDArray[np.bool_]
    side_m: float


@dataclass(frozen=True, slots=True, kw_only=True)
class PictureConfirmation:
    """Whether the pictures confirm a pose, and the figures behind it.

    Attributes:
        pieces, agreeing: how many pieces of the photo were compared, and how many put the scan where the
            pose does.
        log_nfa: evidence, see MIN_LOG_NFA.
        cells: parts of the photo, of 16, that hold an agreeing piece.
        message: why not, or "".
    """

    confirmed: bool
    pieces: int
    message: str
    agreeing: int = 0
    log_nfa: float = 0.0
    cells: int = 0


def confirm_pose(
    views: FrameViews, camera: Camera, cam_from_local: Rigid3, source: RenderSource
) -> PictureConfirmation:
    """Asks the photo's pieces where they belong, at a pose that somebody else found, with its lens."""
    finest = views.options.finest_spacing
    found = compared_pieces(views.gray, camera, cam_from_local, views.cloud, source, finest)
    n, near = len(found.near), found.near
    if n < MIN_PIECES:
        few = f"only {n} pieces of the picture have structure, {MIN_PIECES} are needed"
        return PictureConfirmation(confirmed=False, pieces=n, message=few)
    agreeing = int(near.sum())
    log_nfa = log_nfa_of(agreeing, n)
    cells = len(np.unique(np.clip((found.pixels[near] * 4).astype(int), 0, 3) @ (4, 1)))
    message = _objection(agreeing / n, log_nfa, cells, views.options.min_agreeing) or _layers_differ(found)
    return PictureConfirmation(
        confirmed=not message, pieces=n, agreeing=agreeing, log_nfa=log_nfa, cells=cells, message=message
    )


def log_nfa_of(agreeing: int, pieces: int) -> float:
    """-log10 of the probability that chance puts as many of so many pieces where they belong."""
    # Six parameters can bring three pieces into place whatever they show.
    free, total = max(agreeing // _OVERLAP - 3, 0), pieces // _OVERLAP - 3
    return float(-binom.logsf(free - 1, total, CHANCE) / np.log(10.0))


def compared_pieces(
    photo_gray: NDArray[np.uint8],
    camera: Camera,
    cam_from_local: Rigid3,
    cloud: PointCloud,
    source: RenderSource,
    finest_spacing: float = DEFAULTS.finest_spacing,
) -> Pieces:
    """Where pieces of a rendering at a pose fit the photo (h, w) best, beside where the pose puts them."""
    finest = finest_side_px(camera, cam_from_local, cloud, finest_spacing)
    view = pinhole_view(photo_gray, camera, min(_SIDE_PX, finest))
    margin_px = PIECE_PX // 2
    maps = score_maps_of(view, cam_from_local, margin_px, cloud, source, _SEARCH_PX, _MAX_PIECES)
    places = peaks(maps.maps)[0] if len(maps) else np.zeros((0, 2))
    depth = cam_from_local.act(maps.points_local)[:, 2] if len(maps) else np.zeros(1)
    return Pieces(
        points_local=maps.points_local,
        pixels=(maps.origin + places) / (view.camera.width, view.camera.height),
        near=np.linalg.norm(places - _SEARCH_PX, axis=1) <= _NEAR_PX,
        side_m=PIECE_PX * float(np.median(depth)) / view.camera.focal_px,
    )


def _objection(share: float, log_nfa: float, cells: int, min_share: float) -> str:
    if share < min_share:
        return f"{share:.0%} of the pieces lie where the pose puts them, {min_share:.0%} are needed"
    if log_nfa < MIN_LOG_NFA:
        return f"evidence of 10^-{log_nfa:.1f} against chance, 10^-{MIN_LOG_NFA:g} is needed"
    if cells < _MIN_CELLS:
        return f"agreement in {cells} of 16 parts of the picture, {_MIN_CELLS} are needed"
    return ""


def _layers_differ(found: Pieces) -> str:
    """Why the lower and the upper half of the pieces, by height, speak against a pose, or ""."""
    height = found.points_local[:, 2]
    low = height <= np.median(height)
    if low.all() or np.median(height[~low]) - np.median(height[low]) <= _MIN_LAYER_M:
        return ""
    below, above = float(found.near[low].mean()), float(found.near[~low].mean())
    if below < _MIN_LOW_AGREEING and above > _MAX_LAYER_RATIO * below:
        return f"{below:.0%} of the lower pieces agree and {above:.0%} of the upper ones"
    return ""


# All photos of a map together: pieces that show the same place of the scan count as one.

# Of a piece's side, half of its area: pieces that overlap by half say about half as much as ones that do not.
_CELL = 0.7
_MOST_EACH = 10.0  # places of one similarity that count as such: neighbours on a street agree together
_BEFORE = 10.0  # so many places elsewhere weigh as much as what is known before: chance alone


@dataclass(frozen=True, slots=True, kw_only=True)
class JointEvidence:
    """Of one similarity.

    Attributes:
        places: of the scan that pieces show. agreeing: of these, in shares of the pieces of each.
    """

    places: int
    agreeing: float

    @classmethod
    def of_cells(cls, cells: NDArray[np.int64], agrees: NDArray[np.bool_]) -> "JointEvidence":
        """Of pieces (n,) that agree or not, in cells (n, d)."""
        place = np.unique(cells, axis=0, return_inverse=True)[1].reshape(-1)
        count = np.bincount(place)
        share = np.bincount(place, weights=agrees) / np.maximum(count, 1)
        return cls(places=len(count), agreeing=float(share.sum()))

    def log_nfa(self, elsewhere: Sequence["JointEvidence"], asked: int) -> float:
        """-log10 of how often as many would agree at one of so many wrong places (beta-binomial).

        How often a place agrees that is wrong is taken from others, and from chance: pictures of streets
        agree with streets.

        Args:
            elsewhere: of wrong places. asked: places of which this is the best.
        """
        agreed, failed = _BEFORE * CHANCE, _BEFORE * (1.0 - CHANCE)
        for other in elsewhere:
            weight = min(1.0, _MOST_EACH / max(other.places, 1))
            agreed += weight * other.agreeing
            failed += weight * (other.places - other.agreeing)
        counts = np.arange(int(self.agreeing), self.places + 1)
        tail = float(logsumexp(betabinom.logpmf(counts, self.places, agreed, failed))) / np.log(10.0)
        return float(max(-tail - np.log10(asked), 0.0))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class AskedPhoto:
    """A photo of a map that is asked with others: pose in the map as it is, lens, grey pixels (h, w)."""

    image: MapImage
    camera: Camera
    gray: NDArray[np.uint8]


def evidence_of(
    new_from_old: Sim3, photos: Sequence[AskedPhoto], cloud: PointCloud, source: RenderSource
) -> JointEvidence:
    """What the photos say of a place of the map."""
    asked = []
    for photo in photos:
        pose = new_from_old.act_on_pose(photo.image.cam_from_local)
        pieces = compared_pieces(photo.gray, photo.camera, pose, cloud, source)
        if len(pieces.near):
            asked.append(pieces)
    if not asked:
        return JointEvidence(places=0, agreeing=0.0)
    side_m = _CELL * float(np.median([pieces.side_m for pieces in asked]))
    cells = np.floor(np.vstack([pieces.points_local for pieces in asked])[:, :2] / side_m)
    return JointEvidence.of_cells(cells.astype(np.int64), np.concatenate([pieces.near for pieces in asked]))
