"""Films as strangers make them: shots, titles, black, a zoom, a logo, bars, bad codecs; and their truth."""

from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.simworld.town.texture import Image8
from featuredb.simworld.world import WorldOptions, town_of
from featuredb.video.writer import VideoWriterOptions
from tools.worlds.film_world import FilmOptions, PathOptions, film_frame, film_truth, write_frames

WIDTH, HEIGHT, RATE_HZ = 960, 540, 25.0
_GOOD_CRF, _BAD_CRF, _WORSE_CRF = 20, 34, 37
_EXTENT_M = (32.0, 26.0)  # of flights over the small town
_CARD = (38, 30, 26)


class Card(NamedTuple):
    """What no camera saw: a title, or black where there is no text."""

    frames: int
    text: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class Script:
    """A film.

    Attributes:
        name: of its file, without suffix.
        pieces: what stands between cuts, in its order; a flight that is cut away from end to end shows
            another town.
        logo: burnt into a corner. bars: share of the height that is black above, and below.
        crf: x264's constant rate factor. ev: stops brighter than others.
    """

    name: str
    pieces: tuple[FilmOptions | Card, ...]
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

    def shots_s(self) -> dict[int, tuple[float, float]]:
        """Seconds at which pieces that show the place begin and end, by their numbers."""
        ends = np.cumsum([0, *(piece.frames for piece in self.pieces)]) / RATE_HZ
        shown = [n for n, p in enumerate(self.pieces) if isinstance(p, FilmOptions) and p.cut is None]
        return {number: (float(ends[number]), float(ends[number + 1])) for number in shown}


def six_films(seed: int) -> tuple[Script, ...]:
    """Three films of one place, one of another town, and two of the place that are compressed badly."""
    rng = np.random.default_rng((seed, 81))

    def flight(
        low: float, high: float, seconds: float, focal: float, speed: float = 6.0, zoom: float | None = None
    ) -> FilmOptions:
        path = PathOptions(
            seed=int(rng.integers(1 << 30)),
            half_extent_m=_EXTENT_M,
            heights_m=(low, high),
            speed_m_s=speed,
            down_deg=(45.0, 75.0),
            river=False,
        )
        return FilmOptions(
            world=WorldOptions.short(seed),
            path=path,
            frames=round(seconds * RATE_HZ),
            rate_hz=RATE_HZ,
            width=WIDTH,
            height=HEIGHT,
            samples=1,
            ev_range=0.0,
            focal=focal,
            zoom=zoom,
        )

    def elsewhere(seconds: float, focal: float) -> FilmOptions:
        film = flight(42.0, 60.0, seconds, focal)
        return replace(film, cut=(0, film.frames))

    black = Card(15)
    old = Card(30, "THE OLD TOWN")
    tour = (old, flight(42.0, 50.0, 5.6, 0.757), black, flight(48.0, 60.0, 5.6, 0.757))
    low = (flight(32.0, 40.0, 6.4, 0.62, speed=5.0), flight(38.0, 46.0, 5.0, 0.62, speed=5.0))
    abroad = (Card(30, "FAR AWAY"), elsewhere(8.8, 0.7))
    best = (flight(44.0, 54.0, 5.6, 0.9), elsewhere(4.0, 0.9), flight(50.0, 60.0, 5.6, 0.9))
    zoom = (flight(60.0, 72.0, 10.0, 0.8, zoom=1.25),)
    return (
        Script(name="tour", pieces=tour),
        Script(name="zoom", pieces=zoom, logo=True, bars=0.11, ev=0.15),
        Script(name="low", pieces=low, ev=-0.2),
        Script(name="abroad", pieces=abroad),
        Script(name="old", pieces=(flight(48.0, 58.0, 10.0, 0.757),), crf=_BAD_CRF),
        Script(name="best-of", pieces=best, logo=True, crf=_WORSE_CRF),
    )


class FrameTruth(NamedTuple):
    """A frame of a film: the piece that it belongs to, true intrinsics (None where no camera saw it), and
    cam_from_local (None where it does not show the place)."""

    piece: int
    camera: Camera | None = None
    pose: Rigid3 | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class FilmsTruth:
    """What is true of a folder of films: frames by the name of the film's file, in the place's frame."""

    frame: LocalFrame
    epsg: int
    films: dict[str, list[FrameTruth]]


def write_films(folder: Path, seed: int) -> FilmsTruth:
    """Draw what is not there yet of `six_films`; a film whose script is the same is left as it is."""
    folder.mkdir(parents=True, exist_ok=True)
    films: dict[str, list[FrameTruth]] = {}
    for script in six_films(seed):
        quality = VideoWriterOptions(crf=script.crf, preset="veryfast")
        file, mark = folder / f"{script.name}.mp4", folder.with_name(f"{script.name}.stamp")
        write_frames(file, partial(film_picture, script), script.frames, RATE_HZ, quality, mark, repr(script))
        films[file.name] = []
        for number, piece in enumerate(script.pieces):
            if isinstance(piece, Card):
                films[file.name] += [FrameTruth(number)] * piece.frames
            else:
                poses = enumerate(film_truth(piece).cam_from_local)
                films[file.name] += [FrameTruth(number, piece.camera_at(k), pose) for k, pose in poses]
    town = town_of(WorldOptions.short(seed))
    return FilmsTruth(frame=town.frame, epsg=town.epsg, films=films)


def film_picture(script: Script, frame: int) -> Image8:
    """A frame (h, w, 3) uint8 RGB as it is given to the encoder."""
    number, at = script.at(frame)
    piece = script.pieces[number]
    if isinstance(piece, Card):
        return _card(piece.text)
    picture = film_frame(replace(piece, ev=script.ev), at)
    bar = round(script.bars * HEIGHT)
    if bar:
        picture[:bar] = picture[-bar:] = 0
    return _with_logo(picture, bar) if script.logo else picture


def _card(text: str) -> Image8:
    """A title card; black without text."""
    if not text:
        return np.zeros((HEIGHT, WIDTH, 3), np.uint8)
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
