"""A GeoJSON layer drawn on a tracked film by `featuredb draw`: how far its marks are from where they belong.

The layer is places of a simulated town, those that some frames show at random pixels by the truth. In every
frame each belongs where the true camera sees it; its mark is where the film was changed.
"""

import json
from pathlib import Path

import numpy as np
from scipy.ndimage import distance_transform_edt, find_objects, label

from featuredb.geometry.arrays import FloatArray
from featuredb.simworld.town.scene import Scene
from featuredb.video.frames import open_video
from reloc.tracking.trajectory.files import write_trajectory
from reloc.tracking.trajectory.values import Trajectory
from tools.commands import featuredb
from tools.worlds.film_world import FilmTruth
from tools.worlds.sights import SeenPlaces

_SEED, _SHOWING, _PLACES = 3, 6, 8  # frames that give places, and places of each
_REACH_PX = 10  # around a place: a mark is a ring of 4 px radius
_APART_PX = 3 * _REACH_PX  # places that are nearer to each other in a frame are not measured there
_CHANGED = 50  # grey levels; writing the film anew changes less
_FEWEST_PIXELS = 8  # of a mark that is not hidden


def drawn_marks(
    folder: Path, film: Path, truth: FilmTruth, scene: Scene, track: Trajectory, database: Path
) -> dict[str, float]:
    """Draw a layer over a film that was tracked, and measure its marks; files go into `folder`.

    Frames with a mark, marks that were measured, stray: changed spots that no place explains, and the
    distances between a mark's centre and the pixel where its place belongs.
    """
    places = _places(scene, truth)
    where = truth.frame.geodetic_from_enu(places)[:, [1, 0, 2]].tolist()
    layer = {"type": "Feature", "properties": {}, "geometry": {"type": "MultiPoint", "coordinates": where}}
    (folder / "layer.geojson").write_text(json.dumps(layer))
    write_trajectory(folder / "track.csv", track)
    lens = truth.camera
    camera = ",".join(map(str, (lens.model, lens.width, lens.height, *lens.params)))
    words = ("draw", str(film), str(folder / "layer.geojson"), "--database", str(database))
    more = ("--track", str(folder / "track.csv"), "--camera", camera, "--out", str(folder / "drawn.mp4"))
    featuredb(*words, *more)
    found: list[tuple[list[float], int]] = []
    with open_video(str(film)) as plain, open_video(str(folder / "drawn.mp4")) as drawn:
        for before, after in zip(plain, drawn, strict=True):
            if (pose := truth.cam_from_local[before.index]) is not None:
                changed = np.abs(after.rgb().astype(np.int16) - before.rgb()).max(axis=2)
                found.append(marks_of(changed.astype(np.float64), lens.project(pose.act(places))))
    off = [pixels for marks, _ in found for pixels in marks]
    return {
        "frames": sum(bool(marks) for marks, _ in found),
        "marks": len(off),
        "stray": sum(stray for _, stray in found),
        "median_px": float(np.median(off)),
        "largest_px": max(off),
    }


def marks_of(changed: FloatArray, pixels: FloatArray) -> tuple[list[float], int]:
    """How far marks are from their places, pixels, and how many spots of the picture are no place's.

    Args:
        changed: (h, w) grey levels. pixels: (n, 2) where places belong; NaN of those that are not seen.
    """
    size = np.array(changed.shape[::-1])
    weight = np.where(changed > _CHANGED, changed, 0.0)
    free = np.ones(changed.shape, bool)
    seen = pixels[(np.abs(pixels - size / 2) < size / 2 + _REACH_PX).all(axis=1)]
    for column, row in np.clip(seen.astype(int), 0, size - 1):
        free[row, column] = False
    spots, _ = label((weight > 0) & (distance_transform_edt(free) > _REACH_PX))
    stray = sum(int((spots[part] > 0).sum() >= _FEWEST_PIXELS) for part in find_objects(spots))
    off = []
    for pixel in seen:
        apart = np.linalg.norm(seen - pixel, axis=1)
        corner = pixel.astype(int) - _REACH_PX
        if (apart < _APART_PX).sum() > 1 or (corner < 0).any() or (corner + 2 * _REACH_PX >= size).any():
            continue
        mark = weight[corner[1] :, corner[0] :][: 2 * _REACH_PX + 1, : 2 * _REACH_PX + 1]
        if (mark > 0).sum() >= _FEWEST_PIXELS:  # it is not hidden
            off.append(float(np.linalg.norm(corner + _ring_centre(mark) - pixel)))
    return off, stray


def _ring_centre(mark: FloatArray) -> FloatArray:
    """(2,) of the circle through what is changed, by least squares (Kasa)."""
    rows, columns = np.nonzero(mark)
    places = np.column_stack([columns, rows]) + 0.5
    weight = np.sqrt(mark[rows, columns])
    plan = np.column_stack([2.0 * places, np.ones(len(places))])
    squares = (places**2).sum(axis=1)
    return np.asarray(np.linalg.lstsq(plan * weight[:, None], squares * weight, rcond=None)[0][:2])


def _places(scene: Scene, truth: FilmTruth) -> FloatArray:
    """(n, 3) in the truth's frame, of what stands still."""
    rng = np.random.default_rng(_SEED)
    found = []
    for frame in np.linspace(0, len(truth.times_s) - 1, _SHOWING).astype(int):
        pose = truth.cam_from_local[frame]
        if pose is not None:
            seen = SeenPlaces(scene, truth.camera, pose)
            found.append(seen.places(seen.pixels(rng, _PLACES)))
    return np.concatenate(found)
