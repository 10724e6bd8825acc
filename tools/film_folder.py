"""Draws the films of scripts into a folder, with the truth of every frame."""

from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path

import cv2
import numpy as np

from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.simworld.town.scene import Scene
from featuredb.simworld.town.texture import Image8
from featuredb.simworld.world import WorldOptions, other_town_of, town_of
from featuredb.video.writer import VideoWriterOptions
from tools.film_scripts import HEIGHT, RATE_HZ, WIDTH, Kind, Piece, Script
from tools.worlds.film_frame import Exposure, draw_frame, write_frames
from tools.worlds.flight_path import FlightPath

_SAMPLES = 1
_CARD = (38, 30, 26)


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
