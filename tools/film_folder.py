"""Films as strangers make them: shots, titles, black, a zoom, a logo, bars, bad codecs; and their truth."""

from dataclasses import dataclass, field
from functools import lru_cache, partial
from pathlib import Path
from typing import Literal

import cv2
import numpy as np

from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.simworld.town.scene import Scene
from featuredb.simworld.town.texture import Image8
from featuredb.simworld.world import WorldOptions, other_town_of, town_of
from featuredb.video.writer import VideoWriterOptions
from tools.worlds.film_world import Exposure, draw_frame, write_frames
from tools.worlds.flight_path import FlightPath, PathOptions

Kind = Literal["place", "other", "title", "black"]
WIDTH, HEIGHT, RATE_HZ = 960, 540, 25.0
_GOOD_CRF, _BAD_CRF, _WORSE_CRF = 20, 34, 37
_EXTENT_M = (32.0, 26.0)  # of flights over the small town
_SAMPLES = 1
_CARD = (38, 30, 26)


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


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameTruth:
    """A frame of a film.

    Attributes:
        piece, kind: what it belongs to. camera: true intrinsics; None where no camera saw it.
        pose: cam_from_local; None where it does not show the place.
    """

    piece: int
    kind: Kind
    camera: Camera | None
    pose: Rigid3 | None


@dataclass(frozen=True, slots=True, kw_only=True)
class FilmsTruth:
    """What is true of a folder of films: frames by the name of the film's file, in the place's frame."""

    frame: LocalFrame
    epsg: int
    films: dict[str, tuple[FrameTruth, ...]]


def write_films(folder: Path, scripts: tuple[Script, ...]) -> FilmsTruth:
    """Draw what is not there yet; a film whose script is the same is left as it is."""
    folder.mkdir(parents=True, exist_ok=True)
    for script in scripts:
        quality = VideoWriterOptions(crf=script.crf, preset="veryfast")
        file, mark = folder / f"{script.name}.mp4", folder.with_name(f"{script.name}.stamp")
        write_frames(file, partial(film_picture, script), script.frames, RATE_HZ, quality, mark, repr(script))
    town = place_scene(scripts[0].town)
    films = {f"{s.name}.mp4": tuple(_truth(s, i) for i in range(s.frames)) for s in scripts}
    return FilmsTruth(frame=town.frame, epsg=town.epsg, films=films)


def film_picture(script: Script, frame: int) -> Image8:
    """A frame (h, w, 3) uint8 RGB as it is given to the encoder."""
    number, at = script.at(frame)
    piece = script.pieces[number]
    if piece.kind == "black":
        return np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    if piece.kind == "title":
        return _card(piece.text)
    exposure = Exposure(samples=_SAMPLES, ev=script.ev)
    pose_at = _path(script.town, piece).pose
    time_s = at / RATE_HZ
    scene = _scene(script.town, piece.kind)
    picture = draw_frame(scene, piece.camera(at), pose_at, time_s, exposure, (piece.path.seed, at))
    bar = round(script.bars * HEIGHT)
    if bar:
        picture[:bar] = picture[-bar:] = 0
    return _with_logo(picture, bar) if script.logo else picture


def _truth(script: Script, frame: int) -> FrameTruth:
    number, at = script.at(frame)
    piece = script.pieces[number]
    camera = piece.camera(at) if piece.kind in ("place", "other") else None
    pose = _path(script.town, piece).pose(at / RATE_HZ) if piece.kind == "place" else None
    return FrameTruth(piece=number, kind=piece.kind, camera=camera, pose=pose)


def place_scene(seed: int) -> Scene:
    """The place of the scripts of a seed."""
    return _scene(seed, "place")


@lru_cache(maxsize=2)
def _scene(seed: int, kind: Kind) -> Scene:
    return (town_of if kind == "place" else other_town_of)(WorldOptions.short(seed))


@lru_cache(maxsize=8)
def _path(town: int, piece: Piece) -> FlightPath:
    return FlightPath(_scene(town, piece.kind), piece.path)


def _card(text: str) -> Image8:
    """A title card."""
    card: Image8 = np.full((HEIGHT, WIDTH, 3), _CARD, np.uint8)
    font, size, thick = cv2.FONT_HERSHEY_TRIPLEX, 1.8, 3
    (wide, high), _ = cv2.getTextSize(text, font, size, thick)
    at = ((WIDTH - wide) // 2, (HEIGHT + high) // 2)
    cv2.putText(card, text, at, font, size, (235, 228, 210), thick, cv2.LINE_AA)
    cv2.rectangle(card, (at[0], at[1] + 24), (at[0] + wide, at[1] + 28), (190, 150, 90), -1)
    return card


def _with_logo(picture: Image8, bar: int) -> Image8:
    """The sign of a channel over the lower right corner, half transparent."""
    drawn = picture.copy()
    right, low = WIDTH - 30, HEIGHT - bar - 24
    cv2.circle(drawn, (right - 150, low - 12), 20, (240, 240, 240), -1, cv2.LINE_AA)
    cv2.circle(drawn, (right - 150, low - 12), 11, (200, 40, 40), -1, cv2.LINE_AA)
    font = cv2.FONT_HERSHEY_DUPLEX
    cv2.putText(drawn, "SKY TV", (right - 120, low), font, 0.95, (245, 245, 245), 2, cv2.LINE_AA)
    return np.asarray(cv2.addWeighted(drawn, 0.75, picture, 0.25, 0.0), dtype=np.uint8)
