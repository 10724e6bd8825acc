"""COLMAP: a folder for each map with the model, the database and the place on Earth."""

from functools import partial
from pathlib import Path

from featuredb.export.attribution import attribution_of, write_attribution
from featuredb.export.formats.colmap_model import (
    image_names,
    keypoint_rows,
    reconstruction_of,
    write_colmap_database,
)
from featuredb.export.georeference import GEOREFERENCE, georeference_text
from featuredb.export.job import Exported, ExportJob
from featuredb.export.tally import folder_for_each
from featuredb.maps.unplaced_map import AnyMap

MODEL_FOLDER = "sparse"
DATABASE = "database.db"


def write_colmap(job: ExportJob, *, text: bool = False) -> Exported:
    """Write every selected map to `job.out`/<map>: sparse/, database.db, georeference.json, attribution.csv.

    Args:
        text: the model as COLMAP's text files instead of binary ones.

    Raises:
        ExportError: nothing is selected, or there is something at `job.out`.
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
    (folder / GEOREFERENCE).write_text(georeference_text(feature_map, names), encoding="utf-8")
    write_attribution(folder, attribution_of(feature_map))
