"""What is true of a simulated world, as values and as the file truth.json."""

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from featuredb.errors import InvalidValueError
from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.arrays import FloatArray, freeze
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.simworld.camera.shot import Shot
from featuredb.simworld.town.scene import Scene

TRUTH_FILE = "truth.json"
_VERSION = 1


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TrueImage:
    """One photo's truth.

    Attributes:
        name: path within the world's folder, with forward slashes.
        camera: true intrinsics.
        cam_from_local: true pose, local ENU frame to camera, metres.
        utm: (3,) easting, northing, ellipsoidal height of the camera centre, metres.
        gps_error_m: (3,) east, north, up: what the EXIF position is off by, None without GPS.
    """

    name: str
    camera: Camera
    cam_from_local: Rigid3
    utm: FloatArray
    gps_error_m: FloatArray | None

    def __post_init__(self) -> None:
        freeze(self, utm=(3,))
        if self.gps_error_m is not None:
            freeze(self, gps_error_m=(3,))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Truth:
    """The truth of a world.

    Attributes:
        seed: of the world. epsg: UTM zone of `TrueImage.utm`; heights are ellipsoidal.
        frame: local frame of the poses.
        images: every photo of the town by name; negatives have no truth, since they have no place.
    """

    seed: int
    epsg: int
    frame: LocalFrame
    images: dict[str, TrueImage]

    def group(self, folder: str) -> list[TrueImage]:
        """Images of one folder (drone, queries, street), by name."""
        return [self.images[name] for name in sorted(self.images) if name.startswith(f"{folder}/")]


def true_image(scene: Scene, shot: Shot) -> TrueImage:
    """The truth of a planned photo."""
    center = shot.cam_from_local.center
    return TrueImage(
        name=shot.name,
        camera=shot.device.camera,
        cam_from_local=shot.cam_from_local,
        utm=scene.frame.utm_from_enu(center, scene.epsg),
        gps_error_m=None if shot.gps_enu is None else shot.gps_enu - center,
    )


def write_truth(folder: Path, truth: Truth) -> None:
    """Write folder/truth.json; floats are written so that they read back exactly."""
    images = [_image_json(truth.images[name]) for name in sorted(truth.images)]
    document = {
        "version": _VERSION,
        "seed": truth.seed,
        "epsg": truth.epsg,
        "height_datum": "WGS84 ellipsoid",
        "frame": asdict(truth.frame),
        "images": images,
    }
    (folder / TRUTH_FILE).write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")


def read_truth(folder: Path) -> Truth:
    """Read folder/truth.json.

    Raises:
        InvalidValueError: no such file, or not one that this version wrote.
    """
    path = Path(folder) / TRUTH_FILE
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
        if document["version"] != _VERSION:
            raise InvalidValueError(f"{path}: expected version {_VERSION}, found {document['version']}")
        images = [_image_value(entry) for entry in document["images"]]
        return Truth(
            seed=document["seed"],
            epsg=document["epsg"],
            frame=LocalFrame(**document["frame"]),
            images={image.name: image for image in images},
        )
    except (OSError, json.JSONDecodeError, KeyError, TypeError) as error:
        raise InvalidValueError(
            f"{path}: expected the truth of a simulated world, found {error!r}; "
            "make one with featuredb simworld"
        ) from error


def _image_json(image: TrueImage) -> dict[str, Any]:
    return {
        "name": image.name,
        "camera": asdict(image.camera),
        "cam_from_local": {
            "quaternion_xyzw": image.cam_from_local.quaternion_xyzw.tolist(),
            "translation_m": image.cam_from_local.translation.tolist(),
        },
        "utm": image.utm.tolist(),
        "gps_error_m": None if image.gps_error_m is None else image.gps_error_m.tolist(),
    }


def _image_value(entry: dict[str, Any]) -> TrueImage:
    camera, pose, error = entry["camera"], entry["cam_from_local"], entry["gps_error_m"]
    return TrueImage(
        name=entry["name"],
        camera=Camera(**{**camera, "params": tuple(camera["params"])}),
        cam_from_local=Rigid3.from_quaternion(pose["quaternion_xyzw"], pose["translation_m"]),
        utm=np.asarray(entry["utm"]),
        gps_error_m=None if error is None else np.asarray(error),
    )
