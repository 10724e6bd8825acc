"""kapture 1.1: a folder for each map with sensors, poses, keypoints, descriptors, points and observations.

Reference: naver/kapture, kapture_format.adoc. Its world is the map's local frame (east, north, up, metres),
which `georeference.json` places on Earth, or the own frame of a map without a place. Poses are world to
camera and pixels COLMAP's: nothing is shifted. Timestamps are the images' numbers, devices the map's cameras.
"""

from collections.abc import Iterable, Sequence
from pathlib import Path
from urllib.parse import quote

import numpy as np

from featuredb.export.attribution import attribution_of, write_attribution
from featuredb.export.formats.colmap_model import KeypointRows, colmap_keypoints, image_names, keypoint_rows
from featuredb.export.georeference import GEOREFERENCE, georeference_text
from featuredb.export.job import Exported, ExportJob
from featuredb.export.tally import folder_for_each
from featuredb.features.features import DESCRIPTOR_SIZE
from featuredb.geometry.rotation import quaternion_from_matrix
from featuredb.maps.unplaced_map import AnyMap

HEADER = "# kapture format: 1.1"
SENSORS, RECONSTRUCTION = "sensors", "reconstruction"
_KIND = "sift"  # of keypoints and descriptors, a folder's name
_SAFE = " !$&'()+-.;=@[]^_`{}~"  # in a part of a path; commas part kapture's columns


def write_kapture(job: ExportJob) -> Exported:
    """Write every selected map to `job.out`/<map>.

    Raises:
        ExportError: nothing is selected, or there is something at `job.out`.
    """
    return folder_for_each(job, job.any_maps(), write_map)


def write_map(folder: Path, feature_map: AnyMap) -> None:
    """One map to a new folder; see `write_kapture`."""
    names, keypoints = kapture_names(feature_map), keypoint_rows(feature_map)
    for part in (SENSORS, RECONSTRUCTION):
        (folder / part).mkdir(parents=True)
    _write_sensors(folder / SENSORS, feature_map, names)
    _write_features(folder / RECONSTRUCTION, feature_map, keypoints, names)
    _write_points(folder / RECONSTRUCTION, feature_map, keypoints, names)
    (folder / GEOREFERENCE).write_text(georeference_text(feature_map, names), encoding="utf-8")
    write_attribution(folder, attribution_of(feature_map))


def kapture_names(feature_map: AnyMap) -> list[str]:
    """The images' names as kapture can have them: what tables or paths may not have is percent-encoded."""
    return ["/".join(_part(part) for part in name.split("/")) for name in image_names(feature_map)]


def _part(part: str) -> str:
    """A part of a path: no commas, controls or spaces around it, and nothing that leads out of the folder."""
    text = "".join(c if c.isalnum() or c in _SAFE else quote(c, safe="") for c in part)
    if text.strip(".") == "":
        return text.replace(".", "%2E") or "%"
    return text if text == text.strip() else quote(part, safe="")


def _device(camera_id: int) -> str:
    return f"camera{camera_id}"


def _write_sensors(folder: Path, feature_map: AnyMap, names: Sequence[str]) -> None:
    with_gps = [i for i in feature_map.images if i.gps is not None and i.gps.height_m is not None]
    sensors: list[Sequence[object]] = []
    for k, camera in enumerate(feature_map.cameras):
        key = feature_map.camera_keys[k] if k < len(feature_map.camera_keys) else ""
        lens = (camera.model, camera.width, camera.height, *camera.params)
        sensors.append((_device(k), _part(key) if key else "", "camera", *lens))
    sensors += [
        (f"GPS_{_device(k)}", "", "gnss", "EPSG:4326") for k in sorted({i.camera_id for i in with_gps})
    ]
    _write_table(folder / "sensors.txt", "sensor_id, name, sensor_type, [sensor_params]+", sensors)
    poses = (
        (
            image.image_id,
            _device(image.camera_id),
            *np.roll(quaternion_from_matrix(image.cam_from_local.rotation), 1).tolist(),
            *image.cam_from_local.translation.tolist(),
        )
        for image in feature_map.images
    )
    _write_table(folder / "trajectories.txt", "timestamp, device_id, qw, qx, qy, qz, tx, ty, tz", poses)
    records = [
        (i.image_id, _device(i.camera_id), name) for i, name in zip(feature_map.images, names, strict=True)
    ]
    _write_table(folder / "records_camera.txt", "timestamp, device_id, image_path", records)
    if not with_gps:
        return
    gnss: list[Sequence[object]] = []
    for image in with_gps:
        gps, time = image.gps, image.capture_time
        assert gps is not None
        utc = 0 if time is None or time.tzinfo is None else max(int(time.timestamp()), 0)
        # Its dilution is the receiver's own; the accuracy of the position is in georeference.json.
        position = (gps.longitude_deg, gps.latitude_deg, gps.height_m)
        gnss.append((image.image_id, f"GPS_{_device(image.camera_id)}", *position, utc, 0.0))
    _write_table(folder / "records_gnss.txt", "timestamp, device_id, x, y, z, utc, dop", gnss)


def _write_features(folder: Path, feature_map: AnyMap, keypoints: KeypointRows, names: Sequence[str]) -> None:
    """Keypoints x, y, scale, orientation as COLMAP has them, and descriptors: zeros where there is none."""
    points, descriptors = folder / "keypoints" / _KIND, folder / "descriptors" / _KIND
    for path in (points, descriptors):
        path.mkdir(parents=True)
    _write_table(points / "keypoints.txt", "name, dtype, dsize", [("SIFT", "float32", 4)])
    kind = ("SIFT", "uint8", DESCRIPTOR_SIZE, _KIND, "L2")
    _write_table(descriptors / "descriptors.txt", "name, dtype, dsize, keypoints_type, metric_type", [kind])
    for rows, name in zip(keypoints.rows, names, strict=True):
        for path in (points / f"{name}.kpt", descriptors / f"{name}.desc"):
            path.parent.mkdir(parents=True, exist_ok=True)
        (points / f"{name}.kpt").write_bytes(colmap_keypoints(feature_map, rows).astype("<f4").tobytes())
        (descriptors / f"{name}.desc").write_bytes(feature_map.observations.descriptors[rows].tobytes())


def _write_points(folder: Path, feature_map: AnyMap, keypoints: KeypointRows, names: Sequence[str]) -> None:
    """Points in their order, and who sees each of them."""
    points = zip(feature_map.points_local().tolist(), feature_map.points.rgb.tolist(), strict=True)
    _write_table(folder / "points3d.txt", "X, Y, Z, R, G, B", ((*xyz, *rgb) for xyz, rgb in points))
    seen = feature_map.observations
    name_of = {image.image_id: name for image, name in zip(feature_map.images, names, strict=True)}
    order = np.lexsort((keypoints.point2d, seen.image_id, seen.point_index))
    ends = np.cumsum(np.bincount(seen.point_index, minlength=len(feature_map.points)))
    observations = (
        (
            point,
            _KIND,
            *(v for row in rows for v in (name_of[int(seen.image_id[row])], keypoints.point2d[row])),
        )
        for point, rows in enumerate(np.split(order, ends[:-1]))
        if len(rows)
    )
    _write_table(
        folder / "observations.txt", "point3d_id, keypoints_type, [image_path, feature_id]*", observations
    )


def _write_table(path: Path, columns: str, rows: Iterable[Sequence[object]]) -> None:
    """A text file of kapture; numbers with all their digits."""
    with path.open("w", encoding="utf-8", newline="\n") as out:
        out.write(f"{HEADER}\n# {columns}\n")
        out.writelines(", ".join(str(value) for value in row) + "\n" for row in rows)
