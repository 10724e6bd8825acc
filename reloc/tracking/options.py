"""Settings of the tracking, one class per stage, every threshold with its reason."""

from dataclasses import dataclass, field

from featuredb.errors import InvalidValueError
from featuredb.features.extractor import ExtractorOptions
from reloc.localise.options import LocaliseOptions


@dataclass(frozen=True, slots=True, kw_only=True)
class FlowOptions:
    """Optical flow, at `reference_side_px`; lengths grow with the frames.

    Attributes:
        window_px: side of the patches. levels: of the pyramid above the frame.
        iterations: on each level. max_back_px: a patch that does not come back to where it was by more is
            lost (Kalal, Mikolajczyk and Matas, Forward-Backward Error, 2010).
    """

    window_px: int = 17
    levels: int = 2
    iterations: int = 12
    max_back_px: float = 0.6
    reference_side_px: int = 1280


@dataclass(frozen=True, slots=True, kw_only=True)
class TrackOptions:
    """From frames to poses.

    Attributes:
        landmarks: that are followed; more sharpen the pose as their root, and cost in proportion.
        columns, rows: of the grid over which they are spread.
        min_landmarks: that agree with a pose; fewer are a lost track. Simulated frames with 20 to 30 were off
            by 0.5 to 1.2 m, with bounds that said 1 m.
        least_share: of those that the flow followed, that agree. least_kept: of those that should be in view
            of the next frame; simulated turns on the spot keep 68 % and more, cuts to look-alikes 10 to 43 %.
        keyframe_every: frames from one that is matched against the map to the next.
        keyframe_soonest: so many frames, where landmarks run out: fewer than `few_landmarks` of those wanted.
        answer_after: frames after which the answer to a keyframe is waited for: so the same film gives
            the same poses, however busy the machine is. While the track is lost: `lost_answer_after`.
        keyframe_every_s, answer_after_s, lost_answer_after_s: of the film, where that is sooner: pictures
            that come one in a second are each looked for, and not one in twenty.
        catch_up: frames by which a track that was found comes nearer to the frame at hand with each new one,
            two or more. With all at once one frame waited for 0.18 s.
        earlier: frames before one that is looked for that are kept, and followed backwards once it is found:
            the first frames of a film may be harder to find than those two seconds on. Not live.
        live: answers are taken as soon as they are there, and no frame waits for one. live_frames: that are
            kept meanwhile; 60 are two seconds, and 55 MB at 1280x720. live_steps: frames by which a track
            that was found is carried to the one at hand while a client waits; more are left to the thread.
        min_matches: of a keyframe with the map. max_unconfirmed: keyframes in a row without them; then the
            track is lost, however well its old landmarks agree with each other.
        keyframes: features of a keyframe, whose pose is known to some pixels: as many as a query's take twice
            the time, and place it hardly better. fine_keyframes: where landmarks run out, as over water.
        localise: how a lost track is found again.
    """

    flow: FlowOptions = field(default_factory=FlowOptions)
    landmarks: int = 220
    columns: int = 16
    rows: int = 9
    min_landmarks: int = 30
    least_share: float = 0.4
    least_kept: float = 0.5
    keyframe_every: int = 20
    keyframe_soonest: int = 6
    few_landmarks: float = 0.5
    answer_after: int = 10
    lost_answer_after: int = 20
    keyframe_every_s: float = 1.0
    answer_after_s: float = 0.6
    lost_answer_after_s: float = 1.0
    catch_up: int = 5
    earlier: int = 60
    live: bool = False
    live_frames: int = 60
    live_steps: int = 3
    min_matches: int = 30
    max_unconfirmed: int = 3
    keyframes: ExtractorOptions = field(
        default_factory=lambda: ExtractorOptions(max_side_px=720, max_features=1500, oversample=1.0)
    )
    fine_keyframes: ExtractorOptions = field(
        default_factory=lambda: ExtractorOptions(max_side_px=1280, max_features=6000, oversample=1.0)
    )
    localise: LocaliseOptions = field(default_factory=LocaliseOptions)

    def __post_init__(self) -> None:
        if self.catch_up < 2:
            raise InvalidValueError(
                f"TrackOptions.catch_up: expected 2 frames or more, found {self.catch_up}: a track that was "
                "found would never come to the frame at hand"
            )
