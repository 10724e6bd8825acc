"""COLMAP: a folder for each map with the model, the database and the place on Earth.

The model's world is the map's local frame (east, north, up, metres), or the own frame of a map
without a place. Ids are the map's plus one: of cameras, images, and points. Pixels agree as they are, the
centre of the top-left pixel being (0.5, 0.5).
"""

from collections import Counter
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

from featuredb.export.georeference import write_georeference
from featuredb.export.job import Exported, ExportJob, folder_for_each
from featuredb.maps.feature_map import MapImage
from featuredb.maps.unplaced_map import AnyMap

MODEL_FOLDER = "sparse"
DATABASE = "database.db"
_DIAMETER_OVER_SCALE = 2.0  # OpenCV counts a keypoint's diameter, COLMAP its scale


def write_colmap(job: ExportJob, *, text: bool = False) -> Exported:
    """Write every selected map to `job.out`/<map>: sparse/, database.db, georeference.json, attribution.csv.

    Args:
        text: the model as COLMAP's text files instead of binary ones.
    """
    return folder_for_each(job, job.any_maps(), partial(write_map, text=text))


def write_map(folder: Path, feature_map: AnyMap, *, text: bool = False) -> None:
    """One map to a new folder; see `write_colmap`."""
    model = folder / MODEL_FOLDER
    model.mkdir(parents=True)
    keypoints, names = keypoint_rows(feature_map), image_names(feature_map)
    reconstruction = reconstruction_of(feature_map, keypoints, names)
    if text:
        reconstruction.write_text(str(model))
    else:
        reconstruction.write_binary(str(model))
    write_colmap_database(folder / DATABASE, feature_map, keypoints, names)
    write_georeference(folder, feature_map, names)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class KeypointRows:
    """Which observations are the keypoints of each image, in the order of model and database alike.

    Those with a descriptor come first, the rest have zeros.

    Attributes:
        rows: for each image, rows (k,) of the map's observations.
        point2d: (m,) for each observation, its row among its image's keypoints.
    """

    rows: list[NDArray[np.int64]]
    point2d: NDArray[np.int64]


def keypoint_rows(feature_map: AnyMap) -> KeypointRows:
    """The order of keypoints of every image."""
    seen = feature_map.observations
    image = feature_map.image_rows(seen.image_id)
    order = np.lexsort((np.arange(len(seen)), ~seen.has_descriptor, image))
    counts = np.bincount(image, minlength=len(feature_map.images))
    rows = np.split(order, np.cumsum(counts)[:-1]) if len(counts) else []
    point2d = np.empty(len(seen), dtype=np.int64)
    for of_image in rows:
        point2d[of_image] = np.arange(len(of_image))
    return KeypointRows(rows=rows, point2d=point2d)


def image_names(feature_map: AnyMap) -> list[str]:
    """The images' names; COLMAP wants them unique, so what repeats goes into a folder of its image's id."""
    counts = Counter(image.name for image in feature_map.images)
    names = [
        image.name if counts[image.name] == 1 else f"{image.image_id + 1}/{image.name}"
        for image in feature_map.images
    ]
    return (
        names if len(set(names)) == len(names) else [f"{i.image_id + 1}/{i.name}" for i in feature_map.images]
    )


def reconstruction_of(feature_map: AnyMap, keypoints: KeypointRows, names: list[str]) -> Any:
    """The map as a pycolmap.Reconstruction: each camera a rig of its own, each image a frame.

    Points keep colour, track and stored reprojection error; an image that sees a point twice does so here.
    """
    reconstruction = pycolmap.Reconstruction()
    for k, camera in enumerate(feature_map.cameras):
        reconstruction.add_camera_with_trivial_rig(camera.to_pycolmap(k + 1))
    seen = feature_map.observations
    for image, rows, name in zip(feature_map.images, keypoints.rows, names, strict=True):
        stored = pycolmap.Image(
            name=name,
            keypoints=seen.xy[rows].astype(np.float64),
            camera_id=image.camera_id + 1,
            image_id=image.image_id + 1,
        )
        pose = pycolmap.Rigid3d(np.ascontiguousarray(image.cam_from_local.matrix()[:3]))
        reconstruction.add_image_with_trivial_frame(stored, pose)
    _add_points(reconstruction, feature_map, keypoints)
    return reconstruction


def _add_points(reconstruction: Any, feature_map: AnyMap, keypoints: KeypointRows) -> None:
    seen, points = feature_map.observations, feature_map.points
    order = np.lexsort((keypoints.point2d, seen.image_id, seen.point_index))
    images, rows = (seen.image_id[order] + 1).tolist(), keypoints.point2d[order].tolist()
    ends = np.cumsum(np.bincount(seen.point_index, minlength=len(points))).tolist()
    start = 0
    for xyz, rgb, error, end in zip(
        feature_map.points_local(), points.rgb, points.error_px.tolist(), ends, strict=True
    ):
        elements = [pycolmap.TrackElement(images[i], rows[i]) for i in range(start, end)]
        point_id = reconstruction.add_point3D(xyz, pycolmap.Track(elements), rgb)
        reconstruction.point3D(point_id).error = error
        start = end


def write_colmap_database(path: Path, feature_map: AnyMap, keypoints: KeypointRows, names: list[str]) -> None:
    """COLMAP's database of the map: cameras, rigs, images, frames, keypoints, descriptors; no matches.

    Keypoints have four columns: x, y, scale, orientation in radians.
    """
    database = pycolmap.Database.open(str(path))
    try:
        with pycolmap.DatabaseTransaction(database):
            for k, camera in enumerate(feature_map.cameras):
                stored = camera.to_pycolmap(k + 1)
                stored.has_prior_focal_length = True  # estimated, not guessed
                database.write_camera(stored, use_camera_id=True)
                rig = pycolmap.Rig(rig_id=k + 1)
                rig.add_ref_sensor(stored.sensor_id)
                database.write_rig(rig, use_rig_id=True)
            for image, rows, name in zip(feature_map.images, keypoints.rows, names, strict=True):
                _write_image(database, feature_map, image, rows, name)
    finally:
        database.close()


def _write_image(
    database: Any, feature_map: AnyMap, image: MapImage, rows: NDArray[np.int64], name: str
) -> None:
    image_id, seen = image.image_id + 1, feature_map.observations
    stored = pycolmap.Image(name=name, camera_id=image.camera_id + 1, image_id=image_id)
    database.write_image(stored, use_image_id=True)
    frame = pycolmap.Frame(frame_id=image_id, rig_id=image.camera_id + 1)
    frame.add_data_id(stored.data_id)
    database.write_frame(frame, use_frame_id=True)
    columns = (seen.xy[rows], seen.scale[rows] / _DIAMETER_OVER_SCALE, np.radians(seen.angle[rows]))
    database.write_keypoints(image_id, np.column_stack(columns).astype(np.float32))
    descriptors = pycolmap.FeatureDescriptors(
        pycolmap.FeatureExtractorType.SIFT, np.ascontiguousarray(seen.descriptors[rows])
    )
    database.write_descriptors(image_id, descriptors)
