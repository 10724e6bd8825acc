"""Scripts of films as strangers make them: shots, titles, black, a zoom, a logo, bars, bad codecs."""

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from featuredb.geometry.camera import Camera
from tools.worlds.flight_path import PathOptions

Kind = Literal["place", "other", "title", "black"]
WIDTH, HEIGHT, RATE_HZ = 960, 540, 25.0
_GOOD_CRF, _BAD_CRF, _WORSE_CRF = 20, 34, 37
_EXTENT_M = (32.0, 26.0)  # of flights over the small town


@dataclass(frozen=True, slots=True, kw_only=True)
class Piece:
    """What stands between two cuts.

    Attributes:
        kind: a flight over the place or the other town, or what no camera saw.
        seconds: how long.
        path: of the camera.
        focal: of the lens, in widths of the picture. zoom: what it becomes in the middle third of the piece.
        text: of a title card.
    """

    kind: Kind
    seconds: float
    path: PathOptions = field(default_factory=PathOptions)
    focal: float = 0.757
    zoom: float | None = None
    text: str = ""

    @property
    def frames(self) -> int:
        return round(self.seconds * RATE_HZ)

    def camera(self, frame: int) -> Camera:
        """True intrinsics at a frame of the piece; the lens zooms slowly at first and at last."""
        share = np.clip(3.0 * frame / self.frames - 1.0, 0.0, 1.0)
        eased = float(share * share * (3.0 - 2.0 * share))
        focal = self.focal * ((self.zoom or self.focal) / self.focal) ** eased
        params = (focal * WIDTH, 0.5006 * WIDTH, 0.4991 * HEIGHT, -0.031, 0.012)
        return Camera(model="RADIAL", width=WIDTH, height=HEIGHT, params=params)


@dataclass(frozen=True, slots=True, kw_only=True)
class Script:
    """A film.

    Attributes:
        name: of its file, without suffix. pieces: in their order. town: seed of the place.
        logo: burnt into a corner. bars: share of the height that is black above, and below.
        crf: x264's constant rate factor. ev: stops brighter than others.
    """

    name: str
    pieces: tuple[Piece, ...]
    town: int
    logo: bool = False
    bars: float = 0.0
    crf: int = _GOOD_CRF
    ev: float = 0.0

    @property
    def frames(self) -> int:
        return sum(piece.frames for piece in self.pieces)

    def at(self, frame: int) -> tuple[int, int]:
        """Number of the piece that a frame of the film is in, and the frame's number there."""
        for number, piece in enumerate(self.pieces):
            if frame < piece.frames:
                return number, frame
            frame -= piece.frames
        raise IndexError(f"{self.name}: the film has {self.frames} frames")

    def span_s(self, number: int) -> tuple[float, float]:
        """Seconds at which a piece begins and ends."""
        first = sum(piece.frames for piece in self.pieces[:number])
        return first / RATE_HZ, (first + self.pieces[number].frames) / RATE_HZ


def six_films(seed: int) -> tuple[Script, ...]:
    """Three films of one place, one of another town, and two of the place that are compressed badly."""
    rng = np.random.default_rng((seed, 81))

    def flight(
        low: float, high: float, seconds: float, focal: float, *, speed: float = 6.0, **more: float
    ) -> Piece:
        path = PathOptions(
            seed=int(rng.integers(1 << 30)),
            duration_s=seconds,
            half_extent_m=_EXTENT_M,
            heights_m=(low, high),
            speed_m_s=speed,
            down_deg=(45.0, 75.0),
            river=False,
        )
        return Piece(kind="place", seconds=seconds, path=path, focal=focal, zoom=more.get("zoom"))

    def elsewhere(seconds: float, focal: float) -> Piece:
        path = flight(42.0, 60.0, seconds, focal).path
        return Piece(kind="other", seconds=seconds, path=path, focal=focal)

    black = Piece(kind="black", seconds=0.6)
    tour = (
        Piece(kind="title", seconds=1.2, text="THE OLD TOWN"),
        *(flight(42.0, 50.0, 5.6, 0.757), black, flight(48.0, 60.0, 5.6, 0.757)),
    )
    low = (flight(32.0, 40.0, 6.4, 0.62, speed=5.0), flight(38.0, 46.0, 5.0, 0.62, speed=5.0))
    abroad = (Piece(kind="title", seconds=1.2, text="FAR AWAY"), elsewhere(8.8, 0.7))
    best = (flight(44.0, 54.0, 5.6, 0.9), elsewhere(4.0, 0.9), flight(50.0, 60.0, 5.6, 0.9))
    return (
        Script(name="tour", town=seed, pieces=tour),
        Script(
            name="zoom",
            town=seed,
            pieces=(flight(60.0, 72.0, 10.0, 0.8, zoom=1.25),),
            logo=True,
            bars=0.11,
            ev=0.15,
        ),
        Script(name="low", town=seed, pieces=low, ev=-0.2),
        Script(name="abroad", town=seed, pieces=abroad),
        Script(name="old", town=seed, pieces=(flight(48.0, 58.0, 10.0, 0.757),), crf=_BAD_CRF),
        Script(name="best-of", town=seed, pieces=best, logo=True, crf=_WORSE_CRF),
    )
