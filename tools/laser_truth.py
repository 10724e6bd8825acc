"""Maps and answers against laser truth (Strecha's sets), beside plain COLMAP that is given the true lens.

Of the folder (see `tools.laser_set`) all photos but every fifth from the third on are ingested into a new
database, with exact positions and the EXIF of one camera whose focal length is rounded to a whole
millimetre of 35 mm film. The other photos are asked of a server twice: with their true camera, and with EXIF
alone. Prints, for the map's cameras and for both kinds of answers: the median error of position and
orientation, the median of the 68 % radius that was reported, and the baseline's median (`tools.laser_set`);
and how far the map's lens is from the true one, over the standard deviations that the map stores of it (root
mean square of its parameters: 1 is right). Worst is the largest ratio of a median to the baseline's, or to
the reported radius.
"""

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.error_radius import error_radius
from featuredb.geometry.rigid3 import Rigid3
from featuredb.index.area import Area, build_area
from featuredb.maps.feature_map import FeatureMap, MapImage
from featuredb.maps.lens_uncertainty import LensUncertainty
from featuredb.store import Database
from reloc.localise.answer import placement_covariance
from reloc.localise.lens_prior import lens_of, seen_by_a_map
from reloc.wire.query import CameraRequest
from tools.commands import all_maps, make
from tools.figures import median, pose_errors, pose_offset, poses_in, squared, study_parser, write_figures
from tools.laser_set import FRAME, LaserSet, colmap_given_the_lens, read_laser_set, with_exif
from tools.real_photos import ask_poses


@dataclass(frozen=True, slots=True, kw_only=True)
class Errors:
    """Errors of one kind of poses, of `wanted`, in metres and degrees, and the 68 % radii reported."""

    metres: Sequence[float]
    degrees: Sequence[float]
    told_m: Sequence[float] = ()
    told_deg: Sequence[float] = ()
    wanted: int = 0


def main() -> None:
    args = study_parser(__doc__, "folder").parse_args()
    truth = read_laser_set(args.folder)
    lens = truth.camera
    with tempfile.TemporaryDirectory() as scratch:
        work = Path(scratch) / args.folder.name
        photos = with_exif(truth, truth.mapped, work / "photos", positions=True)
        asked = with_exif(truth, truth.asked, work / "asked", positions=False)
        make(work / "db", "photos", photos)
        maps = [one for one in all_maps(work / "db") if isinstance(one, FeatureMap)]
        if not maps:
            raise SystemExit(f"{truth.photos}: no map was placed")
        told = CameraRequest(model=lens.model, width=lens.width, height=lens.height, params=lens.params)
        database = Database.open(work / "db")
        kinds = {
            "map": map_errors(maps, truth),
            "told": answer_errors(database, asked, truth, told),
            "unknown": answer_errors(database, asked, truth, None),
        }
    theirs = dict(zip(("map", "asked"), colmap_given_the_lens(truth), strict=True))
    baseline = {kind: errors_of(poses, truth) for kind, poses in theirs.items()}
    write_figures(args.json, figures_of(kinds, baseline) | {"lens_off": lens_error(maps, truth)})


def figures_of(kinds: Mapping[str, Errors], theirs: Mapping[str, Errors]) -> dict[str, float]:
    """Medians, and the worst ratio of one to what it is compared with."""
    figures: dict[str, float] = {}
    ratios = []
    for kind, errors in kinds.items():
        metres, degrees = median(errors.metres), median(errors.degrees)
        told_m, told_deg = median(errors.told_m), median(errors.told_deg)
        colmap_m = median(theirs["map" if kind == "map" else "asked"].metres)
        figures |= {
            f"{kind}_found": len(errors.metres),
            f"{kind}_m": metres,
            f"{kind}_deg": degrees,
            f"{kind}_reported_m": told_m,
            f"{kind}_reported_deg": told_deg,
            f"{kind}_colmap_m": colmap_m,
        }
        ratios += [metres / told_m, degrees / told_deg, metres / colmap_m]
        ratios.append(1.0 if errors.metres and len(errors.metres) == errors.wanted else float("inf"))
    figures["worst"] = float(np.nan_to_num(ratios, nan=np.inf).max())
    return figures


def lens_error(maps: Sequence[FeatureMap], truth: LaserSet) -> float:
    """Root mean square of the lens's errors over their standard deviations, of the map with most images."""
    largest = max(maps, key=lambda one: len(one.images))
    _, prior = seen_by_a_map(truth.camera, LensUncertainty.of_provenance(largest.provenance))
    off = (lens_of(largest.cameras[0]) - prior.mean) / prior.sigma
    return float(np.sqrt(np.mean(off**2)))


def map_errors(maps: Sequence[FeatureMap], truth: LaserSet) -> Errors:
    """Of the cameras of placed maps, as they lie."""
    poses: dict[str, Rigid3] = {}
    stated: list[FloatArray] = []
    for one in maps:
        area = build_area([one])
        poses |= poses_in(FRAME, one)
        stated += [stated_covariance(area, one, image) for image in one.images]
    told_m = [error_radius(covariance[3:, 3:]) for covariance in stated]
    told_deg = [float(np.degrees(error_radius(covariance[:3, :3]))) for covariance in stated]
    return replace(errors_of(poses, truth), told_m=told_m, told_deg=told_deg, wanted=len(truth.mapped))


def stated_covariance(area: Area, feature_map: FeatureMap, image: MapImage) -> FloatArray:
    """(6, 6) of a map's camera in its area's axes: rotation (rad) before position (m)."""
    pose = image.cam_from_local
    world_from_cam = np.kron(np.eye(2), pose.rotation.T)
    own = np.zeros((6, 6)) if image.covariance is None else image.covariance
    placed = placement_covariance(area, feature_map, pose.center)
    return np.asarray(world_from_cam @ own @ world_from_cam.T + placed)


def camera_squares(
    feature_map: FeatureMap, frame: LocalFrame, true: Mapping[str, Rigid3]
) -> dict[str, list[float]]:
    """Squared errors of a map's cameras over their covariances, of orientation and position; `true`:
    cam_from_local in `frame`, by name."""
    area, poses = build_area([feature_map]), poses_in(frame, feature_map)
    turn = np.kron(np.eye(2), frame.enu_from(feature_map.frame).rotation)
    result: dict[str, list[float]] = {"orientation": [], "position": []}
    for image in feature_map.images:
        covariance = turn @ stated_covariance(area, feature_map, image) @ turn.T
        error = pose_offset(poses[image.name], true[image.name])
        result["orientation"].append(squared(error[:3], covariance[:3, :3]))
        result["position"].append(squared(error[3:], covariance[3:, 3:]))
    return result


def answer_errors(database: Database, photos: Path, truth: LaserSet, camera: CameraRequest | None) -> Errors:
    """Of a server's answers."""
    rows = ask_poses(database, photos, truth.asked, FRAME, truth.poses, camera)
    found = [row for row in rows if row.error is not None]
    return Errors(
        metres=[row.error.position_m for row in found],
        degrees=[row.error.angle_deg for row in found],
        told_m=[row.position_68_m for row in found],
        told_deg=[row.orientation_68_deg for row in found],
        wanted=len(truth.asked),
    )


def errors_of(poses: Mapping[str, Rigid3], truth: LaserSet) -> Errors:
    """Poses cam_from_local against the true ones."""
    metres, degrees = pose_errors(poses, truth.poses)
    return Errors(metres=metres.tolist(), degrees=degrees.tolist())


if __name__ == "__main__":
    main()
