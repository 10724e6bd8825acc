"""One landmark by many people, a third of whom say where they were: placed as well as that allows?

1. The photos, without positions, become a map. It is the truth, with the building's front 137 m wide.
2. A third of its photos get geotags that are off by 8 m, in a table that says nothing of accuracy. The table
   is ingested by `featuredb ingest photos --trust-geotags`.
3. Geotags are drawn many times, for 5, 8, 15 and 25 photos: off by 8 m; a fifth of them anywhere within some
   hundred metres; three in ten on the landmark instead of where the camera was; off by 15 m. How many draws
   have a place, answer, and lie inside the 68 % and 95 % bounds that the placement gives them.
"""

from dataclasses import dataclass
from itertools import product
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2
from threadpoolctl import threadpool_limits

from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.sim3 import point_jacobian
from ingest.own_frame import held_of
from ingest.photos.photo import Photo, whose_cameras
from ingest.register.gps import place_by_gps
from tools.commands import all_maps, featuredb, largest_map, make
from tools.figures import inside_figures, laid_apart, median, poses_in, squared, study_parser, write_figures
from tools.photo_files import copied, photo_names, position_table

_FRONT_M, _OFF_M, _STATED_M = 137.0, 8.0, 30.0
_FRONT = (2.0, 98.0)  # percentiles of the points along it
_FRAME = LocalFrame(latitude_deg=52.5186, longitude_deg=13.3750, height_m=75.0)
_COUNTS = (5, 8, 15, 25)
_DRAWS, _SEED = 40, 1  # of each kind and number
# Off by how much, metres; shares of tags that are far out, and on the landmark.
_KINDS = ((8.0, 0.0, 0.0), (8.0, 0.2, 0.0), (8.0, 0.0, 0.3), (15.0, 0.0, 0.0))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Landmark:
    """Cameras of a map, in metres: names, poses, whose they are (n,), and the middle of its points (3,)."""

    names: tuple[str, ...]
    poses: tuple[Rigid3, ...]
    camera_of: NDArray[np.int64]
    middle: FloatArray

    @property
    def xyz(self) -> FloatArray:
        """(n, 3) where they are."""
        return np.array([pose.center for pose in self.poses])


def main() -> None:
    args = study_parser(__doc__, "--photos", "--work").parse_args()
    make(args.work / "untagged", "photos", args.photos)
    landmark = true_landmark(args.work / "untagged")
    figures = ingested(landmark, args.photos, args.work)
    with threadpool_limits(1):  # matrices are small
        figures |= drawn(landmark)
    write_figures(args.json, figures)


def true_landmark(database: Path) -> Landmark:
    """The largest map, which has no place, in metres."""
    largest = largest_map(database)
    poses = [image.cam_from_local for image in largest.images]
    plan = largest.points.xyz[:, :2] - np.median(largest.points.xyz[:, :2], axis=0)
    along = plan @ np.linalg.svd(plan, full_matrices=False)[2][0]
    scale = _FRONT_M / float(np.ptp(np.percentile(along, _FRONT)))
    sizes = [largest.cameras[image.camera_id] for image in largest.images]
    names = tuple(Path(image.name).name for image in largest.images)
    photos = [
        Photo(name=n, path=Path(n), width=c.width, height=c.height) for n, c in zip(names, sizes, strict=True)
    ]
    return Landmark(
        names=names,
        poses=tuple(Rigid3(rotation=p.rotation, translation=scale * p.translation) for p in poses),
        camera_of=whose_cameras(photos, [camera.focal_px for camera in sizes]),
        middle=scale * np.median(largest.points.xyz, axis=0),
    )


def ingested(landmark: Landmark, photos: Path, work: Path) -> dict[str, float]:
    """What the command makes of a table in which a third of the photos have a geotag."""
    names = photo_names(photos)
    folder = copied(photos, names, work / "tagged", strip=False)
    rng = np.random.default_rng(_SEED)
    rows = rng.choice(len(landmark.names), len(landmark.names) // 3, replace=False)
    tags = _FRAME.geodetic_from_enu(landmark.xyz[rows] + rng.normal(0.0, _OFF_M, (len(rows), 3)))
    told = {landmark.names[k]: (f"{tag[0]:.7f}", f"{tag[1]:.7f}") for k, tag in zip(rows, tags, strict=True)}
    table = position_table(folder, [(name, *told.get(name, ("", "")), "", "", "") for name in names])
    featuredb("ingest", "photos", str(work / "db"), str(table), "--trust-geotags", "--quiet", refusals=(1,))
    places: dict[str, FloatArray] = {}
    for one in all_maps(work / "db"):
        if one.status == "active":
            places |= {Path(name).name: pose.center for name, pose in poses_in(_FRAME, one).items()}
    true = dict(zip(landmark.names, landmark.xyz, strict=True))
    off = [np.linalg.norm((places[name] - true[name])[:2]) for name in true.keys() & places.keys()]
    return {
        "photos": len(landmark.names),
        "active": len(off),
        "share": len(off) / len(landmark.names),
        "off_m": median(off),
        "shape_m": median(laid_apart(places, true)),
    }


def drawn(landmark: Landmark) -> dict[str, float]:
    """Places by drawn geotags, as ingest makes them: squared errors over their covariances."""
    scores: dict[str, list[list[float]]] = {"answering": [], "waiting": []}
    kinds = list(product(enumerate(_KINDS), _COUNTS, range(_DRAWS)))
    held = held_of(landmark.poses, (), landmark.camera_of)
    for (number, (off_m, far, pinned)), count, draw in kinds:
        rng = np.random.default_rng((_SEED, number, count, draw))
        rows = np.sort(rng.choice(len(landmark.names), count, replace=False))
        tags = landmark.xyz[rows] + rng.normal(0.0, off_m, (count, 3))
        out, on = rng.random(count) < far, rng.random(count) < pinned
        tags[out, :2] += rng.normal(0.0, 150.0, (int(out.sum()), 2))
        tags[on] = landmark.middle + rng.normal(0.0, 15.0, (int(on.sum()), 3))
        sigmas = np.tile([_STATED_M, _STATED_M, np.inf if draw % 2 else _STATED_M], (count, 1))
        placed = place_by_gps(landmark.xyz[rows], tags, sigmas, None, held, landmark.camera_of[rows])
        if placed.local_from_sfm is None or placed.covariance is None or placed.reason is not None:
            continue
        error = placed.local_from_sfm.inverse().log()
        camera = point_jacobian(landmark.xyz[[rng.integers(len(landmark.names))]])[0, :2]
        parts = (camera, np.eye(7)[1:4])  # of position and orientation
        square = [squared(part @ error, part @ placed.covariance @ part.T) for part in parts]
        scores["waiting" if placed.provisional else "answering"].append(square)
    result = {"draws": float(len(kinds))}
    for name, of in scores.items():
        result[name] = len(of) / result["draws"]
        for k, (part, size) in enumerate((("position", 2), ("orientation", 3))):
            result |= inside_figures(f"{name}_{part}", [score[k] for score in of], size)
    limits = 2.0 * chi2.ppf(0.999, [2, 3])
    result["far"] = float(sum((np.array(score) > limits).any() for score in scores["answering"]))
    return result


if __name__ == "__main__":
    main()
