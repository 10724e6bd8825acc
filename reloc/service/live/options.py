"""What a server may be told about live sessions."""

from dataclasses import dataclass, field

from featuredb.errors import InvalidValueError
from featuredb.features.decode import DecodeLimits
from reloc.tracking.options import TrackOptions


@dataclass(frozen=True, slots=True, kw_only=True)
class LiveOptions:
    """Options of the live sessions of one server.

    Attributes:
        max_sessions: open at a time; 0 takes none. Following 30 frames a second and matching keyframes take
            about a core, so two fill the reference machine.
        idle_timeout_s: a session without a usable frame for so long ends; a client that dies is noticed at
            once, one whose network breaks is not.
        limits: bytes and pixels of a frame; 8 MiB and 16 million hold a 4K frame of any quality.
        max_side_px: larger frames are made smaller for tracking, as those of films are.
        track: the tracker's settings; its localisation is that of the server's queries.
    """

    max_sessions: int = 2
    idle_timeout_s: float = 5.0
    limits: DecodeLimits = field(
        default_factory=lambda: DecodeLimits(
            max_bytes=8 << 20, max_pixels=16_000_000, max_scan_pixels=160_000_000, max_side_px=8192
        )
    )
    max_side_px: int = 1280
    track: TrackOptions = field(default_factory=lambda: TrackOptions(live=True))

    def __post_init__(self) -> None:
        if self.max_sessions < 0:
            raise InvalidValueError(f"LiveOptions.max_sessions: expected >= 0, found {self.max_sessions}")
        for name, value in (("idle_timeout_s", self.idle_timeout_s), ("max_side_px", self.max_side_px)):
            if not value > 0:
                raise InvalidValueError(f"LiveOptions.{name}: expected > 0, found {value}")
