"""OpenSfM and OpenDroneMap: a folder for each map as OpenSfM leaves it when it has reconstructed.

`reconstruction.json` has cameras, shots and points in the topocentric frame of `reference_lla.json`, which is
the map's own local frame; `tracks.csv` the observations; `georeference.json` what OpenSfM has no room for.

Cameras have lengths over the longer side of the image, from the image's middle (OpenSfM,
doc/source/geometry.rst). Its pixel (0, 0) is the centre of the top-left pixel, COLMAP's (0.5, 0.5) is; both
have the middle of the image at the same place, so the half pixel drops out.
"""

import json
from pathlib import Path
from typing import IO, Any

from featuredb.errors import ExportError
from featuredb.export.formats.colmap import image_names
from featuredb.export.georeference import write_georeference
from featuredb.export.job import Exported, ExportJob, folder_for_each, write_json
from featuredb.geometry.camera import Camera
from featuredb.geometry.rotation import so3_log
from featuredb.maps.feature_map import FeatureMap, MapImage

_CENTRED = 1e-12  # of the longer side
# COLMAP's model: OpenSfM's, and its names of the terms behind the pinhole's, in COLMAP's order. They are of
# the same powers of the tangent, or of a fisheye's angle.
LENS_TERMS: dict[str, tuple[str, tuple[str, ...]]] = {
    "SIMPLE_PINHOLE": ("brown", ()),
    "PINHOLE": ("brown", ()),
    "SIMPLE_RADIAL": ("brown", ("k1",)),
    "RADIAL": ("brown", ("k1", "k2")),
    "OPENCV": ("brown", ("k1", "k2", "p1", "p2")),
    "FULL_OPENCV": ("brown", ("k1", "k2", "p1", "p2", "k3")),
    "SIMPLE_RADIAL_FISHEYE": ("fisheye_opencv", ("k1",)),
    "RADIAL_FISHEYE": ("fisheye_opencv", ("k1", "k2")),
    "OPENCV_FISHEYE": ("fisheye_opencv", ("k1", "k2", "k3", "k4")),
}
_ALL_TERMS = {"brown": ("k1", "k2", "k3", "p1", "p2"), "fisheye_opencv": ("k1", "k2", "k3", "k4")}


def opensfm_camera(camera: Camera) -> dict[str, Any]:
    """The camera as an entry of `cameras` in reconstruction.json.

    "perspective" where that is exact, since every reader knows it; else "brown" or "fisheye_opencv".

    Raises:
        ExportError: the lens has terms that OpenSfM has no room for.
    """
    size = max(camera.width, camera.height)
    pinhole = camera.to_pycolmap()
    kind, names = LENS_TERMS.get(camera.model, ("", ()))
    given = [camera.params[i] for i in pinhole.extra_params_idxs()]
    if not kind or any(given[len(names) :]):
        raise ExportError(
            f"OpenSfM has no camera for {camera.model} with the terms {given}; export as colmap instead"
        )
    terms = dict.fromkeys(_ALL_TERMS[kind], 0.0) | dict(zip(names, given, strict=False))
    lens = {
        "focal_x": pinhole.focal_length_x / size,
        "focal_y": pinhole.focal_length_y / size,
        "c_x": (pinhole.principal_point_x - camera.width / 2.0) / size,
        "c_y": (pinhole.principal_point_y - camera.height / 2.0) / size,
    }
    common = {"projection_type": kind, "width": camera.width, "height": camera.height}
    centred = abs(lens["c_x"]) < _CENTRED and abs(lens["c_y"]) < _CENTRED
    plain = not (terms.get("p1") or terms.get("p2") or terms.get("k3"))
    if kind == "brown" and centred and plain and lens["focal_x"] == lens["focal_y"]:
        return common | {
            "projection_type": "perspective",
            "focal": lens["focal_x"],
            "k1": terms["k1"],
            "k2": terms["k2"],
        }
    return common | lens | terms


_TRACKS_VERSION = "OPENSFM_TRACKS_VERSION_v1"


def write_opensfm(job: ExportJob) -> Exported:
    """Write every selected map to `job.out`/<map>.

    Raises:
        ExportError: nothing is selected, there is something at `job.out`, or a lens that OpenSfM cannot have.
    """
    return folder_for_each(job, job.maps(), write_map)


def write_map(folder: Path, feature_map: FeatureMap) -> None:
    """One map to a new folder; see `write_opensfm`."""
    folder.mkdir()
    names = image_names(feature_map)
    reference = _reference(feature_map)
    with (folder / "reconstruction.json").open("w", encoding="utf-8", newline="\n") as out:
        _write_reconstruction(out, feature_map, names)
    write_json(folder / "reference_lla.json", reference)
    with (folder / "tracks.csv").open("w", encoding="utf-8", newline="\n") as out:
        _write_tracks(out, feature_map, names)
    write_georeference(folder, feature_map, names)


def _reference(feature_map: FeatureMap) -> dict[str, float]:
    frame = feature_map.frame
    return {"latitude": frame.latitude_deg, "longitude": frame.longitude_deg, "altitude": frame.height_m}


def _write_reconstruction(out: IO[str], feature_map: FeatureMap, names: list[str]) -> None:
    """A list of one reconstruction; points line by line, for there may be millions."""
    cameras = {_camera_id(k): opensfm_camera(camera) for k, camera in enumerate(feature_map.cameras)}
    shots = {name: _shot(image, feature_map) for image, name in zip(feature_map.images, names, strict=True)}
    head: dict[str, Any] = {"cameras": cameras, "shots": shots}
    head |= {"biases": {}, "rig_cameras": {}, "rig_instances": {}}
    head["reference_lla"] = _reference(feature_map)
    out.write("[" + json.dumps(head, allow_nan=False, ensure_ascii=False)[:-1] + ', "points": {')
    separator = "\n"
    for row, (xyz, rgb) in enumerate(
        zip(feature_map.points_local().tolist(), feature_map.points.rgb.tolist(), strict=True)
    ):
        point = json.dumps({"color": [float(c) for c in rgb], "coordinates": xyz}, allow_nan=False)
        out.write(f'{separator}"{row}": {point}')
        separator = ",\n"
    out.write("}}]\n")


def _shot(image: MapImage, feature_map: FeatureMap) -> dict[str, Any]:
    """World to camera as an angle-axis vector and a translation; the position as the photo itself says it."""
    shot: dict[str, Any] = {
        "rotation": so3_log(image.cam_from_local.rotation).tolist(),
        "translation": image.cam_from_local.translation.tolist(),
        "camera": _camera_id(image.camera_id),
        "orientation": 1,
        "capture_time": 0.0,
    }
    gps = image.gps
    if gps is not None and gps.height_m is not None:
        said = feature_map.frame.enu_from_geodetic((gps.latitude_deg, gps.longitude_deg, gps.height_m))
        shot |= {"gps_position": said.tolist(), "gps_dop": gps.sigma_horizontal_m}
    if image.capture_time is not None and image.capture_time.tzinfo is not None:
        shot["capture_time"] = image.capture_time.timestamp()
    return shot


def _write_tracks(out: IO[str], feature_map: FeatureMap, names: list[str]) -> None:
    """Image, track, keypoint, x, y, size in normalised coordinates, and the point's colour."""
    out.write(_TRACKS_VERSION + "\n")
    seen = feature_map.observations
    images = feature_map.image_rows(seen.image_id)
    sizes = feature_map.image_sizes()[images]
    longer = sizes.max(axis=1, initial=1.0)
    xy = (seen.xy - sizes / 2.0) / longer[:, None]
    for row, (image, point) in enumerate(zip(images.tolist(), seen.point_index.tolist(), strict=True)):
        x, y, scale = float(xy[row, 0]), float(xy[row, 1]), float(seen.scale[row]) / float(longer[row])
        red, green, blue = feature_map.points.rgb[point].tolist()
        out.write(
            f"{names[image]}\t{point}\t{row}\t{x:.10g}\t{y:.10g}\t{scale:.8g}\t{red}\t{green}\t{blue}\n"
        )


def _camera_id(index: int) -> str:
    return f"camera {index}"
