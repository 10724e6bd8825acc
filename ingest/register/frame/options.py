"""Settings of registering one photo to a scan."""

from dataclasses import dataclass, field

from featuredb.errors import InvalidValueError
from ingest.register.frame.dense.confirmation import ConfirmOptions


@dataclass(frozen=True, slots=True, kw_only=True)
class DenseFitOptions:
    """How pieces are matched; lengths in pixels of the render.

    Attributes:
        spacing_px: distance of neighbouring scan points in the renders, round by round: finer than the scan,
            since edges between splats are known better than their spacing.
        piece_px: least side of a piece, round by round.
        piece_points: so many scan points are across a piece, as far as the picture has room.
        more_rounds: at most, like the last one, until the pose moves less than a fifth of a pixel.
        near_px: a piece's place is looked for this near, round by round: the first takes up what the search
            left.
    """

    spacing_px: tuple[float, ...] = (2.4, 3.75, 3.75)
    piece_px: tuple[int, ...] = (28, 40, 40)
    piece_points: float = 15.0
    more_rounds: int = 8
    near_px: tuple[int, ...] = (10, 6, 6)


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameOptions:
    """How one photo is registered.

    Attributes:
        threads: for renders and features; 0 takes as many as the process may use, up to four.
        dense_fit: how a pose is fitted to pieces.
        confirm: how the pictures are asked.
    """

    threads: int = 0
    dense_fit: DenseFitOptions = field(default_factory=DenseFitOptions)
    confirm: ConfirmOptions = field(default_factory=ConfirmOptions)

    def __post_init__(self) -> None:
        if self.threads < 0:
            raise InvalidValueError(f"FrameOptions.threads: expected 0 or more, found {self.threads}")
