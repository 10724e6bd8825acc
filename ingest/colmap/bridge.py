"""Photos to pycolmap's database, and its reconstructions to arrays.

In come photos as values, out go reconstructions as plain arrays.
"""

import logging
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

from featuredb.adjust.terms import Block
from featuredb.errors import InvalidValueError
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3

_LOG = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, kw_only=True)
class TwoView:
    """The verified geometry of a pair of photos.

    Attributes:
        inliers: (m, 2) uint32, rows of the keypoints of both photos.
        config: COLMAP's kind of geometry (calibrated, uncalibrated, planar ...).
        essential, fundamental, homography: (3, 3), zeros where COLMAP estimated none.
    """

    inliers: NDArray[np.uint32]
    config: NDArray[np.int64]
    essential: FloatArray
    fundamental: FloatArray
    homography: FloatArray

    @property
    def is_watermark(self) -> bool:
        """Whether the matches are a shift of what stands near the borders of both photos."""
        return int(self.config) == int(pycolmap.TwoViewGeometryConfiguration.WATERMARK)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """By field name, to be written to a file."""
        return {f.name: getattr(self, f.name) for f in fields(self)}


@dataclass(frozen=True, slots=True, kw_only=True)
class SfmPhoto:
    """A photo for structure from motion.

    Attributes:
        name: unique.
        camera_row: row of the cameras.
        keypoints: (n, 2) float32 pixels.
        prior_position: camera centre in a local metric frame, or None.
        prior_sigma_m: standard deviations of the position, metres along each axis.
    """

    name: str
    camera_row: int
    keypoints: NDArray[np.float32]
    prior_position: tuple[float, float, float] | None = None
    prior_sigma_m: tuple[float, float, float] | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Model:
    """A reconstruction as arrays, in the frame and scale of the reconstruction ("sfm").

    Attributes:
        cameras: the rows of the input that registered photos use, refined.
        rows: (k,) registered photos, rising, rows of the input.
        camera_of: (k,) index into cameras.
        cam_from_sfm: k poses.
        xyz: (n, 3) points.
        point_of, photo_of, keypoint_of: (m,) int64: observations as index into xyz, index into rows, and
            row of the photo's keypoints; sorted by point, then photo.
    """

    cameras: tuple[Camera, ...]
    rows: NDArray[np.int64]
    camera_of: NDArray[np.int64]
    cam_from_sfm: tuple[Rigid3, ...]
    xyz: FloatArray
    point_of: NDArray[np.int64]
    photo_of: NDArray[np.int64]
    keypoint_of: NDArray[np.int64]

    def centers(self) -> FloatArray:
        """Camera centres (k, 3)."""
        return np.array([pose.center for pose in self.cam_from_sfm]).reshape(-1, 3)

    def distances(self) -> FloatArray:
        """Distance (m,) of every observation's point to its camera."""
        return np.asarray(np.linalg.norm(self.xyz[self.point_of] - self.centers()[self.photo_of], axis=1))

    def pixels(self, keypoints: Sequence[NDArray[np.floating[Any]]]) -> FloatArray:
        """Pixels (m, 2) of the observations, from those of each photo's keypoints (n, 2)."""
        xy = np.zeros((len(self.point_of), 2))
        for k, pixels in enumerate(keypoints):
            mine = self.photo_of == k
            xy[mine] = pixels[self.keypoint_of[mine]]
        return xy

    def block(self, xy: FloatArray) -> Block:
        """The block of the model, in its frame, with pixels (m, 2) of the observations."""
        return Block(
            names=tuple(str(row) for row in self.rows),
            cameras=self.cameras,
            camera_of=self.camera_of,
            cam_from_block=self.cam_from_sfm,
            xyz=self.xyz,
            point_of=self.point_of,
            photo_of=self.photo_of,
            xy=xy,
        )

    def track_lengths(self) -> NDArray[np.int64]:
        """Number of observations (n,) of each point."""
        return np.bincount(self.point_of, minlength=len(self.xyz))


def verify_pair(
    camera_a: Camera,
    xy_a: NDArray[np.float32],
    camera_b: Camera,
    xy_b: NDArray[np.float32],
    matches: NDArray[np.uint32],
    *,
    focal_known: bool,
    max_error_px: float,
    least_inliers: int = 15,
    seed: int,
) -> TwoView:
    """Two-view geometry of putative matches (m, 2) by COLMAP's LO-RANSAC, with a fixed seed.

    Args:
        focal_known: both cameras have a focal length to be trusted, so an essential matrix is tried.
        least_inliers: with fewer there is no geometry; COLMAP's 15.
    """
    geometry = pycolmap.TwoViewGeometry()
    if len(matches) >= 8:  # the fundamental matrix needs eight
        options = pycolmap.TwoViewGeometryOptions()
        options.min_num_inliers = least_inliers
        options.ransac.max_error = max_error_px
        options.ransac.random_seed = seed
        a, b = camera_a.to_pycolmap(1), camera_b.to_pycolmap(2)
        a.has_prior_focal_length = b.has_prior_focal_length = focal_known
        geometry = pycolmap.estimate_two_view_geometry(
            a, xy_a.astype(np.float64), b, xy_b.astype(np.float64), matches, options
        )
    return TwoView(
        inliers=np.asarray(geometry.inlier_matches, dtype=np.uint32).reshape(-1, 2),
        config=np.array(int(geometry.config), dtype=np.int64),
        essential=_matrix(geometry.E),
        fundamental=_matrix(geometry.F),
        homography=_matrix(geometry.H),
    )


def write_database(
    path: Path,
    cameras: Sequence[tuple[Camera, bool]],
    photos: Sequence[SfmPhoto],
    geometries: Mapping[tuple[int, int], TwoView],
) -> None:
    """A COLMAP database of photos (ids are rows + 1), each a frame of its camera's trivial rig.

    Args:
        cameras: with whether the focal length is known beforehand.
        geometries: of pairs of rows.
    """
    with pycolmap.Database.open(str(path)) as database, pycolmap.DatabaseTransaction(database):
        for row, (camera, focal_known) in enumerate(cameras):
            _write_camera(database, row + 1, camera, focal_known)
        for row, photo in enumerate(photos):
            _write_photo(database, row + 1, photo)
        for (i, j), view in sorted(geometries.items()):
            database.write_matches(i + 1, j + 1, view.inliers)
            database.write_two_view_geometry(i + 1, j + 1, _geometry(view))


def _write_camera(database: Any, camera_id: int, camera: Camera, focal_known: bool) -> None:
    stored = camera.to_pycolmap(camera_id)
    stored.has_prior_focal_length = focal_known
    database.write_camera(stored, use_camera_id=True)
    rig = pycolmap.Rig(rig_id=camera_id)
    rig.add_ref_sensor(stored.sensor_id)
    database.write_rig(rig, use_rig_id=True)


def _write_photo(database: Any, image_id: int, photo: SfmPhoto) -> None:
    image = pycolmap.Image(name=photo.name, camera_id=photo.camera_row + 1, image_id=image_id)
    database.write_image(image, use_image_id=True)
    frame = pycolmap.Frame(frame_id=image_id, rig_id=photo.camera_row + 1)
    frame.add_data_id(image.data_id)
    database.write_frame(frame, use_frame_id=True)
    database.write_keypoints(image_id, photo.keypoints)


def run_incremental(
    database: Path, images: Path, output: Path, settings: Mapping[str, Any]
) -> frozenset[int]:
    """COLMAP's incremental mapping; models land in numbered folders of `output`.

    Args:
        settings: of pycolmap.IncrementalPipelineOptions, nested by dots ("mapper.filter_max_reproj_error").

    Returns:
        Rows of the photos that are registered in models of at least the settings' size.
    """
    options = pycolmap.IncrementalPipelineOptions()
    for name, value in settings.items():
        *parents, last = name.split(".")
        target = options
        for parent in parents:
            target = getattr(target, parent)
        setattr(target, last, value)
    with quiet():
        models = pycolmap.incremental_mapping(str(database), str(images), str(output), options)
    large = [m.reg_image_ids() for m in models.values() if m.num_reg_images() >= options.min_model_size]
    return frozenset(image_id - 1 for ids in large for image_id in ids)


@contextmanager
def quiet() -> Iterator[None]:
    """COLMAP narrates every image on stderr; only its errors are of use to a person."""
    before = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = int(pycolmap.logging.Level.ERROR)
    try:
        yield
    finally:
        pycolmap.logging.minloglevel = before


def posed(cameras: Sequence[Camera], photos: Sequence[SfmPhoto], poses: Mapping[int, Rigid3]) -> Any:
    """A pycolmap.Reconstruction of posed photos without points; ids are rows + 1.

    Args:
        cameras: by the photos' camera_row.
        poses: cam_from_sfm by row of the photos.
    """
    reconstruction = pycolmap.Reconstruction()
    for row in sorted({photos[i].camera_row for i in poses}):
        reconstruction.add_camera_with_trivial_rig(cameras[row].to_pycolmap(row + 1))
    for row, pose in sorted(poses.items()):
        photo = photos[row]
        image = pycolmap.Image(name=photo.name, camera_id=photo.camera_row + 1, image_id=row + 1)
        reconstruction.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pose.matrix()[:3]))
    return reconstruction


def triangulation_settings() -> Any:
    """What all triangulation of posed photos has in common."""
    settings = pycolmap.IncrementalPipelineOptions()
    settings.extract_colors = False
    settings.triangulation.ignore_two_view_tracks = False
    settings.num_threads = 1
    settings.random_seed = 0
    return settings


def read_models(output: Path) -> list[Model]:
    """The models of a finished mapping, largest first, ties by first photo, without those with no lens."""
    models = []
    for folder in sorted(f for f in output.iterdir() if f.is_dir()):
        try:
            models.append(read_model(folder))
        except InvalidValueError as error:
            _LOG.warning("%s is left out: %s", folder, error)
    return sorted(models, key=lambda m: (-len(m.rows), m.rows.tolist()))


def read_model(folder: Path) -> Model:
    """One model folder in COLMAP's binary format."""
    return model_of(pycolmap.Reconstruction(str(folder)))


def model_of(reconstruction: Any) -> Model:
    """The registered images and the points of a pycolmap.Reconstruction; see `without_impossible`.

    Raises:
        InvalidValueError: a lens that maps do not have.
    """
    return without_impossible(whole_model_of(reconstruction))


def whole_model_of(reconstruction: Any) -> Model:
    """The same with every observation; points in the order of their ids.

    Raises:
        InvalidValueError: a lens that maps do not have.
    """
    image_ids = sorted(reconstruction.reg_image_ids())
    camera_ids = sorted({reconstruction.image(i).camera_id for i in image_ids})
    points = [reconstruction.point3D(point_id) for point_id in sorted(reconstruction.point3D_ids())]
    tracks = [point.track.elements for point in points]
    point_of = np.repeat(np.arange(len(points)), [len(track) for track in tracks])
    seen_by = np.array([element.image_id for track in tracks for element in track], dtype=np.int64)
    photo_of = np.searchsorted(image_ids, seen_by)
    keypoint_of = np.array([element.point2D_idx for track in tracks for element in track], dtype=np.int64)
    order = np.lexsort((keypoint_of, photo_of, point_of))
    return Model(
        cameras=tuple(Camera.from_pycolmap(reconstruction.camera(c)) for c in camera_ids),
        rows=np.array(image_ids, dtype=np.int64) - 1,
        camera_of=np.array([camera_ids.index(reconstruction.image(i).camera_id) for i in image_ids]),
        cam_from_sfm=tuple(_pose(reconstruction.image(i).cam_from_world()) for i in image_ids),
        xyz=np.array([point.xyz for point in points], dtype=np.float64).reshape(-1, 3),
        point_of=point_of[order],
        photo_of=photo_of[order],
        keypoint_of=keypoint_of[order],
    )


def without_impossible(model: Model) -> Model:
    """The model without observations of points that their camera cannot see, and points then seen once.

    COLMAP keeps observations past the angle where a lens's distortion turns back. There is no pixel to
    compare them with, and one of them would make all covariances of the map NaN.
    """
    seen = np.zeros(len(model.point_of), dtype=bool)
    for photo, (camera, pose) in enumerate(zip(model.camera_of.tolist(), model.cam_from_sfm, strict=True)):
        rows = np.flatnonzero(model.photo_of == photo)
        pixels = model.cameras[camera].project(pose.act(model.xyz[model.point_of[rows]]))
        seen[rows] = np.isfinite(pixels).all(axis=1)
    if seen.all():
        return model
    seen &= np.bincount(model.point_of[seen], minlength=len(model.xyz))[model.point_of] >= 2
    _LOG.warning("%d of %d observations are of points that their camera cannot see", (~seen).sum(), len(seen))
    return with_observations(model, seen)


def with_observations(model: Model, observation: NDArray[np.bool_]) -> Model:
    """The model with the chosen observations (m,) and the points that they see."""
    points, point_of = np.unique(model.point_of[observation], return_inverse=True)
    return replace(
        model,
        xyz=model.xyz[points],
        point_of=point_of.reshape(-1),
        photo_of=model.photo_of[observation],
        keypoint_of=model.keypoint_of[observation],
    )


def _pose(rigid: Any) -> Rigid3:
    return Rigid3.from_matrix(np.asarray(rigid.matrix()))


def _matrix(value: Any) -> FloatArray:
    return np.zeros((3, 3)) if value is None else np.asarray(value, dtype=np.float64)


def _geometry(view: TwoView) -> Any:
    geometry = pycolmap.TwoViewGeometry()
    geometry.config = int(view.config)
    geometry.inlier_matches = view.inliers
    for name, value in (("E", view.essential), ("F", view.fundamental), ("H", view.homography)):
        if value.any():
            setattr(geometry, name, value)
    return geometry
