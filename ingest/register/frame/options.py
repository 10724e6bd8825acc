"""Settings of registering one photo to a scan."""

from dataclasses import dataclass, field

from featuredb.errors import InvalidValueError
from ingest.register.frame.dense.confirmation import ConfirmOptions
from ingest.register.frame.dense.fit import DenseFitOptions
from ingest.register.frame.features.consistency import ConsistencyOptions
from ingest.register.frame.features.pool import PoolOptions
from ingest.register.frame.features.star import StarOptions
from ingest.register.frame.verdict import VerdictOptions
from ingest.register.frame_registration import RenderSource


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameOptions:
    """How one photo is registered.

    Attributes:
        sources: what is rendered, in the order in which it is tried; empty takes what the scan has. Colours
            come first: where a scan has them they match best by far, and a decisive result ends the search.
        search_side_px, final_side_px: longer side of the renders of the first round and of those from the
            pose found, at most.
        min_side_px: and at least; smaller pictures show too little.
        spacing_px: renders are no finer than this many pixels between scan points: splats show nothing more.
        search_features, final_features: per render. photo_features: of the photo.
        max_ratio: of descriptor distances, best to next place. Loose: true ones are among the bad.
        same_place: pool points nearer than this share of their distance from the camera are one place.
        guided_radius_rel: first radius around a predicted place in which a match is looked for, share of the
            longer side; the second is a third of it.
        min_log_nfa: a pose with less evidence among the features' matches is not looked into.
        decisive_log_nfa: one with so much, if the pictures confirm it, ends the search.
        promising_log_nfa: a pose of the dense search with less evidence of the pictures is not fitted. Before
            the fit right ones had 0.6 and more, of those at wrong places one in ten.
        more_looks: so many times at most the best pose is searched and fitted again, where it is not
            confirmed, but has that much evidence.
        sure_confirmation_log_nfa: and so does one that the pictures confirm so strongly. Three of
            four right poses do; wrong ones reached 8.
        tolerance_rel: inlier tolerance as a share of the longer side (4 pixels at 1600), where points are
            denser than pixels; max_tolerance_rel: where they are sparser, it grows up to this.
        prior_slack: in the fit the prior's deviations count so many times as large. People and devices
            understate them, and what matches leave open stays well within what the verdict bears.
        correlated_inliers: so many inliers count as one measurement. shared_point_share: standard
            deviation of what all inliers share, as a share of the scan's spacing. Both from the
            normalised errors of registered photos of the simulated town.
        threads: for renders and features; 0 takes as many as the process may use, up to four.
        seed: of RANSAC.
        confirm: how the pictures are asked.
    """

    sources: tuple[RenderSource, ...] = ()
    search_side_px: int = 960
    final_side_px: int = 1600
    min_side_px: int = 400
    spacing_px: float = 1.5
    search_features: int = 3000
    final_features: int = 6000
    photo_features: int = 5000
    max_ratio: float = 0.97
    same_place: float = 0.01
    guided_radius_rel: float = 0.012
    min_log_nfa: float = 2.0
    decisive_log_nfa: float = 60.0
    promising_log_nfa: float = 0.5
    more_looks: int = 2
    sure_confirmation_log_nfa: float = 20.0
    tolerance_rel: float = 0.0025
    max_tolerance_rel: float = 0.006
    prior_slack: float = 2.0
    correlated_inliers: float = 4.0
    shared_point_share: float = 0.1
    threads: int = 0
    seed: int = 0
    star: StarOptions = field(default_factory=StarOptions)
    pool: PoolOptions = field(default_factory=PoolOptions)
    consistency: ConsistencyOptions = field(default_factory=ConsistencyOptions)
    dense_fit: DenseFitOptions = field(default_factory=DenseFitOptions)
    confirm: ConfirmOptions = field(default_factory=ConfirmOptions)
    verdict: VerdictOptions = field(default_factory=VerdictOptions)

    def __post_init__(self) -> None:
        if not 64 <= self.min_side_px <= self.search_side_px <= self.final_side_px:
            raise InvalidValueError(
                "FrameOptions: expected 64 <= min_side_px <= search_side_px <= final_side_px, found "
                f"{self.min_side_px}, {self.search_side_px}, {self.final_side_px}"
            )
        if self.threads < 0:
            raise InvalidValueError(f"FrameOptions.threads: expected 0 or more, found {self.threads}")
