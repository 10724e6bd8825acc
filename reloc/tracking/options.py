"""Settings of the tracking, one class per stage, every threshold with its reason."""

from dataclasses import dataclass, field

from featuredb.features.extractor import ExtractorOptions
from reloc.localise.options import LocaliseOptions


@dataclass(frozen=True, slots=True, kw_only=True)
class FlowOptions:
    """Optical flow, at `reference_side_px`; lengths grow with the frames."""

    window_px: int = 17  # side of the patches
    levels: int = 2  # of the pyramid above the frame
    iterations: int = 12  # on each level
    # A patch that does not come back to where it was by more is lost (Kalal, Mikolajczyk and Matas,
    # Forward-Backward Error, 2010).
    max_back_px: float = 0.6
    reference_side_px: int = 1280


@dataclass(frozen=True, slots=True, kw_only=True)
class TrackOptions:
    """From frames to poses."""

    flow: FlowOptions = field(default_factory=FlowOptions)
    landmarks: int = 220  # that are followed; more sharpen the pose as their root, and cost in proportion
    columns: int = 16  # of the grid over which they are spread
    rows: int = 9
    # That agree with a pose; fewer are a lost track. Simulated frames with 20 to 30 were off by 0.5 to 1.2 m,
    # with bounds that said 1 m.
    min_landmarks: int = 30
    least_share: float = 0.4  # of those that the flow followed, that agree
    # Of those that should be in view of the next frame; simulated turns on the spot keep 68 % and more, cuts
    # to look-alikes 10 to 43 %.
    least_kept: float = 0.5
    keyframe_every: int = 20  # frames from one that is matched against the map to the next
    keyframe_soonest: int = 6  # so many frames, where landmarks run out:
    few_landmarks: float = 0.5  # fewer than this share of those wanted
    # Frames after which the answer to a keyframe is waited for, so that the same film gives the same poses,
    # however busy the machine is; the second: while the track is lost.
    answer_after: int = 10
    lost_answer_after: int = 20
    # Of the film, where that is sooner: pictures that come one in a second are each looked for.
    keyframe_every_s: float = 1.0
    answer_after_s: float = 0.6
    lost_answer_after_s: float = 1.0
    # Frames by which a track that was found comes nearer to the frame at hand with each new one, two or more.
    # With all at once one frame waited for 0.18 s.
    catch_up: int = 5
    # Frames before one that is looked for that are followed backwards once it is found: the first frames of a
    # film may be harder to find than those two seconds on. Not live.
    earlier: int = 60
    live: bool = False  # answers are taken as soon as they are there, and no frame waits for one
    live_frames: int = 60  # that are kept meanwhile: two seconds, and 55 MB at 1280x720
    min_matches: int = 30  # of a keyframe with the map
    max_unconfirmed: int = 3  # keyframes in a row without them; then the track is lost
    # Of a keyframe, whose pose is known to some pixels: as many as a query's take twice the time, and place
    # it hardly better. The second: where landmarks run out, as over water.
    keyframes: ExtractorOptions = field(
        default_factory=lambda: ExtractorOptions(first_octave_px=1200, max_features=1500, oversample=1.0)
    )
    fine_keyframes: ExtractorOptions = field(
        default_factory=lambda: ExtractorOptions(first_octave_px=2000, max_features=6000, oversample=1.0)
    )
    localise: LocaliseOptions = field(default_factory=LocaliseOptions)  # how a lost track is found again
