"""Settings of the localisation, one class per stage, every threshold with its reason."""

from dataclasses import dataclass, field

from featuredb.features.extractor import ExtractorOptions
from featuredb.geometry.camera import Camera
from reloc.localise.acceptance import AcceptanceOptions
from reloc.localise.lens_prior import LensPriors


@dataclass(frozen=True, slots=True, kw_only=True)
class CandidateOptions:
    """Which images of the maps are tried."""

    # The strongest query features that vote for their nearest map point. Of a million points 1,000 find the
    # place of all photos of the row `scale-1m`.
    vote_features: int = 1000
    vote_background: int = 10  # their neighbour of this rank says how near a point must be to be told apart
    vote_tie: float = 0.02  # points farther than the nearest by this share of its distance are as near
    max_cluster_images: int = 12  # images of one covisibility cluster; about what one photo can see
    # shortlist, shortlist_features: clusters with most votes; where the first of them does not settle it, so
    # many of the best spread features are matched against each of the others, and those that match best are
    # tried.
    shortlist: int = 10
    shortlist_features: int = 200
    max_clusters: int = 3  # clusters that are tried, best first
    # An area with at most so many points in reach is matched as a whole. Where all areas have no more
    # together, and are few, all are, without voting, which would cost more.
    single_cluster_points: int = 20_000
    prior_sigmas: float = 3.0  # images within so many standard deviations of the prior are in reach ...
    prior_reach: float = 2.0  # ... plus so many times the distance from which they look at their scene


@dataclass(frozen=True, slots=True, kw_only=True)
class PointMatchOptions:
    """2D-3D matching."""

    # So many features are matched first, the rest only if these do not settle it: a third of them finds the
    # pose of a photo that shows the map well, in a third of the time.
    first_features: int = 1000
    ratio: float = 0.85  # largest ratio of distances of the best to the second-best place
    # Map points closer together than this share of their viewing distance are one place (a track that broke
    # in two), and do not compete in the ratio test.
    same_place: float = 0.005
    # Radius in which a projected point looks for its keypoint, as a share of the image's longer side (8
    # pixels at 1600).
    guided_radius_rel: float = 0.005
    guided_max_distance: float = 300.0  # largest descriptor distance (length 512) of such a match


@dataclass(frozen=True, slots=True, kw_only=True)
class PoseOptions:
    """Robust pose."""

    # Inlier tolerance as a share of the image's longer side (4 pixels at 1600): SIFT's own 1 px, the map's
    # point errors, and a lens that is not quite the map's.
    tolerance_rel: float = 0.0025
    min_matches: int = 8  # fewer are not tried
    # max_iterations, confidence, seed: of RANSAC.
    max_iterations: int = 20_000
    confidence: float = 0.9999
    seed: int = 0
    # What is known of a lens that neither the request nor a map describes.
    lens: LensPriors = field(default_factory=LensPriors)

    def tolerance_px(self, camera: Camera) -> float:
        """The inlier tolerance in pictures of this camera's size."""
        return self.tolerance_rel * max(camera.width, camera.height)


@dataclass(frozen=True, slots=True, kw_only=True)
class LocaliseOptions:
    """All of the localisation's settings."""

    extractor: ExtractorOptions = field(
        default_factory=lambda: ExtractorOptions(first_octave_px=1600, max_features=3000, oversample=1.25)
    )
    candidates: CandidateOptions = field(default_factory=CandidateOptions)
    matching: PointMatchOptions = field(default_factory=PointMatchOptions)
    pose: PoseOptions = field(default_factory=PoseOptions)
    acceptance: AcceptanceOptions = field(default_factory=AcceptanceOptions)
