"""One lens of many photos, estimated with all their poses: a photo alone hardly tells it from its height.

One adjustment (`featuredb.adjust`) over the pixels of all photos, with the prior of
`reloc.localise.lens_prior`. The map's points are held fixed.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from featuredb.adjust.problem import Problem
from featuredb.adjust.terms import Block, LensPrior, Marks, Terms, whole_camera
from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from reloc.answered_view import AnsweredView
from reloc.localise.lens_prior import LensPriors, QueryLensPrior, opencv_by_lens, with_lens
from reloc.localise.options import PoseOptions
from reloc.localise.self_calibration import LensProblem, calibrate, measured_noise_px
from reloc.wire.query import CameraRequest, LocaliseReply

_LEAST_PHOTOS = 3  # that agree on a lens
# By how much more a photo's pixels disagree with the common lens than with one of its own is half a
# chi-square of eight degrees of freedom, times a variance factor: errors of neighbouring pixels, and of a
# real map's points, are not independent. The photos' median tells that factor; no more is believed than how
# far photos disagree about lenses (decision 0004).
_MEDIAN_EXCESS, _MAX_EXCESS = 0.5 * chdtri(8, 0.5), 0.5 * chdtri(8, 0.001)
# The focal lengths of random groups of 3 to 14 photos of a simulated drone were off by 1.4 to 1.7 of the
# plain sigmas, where excesses tell nothing.
_LEAST_FACTOR, _MOST_FACTOR = 1.6**2, 50.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LensView:
    """What a localised photo says of its lens: pixels (k, 2) of points (k, 3), and its own pose and lens."""

    pixels: FloatArray
    points: FloatArray
    cam_from_local: Rigid3
    camera: Camera


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SharedLens:
    """A lens that photos agree on."""

    camera: Camera  # OPENCV
    sigmas: FloatArray  # (8,) one standard deviation of each of its parameters, in their order
    agree: NDArray[np.bool_]  # (n,) which of the photos

    def as_request(self) -> CameraRequest:
        """As a query takes it."""
        return CameraRequest(**asdict(self.camera), sigmas=tuple(float(s) for s in self.sigmas))


def views_of(replies: Sequence[LocaliseReply]) -> list[LensView | None]:
    """From answers with inliers; None for those that are not localised, or whose lens was known."""
    views: list[LensView | None] = []
    frame: LocalFrame | None = None
    for reply in replies:
        utm, lens, inliers = reply.utm, reply.camera, reply.inlier_points
        if utm is None or lens is None or inliers is None or lens.source not in ("exif", "estimated"):
            views.append(None)
            continue
        view = AnsweredView.of_reply(reply)
        frame = frame or view.frame
        views.append(
            LensView(
                pixels=np.array(inliers.pixels, dtype=np.float64).reshape(-1, 2),
                points=frame.enu_from_utm(np.array(inliers.utm, dtype=np.float64).reshape(-1, 3), utm.epsg),
                cam_from_local=view.seen_in(frame).cam_from_local,
                camera=view.camera,
            )
        )
    return views


def lenses_of_cameras(
    keys: Sequence[str], views: Sequence[LensView | None]
) -> tuple[dict[str, SharedLens], list[CameraRequest | None]]:
    """The lens of each camera whose photos agree on one, and what each photo (n) is to be asked with.

    A photo that contradicts its camera's lens, or whose lens is known already, is asked with none. `keys`:
    (n) of the photos' cameras. `views`: (n), see `views_of`.
    """
    rows: dict[str, list[int]] = {}
    for row, (key, view) in enumerate(zip(keys, views, strict=True)):
        if view is not None:
            rows.setdefault(key, []).append(row)
    lenses: dict[str, SharedLens] = {}
    asked_with: list[CameraRequest | None] = [None] * len(views)
    for key, own in rows.items():
        lens = shared_lens([view for view in (views[row] for row in own) if view is not None])
        if lens is None:
            continue
        lenses[key] = lens
        for row, agrees in zip(own, lens.agree, strict=True):
            asked_with[row] = lens.as_request() if agrees else None
    return lenses, asked_with


def shared_lens(views: Sequence[LensView]) -> SharedLens | None:
    """The lens that most views agree on, without those that do not; None where too few are left.

    Views are of pictures of one size, with cameras of OPENCV's or SIMPLE_RADIAL's model.
    """
    priors = LensPriors()
    agree = np.ones(len(views), dtype=np.bool_)
    excess = np.full(len(views), np.inf)
    if len(views) < _LEAST_PHOTOS:
        return None
    first = views[0].camera
    # Where a photo's own lens lies among the priors does not matter: all of them outweigh these by far.
    focal_px = float(np.median([v.camera.focal_px for v in views]))
    prior = priors.around(first, focal_px, priors.unknown_focal_rel)
    noise_px = 0.25 * PoseOptions().tolerance_px(first)
    noise = [measured_noise_px(v.pixels, v.points, v.cam_from_local, v.camera, noise_px) for v in views]
    problems, alone = [], []  # each photo's pixels, and what they cost with a lens of its own
    for view, own_px in zip(views, noise, strict=True):
        pixels, points, trust = view.pixels, view.points, (noise_px / own_px) ** 2
        problem = LensProblem(pixels=pixels, points=points, noise_px=noise_px, trust=trust, prior=prior)
        problems.append(problem)
        moved, lens, _ = calibrate(pixels, points, view.cam_from_local, view.camera, prior, noise_px)
        alone.append(problem.cost_of_pixels(moved, lens))
    while agree.sum() >= _LEAST_PHOTOS:
        rows = [int(r) for r in np.flatnonzero(agree)]
        start = views[max(rows, key=lambda r: len(views[r].pixels))].camera
        block, covariance = _together(
            [views[r] for r in rows], [noise[r] for r in rows], whole_camera(start), prior
        )
        camera = block.cameras[0]
        for r, found in zip(rows, block.cam_from_block, strict=True):
            excess[r] = problems[r].cost_of_pixels(found, camera) - alone[r]
        factor = float(np.clip(np.median(excess[rows]) / _MEDIAN_EXCESS, _LEAST_FACTOR, _MOST_FACTOR))
        worst = max(rows, key=lambda r: excess[r])
        if excess[worst] <= factor * _MAX_EXCESS:
            return SharedLens(camera=camera, sigmas=np.sqrt(factor * np.diag(covariance)), agree=agree)
        agree[worst] = False
    return None


def _together(
    views: Sequence[LensView], noise_px: Sequence[float], start: Camera, prior: QueryLensPrior
) -> tuple[Block, FloatArray]:
    """The poses and the lens that all pixels say together, and the lens's covariance (8, 8)."""
    count = [len(view.pixels) for view in views]
    block = Block(
        names=tuple(str(k) for k in range(len(views))),
        cameras=(start,),
        camera_of=np.zeros(len(views), dtype=np.int64),
        cam_from_block=tuple(view.cam_from_local for view in views),
        xyz=np.zeros((0, 3)),
        point_of=np.zeros(0, dtype=np.int64),
        photo_of=np.zeros(0, dtype=np.int64),
        xy=np.zeros((0, 2)),
    )
    marks = Marks(
        xyz=np.concatenate([view.points for view in views]),
        photo_of=np.repeat(np.arange(len(views)), count),
        xy=np.concatenate([view.pixels for view in views]),
        sigma_px=np.repeat(noise_px, count),
    )
    by_lens = opencv_by_lens(prior.mean)  # the prior is of other parameters than OPENCV's own
    known = LensPrior(
        mean=with_lens(start, prior.mean), covariance=by_lens @ np.diag(1.0 / prior.information) @ by_lens.T
    )
    problem = Problem(block, Terms(keypoint_px=1.0, lenses=(known,), marks=marks))
    problem.solve(100, 1e-10)
    return problem.block(), problem.marginals().lens(0)
