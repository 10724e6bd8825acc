"""The photos of the planar map as files, and the map that names them by their bytes."""

from dataclasses import replace
from pathlib import Path

from PIL import Image

from featuredb.atomic import file_sha256
from featuredb.maps.feature_map import FeatureMap
from tests.support import planar_map as field


def with_photos(feature_map: FeatureMap, folder: Path) -> FeatureMap:
    """Write what each image of a planar map was made of to `folder`, under its name, without loss."""
    texture = field.field_texture(1)
    images = []
    for k, image in enumerate(feature_map.images):
        Image.fromarray(field.render(texture, image.cam_from_local, seed=k)).save(folder / image.name)
        sha256 = file_sha256(folder / image.name)
        images.append(replace(image, sha256=sha256, owner="Ann", licence="CC-BY-4.0"))
    return replace(feature_map, images=tuple(images), camera_keys=("maker|model",))
