"""Settings of the adjustment of a map by a scan."""

from dataclasses import dataclass, field

from ingest.colmap.adjust import AdjustOptions
from ingest.register.structure.surface_fit import SurfaceFitOptions


@dataclass(frozen=True, slots=True, kw_only=True)
class AdjustLidarOptions:
    """The adjustment and its gates.

    Attributes:
        min_control: correspondences of registered frames; fewer leave lens and height to the surface alone.
        min_sigma_rel: least standard deviation of keypoints and of correspondences with the scan, as a share
            of the photo's longer side: a pixel in 4000. Tracks alone may fit to a third of that, but what
            lens models leave is common to neighbours and does not average out; trusted to their noise,
            thousands of tracks outvote the frames' correspondences.
        min_surface_m: of a scan's surface against map points; roughness of grass and pavement.
        focal_rel: standard deviation of the focal length's prior: structure from motion over flat ground
            was 25 % off on `brighton`.
        center_rel: of the principal point's, as a share of the longer side: most lenses are centred to that.
        aspect_rel: of the ratio of the two focal lengths: pixels are square.
        radial, tangential: of a coefficient's.
        lens_dilution: what lenses leave open counts so many times in the poses' covariances
            (`ingest.colmap.adjust.AdjustOptions.dilution`, measured there).
        rounds: of looking up the scan's planes; it ends earlier when points move by less than `settled_m`.
        steps: of the solver in each round.
        settled_m: see above; far below a scan's noise.
        reach_m: a plane further from a point says nothing of it.
        max_control_rel: median miss of the correspondences after the adjustment, as a share of the photo's
            longer side: 8 pixels in 4000. Honest ones miss by about two; more means that frames, map and
            scan contradict each other, and that robust weights have put the frames aside.
        max_reprojection_growth: of the median reprojection error, or of `reprojection_floor_rel` of the
            longer side where it is smaller (half a pixel in 4000).
        surface: the scan as planes; finer than for the similarity, since single points are moved.
    """

    min_control: int = 60
    min_sigma_rel: float = 0.00025
    min_surface_m: float = 0.03
    focal_rel: float = 0.3
    center_rel: float = 0.02
    aspect_rel: float = 0.002
    radial: float = 0.1
    tangential: float = 0.003
    lens_dilution: float = AdjustOptions().dilution
    rounds: int = 25
    steps: int = 8
    settled_m: float = 1e-3
    reach_m: float = 1.0
    max_control_rel: float = 0.002
    max_reprojection_growth: float = 0.1
    reprojection_floor_rel: float = 0.000125
    surface: SurfaceFitOptions = field(default_factory=lambda: SurfaceFitOptions(max_surface_points=250_000))
