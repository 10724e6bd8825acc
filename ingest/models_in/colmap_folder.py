"""A COLMAP model on disk, as arrays: poses, points and keypoints, whatever version wrote it."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap

from featuredb.errors import IngestError, InvalidValueError
from ingest.colmap.bridge import Model, model_of
from ingest.models_in.colmap_whole import check_whole
from ingest.models_in.stored import StoredModel


def model_folder(folder: Path) -> Path:
    """Where the model lies: in the folder, its `sparse` or `sparse/0`.

    Raises:
        IngestError: nowhere there.
    """
    for place in (folder, folder / "sparse", folder / "sparse" / "0"):
        if any((place / f"cameras{ending}").is_file() for ending in (".bin", ".txt")):
            return place
    raise IngestError(
        f"{folder}: expected a COLMAP model (cameras, images and points3D, .bin or .txt), found none there "
        "nor in sparse or sparse/0"
    )


def read_colmap(folder: Path) -> StoredModel:
    """The model in one of the places of `model_folder`.

    Raises:
        IngestError: there is none, it is broken, without registered images or points, or has a lens that maps
            do not have.
    """
    place = model_folder(folder)
    check_whole(place)
    try:
        reconstruction = pycolmap.Reconstruction(str(place))
    except (ValueError, RuntimeError, OSError, IndexError, MemoryError) as error:
        raise IngestError(f"{place}: COLMAP cannot read this model: {str(error).strip()}") from error
    image_ids = sorted(reconstruction.reg_image_ids())
    if not image_ids or not reconstruction.num_points3D():
        raise IngestError(
            f"{place}: expected a model with registered images and points, found {len(image_ids)} and "
            f"{reconstruction.num_points3D()}"
        )
    try:
        model = model_of(reconstruction)
    except InvalidValueError as error:
        raise IngestError(f"{place}: {error}; undistort the images to a simpler camera first") from error
    images = [reconstruction.image(i) for i in image_ids]
    point_ids = sorted(reconstruction.point3D_ids())
    return StoredModel(
        model=_numbered(model),
        names=tuple(image.name for image in images),
        camera_ids=tuple(sorted({image.camera_id for image in images})),
        xy=tuple(np.array([p.xy for p in i.points2D], dtype=np.float64).reshape(-1, 2) for i in images),
        rgb=np.array([reconstruction.point3D(i).color for i in point_ids], dtype=np.uint8),
    )


def _numbered(model: Model) -> Model:
    """Rows are those of this model alone: ids of COLMAP may have gaps."""
    return replace(model, rows=np.arange(len(model.rows), dtype=np.int64))
